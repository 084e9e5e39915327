"""A robot whose tip departs from its model smoothly, as by an error that depends on where its tubes are.

Such a departure goes on for a while in a direction, as that of a tracker whose frame moves does. It differs in that it turns back. It is a
Gauss-Markov process of second order (Matern covariance of smoothness 3/2), of each of some sizes and times.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.monitoring.densities import log_density
from ctr_dynamics.estimation.monitoring.taken_again import REMEMBERED, drop_from

Floats = NDArray[np.float64]


class Smooth(NamedTuple):
    """What the measurements up to ``stamp_ns`` say of every size and time.

    Attributes:
        mean: (n, 2, 3) departure, m, and its rate, m/s. covariance: (n, 2, 2), of each axis. evidence: (n,) logarithm.
    """

    stamp_ns: int
    mean: Floats
    covariance: Floats
    evidence: Floats


class SmoothDeparture:
    """Evidence for a smooth departure.

    Args:
        noise: m per axis, deviation of a measured position.
        sizes, times: (n,) m and s, deviations and correlation times that are tried.
        prior: probability of all of them together.
        memory_s: s, for which evidence counts.
    """

    def __init__(self, noise: float, sizes: Floats, times: Floats, prior: float, memory_s: float) -> None:
        self._noise, self._memory_s = noise**2, memory_s
        self._rates = math.sqrt(3.0) / times
        self._prior = math.log(prior / len(sizes))
        self._stationary = np.zeros((len(sizes), 2, 2))
        self._stationary[:, 0, 0], self._stationary[:, 1, 1] = sizes**2, (sizes * self._rates) ** 2
        self.clear()

    def clear(self) -> None:
        """Forget all measurements."""
        self._known: deque[Smooth] = deque(maxlen=REMEMBERED)

    @property
    def evidence(self) -> Floats:
        """(n,) logarithm of the evidence of every size and time, without prior."""
        return self._known[-1].evidence if self._known else np.full(len(self._rates), -math.inf)

    def add(self, stamp_ns: int, residual: Floats) -> float:
        """Take in a measurement that lies ``residual`` (3,) m from the open-loop tip; one of a stamp that is known takes its place.

        Returns:
            Logarithm of the evidence of all sizes and times, prior included.
        """
        known, rates, at_rest = self._known, self._rates, self._stationary
        drop_from(known, stamp_ns)
        count = len(rates)
        last = known[-1] if known else Smooth(stamp_ns, np.zeros((count, 2, 3)), at_rest, np.zeros(count))
        elapsed = (stamp_ns - last.stamp_ns) * 1e-9
        angle = rates * elapsed
        F = np.array([[1.0 + angle, np.full(count, elapsed)], [-rates * angle, 1.0 - angle]]).transpose(
            2, 0, 1
        )
        F *= np.exp(-angle)[:, None, None]
        turned = F.transpose(0, 2, 1)
        covariance = F @ (last.covariance - at_rest) @ turned + at_rest
        mean = F @ last.mean
        total = covariance[:, 0, 0] + self._noise
        change = residual - mean[:, 0]
        density = log_density((change**2).sum(axis=1), total, self._noise)
        gain = covariance[:, :, 0] / total[:, None]
        evidence = math.exp(-elapsed / self._memory_s) * last.evidence + density
        known.append(
            Smooth(
                stamp_ns,
                mean + gain[:, :, None] * change[:, None],
                covariance - gain[:, :, None] * covariance[:, None, 0],
                evidence,
            )
        )
        return float(np.logaddexp.reduce(evidence)) + self._prior
