"""The pieces of a diagnosis on problems with known answers."""

import math

import numpy as np
import pytest

from ctr_dynamics.cli.main import spread
from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.forward_model import at_times, smooth
from ctr_dynamics.diagnosis.inference.candidates import candidates
from ctr_dynamics.diagnosis.inference.gaussian_posterior import posterior
from ctr_dynamics.diagnosis.inference.hypotheses import best_size_nearby
from ctr_dynamics.diagnosis.inference.map_fit import GaussNewton
from ctr_dynamics.diagnosis.verdict.validation import Validation, block_bootstrap
from ctr_dynamics.diagnosis.whitening import Whitener
from ctr_dynamics.effects import EFFECTS, EffectParameter, Quantity, quantities
from ctr_dynamics.kernels.backlash import behind_backlash
from ctr_dynamics.kernels.rotations import multiply_rows, rotate_rows, to_vector_rows
from ctr_dynamics.robot_files import load_robot

OPTIONS = DiagnosisOptions()


def test_posterior_is_bayes_rule():
    """Against the dense formulas of a linear Gaussian model."""
    rng = np.random.default_rng(1)
    J, N = rng.normal(size=(40, 3)), rng.normal(size=(40, 2))
    variance = np.array([0.5, 2.0, 0.01])
    departure = np.array([0.3, -0.2, 0.1])
    y = rng.normal(size=40)  # residual at the departure
    mean, covariance, evidence = posterior(y, J, departure, variance, N)
    data = y + J @ departure
    noise = np.eye(40) + N @ N.T
    precision = np.diag(1 / variance) + J.T @ np.linalg.solve(noise, J)
    np.testing.assert_allclose(covariance, np.linalg.inv(precision), rtol=1e-9)
    np.testing.assert_allclose(
        mean, np.linalg.solve(precision, J.T @ np.linalg.solve(noise, data)), rtol=1e-9
    )
    total = noise + J @ np.diag(variance) @ J.T
    expected = -0.5 * data @ np.linalg.solve(total, data) - 0.5 * np.linalg.slogdet(total)[1]
    assert evidence == pytest.approx(expected, rel=1e-9)


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


def test_backlash_follows_after_the_dead_zone():
    x = np.concatenate([np.linspace(0, 1, 50), np.linspace(1, -1, 100)])
    y = behind_backlash(x, 0.2, x[0])
    assert y[49] == pytest.approx(0.9)
    assert y[55] == pytest.approx(0.9)  # still inside the dead zone of the reversal
    assert y[-1] == pytest.approx(-0.9)


def test_interpolation_is_exact_for_cubics_and_held_outside():
    t = np.arange(20) * 0.003
    values = np.stack([t**3 - t, 2 * t**2], axis=1)
    at = np.array([0.0, 0.0041, 0.02, 0.0559])
    np.testing.assert_allclose(at_times(values, t, at), np.stack([at**3 - at, 2 * at**2], axis=1), atol=1e-14)
    np.testing.assert_allclose(at_times(values, t, np.array([9.0])), values[-1:], atol=1e-14)


def test_joints_are_smooth_between_samples_straight_across_gaps_and_held_outside():
    t = np.concatenate([0.01 * np.arange(6), 0.2 + 0.01 * np.arange(4)])
    values = np.stack([3.0 * t**2 - t, np.cos(40.0 * t)], axis=1)
    at = smooth(t, values, OPTIONS.forward_model.joint_gap_s)
    np.testing.assert_allclose(at(t)[0], values, atol=1e-14)
    inner = np.linspace(0.0101, 0.0399, 50)
    np.testing.assert_allclose(at(inner)[0][:, 0], 3.0 * inner**2 - inner, atol=1e-14)  # parabolas exactly
    times, h = np.linspace(0.001, 0.0489, 400), 1e-7
    numbers = (at(times + h)[0] - at(times - h)[0]) / (2 * h)
    np.testing.assert_allclose(at(times)[1], numbers, atol=2e-3)
    assert (
        np.abs(np.diff(at(times)[1], axis=0)).max() < 2.0 * 40.0**2 * np.diff(times).max()
    )  # no jump at a sample
    gap = np.array([0.08, 0.11, 0.14])
    assert np.ptp(at(gap)[1], axis=0).max() < 1e-12
    value, rate = at(np.array([-1.0, 0.0, 1.0]))
    np.testing.assert_array_equal(value, values[[0, 0, -1]])
    assert not rate.any()


