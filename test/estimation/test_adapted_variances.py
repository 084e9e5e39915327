"""Sizes of tip force, tracker shift and tracker noise, against a scalar filter run with every size and against dense matrices."""

import math

import numpy as np
import pytest

from ctr_dynamics.estimation.filter.adapted_variances import (
    FORCE_PART,
    LARGEST,
    SHIFT_PART,
    AdaptationOptions,
    AdaptedVariances,
    Constants,
    ForceRange,
)
from ctr_dynamics.kernels.variance_likelihood import (
    DensityBuffers,
    densities,
    new_randomness,
    position_density,
    pull_to_zero,
    quadratic_forms,
)
from ctr_dynamics.sensing.tracker import SHIFT, STATES

NEVER = AdaptationOptions(sound_s=1e30)  # faults of the tracker are ruled out


def force_alone(least, most, change_s):
    """The force alone, beside a tracker without faults."""
    return AdaptedVariances(ForceRange(least, most, change_s), 1.0, 100.0, NEVER)


DECAY, NOISE = 0.8, 1.0  # of the force from one measurement to the next; variance of a measurement


class Scalar:
    """A filter of a force f (AR(1)) read directly, beside a constant offset b that is certain to 0.3: states (f, b)."""

    def __init__(self, force, learning=True):
        self.force, self.learning = force, learning
        self.pi = np.diag([force.sigma**2, 0.09])
        force.start(self.pi, slice(0, 1))
        self.x, self.t = np.zeros(2), 0.0
        self.H = np.ones((1, 2))

    def step(self, measurement):
        A = np.diag([DECAY, 1.0])
        self.x, self.t = A @ self.x, self.t + 0.025
        self.pi = A @ self.pi @ A.T
        self.force.decay(slice(0, 1), DECAY)
        fresh = (1.0 - DECAY**2) * self.force.sigma**2
        self.pi[0, 0] += fresh
        self.force.parts[FORCE_PART, 0, 0] += fresh
        nu = np.array([measurement]) - self.H @ self.x
        S = self.H @ self.pi @ self.H.T + NOISE
        if self.learning:
            self.pi = self.pi + self.force.adapt(self.t, nu, self.H, S, NOISE * np.eye(1))
            S = self.H @ self.pi @ self.H.T + NOISE
        K = self.pi @ self.H.T / S
        left = np.eye(2) - K @ self.H
        self.pi = left @ self.pi @ left.T + NOISE * K @ K.T
        self.force.correct(K, self.H, NOISE * np.eye(1))
        self.x = self.x + K @ nu
        return K


def measurements(rng, size, count):
    value = 0.0
    for _ in range(count):
        value = DECAY * value + math.sqrt(1 - DECAY**2) * size * rng.standard_normal()
        yield value + 0.3 + math.sqrt(NOISE) * rng.standard_normal()


def test_the_covariance_is_affine_in_the_variance_for_the_gains_that_were_used():
    force = force_alone(0.5, 0.5, 10.0)
    scalar = Scalar(force, learning=False)
    c = 7.3
    other = np.diag([c * 0.25, 0.09])  # covariance of the same estimates, had the force c times the variance
    for measurement in measurements(np.random.default_rng(1), 0.5, 40):
        A = np.diag([DECAY, 1.0])
        other = A @ other @ A.T
        other[0, 0] += (1.0 - DECAY**2) * c * 0.25
        K = scalar.step(measurement)
        left = np.eye(2) - K @ scalar.H
        other = left @ other @ left.T + NOISE * K @ K.T
    np.testing.assert_allclose(scalar.pi + (c - 1.0) * force.parts[FORCE_PART], other, rtol=1e-10)


