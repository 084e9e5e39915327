"""The size of the unknown tip force, against a scalar filter run with every size and against dense matrices."""

import math

import numpy as np
import pytest

from ctr_dynamics.estimation.filter.process_noise import MOST, ForceDrive

DECAY, NOISE = 0.8, 1.0  # of the force from one reading to the next; variance of a reading


def lists(drive):
    """The distribution as it is told: variances and weights."""
    return np.exp(drive.grid), drive.weights


class Scalar:
    """A filter of a force f (AR(1)) read directly, beside a constant offset b that is certain to 0.3: states (f, b)."""

    def __init__(self, drive, learning=True):
        self.drive, self.learning = drive, learning
        self.pi = np.diag([drive.sigma**2, 0.09])
        drive.start(self.pi, slice(0, 1))
        self.x, self.t = np.zeros(2), 0.0
        self.H = np.ones((1, 2))

    def step(self, reading):
        A = np.diag([DECAY, 1.0])
        self.x, self.t = A @ self.x, self.t + 0.025
        self.pi = A @ self.pi @ A.T
        self.drive.fade(slice(0, 1), DECAY)
        fresh = (1.0 - DECAY**2) * self.drive.sigma**2
        self.pi[0, 0] += fresh
        self.drive.part[0, 0] += fresh
        nu = np.array([reading]) - self.H @ self.x
        S = self.H @ self.pi @ self.H.T + NOISE
        if self.learning:
            self.pi = self.pi + self.drive.learn(self.t, nu, self.H, S)
            S = self.H @ self.pi @ self.H.T + NOISE
        K = self.pi @ self.H.T / S
        left = np.eye(2) - K @ self.H
        self.pi = left @ self.pi @ left.T + NOISE * K @ K.T
        self.drive.corrected(K, self.H)
        self.x = self.x + K @ nu
        return K


def readings(rng, size, count):
    force = 0.0
    for _ in range(count):
        force = DECAY * force + math.sqrt(1 - DECAY**2) * size * rng.standard_normal()
        yield force + 0.3 + math.sqrt(NOISE) * rng.standard_normal()


def test_the_covariance_is_affine_in_the_variance_for_the_gains_that_were_used():
    drive = ForceDrive(0.5, 0.5, 10.0)
    scalar = Scalar(drive, learning=False)
    c = 7.3
    other = np.diag([c * 0.25, 0.09])  # covariance of the same estimates, had the force c times the variance
    for reading in readings(np.random.default_rng(1), 0.5, 40):
        A = np.diag([DECAY, 1.0])
        other = A @ other @ A.T
        other[0, 0] += (1.0 - DECAY**2) * c * 0.25
        K = scalar.step(reading)
        left = np.eye(2) - K @ scalar.H
        other = left @ other @ left.T + NOISE * K @ K.T
    np.testing.assert_allclose(scalar.pi + (c - 1.0) * drive.part, other, rtol=1e-10)


@pytest.mark.parametrize("size", [3.0, 30.0])
def test_a_force_is_found_within_a_second_and_its_size_afterwards(size):
    drive = ForceDrive(0.01, 100.0, 20.0)
    scalar = Scalar(drive)
    rng = np.random.default_rng(7)
    found = []
    for reading in readings(rng, size, 400):
        scalar.step(reading)
        found.append(drive.sigma)
    assert max(found[:40]) > 0.3 * size
    assert 0.6 * size < np.median(found[100:]) < 1.6 * size
    for reading in readings(rng, 0.0, 1200):
        scalar.step(reading)
    assert drive.sigma < 0.7  # less than what a reading shows
    assert (
        np.linalg.eigvalsh(scalar.pi - drive.part)[0] > -1e-12
    )  # what the force does not cause is a covariance


def test_without_a_force_the_drive_stays_where_it_does_not_show():
    drive = ForceDrive(0.01, 100.0, 20.0)
    scalar = Scalar(drive)
    shares = []
    for reading in readings(np.random.default_rng(3), 0.0, 800):
        scalar.step(reading)
        shares.append(drive.share)
    assert np.median(shares) < 0.05
    variances, weights = lists(drive)
    assert weights[variances > 4.0].sum() < 1e-2


