"""Stamps that scatter, as of a driver that stamps poses when they arrive: the open-loop run with a slow departure, and jitter of every size.

A pose whose stamp is off lies beside the tip by the way that the tip goes in that time: by nothing at rest, by centimetres in a vibration. To the
filter that looks like forces that come and go. It differs from other noise by its direction, which is that of the velocity, and by its size.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.monitoring.densities import student_peak
from ctr_dynamics.estimation.monitoring.prequential_evidence import DRIFT_S, FREEDOM, MEMORY_S, PRIOR
from ctr_dynamics.estimation.monitoring.taken_again import REMEMBERED, drop_from
from ctr_dynamics.kernels.jitter_update import correct_departures

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class StampJitterOptions:
    """How jitter is looked for.

    Attributes:
        smallest_s, largest_s: deviations of a stamp. From a tick of a slow clock to a period of a tracker. steps: between one size and the next, as a
            factor.
        prior: probability of a tracker whose stamps scatter.
        drifts_s: s, in which the open-loop run goes astray by about the tracker's noise, if the model is good, or less good.
        freedom: degrees of Student's distribution; outliers do not speak for or against jitter.
        lasts_s: s, for which it has been likely before it is believed. Outliers look like it for a moment, no longer: some measurements
            are enough.
        memory_s: s, for which evidence counts.
    """

    smallest_s: float = 0.001
    largest_s: float = 0.032
    steps: float = 2.0
    prior: float = PRIOR
    drifts_s: tuple[float, ...] = (DRIFT_S, 0.1 * DRIFT_S, 0.01 * DRIFT_S)
    freedom: float = FREEDOM
    lasts_s: float = 0.2
    memory_s: float = MEMORY_S


class Jitter(NamedTuple):
    """What the measurements up to ``stamp_ns`` say of every size.

    Attributes:
        level: (s, 3) m, the departure, which drifts. covariance: (s, 3, 3) m^2, of it. evidence: (s,) logarithm.
    """

    stamp_ns: int
    level: Floats
    covariance: Floats
    evidence: Floats


class StampJitter:
    """Evidence for every size of the jitter.

    Args:
        noise: m per axis, deviation of a measured position.
        registered: m per axis, by which the tip may depart for the registration's tolerance alone.
        options: how jitter is looked for.

    Attributes:
        sizes: (s,) s, of every hypothesis: each size with each drift.
    """

    def __init__(self, noise: float, registered: float, options: StampJitterOptions | None = None) -> None:
        self.options = options = options or StampJitterOptions()
        count = 1 + round(math.log(options.largest_s / options.smallest_s) / math.log(options.steps))
        sizes = np.r_[0.0, np.geomspace(options.smallest_s, options.largest_s, count)]
        count += 1
        self.sizes = np.tile(sizes, len(options.drifts_s))
        self._drifts = np.repeat(np.array(options.drifts_s), count)
        self._noise, self._registered = noise**2, registered**2
        self._prior = math.log(options.prior / len(self.sizes))
        self.clear()

    def clear(self) -> None:
        """Forget all measurements."""
        self._known: deque[Jitter] = deque(maxlen=REMEMBERED)

    def add(self, stamp_ns: int, residual: Floats, velocity: Floats, acceleration: Floats) -> float:
        """Take in a measurement that lies ``residual`` (3,) m from the open-loop tip of ``velocity`` (3,) m/s; one of a stamp that is known takes its
        place.

        Returns:
            Logarithm of the evidence of jitter of any size, its prior included.
        """
        known, options = self._known, self.options
        drop_from(known, stamp_ns)
        count = len(self.sizes)
        last = known[-1] if known else Jitter(
            stamp_ns, np.zeros((count, 3)), np.tile(self._registered * np.eye(3), (count, 1, 1)),
            np.zeros(count),
        )  # fmt: skip
        elapsed = (stamp_ns - last.stamp_ns) * 1e-9
        level, covariance, density = last.level.copy(), last.covariance.copy(), np.empty(count)
        covariance[:, range(3), range(3)] += (self._noise * elapsed / self._drifts)[:, None]
        motion = np.stack([residual, velocity, acceleration])
        correct_departures(level, covariance, self.sizes, motion, self._noise, options.freedom, density)
        decay = math.exp(-elapsed / options.memory_s)
        evidence = decay * last.evidence + density + student_peak(options.freedom)
        known.append(Jitter(stamp_ns, level, covariance, evidence))
        return float(np.logaddexp.reduce(evidence)) + self._prior

    @property
    def evidence(self) -> Floats:
        """(s,) logarithm of the evidence of every size, its prior included."""
        return self._known[-1].evidence + self._prior if self._known else np.full(len(self.sizes), -math.inf)
