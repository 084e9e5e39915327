"""How strongly the unknown tip force is driven: a distribution over its size, from how large the innovations are (docs/filter.md).

With the gains that the filter has used, its covariance is affine in the force's variance: P = F + c D, where F comes from the prior, the other
noise and the readings' noise, D from the force's randomness, and c is the variance by the one assumed so far. D goes through the filter beside P. So
what an innovation's covariance would be with any other variance is known, S(c) = S + (c - 1) H D H^T, and with it the likelihood of that variance.
The variance is taken from a grid and changes now and then to one drawn from its prior: a filter for a hidden Markov chain (Rabiner 1989).
The drive is the mean variance, and P is at once what it would be had that been the drive all along.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dsygvd

Floats = NDArray[np.float64]

MOST = 10.0  # times the variance, at one sample, up or down: what else the model misses looks like a force at its first sample
RAISED = 1000.0  # times the variance, at one sample, where readings in a row have been outside the gate
SHORTEST = (
    1e-3  # s between two samples, or a late one and its predecessor: no size is ever out of the question
)
SPACING = 0.5  # of the grid, in the logarithm of the variance: less than one innovation can tell apart


class ForceDrive:
    """Distribution of the unknown tip force's variance.

    Attributes:
        part: (n, n) what of the filter's covariance is in proportion to that variance.
        share: largest part of an innovation's variance that the force had at the last sample, 0 to 1, along any direction.
        grid: (m,) logarithms of the variances (N^2) between ``least``^2 and ``most``^2; prior, weights: (m,) their probabilities. A variance
            ten times as large is a tenth as likely before anything is measured.
    """

    def __init__(self, least: float, most: float, change_s: float) -> None:
        """Deviations ``least`` to ``most`` (N per axis); ``change_s``: mean time between two changes, s."""
        low, high = 2.0 * math.log(least), 2.0 * math.log(most)
        self.grid = np.linspace(low, high, max(1, math.ceil((high - low) / SPACING) + 1))
        prior = np.exp(low - self.grid)
        self.prior: Floats = prior / prior.sum()
        self.change_s = change_s
        self.part = np.zeros((0, 0))
        self.weights = self.prior
        self.sigma = least  # N per axis
        self.share = 0.0
        self._stamp = -math.inf

    def start(self, pi: Floats, force: slice) -> None:
        """Begin with the least deviation, which coefficients ``force`` of the covariance ``pi`` hold."""
        self.part = np.zeros_like(pi)
        self.part[force, force] = pi[force, force]
        self.weights = self.prior
        self.sigma, self.share, self._stamp = math.exp(0.5 * self.grid[0]), 0.0, -math.inf

    def append(self, at: int, count: int, variance: float) -> None:
        """New randomness of the force: ``count`` coefficients of ``variance`` before the coefficient ``at``."""
        n = len(self.part)
        old = np.r_[:at, at + count : n + count]
        part = np.zeros((n + count, n + count))
        part[np.ix_(old, old)] = self.part
        np.fill_diagonal(part[at : at + count, at : at + count], variance)
        self.part = part

    def fade(self, rows: slice, decay: float) -> None:
        """States ``rows`` have decayed."""
        self.part[rows, :] *= decay
        self.part[:, rows] *= decay

    def keep(self, kept: Floats) -> None:
        """The first r coefficients a have become ``kept`` (k, r) a."""
        k, r = kept.shape
        old, n = self.part, k + len(self.part) - r
        part = np.empty((n, n))
        part[:k, :k] = kept @ old[:r, :r] @ kept.T
        part[:k, k:] = kept @ old[:r, r:]
        part[k:, :k] = part[:k, k:].T
        part[k:, k:] = old[r:, r:]
        self.part = part

    def learn(self, stamp: float, nu: Floats, H: Floats, S: Floats) -> Floats:
        """Take in an innovation ``nu`` (k,) of derivative ``H`` (k, n) and covariance ``S`` (k, k), of time ``stamp`` (s).

        Returns the change (n, n) that the new drive makes of the filter's covariance.
        """
        share, axes, failed = dsygvd(H @ self.part @ H.T, S)
        if failed:
            return np.zeros_like(self.part)
        share = np.clip(share, 0.0, 1.0)
        squares = (axes.T @ nu) ** 2  # in directions where S is 1 and the force's part of it the share
        by_size = np.exp(self.grid - 2.0 * math.log(self.sigma))
        size = np.maximum(1.0 + np.multiply.outer(by_size - 1.0, share), 1e-9)
        likelihood = -0.5 * (np.log(size) + squares / size).sum(axis=1)
        changed = -math.expm1(-max(SHORTEST, stamp - self._stamp) / self.change_s)
        self._stamp = max(stamp, self._stamp)
        weights = (1.0 - changed) * self.weights + changed * self.prior
        weights *= np.exp(likelihood - likelihood.max())
        self.weights = weights / weights.sum()
        c = min(max(float(self.weights @ by_size), 1.0 / MOST), MOST)
        largest = float(share.max())
        self.share = c * largest / (1.0 + (c - 1.0) * largest)
        more = (c - 1.0) * self.part
        self.scale(c)
        return more

    @property
    def headroom(self) -> float:
        """By how much the variance may grow where the filter has lost the robot."""
        return min(RAISED, math.exp(self.grid[-1]) / self.sigma**2)

    def scale(self, c: float, wider: Floats | None = None) -> None:
        """Have ``c`` times the variance, in the past too; ``wider`` (n,): deviations of the coefficients by what they were."""
        self.sigma *= math.sqrt(c)
        self.part = c * self.part
        if wider is not None:
            self.part *= np.multiply.outer(wider, wider)

    def corrected(self, K: Floats, H: Floats) -> None:
        """A reading has been fused with gain ``K`` (n, k)."""
        left = np.eye(len(K)) - K @ H
        part = left @ self.part @ left.T
        self.part = 0.5 * (part + part.T)

    def snapshot(self) -> tuple:
        """What :meth:`restore` returns to. Nothing in it is written to later."""
        return self.part.copy(), self.weights, self.sigma, self.share, self._stamp

    def restore(self, snapshot: tuple) -> None:
        """Return to a snapshot."""
        part, self.weights, self.sigma, self.share, self._stamp = snapshot
        self.part = part.copy()
