"""The way that actuators took while no joint states came: a cubic with the rates before and after."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SPACING_NS = 10_000_000  # of the points on the cubic: straight lines between them leave out 0.1 % of what a motion of 1 Hz turns
FITTED_NS = 40_000_000  # before a gap, that the rate there is taken from: encoder noise is small over it


class KnownActuators(NamedTuple):
    """A joint state: ``stamp_ns`` and the drives' positions ``value`` (2 N,), rad and m."""

    stamp_ns: int
    value: Floats


def end_rate(stamps: Sequence[int], values: Sequence[Floats]) -> Floats:
    """Rate (size,) at the last of increasing ``stamps`` (ns), 1/s: that of a parabola through the last 40 ms, or of what there is."""
    count = sum(stamp >= stamps[-1] - FITTED_NS for stamp in stamps[-50:])
    if count < 2:
        return np.zeros_like(values[-1])
    times = np.array([stamp - stamps[-1] for stamp in stamps[-count:]]) * 1e-9
    powers = times[:, None] ** np.arange(min(count - 1, 2) + 1)
    found, *_ = np.linalg.lstsq(powers, np.array(values[-count:]), rcond=None)
    return np.asarray(found[1], dtype=float)


def bridge(
    stamps: Sequence[int], values: Sequence[Floats], first: KnownActuators, second: KnownActuators
) -> list[KnownActuators]:
    """Points between the last of ``stamps`` (ns; ``values`` (size,) each) and the ``first`` joints after a gap; the ``second`` tell the rate."""
    begin, before = stamps[-1], values[-1]
    length = (first.stamp_ns - begin) * 1e-9
    rate = end_rate(stamps, values)
    rate_after = (second.value - first.value) / ((second.stamp_ns - first.stamp_ns) * 1e-9)
    change = first.value - before
    points = []
    for stamp in range(begin + SPACING_NS, first.stamp_ns - SPACING_NS // 2, SPACING_NS):
        x = (stamp - begin) * 1e-9 / length
        value = before + length * rate * (x * (1.0 - x) ** 2) + length * rate_after * (x**2 * (x - 1.0))
        points.append(KnownActuators(stamp, value + change * (x**2 * (3.0 - 2.0 * x))))
    return points