def test_the_weights_are_those_of_the_likelihoods():
    rng = np.random.default_rng(5)
    drive = ForceDrive(0.1, 10.0, 1e9)
    root = rng.normal(size=(5, 5))
    pi = root @ root.T
    pi[:2, 2:] = pi[2:, :2] = 0.0
    drive.start(pi, slice(0, 2))
    H, R = rng.normal(size=(3, 5)), np.diag([0.5, 1.0, 2.0])
    S = H @ pi @ H.T + R
    nu = rng.normal(size=3)
    part, sigma = drive.part.copy(), drive.sigma
    more = drive.learn(0.0, nu, H, S)
    wanted = []
    for variance, prior in zip(np.exp(drive.grid), drive.prior, strict=True):
        trial = S + (variance / sigma**2 - 1.0) * H @ part @ H.T
        wanted.append(
            prior * math.exp(-0.5 * nu @ np.linalg.solve(trial, nu)) / math.sqrt(np.linalg.det(trial))
        )
    np.testing.assert_allclose(drive.weights, np.array(wanted) / sum(wanted), rtol=1e-9)
    mean = drive.weights @ np.exp(drive.grid)
    assert drive.sigma**2 == pytest.approx(np.clip(mean / sigma**2, 1.0 / MOST, MOST) * sigma**2)
    np.testing.assert_allclose(more, (drive.sigma**2 / sigma**2 - 1.0) * part)
    np.testing.assert_allclose(drive.part, part + more)
    shown = max(np.linalg.eigvals(np.linalg.solve(S + H @ more @ H.T, H @ drive.part @ H.T)).real)
    assert drive.share == pytest.approx(shown)


def test_readings_of_one_stamp_that_contradict_all_before_leave_a_distribution():
    drive = ForceDrive(1e-3, 100.0, 1e6)
    drive.start(np.diag([1e-6]), slice(0, 1))
    for reading in [0.0] * 400 + [1e4] * 3:
        drive.learn(0.0, np.array([reading]), np.eye(1), drive.part + NOISE)
        assert np.all(np.isfinite(drive.weights))
        assert 1e-3 <= drive.sigma * (1 + 1e-9) <= 101.0
    assert drive.sigma > 0.02  # ten times the variance at each


def test_one_size_is_kept():
    drive = ForceDrive(0.2, 0.2, 10.0)
    scalar = Scalar(drive)
    for reading in readings(np.random.default_rng(2), 50.0, 50):
        scalar.step(reading)
    assert drive.sigma == pytest.approx(0.2)
    assert drive.headroom == pytest.approx(1.0)


def test_a_snapshot_is_what_is_returned_to():
    drive = ForceDrive(0.01, 100.0, 20.0)
    scalar = Scalar(drive)
    numbers = list(readings(np.random.default_rng(4), 5.0, 60))
    for reading in numbers[:30]:
        scalar.step(reading)
    kept, pi, x, t = drive.snapshot(), scalar.pi.copy(), scalar.x.copy(), scalar.t
    course = []
    for _ in range(2):
        drive.restore(kept)
        scalar.pi, scalar.x, scalar.t = pi.copy(), x.copy(), t
        for reading in numbers[30:]:
            scalar.step(reading)
        course.append((drive.sigma, drive.share, *drive.weights, *drive.part.ravel()))
    assert course[0] == course[1]


def test_new_and_fewer_coefficients_are_those_of_dense_matrices():
    rng = np.random.default_rng(6)
    drive = ForceDrive(0.1, 10.0, 10.0)
    drive.part = np.cov(rng.normal(size=(6, 20)))
    old = drive.part.copy()
    drive.append(4, 3, 0.7)
    index = [0, 1, 2, 3, 7, 8]
    np.testing.assert_array_equal(drive.part[np.ix_(index, index)], old)
    np.testing.assert_array_equal(drive.part[4:7, 4:7], 0.7 * np.eye(3))
    assert not drive.part[4:7][:, index].any()
    kept, before = rng.normal(size=(5, 7)), drive.part.copy()
    drive.keep(kept)
    whole = np.block([[kept, np.zeros((5, 2))], [np.zeros((2, 7)), np.eye(2)]])
    np.testing.assert_allclose(drive.part, whole @ before @ whole.T, rtol=1e-12, atol=1e-14)
