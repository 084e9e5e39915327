"""How large the unknown tip force is: a distribution over its variance, adapted to how large the innovations are (docs/filter.md).

With the gains that the filter has used, its covariance is affine in the force's variance: Pi = F + c D. F comes from the prior, the other
noise and the measurement noise, D from the force's randomness, and c is the variance by the one assumed so far. D goes through the filter
beside Pi. So the covariance of an innovation with any other variance is known, S(c) = S + (c - 1) H D H^T, and with it the likelihood of that
variance. The variance is taken from a grid and changes now and then to one drawn from its prior: a filter for a hidden Markov chain
(Rabiner 1989). The process noise has the mean variance, and Pi is at once what it would be had the variance been that all along.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dsygvd

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class AdaptationOptions:
    """How fast the variance of the tip force is adapted.

    Attributes:
        largest_change: times the variance, at one measurement, up or down. Whatever else the model misses looks like a force at its first
            measurement.
        largest_inflation: times the variance, at one measurement, where several in a row have been outside the gate.
        shortest_interval: s between two measurements, or a late one and its predecessor. Above 0, so that no variance is ever ruled out.
        spacing: of the grid, in the logarithm of the variance. Less than one innovation can tell apart.
    """

    largest_change: float = 10.0
    largest_inflation: float = 1000.0
    shortest_interval: float = 1e-3
    spacing: float = 0.5


class ForceVarianceState(NamedTuple):
    """What a checkpoint stores of a :class:`ForceVariance`; nothing in it is written to later."""

    part: Floats
    weights: Floats
    sigma: float
    fraction: float
    stamp: float


class ForceVariance:
    """Distribution of the unknown tip force's variance.

    Args:
        least, most: deviations between which the force's lies, N per axis.
        change_s: mean time between two changes of the variance, s.
        options: how fast it is adapted.

    Attributes:
        sigma: deviation that the process noise has now, N per axis.
        part: (n, n) D: what of the filter's covariance is in proportion to the force's variance.
        fraction: largest part of an innovation's variance that the force had at the last measurement, 0 to 1, along any direction.
        grid: (m,) logarithms of the variances (N^2) between ``least``^2 and ``most``^2.
        prior, weights: (m,) probabilities of the grid. A variance ten times as large is a tenth as likely before anything is measured.
    """

    def __init__(
        self, least: float, most: float, change_s: float, options: AdaptationOptions | None = None
    ) -> None:
        self.options = options or AdaptationOptions()
        low, high = 2.0 * math.log(least), 2.0 * math.log(most)
        self.grid = np.linspace(low, high, max(1, math.ceil((high - low) / self.options.spacing) + 1))
        prior = np.exp(low - self.grid)
        self.prior: Floats = prior / prior.sum()
        self.change_s = change_s
        self.part = np.zeros((0, 0))
        self.weights = self.prior
        self.sigma = least
        self.fraction = 0.0
        self._stamp = -math.inf

    def start(self, pi: Floats, force: slice) -> None:
        """Begin with the least deviation, which the coefficients ``force`` of the covariance ``pi`` (n, n) hold."""
        self.part = np.zeros_like(pi)
        self.part[force, force] = pi[force, force]
        self.weights = self.prior
        self.sigma, self.fraction, self._stamp = math.exp(0.5 * self.grid[0]), 0.0, -math.inf

    def append(self, at: int, count: int, variance: float) -> None:
        """New randomness of the force: ``count`` coefficients of ``variance`` before the coefficient ``at``."""
        n = len(self.part)
        old = np.r_[:at, at + count : n + count]
        part = np.zeros((n + count, n + count))
        part[np.ix_(old, old)] = self.part
        np.fill_diagonal(part[at : at + count, at : at + count], variance)
        self.part = part

    def decay(self, rows: slice, factor: float) -> None:
        """The states ``rows`` have decayed by ``factor``."""
        self.part[rows, :] *= factor
        self.part[:, rows] *= factor

    def project(self, projection: Floats) -> None:
        """The first r coefficients a have become ``projection`` (k, r) a."""
        k, r = projection.shape
        old, n = self.part, k + len(self.part) - r
        part = np.empty((n, n))
        part[:k, :k] = projection @ old[:r, :r] @ projection.T
        part[:k, k:] = projection @ old[:r, r:]
        part[k:, :k] = part[:k, k:].T
        part[k:, k:] = old[r:, r:]
        self.part = part

    def adapt(self, stamp: float, nu: Floats, H: Floats, S: Floats) -> Floats:
        """Take in an innovation ``nu`` (k,) of derivative ``H`` (k, n) and covariance ``S`` (k, k), of time ``stamp`` (s).

        Returns the change (n, n) of the filter's covariance that the new variance makes.
        """
        options = self.options
        # 1. Directions in which S is 1, and the fraction of it that the force has along each.
        fraction, axes, failed = dsygvd(H @ self.part @ H.T, S)
        if failed:
            return np.zeros_like(self.part)
        fraction = np.clip(fraction, 0.0, 1.0)
        squares = (axes.T @ nu) ** 2
        # 2. Likelihood of every variance of the grid.
        by_size = np.exp(self.grid - 2.0 * math.log(self.sigma))
        size = np.maximum(1.0 + np.multiply.outer(by_size - 1.0, fraction), 1e-9)
        likelihood = -0.5 * (np.log(size) + squares / size).sum(axis=1)
        # 3. Hidden Markov chain: the variance may have changed since the last innovation, then Bayes' rule.
        changed = -math.expm1(-max(options.shortest_interval, stamp - self._stamp) / self.change_s)
        self._stamp = max(stamp, self._stamp)
        weights = (1.0 - changed) * self.weights + changed * self.prior
        weights *= np.exp(likelihood - likelihood.max())
        self.weights = weights / weights.sum()
        # 4. The process noise goes over to the mean variance.
        c = min(max(float(self.weights @ by_size), 1.0 / options.largest_change), options.largest_change)
        largest = float(fraction.max())
        self.fraction = c * largest / (1.0 + (c - 1.0) * largest)
        more = (c - 1.0) * self.part
        self.scale(c)
        return more

    @property
    def headroom(self) -> float:
        """By how much the variance may grow where the filter has lost the robot."""
        return min(self.options.largest_inflation, math.exp(self.grid[-1]) / self.sigma**2)

    def scale(self, c: float, deviations: Floats | None = None) -> None:
        """Have ``c`` times the variance, in the past too; ``deviations`` (n,): of the coefficients, by what they were."""
        self.sigma *= math.sqrt(c)
        self.part = c * self.part
        if deviations is not None:
            self.part *= np.multiply.outer(deviations, deviations)

    def correct(self, K: Floats, H: Floats) -> None:
        """A measurement has been fused with gain ``K`` (n, k) and derivative ``H`` (k, n).

        (I - K H) D (I - K H)^T is multiplied as it stands and made symmetric. Written out, rounding errors grow until Pi is no covariance.
        """
        left = np.eye(len(K)) - K @ H
        part = left @ self.part @ left.T
        self.part = 0.5 * (part + part.T)

    def checkpoint(self) -> ForceVarianceState:
        """What :meth:`restore` returns to."""
        return ForceVarianceState(self.part.copy(), self.weights, self.sigma, self.fraction, self._stamp)

    def restore(self, state: ForceVarianceState) -> None:
        """Return to a checkpoint."""
        self.part = state.part.copy()
        self.weights, self.sigma, self.fraction, self._stamp = (
            state.weights,
            state.sigma,
            state.fraction,
            state.stamp,
        )
