"""Steps of a simulation in time: in windows of even steps, long ones where the motion is slow."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TimeSteps:
    """Windows of even steps.

    Attributes:
        window_s: length of a window. in_window: s, a step in each window; the last one serves for whatever comes after.
    """

    window_s: float
    in_window: tuple[float, ...]

    @property
    def shortest(self) -> float:
        """s"""
        return min(self.in_window)

    @property
    def longest(self) -> float:
        """s"""
        return max(self.in_window)

    def lengths(self, duration: float) -> Floats:
        """(K,) s of all steps, which end at ``duration`` (s). Those of a window are as long as its own, or a little shorter, so that they fill it."""
        parts = []
        for i in range(math.ceil(duration / self.window_s - 1e-9)):
            span = min(self.window_s, duration - i * self.window_s)
            count = math.ceil(span / self.in_window[min(i, len(self.in_window) - 1)] - 1e-9)
            parts.append(np.full(count, span / count))
        return np.concatenate(parts) if parts else np.zeros(0)

    def scaled(self, factor: float) -> TimeSteps:
        """The same with every step ``factor`` times as long."""
        return replace(self, in_window=tuple(factor * dt for dt in self.in_window))

    def at_least(self, dt: float) -> TimeSteps:
        """The same with steps of ``dt`` (s) where they are shorter."""
        return replace(self, in_window=tuple(max(dt, own) for own in self.in_window))