@pytest.mark.parametrize("size", [3.0, 30.0])
def test_a_force_is_found_within_a_second_and_its_size_afterwards(size):
    force = force_alone(0.01, 100.0, 20.0)
    scalar = Scalar(force)
    rng = np.random.default_rng(7)
    found = []
    for measurement in measurements(rng, size, 400):
        scalar.step(measurement)
        found.append(force.sigma)
    assert max(found[:40]) > 0.3 * size
    assert 0.6 * size < np.median(found[100:]) < 1.6 * size
    for measurement in measurements(rng, 0.0, 1200):
        scalar.step(measurement)
    assert force.sigma < 0.7  # less than what a measurement shows
    assert (
        np.linalg.eigvalsh(scalar.pi - force.parts[FORCE_PART])[0] > -1e-12
    )  # what the force does not cause is a covariance


def test_without_a_force_its_variance_stays_where_it_does_not_show():
    force = force_alone(0.01, 100.0, 20.0)
    scalar = Scalar(force)
    fractions = []
    for measurement in measurements(np.random.default_rng(3), 0.0, 800):
        scalar.step(measurement)
        fractions.append(force.fraction)
    assert np.median(fractions) < 0.05
    variances, weights = force.grids[0], force.weights.sum(axis=(1, 2))
    assert weights[variances > 4.0].sum() < 1e-2


def test_the_weights_are_those_of_the_likelihoods():
    rng = np.random.default_rng(5)
    sizes = AdaptedVariances(ForceRange(0.1, 10.0, 20.0), 0.5, 10.0)
    n, k, dt = 5 + STATES, 3, 0.025
    root = rng.normal(size=(n, n))
    pi = root @ root.T
    sizes.start(pi, slice(0, 2))
    H, R = rng.normal(size=(k, n)), np.diag([0.5, 1.0, 2.0])
    weights = sizes.weights
    for t in (0.0, dt):
        sizes.jump(t, pi)
        S, nu = H @ pi @ H.T + sizes.noise * R, 3.0 * rng.normal(size=k)
        parts, present = sizes.parts.copy(), (sizes.sigma**2, sizes.shift**2, sizes.noise)
        more = sizes.adapt(t, nu, H, S, R)
        wanted = np.empty(weights.shape)
        elapsed = t or AdaptationOptions().shortest_interval
        before = weights
        for axis, prior in enumerate(sizes.priors):
            leaves = -np.expm1(-elapsed * sizes._rates[axis])
            change = np.diag(1.0 - leaves) + np.outer(leaves, prior)  # from row to column
            before = np.moveaxis(np.tensordot(before, change, axes=(axis, 0)), -1, axis)
        for index in np.ndindex(weights.shape):
            trial = S.copy()
            for part, grid, value, i in zip(parts, sizes.grids, present, index, strict=True):
                trial += (grid[i] / value - 1.0) * H @ part @ H.T
            trial += (sizes.grids[2][index[2]] - present[2]) * R
            wanted[index] = math.exp(-0.5 * nu @ np.linalg.solve(trial, nu)) / math.sqrt(np.linalg.det(trial))
        weights = wanted * before / (wanted * before).sum()
        np.testing.assert_allclose(sizes.weights, weights, rtol=1e-8, atol=1e-14)
        means = [weights.sum(axis=tuple({0, 1, 2} - {a})) @ sizes.grids[a] for a in range(3)]
        most = AdaptationOptions().largest_change
        assert sizes.sigma**2 == pytest.approx(np.clip(means[0] / present[0], 1 / most, most) * present[0])
        assert sizes.shift**2 == pytest.approx(means[1])
        assert sizes.noise == pytest.approx(means[2])
        changes = sizes.parts - parts
        if sizes.sigma**2 < present[0]:  # the trace of a force that has become less stays
            changes[FORCE_PART] = 0.0
        np.testing.assert_allclose(more, changes.sum(axis=0), rtol=1e-9, atol=1e-12)
        pi = pi + more


