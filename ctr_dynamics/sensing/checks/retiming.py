"""Stamps that tell when messages were handed over, or on a coarse grid, spaced as evenly as the sensor measured.

A sensor measures evenly. A stamp of arrival bounds the time of a measurement from above; a stamp that is rounded down bounds it from both
sides. The bounds of many measurements together leave little freedom.
"""

from __future__ import annotations

import math
import statistics
from collections import deque

FOLLOWED = 4  # bursts whose least lateness is followed
REMEMBERED = 8  # bursts whose scatter tells the error
LEAST_ERROR = 0.02  # of a period: what a bound that is followed slowly leaves
LEAK = 0.002  # of a period: bounds of a grid are loosened by it at every message, as the period is not known exactly


def begins_burst(step_ns: int, burst_ns: float) -> bool:
    """Whether a message that follows the one before after ``step_ns`` begins a burst, where these come every ``burst_ns``."""
    return step_ns > 0.5 * burst_ns


class Retiming:
    """Times of measurements from their stamps; every call is one measurement, in order.

    Attributes:
        time_ns: of the last. error_s: 1-sigma of what is left, s.
    """

    def __init__(self, time_ns: int) -> None:
        self.time_ns = time_ns
        self.error_s = 0.0
        # ns by which the stamp of the last message of each burst lies after its time: as it was, and but for messages that were lost
        self._lateness = deque[int](maxlen=REMEMBERED)
        self._late = deque[int](maxlen=FOLLOWED)
        self._stamp_ns = time_ns
        self._low = self._high = 0.0

    def from_bursts(self, stamp_ns: int, period_ns: float, burst_ns: float) -> int:
        """Time of a measurement stamped on arrival. ``period_ns``: mean interval; ``burst_ns``: time from burst to burst."""
        begins = begins_burst(stamp_ns - self._stamp_ns, burst_ns)
        if begins:
            self._end_burst(period_ns)
        time_ns = self.time_ns + round(period_ns)
        if begins and time_ns < stamp_ns - round(burst_ns):
            # what is that old would have come with the burst before
            time_ns = stamp_ns - round(burst_ns - period_ns)
        self._stamp_ns, self.time_ns = stamp_ns, max(min(time_ns, stamp_ns), self.time_ns + 1)
        return self.time_ns

    def _end_burst(self, period_ns: float) -> None:
        """Follow what the burst that is over tells: it ended with its freshest measurement, unless that was lost."""
        late, lost_ns = self._stamp_ns - self.time_ns, 0
        if self._late and late > max(self._late) + 0.5 * period_ns:
            # some of its messages were lost: those behind them have been given times too early by as many periods
            lost_ns = round(int((late - min(self._late)) / period_ns + 0.1) * period_ns)
        self._late.append(late - lost_ns)
        self._lateness.append(late)
        self.time_ns += lost_ns + min(self._late) // 4
        self.error_s = 1e-9 * math.hypot(LEAST_ERROR * period_ns, statistics.pstdev(self._lateness))

    def from_grid(self, stamp_ns: int, period_ns: float, grid_ns: int, latest_ns: int | None) -> int:
        """Time of a measurement whose stamp is rounded down to ``grid_ns``; ``latest_ns``: when it had arrived, on the same clock."""
        low, high = float(stamp_ns), float(stamp_ns + grid_ns)
        if latest_ns is not None:
            high = max(low, min(high, float(latest_ns)))
        if self._high > self._low:
            step = max(1, round((stamp_ns + 0.5 * grid_ns - self.time_ns) / period_ns)) * period_ns
            leak = LEAK * period_ns
            kept_low, kept_high = max(low, self._low + step - leak), min(high, self._high + step + leak)
            if (
                kept_low <= kept_high
            ):  # else messages were lost or the rhythm changed: what the stamp itself says
                low, high = kept_low, kept_high
        self._low, self._high = low, high
        self.time_ns = max(round(0.5 * (low + high)), self.time_ns + 1)
        self.error_s = 0.29e-9 * (high - low)
        return self.time_ns
