"""Checks of a pose's orientation: no unit quaternion, none measured, scalar first."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ctr_dynamics.io.messages.unit_quaternions import is_unit, norm
from ctr_dynamics.sensing.checks import rejection_texts
from ctr_dynamics.sensing.checks.check_limits import CheckLimits
from ctr_dynamics.sensing.checks.value_trains import Values
from ctr_dynamics.sensing.checks.verdicts import ACCEPT, Findings, Kind, Verdict


class OrientationChecks:
    """Orientations of one tracker, in the order of arrival.

    Args:
        exact: whether the tracker is said to be free of noise; equal orientations are then nothing odd.

    Attributes:
        measured: False while all orientations are equal though positions move. scalar_first: whether components come in the order w, x, y, z.
    """

    def __init__(self, findings: Findings, limits: CheckLimits, exact: bool) -> None:
        self.findings, self.limits, self.exact = findings, limits, exact
        self.forget()

    def forget(self) -> None:
        """Start again; findings stay."""
        self.measured, self.scalar_first = True, False
        self._equal = 0  # different positions in a row with one orientation
        self._first: int | None = None
        self._last: tuple[Values, Values] | None = None
        self._reordered = 0  # poses in a row that fit only in the other order

    def check(
        self, at: int, pose: tuple[Values, Values], expected_wxyz: Sequence[float] | None = None
    ) -> Verdict:
        """Verdict on a pose's orientation: "accept", "correct" (its position only) or "drop"."""
        unmeasured = self._unmeasured(at, pose)
        if unmeasured is not None:
            return unmeasured
        quaternion = pose[1]
        size = norm(quaternion)
        if not is_unit(size):
            text = rejection_texts.no_quaternion(size)
            self.findings.add(Kind.QUATERNION, at, abs(size - 1.0), "", text)
            return Verdict("drop", Kind.QUATERNION, text)
        return ACCEPT if expected_wxyz is None else self._ordered(at, quaternion, expected_wxyz)

    def _unmeasured(self, at: int, pose: tuple[Values, Values]) -> Verdict | None:
        """Position only, where orientations are equal bit by bit though positions are not."""
        last, self._last = self._last, pose
        if self.exact:
            return None
        if last is not None and last[1] == pose[1]:
            self._equal += last[0] != pose[0]
        elif last is not None:
            self._equal, self.measured = 0, True
        simple = all(v in (0.0, 1.0, -1.0) for v in pose[1]) and any(pose[1])
        if self._equal >= self.limits.equal_orientations:
            self.measured = False
        if self.measured and not simple:
            return None
        if self.measured and last is None:
            return Verdict("correct", orientation=False)
        text = (
            f"orientation is the same, bit by bit, in {self._equal + 1} poses that differ: it is not measured; "
            "set tracker.axes to xyz, so that positions are used"
        )
        early = self._equal if Kind.NO_ORIENTATION not in self.findings else 0
        self.findings.add(Kind.NO_ORIENTATION, at, float(self._equal + 1), "", text, count=1 + early)
        return Verdict("correct", Kind.NO_ORIENTATION, text, orientation=False)

    def _ordered(self, at: int, quaternion: Values, expected_wxyz: Sequence[float]) -> Verdict:
        """In the right order, where orientations fit the expected ones only with w first; position only until that is known."""
        x, y, z, w = quaternion
        given = _angle((w, x, y, z), expected_wxyz)
        reordered = _angle((x, y, z, w), expected_wxyz)
        limits = self.limits
        if reordered <= limits.fitting_rad and given - reordered >= limits.distinct_rad:
            self._reordered += 1
        elif given + 0.5 * limits.distinct_rad < reordered:
            self._reordered, self.scalar_first = 0, False
            return ACCEPT
        elif not self._reordered:  # this orientation does not tell the orders apart
            return ACCEPT
        self.scalar_first |= self._reordered >= limits.scalar_first_poses
        if not self.scalar_first:
            return Verdict("correct", orientation=False)
        text = (
            f"orientations are {reordered:.2f} rad off the expected ones as w, x, y, z (limit {limits.fitting_rad:g} rad), and {given:.2f} rad "
            "as x, y, z, w: they are taken as w, x, y, z; ROS wants w last"
        )
        early = 1 if Kind.SCALAR_FIRST in self.findings else self._reordered
        self.findings.add(Kind.SCALAR_FIRST, at, given, "rad", text, count=early)
        return Verdict("correct", Kind.SCALAR_FIRST, text, quaternion_xyzw=(y, z, w, x))


def _angle(one: Sequence[float], other: Sequence[float]) -> float:
    """Angle between two orientations, rad; quaternions of any norm."""
    dot = abs(sum(a * b for a, b in zip(one, other, strict=True)))
    return 2.0 * math.acos(min(1.0, dot / (math.hypot(*one) * math.hypot(*other))))