def test_the_densities_equal_their_numpy_twin():
    rng = np.random.default_rng(8)
    S, *parts = (root @ root.T for root in rng.normal(size=(4, 6, 6)))
    S, parts, nu = S + np.eye(6), np.array(parts), rng.normal(size=6)
    grids = [rng.uniform(0.0, 5.0, size) for size in (8, 2, 4)]
    grids[0][0] = -1e3  # no covariance
    found = densities(nu, S, parts, tuple(grids), DensityBuffers.of((2, 4, 8), 6))
    assert not found[:, :, 0].any()
    wanted = np.zeros((2, 4, 8))
    for j, m, i in np.ndindex(wanted.shape):
        trial = S + grids[0][i] * parts[0] + grids[1][j] * parts[1] + grids[2][m] * parts[2]
        if i > 0:
            wanted[j, m, i] = math.exp(-0.5 * nu @ np.linalg.solve(trial, nu)) / math.sqrt(
                np.linalg.det(trial)
            )
    np.testing.assert_allclose(found / found.max(), wanted / wanted.max(), rtol=1e-10)
    grids[0][:] = -1e3
    assert densities(nu, S, parts, tuple(grids), DensityBuffers.of((2, 4, 8), 6)) is None


def test_forms_and_new_randomness_equal_their_numpy_twins():
    rng = np.random.default_rng(9)
    D, H = rng.normal(size=(3, 9, 9)), rng.normal(size=(4, 9))
    D, forms = D @ D.transpose(0, 2, 1), np.empty((3, 4, 4))
    quadratic_forms(H, D, forms)
    np.testing.assert_allclose(forms, H @ D @ H.T, rtol=1e-12, atol=1e-12)
    pi, parts = D[0].copy(), D.copy()
    new_randomness(pi, parts, 5, 0.7, (0.25, 0.5))
    jump = np.diag([0.0] * 5 + [0.7] * 3 + [0.0])
    np.testing.assert_allclose(pi, D[0] + jump)
    np.testing.assert_allclose(parts, np.array([D[0], 0.25 * D[1] + jump, 0.5 * D[2]]))


def test_the_density_of_a_position_equals_its_numpy_twin():
    rng = np.random.default_rng(4)
    root, nu = rng.normal(size=(6, 6)), rng.normal(size=6)
    S, R = root @ root.T, np.diag(rng.uniform(0.1, 1.0, 6))
    wanted = -0.5 * (
        nu[:3] @ np.linalg.solve(S[:3, :3], nu[:3])
        + np.linalg.slogdet(S[:3, :3])[1]
        - np.log(R.diagonal()[:3]).sum()
    )
    assert position_density(nu, S, R) == pytest.approx(wanted, rel=1e-12)
    assert position_density(nu, S - 100.0 * np.eye(6), R) == -math.inf


