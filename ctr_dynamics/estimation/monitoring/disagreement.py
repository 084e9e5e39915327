"""How far tracker and estimate lie apart in what is no noise of the tracker: then nobody can tell which of them is right.

Noise of a tracker is new with every measurement. Residuals that resemble those before them show an error of the model, such as a drive that is
blocked, an encoder that has slipped, or a vibration that the robot does not make. Only where measured positions have jumped and the robot did not, it
was the tracker, or its sensor, that was moved.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import chi_square
from ctr_dynamics.estimation.monitoring.taken_again import REMEMBERED, drop_from

Floats = NDArray[np.float64]
LAST = 8  # residuals that are looked at, 0.2 s at 40 Hz: an error of 0.1 s shows in them
LAGS = 1, 2, 3  # of their correlations: a vibration of a fourth of the tracker's rate does not show at 1
CHANCE = 1e-3  # probability with which noise alone seems to be correlated
DEVIATIONS = 3.0  # of the noise of a change, beyond which it is a jump
# age of the newest measurement, up to which it tells how far the open-loop run is off now
FRESH_NS = 100_000_000
TIMES = 2.0  # as far as the model, by which measurements jump where the tracker does


class ComparedMeasurement(NamedTuple):
    """One measurement, base axes.

    Attributes:
        stamp_ns: of its header.
        seen, model: (3,) m, the tip as measured and as the open-loop run has it.
        residual: (3,) m, as measured from the estimate, less the jumps where they explain it.
        jumps: (3,) m, sum of those that the tracker was seen to make so far.
    """

    stamp_ns: int
    seen: Floats
    model: Floats
    residual: Floats
    jumps: Floats


class Disagreement:
    """The part of the last residuals that is no noise.

    Args:
        noise: m per axis, deviation of a measured position.
    """

    def __init__(self, noise: float) -> None:
        self._noise = noise
        self._least = DEVIATIONS * np.sqrt(6.0) * noise  # m, of the change of a residual
        self._correlated = chi_square.quantile(1.0 - CHANCE, len(LAGS))
        self.clear()

    def clear(self) -> None:
        """Forget all measurements."""
        self._measured: deque[ComparedMeasurement] = deque(maxlen=REMEMBERED)
        self._covariance: Floats | None = np.zeros((3, 3))

    def add(self, stamp_ns: int, seen: Floats, model: Floats, residual: Floats) -> None:
        """Take in a measurement (see :class:`ComparedMeasurement`); one of a stamp that is known takes its place."""
        known, self._covariance = self._measured, None
        drop_from(known, stamp_ns)
        jumps = known[-1].jumps + self._jump(stamp_ns, seen, model) if known else np.zeros(3)
        if np.linalg.norm(residual) < self._least:
            jumps = np.zeros(3)  # it is back, or the estimate has followed it
        elif np.linalg.norm(residual - jumps) < np.linalg.norm(residual):
            residual = residual - jumps
        known.append(ComparedMeasurement(stamp_ns, seen, model, residual, jumps))

    def _jump(self, stamp_ns: int, seen: Floats, model: Floats) -> Floats:
        """(3,) m, by which the tracker has jumped: what a straight line through the two measurements before does not lead to."""
        known = self._measured
        if len(known) < 2:
            return np.zeros(3)
        first, last = known[-2], known[-1]
        change = (seen - model) - (last.seen - last.model)
        if np.linalg.norm(change) < self._least:
            return np.zeros(3)
        apart = np.array([known[i].seen - known[i].model for i in range(-min(len(known), LAST), 0)])
        usual = float(np.median(np.linalg.norm(np.diff(apart, axis=0), axis=1)))
        ahead = (stamp_ns - last.stamp_ns) / (last.stamp_ns - first.stamp_ns)
        of_seen = np.linalg.norm(seen - last.seen - ahead * (last.seen - first.seen))
        of_model = np.linalg.norm(model - last.model - ahead * (last.model - first.model))
        return change if of_seen > max(TIMES * of_model, DEVIATIONS * usual, self._least) else np.zeros(3)

    def of_open_loop(self, stamp_ns: int) -> float:
        """m, rms, by which the last measurements lie apart from the open-loop run at ``stamp_ns``; infinite where they are too few or too old."""
        if len(self._measured) < LAST or stamp_ns - self._measured[-1].stamp_ns > FRESH_NS:
            return math.inf
        apart = [self._measured[i].seen - self._measured[i].model for i in range(-LAST, 0)]
        return math.sqrt(sum(float(each @ each) for each in apart) / LAST)

    @property
    def covariance(self) -> Floats:
        """(3, 3) m^2, mean square of the last residuals beyond the noise, where they are correlated; zero where they are not."""
        if self._covariance is None:
            self._covariance = self._compare()
        return self._covariance

    def _compare(self) -> Floats:
        """Ljung and Box's statistic of the residuals, whose mean is known to be zero, over the three axes."""
        if len(self._measured) < LAST:
            return np.zeros((3, 3))
        r = np.array([self._measured[i].residual for i in range(-LAST, 0)])
        squares = sum(float((r[lag:] * r[:-lag]).sum()) ** 2 / (LAST - lag) for lag in LAGS)
        # not divided by: a tracker without noise may leave nothing
        if r.size * (LAST + 2) * squares <= self._correlated * float((r * r).sum()) ** 2:
            return np.zeros((3, 3))
        sizes, axes = np.linalg.eigh(r.T @ r / LAST)
        more: Floats = (axes * np.maximum(sizes - self._noise**2, 0.0)) @ axes.T
        return more
