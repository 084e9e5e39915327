"""A tracker whose frame moves, found in how well that foretells measurements."""

from dataclasses import replace

import numpy as np
import pytest
from estimation_cases import bag_messages, check_outputs, play, truth_error
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal
from test_model_error_search import AT_REST, NONE, WELL, moving, search, wandering

from ctr_dynamics.kernels.motion_regression import correct_motions

BEGIN = 200  # measurement, 5 s after the first
BADLY = (-7.0, -7.0)  # as a filter foretells that follows a tracker astray


def drifting(velocity, turn, count=400, end=10_000):
    """Departures (count, 3) m of a frame that moves by ``velocity`` (m/s) and ``turn`` (rad/s) from ``BEGIN`` on until ``end``."""
    t = 0.025 * np.maximum(np.minimum(np.arange(count), end) - BEGIN, 0)
    turned = Rotation.from_rotvec(t[:, None] * np.asarray(turn))
    tips = np.array([moving(k) for k in range(count)])
    return turned.apply(tips) - tips + t[:, None] * np.asarray(velocity)


def told(k):
    """What the filter foretells."""
    return (WELL, WELL) if k < BEGIN else BADLY


def fed(departures):
    """A search that has met all of them."""
    found = search(departures[:BEGIN], predictive=(WELL, WELL))
    rng = np.random.default_rng(7)
    for k in range(BEGIN, len(departures)):
        residual = departures[k] + 3e-4 * rng.standard_normal(3)
        found.add(25_000_000 * k, moving(k) + residual, residual, *AT_REST, np.zeros(3), told(k))
    return found


@pytest.mark.parametrize(
    ("velocity", "turn"),
    [((2e-3, 0.0, -1e-3), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.1)), ((0.0, 0.02, 0.0), (0.05, 0.0, 0.0))],
)  # fmt: skip
def test_a_frame_that_moves_is_found_with_its_rates(velocity, turn):
    frame = fed(drifting(velocity, turn, 280)).frame
    assert frame.moves(False)
    assert frame.probability > 0.9
    found = [frame.rates(moving(k))[0] for k in (240, 270)]
    true = [np.asarray(velocity) + np.cross(turn, moving(k)) for k in (240, 270)]
    np.testing.assert_allclose(found, true, atol=4e-4 + 0.05 * np.linalg.norm(true))


def test_it_is_not_taken_for_an_error_of_the_model():
    assert fed(drifting((1.5e-3, 0.0, 0.0), (0.0, 0.0, 0.0))).found(NONE) is None


def test_it_is_believed_after_a_second_and_likely_before():
    departures = drifting((5e-3, 0.0, 0.0), (0.0, 0.0, 0.0))
    early, late = (fed(departures[: BEGIN + count]).frame for count in (30, 60))
    assert early.probability > 0.9
    assert not early.moves(False)
    assert late.moves(False)


def test_a_frame_that_stands_still_again_does_not_move():
    """And what it has left is no error of the model."""
    moved = fed(drifting((5e-3, 0.0, 0.0), (0.0, 0.0, 0.0), end=BEGIN + 80))
    assert not moved.frame.moves(True)
    assert moved.found(NONE) is None


@pytest.mark.parametrize("departures", [
    np.zeros((400, 3)),
    np.full((400, 3), 2e-3),
    np.repeat(np.where(np.arange(400) < 300, 0.0, 0.01)[:, None], 3, axis=1),  # a tracker that was moved at once
    wandering(2e-3, 0.3, 400),
    3e-3 * np.sin(0.025 * 35.0 * np.arange(400))[:, None] * np.array([1.0, 0.0, 0.5]),
])  # fmt: skip
def test_what_does_not_grow_steadily_is_no_moving_frame(departures):
    rng = np.random.default_rng(5)
    found = search(departures[:BEGIN], predictive=(WELL, WELL))
    for k in range(BEGIN, len(departures)):
        residual = departures[k] + 3e-4 * rng.standard_normal(3)
        found.add(25_000_000 * k, moving(k) + residual, residual, *AT_REST, np.zeros(3), (-4.0, -4.0))
        assert not found.frame.moves(False)


@pytest.mark.parametrize("period_s", [6.0, 15.0])
def test_a_model_that_errs_by_where_its_tubes_are_is_no_moving_frame(period_s):
    """Its departure is smooth, and goes on in a direction for seconds, as on a real robot that is not calibrated (10 Hz, 60 s)."""
    rng = np.random.default_rng(9)
    t = 0.1 * np.arange(600)
    phases, sizes = rng.uniform(0.0, 2.0 * np.pi, (3, 3)), np.array([4e-3, 2e-3, 1e-3])
    speeds = 2.0 * np.pi / period_s * np.array([1.0, 1.7, 2.9])
    departures = (sizes * np.sin(t[:, None, None] * speeds + phases)).sum(axis=2)
    found = search(departures[:0])
    believed = 0
    for k, departure in enumerate(departures):
        residual = departure + 3e-4 * rng.standard_normal(3)
        found.add(100_000_000 * k, moving(4 * k) + residual, residual, *AT_REST, np.zeros(3), (-8.0, -8.0))
        believed += found.frame.moves(False)
    assert believed == 0


