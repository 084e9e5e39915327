"""A tracker that is noisier than the robot file says, for good: the open-loop run with a constant departure, and noise of every size.

Such noise looks like a tip that departs from its model fast and by as much. It differs in that what comes next has nothing to do with what was.
Its tails are those of Student's distribution, so that outliers among the measurements do not speak against it (Lange, Little and Taylor 1989).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.monitoring.densities import student_peak
from ctr_dynamics.estimation.monitoring.prequential_evidence import FREEDOM, MEMORY_S, PRIOR
from ctr_dynamics.estimation.monitoring.taken_again import REMEMBERED, drop_from

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class NoisyTrackerOptions:
    """How noise is looked for.

    Attributes:
        smallest: by the stated noise; less is left to the filter. The largest is the robot's length. steps: between one size and the next, as a
            factor.
        freedom: degrees of Student's distribution.
        prior: probability of a tracker that is noisier than its file says.
        memory_s: s, for which evidence counts.
    """

    smallest: float = 2.0
    steps: float = 1.6
    freedom: float = FREEDOM
    prior: float = PRIOR
    memory_s: float = MEMORY_S


class NoiseEvidence(NamedTuple):
    """What the measurements up to ``stamp_ns`` say of every size.

    Attributes:
        level: (n, 3) m, the constant departure. variance: (n,) m^2, of it. evidence: (n,) logarithm.
    """

    stamp_ns: int
    level: Floats
    variance: Floats
    evidence: Floats


class NoisyTracker:
    """Evidence for every size of the tracker's noise.

    Args:
        noise: m per axis, as stated.
        length: m, of the robot outside the base plate at most.
        registered: m per axis, by which the tip may depart for the registration's tolerance alone.
        options: how noise is looked for.
    """

    def __init__(
        self, noise: float, length: float, registered: float, options: NoisyTrackerOptions | None = None
    ) -> None:
        self.options = options = options or NoisyTrackerOptions()
        least = options.smallest * noise
        count = 1 + math.ceil(math.log(max(length / least, 1.0)) / math.log(options.steps))
        self._stated, self._registered = noise**2, registered**2
        self._squares = np.geomspace(least, max(least, length), count) ** 2
        self.clear()

    def clear(self) -> None:
        """Forget all measurements."""
        self._known: deque[NoiseEvidence] = deque(maxlen=REMEMBERED)

    def add(self, stamp_ns: int, residual: Floats) -> float:
        """Take in a measurement that lies ``residual`` (3,) m from the open-loop tip; one of a stamp that is known takes its place.

        Returns:
            Logarithm of the evidence of a tracker that is noisier than stated by any size, its prior included.
        """
        known, options, freedom = self._known, self.options, self.options.freedom
        drop_from(known, stamp_ns)
        count = len(self._squares)
        last = known[-1] if known else NoiseEvidence(
            stamp_ns, np.zeros((count, 3)), np.full(count, self._registered), np.zeros(count)
        )  # fmt: skip
        change, total = residual - last.level, last.variance + self._squares
        square = (change**2).sum(axis=1) / total
        density = (
            student_peak(freedom)
            - 1.5 * np.log(total / self._stated)
            - 0.5 * (freedom + 3.0) * np.log1p(square / freedom)
        )
        # a far one moves the level less
        weight = (freedom + 3.0) / (freedom + square)
        gain = last.variance / (last.variance + self._squares / weight)
        decay = math.exp(-(stamp_ns - last.stamp_ns) * 1e-9 / options.memory_s)
        evidence = decay * last.evidence + density
        known.append(
            NoiseEvidence(
                stamp_ns, last.level + gain[:, None] * change, last.variance * (1.0 - gain), evidence
            )
        )
        return float(np.logaddexp.reduce(evidence)) + math.log(options.prior / count)
