"""Stamps that tell when messages were handed over, or on a coarse grid, spaced as evenly as the sensor measured.

A sensor measures evenly. A stamp of arrival bounds the time of a measurement from above; a stamp that is rounded down bounds it from both
sides. The bounds of many measurements together leave little freedom.
"""

from __future__ import annotations

RESYNC_BURSTS = 2.5  # a spacing that lies more bursts behind has lost messages, or the sensor has paused
LEAK = 0.002  # of a period: bounds of a grid are loosened by it at every message, as the period is not known exactly


class Retiming:
    """Times of measurements from their stamps; every call is one measurement, in order.

    Attributes:
        time_ns: of the last. error_s: 1-sigma of what is left, s.
    """

    def __init__(self, time_ns: int) -> None:
        self.time_ns = time_ns
        self.error_s = 0.0
        self._late: list[
            int
        ] = []  # ns by which the stamp of the last message of each burst lies after its time
        self._stamp_ns = time_ns
        self._low = self._high = 0.0

    def from_bursts(self, stamp_ns: int, period_ns: float, burst_ns: float) -> int:
        """Time of a measurement stamped on arrival. ``period_ns``: mean interval; ``burst_ns``: time from burst to burst."""
        if (
            stamp_ns - self._stamp_ns > 0.5 * burst_ns
        ):  # a burst begins: the one before it ended with its freshest measurement
            self._late = [*self._late[-3:], self._stamp_ns - self.time_ns]
            self.time_ns += min(self._late) // 4
        time_ns = self.time_ns + round(period_ns)
        if stamp_ns - time_ns > RESYNC_BURSTS * burst_ns:
            time_ns = stamp_ns - round(burst_ns - period_ns)
        self._stamp_ns, self.time_ns = stamp_ns, max(min(time_ns, stamp_ns), self.time_ns + 1)
        self.error_s = 0.25e-9 * period_ns
        return self.time_ns

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
