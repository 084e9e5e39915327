"""Input signals in time: joints and tip load, linear between stamps, held or extrapolated after the last, with everything odd counted.

Stamps are integer nanoseconds; times handed to the model are seconds from the first complete joint state.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
ThreePoints = tuple[Floats, Floats, Floats, int, int, int]  # three values and their stamps, ns


class Signal:
    """A vector sampled at stamps, kept for as long as steps may still be taken again.

    Attributes:
        stamps: int ns, increasing; values: one (size,) array each.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self.stamps: list[int] = []
        self.values: list[Floats] = []

    @property
    def interval_ns(self) -> int:
        """ns between the last two samples; 0 before there are two."""
        return self.stamps[-1] - self.stamps[-2] if len(self.stamps) > 1 else 0

    def add(self, stamp_ns: int, value: Floats) -> str:
        """Insert a sample: "new" (after all others), "late" (between others), or "duplicate" (that stamp is known; kept as it was)."""
        if not self.stamps or stamp_ns > self.stamps[-1]:
            self.stamps.append(stamp_ns)
            self.values.append(value)
            return "new"
        i = bisect.bisect_left(self.stamps, stamp_ns)
        if self.stamps[i] == stamp_ns:
            return "duplicate"
        self.stamps.insert(i, stamp_ns)
        self.values.insert(i, value)
        return "late"

    def drop(self, stamp_ns: int) -> None:
        """Take the sample of that stamp away, if there is one."""
        if stamp_ns in self.stamps:
            i = self.stamps.index(stamp_ns)
            del self.stamps[i], self.values[i]

    def forget(self, before_ns: int) -> None:
        """Drop samples that no time from ``before_ns`` on needs; two are left, for what comes after the last is on their line."""
        i = min(bisect.bisect_right(self.stamps, before_ns) - 1, len(self.stamps) - 2)
        if i > 0:
            del self.stamps[:i], self.values[:i]

    def at(self, time_ns: float, extrapolate_ns: int = 0) -> tuple[Floats, Floats]:
        """Value and rate (1/s) at a time.

        Linear between samples, the first before all, extrapolated by the last rate for at most ``extrapolate_ns`` after the last and held from
        there. At a sample the rate is that of the interval before it, so that it does not depend on what comes next.
        """
        stamps, values = self.stamps, self.values
        i = bisect.bisect_left(stamps, time_ns)
        if i == len(stamps):
            if len(stamps) < 2 or extrapolate_ns <= 0:
                return values[-1], np.zeros(self.size)
            i -= 1
        if i == 0:
            return values[0], np.zeros(self.size)
        rate = (values[i] - values[i - 1]) * (1e9 / (stamps[i] - stamps[i - 1]))
        held_ns = stamps[-1] + extrapolate_ns
        value = values[i - 1] + rate * ((min(time_ns, held_ns) - stamps[i - 1]) * 1e-9)
        return value, rate if time_ns <= held_ns else np.zeros(self.size)

    def rows(self, times_ns: list[int], extrapolate_ns: int = 0) -> tuple[Floats, Floats]:
        """Values and rates (times, size) at several times; see :meth:`at`."""
        pairs = [self.at(t, extrapolate_ns) for t in times_ns]
        return np.array([value for value, _ in pairs]), np.array([rate for _, rate in pairs])

    def around(self, first_ns: int, last_ns: int, extrapolate_ns: int = 0) -> ThreePoints | None:
        """Three samples on whose lines lies what :meth:`at` gives at all times between two; None where that is not so."""
        stamps, values = self.stamps, self.values
        i = bisect.bisect_left(stamps, last_ns)
        if i == len(stamps):
            if first_ns > stamps[-1] and (extrapolate_ns <= 0 or i == 1):
                return (values[-1],) * 3 + (0, 1, 2)
            if last_ns - stamps[-1] > extrapolate_ns:
                return None
            i -= 1
        j = max(i - 2, 0)
        if i == 0 or first_ns <= stamps[j]:
            return None
        return values[j], values[i - 1], values[i], stamps[j], stamps[i - 1], stamps[i]

    def slope_changes(self, after_ns: float, until_ns: float, least: Floats) -> list[int]:
        """Stamps between two times at which the rate changes by more than ``least`` (size,), 1/s, in some component."""
        stamps, values = self.stamps, self.values
        found = []
        for i in range(bisect.bisect_right(stamps, after_ns), bisect.bisect_left(stamps, until_ns)):
            change = np.zeros(self.size)
            if i > 0:
                change += (values[i] - values[i - 1]) * (1e9 / (stamps[i] - stamps[i - 1]))
            if i + 1 < len(stamps):
                change -= (values[i + 1] - values[i]) * (1e9 / (stamps[i + 1] - stamps[i]))
            if np.any(np.abs(change) > least):
                found.append(stamps[i])
        return found


@lru_cache(maxsize=16)  # of a driver, it is the same in every message
def joint_order(names: tuple[str, ...], n: int) -> tuple[int, ...] | str:
    """Positions in a JointState's names of tube1_rotation.., tube1_translation..; or what is missing or double, in words."""
    wanted = [f"tube{i + 1}_{kind}" for kind in ("rotation", "translation") for i in range(n)]
    where = {name: i for i, name in enumerate(names)}
    missing = [name for name in wanted if name not in where]
    if missing:
        have = ", ".join(names[:8]) or "none"
        return f"joint state lacks {', '.join(missing)} (it has: {have}); name the joints tubeN_rotation and tubeN_translation"
    double = sorted({name for name in wanted if names.count(name) > 1})
    if double:
        return f"joint state names {', '.join(double)} more than once; name each joint once"
    return tuple(where[name] for name in wanted)


def finite(values: Sequence[float]) -> bool:
    """Whether every number is finite."""
    return all(math.isfinite(v) for v in values)