@pytest.mark.parametrize(("distance", "plausible"), [(0.1, True), (30.0, False)])
def test_states_are_pulled_to_zero_where_that_is_plausible(distance, plausible):
    rng = np.random.default_rng(6)
    n, first, noise, most = 9, 4, 0.3, 1e4
    root = rng.normal(size=(n, n))
    pi, x = root @ root.T, rng.normal(size=n)
    x[first : first + 3] *= distance
    V, shift = pi[first : first + 3, first : first + 3], x[first : first + 3]
    against, size = shift @ np.linalg.solve(V, shift), np.linalg.slogdet(V / most)[1]
    assert (against < -size) == plausible
    H = np.eye(n)[first : first + 3]
    K = pi @ H.T @ np.linalg.inv(V + noise * np.eye(3))
    left = np.eye(n) - K @ H
    moved, after, gain = x.copy(), pi.copy(), np.empty((n, 3))
    assert pull_to_zero(after, first, noise, most, moved, gain) == plausible
    if plausible:
        np.testing.assert_allclose(gain, K, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(moved, x - K @ shift, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(after, left @ pi @ left.T + noise * K @ K.T, rtol=1e-9, atol=1e-12)
    else:
        np.testing.assert_array_equal(moved, x)
        np.testing.assert_array_equal(after, pi)


FAULTS = {
    "jump": (lambda i, rng: np.array([5.0, -3.0, 2.0]), "shift"),
    "ramp": (lambda i, rng: 0.5 * i * np.array([1.0, 0.0, 0.0]), "shift"),
    "spikes": (lambda i, rng: rng.normal(size=3) * 10.0 * (rng.random() < 0.5), None),
    "noise": (lambda i, rng: rng.normal(size=3) * 5.0, None),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_the_tracker_moves_nothing_that_is_known(fault):
    """A point that stands still within 0.1, measured with noise 1: the fault is found, and the point stays where it is."""
    beside, kind = FAULTS[fault]
    rng = np.random.default_rng(11)
    sizes = AdaptedVariances(ForceRange(1e-6, 1e-6, 20.0), 1.0, 100.0)
    n = 6 + STATES  # point, a force that does not act, tracker states
    pi, x, H = np.zeros((n, n)), np.zeros(n), np.zeros((3, n))
    pi[:3, :3] = 0.01 * np.eye(3)
    H[:, :3] = H[:, 6 + SHIFT.start :] = np.eye(3)
    sizes.start(pi, slice(3, 6))
    faulty = 0
    for i in range(120):
        z = rng.normal(size=3) + (beside(i - 40, rng) if i >= 40 else 0.0)
        sizes.jump(0.025 * i, pi)
        nu = z - H @ x
        S = H @ pi @ H.T + sizes.noise * np.eye(3)
        pi = pi + sizes.adapt(0.025 * i, nu, H, S, np.eye(3))
        K = pi @ H.T @ np.linalg.inv(H @ pi @ H.T + sizes.noise * np.eye(3))
        x = x + K @ nu
        left = np.eye(n) - K @ H
        pi = left @ pi @ left.T + sizes.noise * K @ K.T
        sizes.correct(K, H, np.eye(3))
        faulty += not sizes.sound
        assert i >= 40 or sizes.sound
    assert faulty > 0
    assert np.abs(x[:3]).max() < 0.3, "the point followed the tracker"
    if kind == "shift":
        assert np.allclose(x[6 + SHIFT.start :], beside(79, rng), atol=1.5)


def test_measurements_of_one_stamp_that_contradict_all_before_leave_a_distribution():
    force = force_alone(1e-3, 100.0, 1e6)
    force.start(np.diag([1e-6]), slice(0, 1))
    for measurement in [0.0] * 400 + [1e4] * 3:
        force.adapt(0.0, np.array([measurement]), np.eye(1), force.parts[FORCE_PART] + NOISE, np.eye(1))
        assert np.all(np.isfinite(force.weights))
        assert 1e-3 <= force.sigma * (1 + 1e-9) <= 101.0
    assert force.sigma > 0.02  # ten times the variance at each


def test_one_size_is_kept():
    force = force_alone(0.2, 0.2, 10.0)
    scalar = Scalar(force)
    for measurement in measurements(np.random.default_rng(2), 50.0, 50):
        scalar.step(measurement)
    assert force.sigma == pytest.approx(0.2)
    assert force.headroom == pytest.approx(1.0)


def test_a_checkpoint_is_what_is_returned_to():
    force = force_alone(0.01, 100.0, 20.0)
    scalar = Scalar(force)
    numbers = list(measurements(np.random.default_rng(4), 5.0, 60))
    for measurement in numbers[:30]:
        scalar.step(measurement)
    stored, pi, x, t = force.checkpoint(), scalar.pi.copy(), scalar.x.copy(), scalar.t
    trajectories = []
    for _ in range(2):
        force.restore(stored)
        scalar.pi, scalar.x, scalar.t = pi.copy(), x.copy(), t
        for measurement in numbers[30:]:
            scalar.step(measurement)
        trajectories.append((force.sigma, force.fraction, *force.weights.ravel(), *force.parts.ravel()))
    assert trajectories[0] == trajectories[1]


def test_new_and_fewer_coefficients_are_those_of_dense_matrices():
    rng = np.random.default_rng(6)
    force = force_alone(0.1, 10.0, 10.0)
    force.parts = np.array([np.cov(rng.normal(size=(6, 20))) for _ in range(3)])
    old = force.parts.copy()
    force.append(4, 3, 0.7)
    index = [0, 1, 2, 3, 7, 8]
    for part, before in zip(force.parts, old, strict=True):
        np.testing.assert_array_equal(part[np.ix_(index, index)], before)
        assert not part[4:7][:, index].any()
    np.testing.assert_array_equal(force.parts[FORCE_PART, 4:7, 4:7], 0.7 * np.eye(3))
    assert not force.parts[FORCE_PART + 1 :, 4:7, 4:7].any()
    projection, before = rng.normal(size=(5, 7)), force.parts.copy()
    force.project(projection)
    whole = np.block([[projection, np.zeros((5, 2))], [np.zeros((2, 7)), np.eye(2)]])
    np.testing.assert_allclose(force.parts, whole @ before @ whole.T, rtol=1e-12, atol=1e-14)


def test_a_force_that_has_ended_stays_in_the_covariance_until_it_is_measured():
    """Innovations say that the force was large and is small now: its variance falls, the covariance does not, before a correction."""
    sizes = AdaptedVariances(ForceRange(0.1, 100.0, 0.1), 1.0, 100.0)
    n = 3 + STATES
    pi, H, R = np.zeros((n, n)), np.zeros((3, n)), np.eye(3)
    pi[:3, :3] = sizes.sigma**2 * np.eye(3)
    H[:, :3] = np.eye(3)
    sizes.start(pi, slice(0, 3))
    for i in range(5):
        pi = pi + sizes.adapt(0.1 * i, np.full(3, 30.0), H, H @ pi @ H.T + sizes.noise * R, R)
    large, before = sizes.sigma, pi.copy()
    for i in range(5, 10):
        pi = pi + sizes.adapt(0.1 * i, np.zeros(3), H, H @ pi @ H.T + sizes.noise * R, R)
    assert sizes.sigma < 0.1 * large
    assert np.linalg.eigvalsh(pi - before)[0] > -1e-9


def test_faults_of_the_tracker_make_no_constant_much_less_certain_than_its_tolerance():
    """A shift of the tracker grows a thousandfold. What earlier randomness of it has left in the constants grows to their tolerances only."""
    n = 3 + STATES
    shift = slice(3 + SHIFT.start, 3 + SHIFT.stop)
    found = []
    for bounded in (True, False):
        sizes = AdaptedVariances(ForceRange(1e-3, 2e-3, 1.0), 0.2, 100.0)
        pi, H, R = np.zeros((n, n)), np.zeros((3, n)), 0.04 * np.eye(3)
        H[:, :3] = H[:, shift] = np.eye(3)
        sizes.start(pi, slice(0, 0))
        random = np.zeros((n, 3))  # a part of the constants' errors comes from the shift
        random[:3], random[shift] = -0.01 * np.eye(3), 0.03 * np.eye(3)
        sizes.parts = np.array([np.zeros((n, n)), random @ random.T, np.zeros((n, n))])
        pi += sizes.parts[SHIFT_PART]
        pi[:3, :3] += 0.5 * np.eye(3)
        before = pi.copy()
        nu = np.array([50.0, 0.0, 0.0])
        constants = Constants(np.eye(3, n), pi) if bounded else None
        pi = pi + sizes.adapt(0.025, nu, H, H @ pi @ H.T + R, R, constants)
        assert np.linalg.eigvalsh(pi - before)[0] > -1e-9
        assert np.linalg.eigvalsh(pi - sizes.parts.sum(axis=0))[0] > -1e-9
        found.append((pi.diagonal()[:3].max(), pi.diagonal()[shift].max()))
    (constant, shifted), (unbounded, as_much) = found
    assert constant == pytest.approx(LARGEST)
    assert unbounded > 10.0 * LARGEST
    assert shifted > 10.0**2
    assert shifted == pytest.approx(as_much, rel=0.1)


def test_the_bound_of_the_constants_changes_nothing_where_it_is_not_reached():
    rng = np.random.default_rng(5)
    more = np.cov(rng.normal(size=(4, 20)))
    constants = Constants(np.eye(2, 4), 0.5 * np.eye(4))
    assert constants.most(0.1 * more / more.max()) == 1.0
    share = constants.most(100.0 * np.eye(4))
    assert share == pytest.approx((LARGEST - 0.5) / 100.0)