def test_rotations_by_rows():
    h = np.array([[math.cos(0.2), 0.0, 0.0, math.sin(0.2)], [1.0, 0.0, 0.0, 0.0]])
    v = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    np.testing.assert_allclose(
        rotate_rows(h, v), [[math.cos(0.4), math.sin(0.4), 0.0], [0.0, 2.0, 0.0]], atol=1e-15
    )
    np.testing.assert_allclose(
        to_vector_rows(multiply_rows(h, h)), [[0.0, 0.0, 0.8], [0.0, 0.0, 0.0]], atol=1e-15
    )


def test_bootstrap_interval_holds_the_gain():
    rng = np.random.default_rng(3)
    t = np.arange(400) / 40.0
    before, after = rng.chisquare(3, 400), 0.25 * rng.chisquare(3, 400)
    low, high = block_bootstrap(before, after, t, OPTIONS.validation)
    assert low < 1 - after.sum() / before.sum() < high
    assert 0.6 < low < high < 0.85


def test_every_effect_of_the_catalogue_is_a_candidate():
    robot = load_robot("till2020_tissue")
    positions = np.random.default_rng(4).normal(size=(100, 3)) * 0.02
    found = {c.effect for c in candidates(quantities(robot), positions)}
    assert found == {name for name, effect in EFFECTS.items() if not effect.nuisance}


def test_validate_takes_every_bag_up_to_the_next_option():
    given = ["diagnose", "a", "--validate", "b", "c", "--robot", "r", "--validate", "d", "--json"]
    assert spread(given, ("--validate",)) == [
        "diagnose", "a", "--validate", "b", "--validate", "c", "--robot", "r", "--validate", "d", "--json",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("before", "after", "confirmed"),
    [
        (30.0, 1.02, True),
        (30.0, 1.2, False),
        (1.26, 1.13, False),
        (1.26, 1.03, True),
        (1.0, 0.99, True),
        (0.99, 1.05, False),
    ],
)
def test_a_validation_confirms_what_removes_most_of_a_visible_misfit(before, after, confirmed):
    assert Validation(1e-3, 1e-3, 0.0, (0.0, 0.0), before, after).confirms(OPTIONS.validation) is confirmed


def quantity(name, low=-math.inf, high=math.inf, *, tolerance=0.0, scale=1.0, off=0.0):
    """A coordinate of no effect of the catalogue."""
    return Quantity("made_up", name, off, tolerance, scale, low, high, EffectParameter(name, "1", off, scale))


class Vibration:
    """A problem whose prediction is a decaying vibration; ``reach`` as in the real one, no numerics."""

    reach, options = 2.0, OPTIONS

    def __init__(self, truth, nuisances=()):
        self.t = np.linspace(0.0, 14.0, 500)
        self.truth, self.nuisances, self.numerics = truth, nuisances, np.zeros((500, 0))
        self.steps = []

    def with_step(self, dt):
        self.steps.append(dt)
        return self

    def predicted(self, point):
        f = 5.0 * (1.0 + point.get(("made_up", "frequency"), 0.0))
        return 40.0 * np.exp(-self.t) * np.cos(2 * math.pi * f * self.t)

    def residual(self, point):
        return self.predicted(self.truth) - self.predicted(point)


def test_a_size_is_looked_for_beyond_the_reach_of_its_column():
    """Half a turn of phase has run away before the vibration has decayed."""
    frequency = quantity("frequency")
    problem = Vibration({frequency.key: 0.4})
    found = best_size_nearby(problem, {frequency.key: 0.3}, frequency)
    assert found[frequency.key] == pytest.approx(0.4, abs=0.003)
    assert problem.steps == [OPTIONS.screening.finite_size_dt_s]


def test_steps_are_the_best_inside_the_bounds():
    rng = np.random.default_rng(3)
    names = ("a", "b", "c", "d")
    nuisances = tuple(quantity(n, tolerance=0.5) for n in names)
    cause = quantity("size", low=0.0, scale=2.0)
    descent = GaussNewton(Vibration({}, nuisances), (cause,), {})
    descent.columns, descent.residual = rng.normal(size=(500, 5)), 3.0 * rng.normal(size=500)
    descent.residual += descent.columns @ np.array([4.0, -3.0, 0.2, 0.1, -1.0])  # beyond the bounds of three
    descent.cost = descent.cost_at(descent.residual, descent.values)
    step = descent.step()
    assert np.all(step >= descent.low - descent.values)
    assert np.all(step <= descent.high - descent.values)
    assert sum(np.isclose(step, (1.0, -1.0, 9.0, 9.0, 0.0))) == 3
    best = descent.promise(step)
    for _ in range(200):
        other = np.clip(step + rng.normal(scale=0.1, size=5), descent.low, descent.high)
        assert descent.promise(other) <= best + 1e-9
    sizes = [np.linalg.norm(descent.step(damping)) for damping in (0.0, 1e3, 1e5)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 0.1 * sizes[0]
    assert descent.promise(descent.step(1e5)) > 0.0