def test_measurements_that_are_taken_again_count_once():
    departures = drifting((2e-3, 0.0, 0.0), (0.0, 0.0, 0.0), 260)
    once, again = fed(departures), fed(departures)
    rng = np.random.default_rng(7)
    for k in range(BEGIN, 260):
        residual = departures[k] + 3e-4 * rng.standard_normal(3)
        if k >= 220:
            again.add(25_000_000 * k, moving(k) + residual, residual, *AT_REST, np.zeros(3), told(k))
    assert again.frame.moving == pytest.approx(once.frame.moving, abs=1e-9)


def against_truth(run):
    """Errors of the fused tip and their stated deviations (k,) m, 3-D, from 0.5 s of `clean_sweep` on, and these steps."""
    left, steps = truth_error(run, "clean_sweep", "p_trk", since=0.5)
    covariance = run.column("tip_covariance")[steps, :3, :3]
    return np.linalg.norm(left, axis=1), np.sqrt(np.trace(covariance, axis1=1, axis2=2)), steps


def test_the_estimate_does_not_follow_a_frame_that_moves():
    """Slowly enough that no measurement is unlikely; the pose stays where the model has it, or the covariance says how far it is off."""
    messages = []
    for m in bag_messages("clean_sweep", 7.0):
        if m.kind == "pose" and (late := m.stamp * 1e-9 - 2.0) > 0.0:
            position, *rest = m.content
            m = replace(m, content=(tuple(np.add(position, (0.0, 1.5e-3 * late, 0.0))), *rest))
        messages.append(m)
    run = play(messages)
    check_outputs(run)
    assert "moving frame" in run.estimator.health.tracker
    error, deviation, steps = against_truth(run)
    assert np.all((error < 3e-3) | (error < 3.0 * deviation))
    assert error[run.t[steps] > 5.5].max() < 2e-3


def test_a_frame_that_turns_is_no_latency():
    """Fast enough that the filter cannot follow: a turn looks like a latency that grows, and its poses must not be fused with one."""
    axis, messages = np.array([-0.130, -0.398, -0.908]), []
    for m in bag_messages("clean_sweep", 8.0):
        if m.kind == "pose" and (since := m.stamp * 1e-9 - 3.8) > 0.0:
            position, *rest = m.content
            turned = Rotation.from_rotvec(0.2 * since * axis).apply(position)
            m = replace(m, content=(tuple(turned), *rest))
        messages.append(m)
    run = play(messages)
    assert "moving frame" in run.estimator.health.tracker
    assert "latency" not in run.estimator.health.tracker
    error, deviation, steps = against_truth(run)
    valid = np.array([out.valid for out in run.outputs])[steps]
    assert np.all((error < 3e-3) | (error < 3.0 * deviation) | ~valid)


def test_the_kernel_is_the_update_of_a_kalman_filter():
    """Against NumPy, in the words of the textbook."""
    rng = np.random.default_rng(3)
    mean, factor = rng.standard_normal((4, 9)), rng.standard_normal((4, 9, 9))
    covariance = factor @ factor.transpose(0, 2, 1)
    since, arm, residual, noise = rng.random(4), rng.standard_normal((4, 3)), rng.standard_normal(3), 0.3
    found_mean, found_covariance, density = mean.copy(), covariance.copy(), np.empty(4)
    correct_motions(found_mean, found_covariance, since, arm, residual, noise, density)
    for m, P, tau, a, new_mean, new_covariance, d in zip(
        mean, covariance, since, arm, found_mean, found_covariance, density, strict=True
    ):
        turned = np.array([np.cross(e, a) for e in np.eye(3)]).T  # turn rate x arm
        H = np.hstack([np.eye(3), tau * np.eye(3), tau * turned])
        S = H @ P @ H.T + noise * np.eye(3)
        K, innovation = P @ H.T @ np.linalg.inv(S), residual - H @ m
        np.testing.assert_allclose(new_mean, m + K @ innovation)
        np.testing.assert_allclose(new_covariance, P - K @ S @ K.T, atol=1e-12)
        by_noise = multivariate_normal(np.zeros(3), noise * np.eye(3)).logpdf(np.zeros(3))
        assert d == pytest.approx(multivariate_normal(H @ m, S).logpdf(residual) - by_noise)
