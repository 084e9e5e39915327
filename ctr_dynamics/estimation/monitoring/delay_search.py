"""A tracker whose poses are far older than the robot file says: the delay with which measurements fit the open-loop run best.

A delay shows while the robot moves, and looks like a force or like noise to the filter, whose prior for it is narrow. The open-loop run does not
depend on the tracker, so every measurement is compared with its tips of the last 0.3 s. A registration that is wrong moves all residuals alike,
so their scatter over a short time counts.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DelaySearchOptions:
    """When a delay is believed.

    Attributes:
        longest_s: largest delay beyond the nominal one. spacing_s: of those that are tried.
        fewest: measurements that are compared. window_s: s, over which they lie at most.
        better: times. The scatter with the delay of the filter is larger than the least by that, or the delay stays. Residuals are correlated
            over a period of a slow vibration, so that they count as few.
        unique: times. So much larger is the scatter at every other minimum: a free vibration fits with its period more, too. A window holds
            some 12 independent values, for which 2.5 means odds of 2.5^6, 200 to 1.
        fits: deviations of the noise, at most, of the scatter with the best delay. A model that does not fit with any delay tells nothing.
        least_s: a smaller difference is left to the filter's own estimate.
    """

    longest_s: float = 0.3
    spacing_s: float = 0.005
    fewest: int = 8
    window_s: float = 0.6
    better: float = 4.0
    unique: float = 2.5
    fits: float = 3.0
    least_s: float = 0.01


class DelaySearch:
    """Scatter of the open-loop residuals for many delays.

    Args:
        noise: m per axis, deviation of a measured position.
        options: when a delay is believed.
    """

    def __init__(self, noise: float, options: DelaySearchOptions | None = None) -> None:
        self.options = options = options or DelaySearchOptions()
        self._fits = 3.0 * (options.fits * noise) ** 2
        self.delays = np.arange(0.0, options.longest_s + 0.5 * options.spacing_s, options.spacing_s)
        self.clear()

    def clear(self) -> None:
        """Forget all measurements."""
        self._compared: deque[tuple[int, Floats, bool]] = deque()

    def add(self, stamp_ns: int, time_s: float, position: Floats, stamps: Floats, tips: Floats) -> None:
        """Take in a measured tip; one of a stamp that is known takes its place.

        Args:
            stamp_ns: of its header. time_s: its own time with the nominal delay, s from the first step.
            position: (3,) m, base axes.
            stamps, tips: (k,) s and (k, 3) m of the open-loop run.
        """
        while self._compared and self._compared[-1][0] >= stamp_ns:
            self._compared.pop()  # its step is taken again
        while self._compared and stamp_ns - self._compared[0][0] > self.options.window_s * 1e9:
            self._compared.popleft()
        times = time_s - self.delays
        if len(stamps) < 2 or times[-1] < stamps[0]:
            return
        seen = np.stack([np.interp(times, stamps, tips[:, axis]) for axis in range(3)], axis=1)
        self._compared.append((stamp_ns, position - seen, True))

    def explained(self, sound: bool) -> None:
        """Whether the filter has explained the last measurement by a ``sound`` tracker."""
        if self._compared:
            stamp_ns, residual, _ = self._compared[-1]
            self._compared[-1] = stamp_ns, residual, sound

    def found(self, present_s: float) -> float | None:
        """The delay (s, beyond the nominal one) that is far more likely than ``present_s``; None where there is none.

        None too while the filter explains the measurements: a model whose frequencies are a little wrong vibrates late or early, which is no
        delay of the tracker.
        """
        options = self.options
        recent = [sound for _, _, sound in self._compared][-options.fewest :]
        if len(recent) < options.fewest or 2 * sum(recent) > len(recent):
            return None
        residuals = np.array([residual for _, residual, _ in self._compared])
        scatter = residuals.var(axis=0).sum(axis=1) * len(residuals) / (len(residuals) - 1)
        best = int(np.argmin(scatter))
        now = float(np.interp(present_s, self.delays, scatter))
        if scatter[best] > self._fits or now < options.better * max(
            scatter[best], self._fits / options.fits**2
        ):
            return None
        apart = np.abs(self.delays - self.delays[best]) > 2.0 * options.least_s
        lowest = np.r_[True, scatter[1:] < scatter[:-1]] & np.r_[scatter[:-1] < scatter[1:], True]
        if np.any(scatter[lowest & apart] < options.unique * scatter[best]):
            return None
        delay = self._vertex(scatter, best)
        return delay if abs(delay - present_s) > options.least_s else None

    def _vertex(self, scatter: Floats, best: int) -> float:
        """The lowest point of the parabola through the least scatter and its neighbours."""
        if not 0 < best < len(scatter) - 1:
            return float(self.delays[best])
        before, at, after = scatter[best - 1 : best + 2]
        second = before - 2.0 * at + after
        shift = 0.5 * (before - after) / second if second > 0.0 else 0.0
        return float(self.delays[best] + shift * self.options.spacing_s)
