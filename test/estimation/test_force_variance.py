"""The size of the unknown tip force, against a scalar filter run with every size and against dense matrices."""

import math

import numpy as np
import pytest

from ctr_dynamics.estimation.filter.force_variance import AdaptationOptions, ForceVariance

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
        self.force.part[0, 0] += fresh
        nu = np.array([measurement]) - self.H @ self.x
        S = self.H @ self.pi @ self.H.T + NOISE
        if self.learning:
            self.pi = self.pi + self.force.adapt(self.t, nu, self.H, S)
            S = self.H @ self.pi @ self.H.T + NOISE
        K = self.pi @ self.H.T / S
        left = np.eye(2) - K @ self.H
        self.pi = left @ self.pi @ left.T + NOISE * K @ K.T
        self.force.correct(K, self.H)
        self.x = self.x + K @ nu
        return K


def measurements(rng, size, count):
    value = 0.0
    for _ in range(count):
        value = DECAY * value + math.sqrt(1 - DECAY**2) * size * rng.standard_normal()
        yield value + 0.3 + math.sqrt(NOISE) * rng.standard_normal()


def test_the_covariance_is_affine_in_the_variance_for_the_gains_that_were_used():
    force = ForceVariance(0.5, 0.5, 10.0)
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
    np.testing.assert_allclose(scalar.pi + (c - 1.0) * force.part, other, rtol=1e-10)


@pytest.mark.parametrize("size", [3.0, 30.0])
def test_a_force_is_found_within_a_second_and_its_size_afterwards(size):
    force = ForceVariance(0.01, 100.0, 20.0)
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
        np.linalg.eigvalsh(scalar.pi - force.part)[0] > -1e-12
    )  # what the force does not cause is a covariance


def test_without_a_force_its_variance_stays_where_it_does_not_show():
    force = ForceVariance(0.01, 100.0, 20.0)
    scalar = Scalar(force)
    fractions = []
    for measurement in measurements(np.random.default_rng(3), 0.0, 800):
        scalar.step(measurement)
        fractions.append(force.fraction)
    assert np.median(fractions) < 0.05
    variances, weights = np.exp(force.grid), force.weights
    assert weights[variances > 4.0].sum() < 1e-2


def test_the_weights_are_those_of_the_likelihoods():
    rng = np.random.default_rng(5)
    force = ForceVariance(0.1, 10.0, 1e9)
    root = rng.normal(size=(5, 5))
    pi = root @ root.T
    pi[:2, 2:] = pi[2:, :2] = 0.0
    force.start(pi, slice(0, 2))
    H, R = rng.normal(size=(3, 5)), np.diag([0.5, 1.0, 2.0])
    S = H @ pi @ H.T + R
    nu = rng.normal(size=3)
    part, sigma = force.part.copy(), force.sigma
    more = force.adapt(0.0, nu, H, S)
    wanted = []
    for variance, prior in zip(np.exp(force.grid), force.prior, strict=True):
        trial = S + (variance / sigma**2 - 1.0) * H @ part @ H.T
        wanted.append(
            prior * math.exp(-0.5 * nu @ np.linalg.solve(trial, nu)) / math.sqrt(np.linalg.det(trial))
        )
    np.testing.assert_allclose(force.weights, np.array(wanted) / sum(wanted), rtol=1e-9)
    mean = force.weights @ np.exp(force.grid)
    most = AdaptationOptions().largest_change
    assert force.sigma**2 == pytest.approx(np.clip(mean / sigma**2, 1.0 / most, most) * sigma**2)
    np.testing.assert_allclose(more, (force.sigma**2 / sigma**2 - 1.0) * part)
    np.testing.assert_allclose(force.part, part + more)
    shown = max(np.linalg.eigvals(np.linalg.solve(S + H @ more @ H.T, H @ force.part @ H.T)).real)
    assert force.fraction == pytest.approx(shown)


def test_measurements_of_one_stamp_that_contradict_all_before_leave_a_distribution():
    force = ForceVariance(1e-3, 100.0, 1e6)
    force.start(np.diag([1e-6]), slice(0, 1))
    for measurement in [0.0] * 400 + [1e4] * 3:
        force.adapt(0.0, np.array([measurement]), np.eye(1), force.part + NOISE)
        assert np.all(np.isfinite(force.weights))
        assert 1e-3 <= force.sigma * (1 + 1e-9) <= 101.0
    assert force.sigma > 0.02  # ten times the variance at each


def test_one_size_is_kept():
    force = ForceVariance(0.2, 0.2, 10.0)
    scalar = Scalar(force)
    for measurement in measurements(np.random.default_rng(2), 50.0, 50):
        scalar.step(measurement)
    assert force.sigma == pytest.approx(0.2)
    assert force.headroom == pytest.approx(1.0)


def test_a_checkpoint_is_what_is_returned_to():
    force = ForceVariance(0.01, 100.0, 20.0)
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
        trajectories.append((force.sigma, force.fraction, *force.weights, *force.part.ravel()))
    assert trajectories[0] == trajectories[1]


def test_new_and_fewer_coefficients_are_those_of_dense_matrices():
    rng = np.random.default_rng(6)
    force = ForceVariance(0.1, 10.0, 10.0)
    force.part = np.cov(rng.normal(size=(6, 20)))
    old = force.part.copy()
    force.append(4, 3, 0.7)
    index = [0, 1, 2, 3, 7, 8]
    np.testing.assert_array_equal(force.part[np.ix_(index, index)], old)
    np.testing.assert_array_equal(force.part[4:7, 4:7], 0.7 * np.eye(3))
    assert not force.part[4:7][:, index].any()
    projection, before = rng.normal(size=(5, 7)), force.part.copy()
    force.project(projection)
    whole = np.block([[projection, np.zeros((5, 2))], [np.zeros((2, 7)), np.eye(2)]])
    np.testing.assert_allclose(force.part, whole @ before @ whole.T, rtol=1e-12, atol=1e-14)
