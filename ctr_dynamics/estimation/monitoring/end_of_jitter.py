"""The end of jitter that the filter counts on: a CUSUM of how much better it would foretell with half of it (Page 1954)."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from ctr_dynamics.estimation.monitoring.taken_again import REMEMBERED, drop_from

ODDS = 1e4  # measurements between two false alarms at least (Lorden 1971): four minutes at 40 Hz; jitter that is still there is found again


class Sum(NamedTuple):
    """The CUSUM up to a measurement."""

    stamp_ns: int
    value: float


class EndOfJitter:
    """Whether the jitter has become less."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all measurements."""
        self._sums: deque[Sum] = deque(maxlen=REMEMBERED)

    def add(self, stamp_ns: int, half_jitter_gain: float) -> None:
        """Take in a measurement that half the jitter would foretell better, by the logarithm ``half_jitter_gain`` of a ratio of densities."""
        drop_from(self._sums, stamp_ns)
        before = self._sums[-1].value if self._sums else 0.0
        self._sums.append(Sum(stamp_ns, max(before + half_jitter_gain, 0.0)))

    @property
    def less(self) -> bool:
        """Whether it has."""
        return bool(self._sums) and self._sums[-1].value > math.log(ODDS)
