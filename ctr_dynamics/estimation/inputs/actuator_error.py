"""What is not known of the actuators that a step was driven by: between joint states, after them, or where the step is not corrected yet."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.output_errors import add_actuator_error
from ctr_dynamics.sensing.interpolation import Signal

Floats = NDArray[np.float64]
# accelerations are looked for in the last 0.16 s; encoder noise is small in rates over 40 ms
SMOOTHED_NS, INTERVALS = 40_000_000, 4
COARSE_NS = 20_000_000  # of joint states this close, a line between them errs by no more than an encoder: 50 urad at 1 rad/s^2


def largest_acceleration(stamps: Sequence[int], values: Sequence[Floats]) -> Floats:
    """Largest acceleration (size,) of a signal of late, 1/s^2: from its mean rates over the last intervals of ``SMOOTHED_NS``."""
    ends = [len(stamps) - 1]
    while len(ends) <= INTERVALS:
        before = bisect.bisect_right(stamps, stamps[ends[-1]] - SMOOTHED_NS) - 1
        if before < 0:
            break
        ends.append(before)
    if len(ends) < 3:
        return np.zeros_like(values[-1])
    times = [1e-9 * (stamps[i] - stamps[-1]) for i in ends]
    places = [values[i].tolist() for i in ends]
    rates = [
        [(b - a) / (t - s) for a, b in zip(first, second, strict=True)]
        for (s, first), (t, second) in pairwise(zip(times, places, strict=True))
    ]
    between = [0.5 * (t - s) for s, t in zip(times[:-2], times[2:], strict=True)]
    changes = zip(between, pairwise(rates), strict=True)
    each = [[abs((b - a) / t) for a, b in zip(*pair, strict=True)] for t, pair in changes]
    return np.array([max(column) for column in zip(*each, strict=True)])


class ActuatorError:
    """Deviations (2 N,) of actuators, rad and m, from those that steps were driven by.

    Args:
        joints: actuators by stamp.
    """

    def __init__(self, joints: Signal) -> None:
        self._joints = joints
        self._accelerations: tuple[int, Floats] | None = None  # and the stamp up to which
        self._uncorrected = np.zeros(joints.size)

    def revise(self, before: Floats, after: Floats) -> None:
        """Steps were driven by ``before`` (2 N,) where the actuators are now known to have been at ``after``."""
        self._uncorrected = np.maximum(self._uncorrected, np.abs(after - before))

    def corrected(self) -> None:
        """All steps have been taken again with what is known."""
        self._uncorrected[:] = 0.0

    def at(self, time_ns: int) -> Floats:
        """Of the step to that time: by the accelerations that the actuators have had of late, and by what is not corrected.

        Actuators are taken to go on a straight line between joint states, and on that of the last two after them.
        """
        stamps = self._joints.stamps
        i = min(max(bisect.bisect_left(stamps, time_ns), 1), len(stamps) - 1)
        if i < 1:
            return self._uncorrected
        since, before = (time_ns - stamps[i]) * 1e-9, (time_ns - stamps[i - 1]) * 1e-9
        if since <= 0.0 and stamps[i] - stamps[i - 1] < COARSE_NS:
            return self._uncorrected
        if self._accelerations is None or self._accelerations[0] != stamps[-1]:
            self._accelerations = stamps[-1], largest_acceleration(stamps, self._joints.values)
        return np.hypot((0.5 * abs(since * before)) * self._accelerations[1], self._uncorrected)

    def inflate(
        self, covariance: Floats, position: Floats, length: float, time_ns: int, open_ns: int
    ) -> float:
        """Add to the ``covariance`` (12, 12) of the tip, in place, what is not known of the actuators; returns the 3-D deviation (m) of that.

        A rotation moves the tip at its distance from the axis, or half the robot's length where tubes turn against each other; a translation
        moves it by as much.

        Args:
            position: (3,) m, of the tip.
            length: m, of tube 1.
            time_ns: of the step. open_ns: how long its input has been without correction.
        """
        error, joints = self.at(time_ns), self._joints
        duration = max(time_ns - joints.stamps[-1], joints.interval_ns, open_ns) * 1e-9
        moved = add_actuator_error(error, length, joints.values[-1], position, duration, covariance)
        return math.sqrt(3.0 * moved)
