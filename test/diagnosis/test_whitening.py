"""The whitened residual has unit noise."""

import math
import tracemalloc

import numpy as np
import pytest

from ctr_dynamics.diagnosis.whitening import Whitener
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict


def test_whitener_gives_unit_noise():
    robot = load_robot("till2020_tissue")
    noise = robot.tracker.noise
    t = np.arange(400) / 40.0
    rng = np.random.default_rng(2)
    drift = np.zeros((400, 3))
    drift[0] = noise.drift.value * rng.normal(size=3)
    keep = math.exp(-1 / (40.0 * noise.drift_time.value))
    for k in range(1, 400):
        drift[k] = keep * drift[k - 1] + noise.drift.value * math.sqrt(1 - keep**2) * rng.normal(size=3)
    values = np.hstack(
        [
            drift + noise.position.value * rng.normal(size=(400, 3)),
            noise.rotation.value * rng.normal(size=(400, 3)),
        ]
    )
    whiten = Whitener(robot, t, np.ones(6, bool), np.ones(400, bool))
    white = whiten(values)
    assert white.size == whiten.size == 2400
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.1)
    assert abs(float(white[1:400] @ white[:399])) / 400 < 0.15
    # derivatives go the same way as values
    np.testing.assert_allclose(whiten(values[:, :, None])[:, 0], white)


@pytest.fixture(params=[0.0, 3e-4])
def uneven(request):
    """A whitener of uneven stamps with a gap, the covariance of its positions, and what it whitens; drift 0 and as large as the noise."""
    data = robot_to_dict(load_robot("till2020_tissue"))
    data["tracker"]["noise"]["drift"] = {"value": request.param, "unit": "m"}
    robot = robot_from_dict(data)
    noise, rng = robot.tracker.noise, np.random.default_rng(3)
    stamps = np.cumsum(rng.uniform(0.005, 0.05, 300)) + 5.0 * (np.arange(300) > 170)
    used = rng.random(300) > 0.1
    t = stamps[used]
    covariance = noise.drift.value**2 * np.exp(-np.abs(t[:, None] - t[None]) / noise.drift_time.value)
    covariance += noise.position.value**2 * np.eye(len(t))
    return Whitener(robot, stamps, np.array([True] * 4 + [False] * 2), used), covariance, rng


def test_whitening_is_by_the_cholesky_factor_of_the_covariance(uneven):
    whiten, covariance, rng = uneven
    factor = np.linalg.cholesky(covariance)
    values = rng.normal(size=(300, 6, 3))
    n = len(covariance)
    expected = np.linalg.solve(factor, values[whiten.used, 1])
    np.testing.assert_allclose(
        whiten(values)[n : 2 * n], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max()
    )
    for white in (rng.normal(size=n), rng.normal(size=(n, 4))):
        np.testing.assert_allclose(whiten.positions(white), factor @ white, rtol=1e-9, atol=1e-12)
    process = np.exp(-np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / 9.0)
    half = np.linalg.solve(factor, process)
    found = whiten.covariance(process, position=True)
    np.testing.assert_allclose(
        found, np.linalg.solve(factor, half.T), rtol=1e-7, atol=1e-7 * np.abs(found).max()
    )


def test_half_an_hour_of_poses_needs_no_matrix_of_all_pairs():
    robot = load_robot("till2020_tissue")
    count = 30 * 60 * 40
    tracemalloc.start()
    whiten = Whitener(robot, np.arange(count) / 40.0, np.ones(6, bool), np.ones(count, bool))
    white = whiten(np.random.default_rng(1).normal(size=(count, 6)) * robot.tracker.noise.position.value)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.isfinite(white).all()
    assert peak < 200 * 8 * count


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_any_poses_are_whitened(count):
    robot = load_robot("till2020_tissue")
    used = np.arange(3) < count
    whiten = Whitener(robot, np.arange(3.0), np.ones(6, bool), used)
    assert whiten(np.ones((3, 6))).shape == (6 * count,)


@pytest.mark.parametrize(("first", "end"), [(0, 40), (40, 41), (100, 250), (200, 9000)])
def test_part_of_a_recording_is_whitened_given_what_is_before_it(uneven, first, end):
    whiten, covariance, rng = uneven
    factor = np.linalg.cholesky(covariance)[first:end, first:end]
    part = whiten.part(first, end)
    assert part.used.sum() == len(factor)
    np.testing.assert_array_equal(np.flatnonzero(part.used), np.flatnonzero(whiten.used)[first:end])
    white = rng.normal(size=len(factor))
    np.testing.assert_allclose(part.positions(white), factor @ white, rtol=1e-9, atol=1e-12)
    process = np.eye(len(factor)) + 0.5
    half = np.linalg.solve(factor, process)
    found = part.covariance(process, position=True)
    np.testing.assert_allclose(
        found, np.linalg.solve(factor, half.T), rtol=1e-7, atol=1e-7 * np.abs(found).max()
    )
