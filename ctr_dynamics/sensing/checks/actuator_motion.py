"""What actuators can do: ranges, speeds, whole turns of a wrapped angle; and how far from it a reading is, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from ctr_dynamics.sensing.checks.check_limits import CheckLimits
from ctr_dynamics.sensing.checks.value_trains import Values
from ctr_dynamics.sensing.checks.verdicts import Kind

if TYPE_CHECKING:
    from ctr_dynamics.robot import Robot

MOVED_S = 0.25  # what moves by less than a step within it is at rest
STAYS = "left out unless it stays there"  # what is said of a jump before its fate is known


class Jump(NamedTuple):
    """A joint that has moved by more than its actuator can."""

    joint: int
    change: float
    allowed: float
    elapsed_s: float


class ActuatorMotion:
    """Limits of the motion of N tubes; values are (2 N,): rotations in rad, then translations in m.

    Attributes:
        names: of the joints. scale: steps below which nothing is a jump. speeds: 1/s. acceleration: scales/s^2 that no joint exceeds.
    """

    def __init__(self, n: int, limits: CheckLimits, robot: Robot | None = None) -> None:
        self.n, self.limits = n, limits
        noise = robot.encoders.noise.value if robot is not None else 0.0
        turning = max(limits.rotation_step, limits.noise_factor * noise)
        self.names = tuple(f"tube{i + 1}_{kind}" for kind in ("rotation", "translation") for i in range(n))
        self.scale = (turning,) * n + (limits.translation_step,) * n
        stated = robot.actuators if robot is not None else None
        turn = stated.rotation_speed.value if stated and stated.rotation_speed else limits.rotation_speed
        slide = (
            stated.translation_speed.value
            if stated and stated.translation_speed
            else limits.translation_speed
        )
        self.speeds = (turn,) * n + (slide,) * n
        self.acceleration = max(
            limits.rotation_acceleration / turning,
            limits.translation_acceleration / limits.translation_step,
        )
        self._ranges = (limits.largest_angle,) * n + (limits.longest_robot,) * n
        self.still: Values = (0.0,) * (2 * n)

    def unit(self, joint: int) -> str:
        """Unit of a joint's value."""
        return "rad" if joint < self.n else "m"

    def moves(self, rates: Values) -> bool:
        """Whether something moves at these rates, 1/s."""
        return any(abs(r) * MOVED_S > s for r, s in zip(rates, self.scale, strict=True))

    def bad_value(self, values: Values) -> tuple[Kind, float, str] | None:
        """A value that no robot has: kind, size and words; None where there is none."""
        for i, (value, most) in enumerate(zip(values, self._ranges, strict=True)):
            if abs(value) <= most:
                continue
            if not math.isfinite(value):
                text = f"{self.names[i]} is not finite; the joint state was left out; look at the driver"
                return Kind.NOT_FINITE, math.inf, text
            hint = "degrees? give radians" if i < self.n else "millimetres? give metres"
            unit = self.unit(i)
            text = f"{self.names[i]} is {value:.4g} {unit}, limit {most:.3g} {unit}: {hint}; left out"
            return Kind.OUT_OF_RANGE, abs(value), text
        return None

    def jump(self, old: Values, new: Values, elapsed_s: float) -> Jump | None:
        """The joint that exceeds its speed most, between two values; None where none does."""
        worst, worst_ratio = None, 1.0
        for i, (a, b, speed, step) in enumerate(zip(old, new, self.speeds, self.scale, strict=True)):
            allowed = speed * elapsed_s + step
            ratio = abs(b - a) / allowed
            if ratio > worst_ratio:
                worst, worst_ratio = Jump(i, b - a, allowed, elapsed_s), ratio
        return worst

    def beside(self, last: Values, ahead: Values, new: Values, elapsed_s: float) -> Jump | None:
        """The joint that lies farthest beside its way from the ``last`` values to those ``ahead``; None where none does by more than a step."""
        off = [
            (y - min(max(y, min(a, b)), max(a, b))) / s
            for a, b, y, s in zip(last, ahead, new, self.scale, strict=True)
        ]
        i = max(range(len(off)), key=lambda joint: abs(off[joint]))
        if abs(off[i]) <= 1.0:
            return None
        return Jump(i, off[i] * self.scale[i], self.scale[i], elapsed_s)

    def stray_text(self, stray: Jump) -> str:
        """A message off the rhythm and beside the motion in words; :data:`STAYS` in it is to be replaced once its fate is known."""
        unit = self.unit(stray.joint)
        return (
            f"{self.names[stray.joint]} lies {stray.change:.4g} {unit} beside its motion, limit {stray.allowed:.3g} {unit}, "
            f"in a message {1e3 * stray.elapsed_s:.1f} ms after the last; {STAYS}; look for a second driver"
        )

    def jump_text(self, jump: Jump) -> str:
        """A jump in words; :data:`STAYS` in it is to be replaced once its fate is known."""
        unit, speed = self.unit(jump.joint), self.speeds[jump.joint]
        return (
            f"{self.names[jump.joint]} jumps by {jump.change:.4g} {unit} within {jump.elapsed_s:.3f} s, "
            f"limit {jump.allowed:.3g} {unit} ({speed:g} {unit}/s); {STAYS}; look at encoder and driver"
        )

    def gap(self, silent_s: float, moved: Values, rates: Values) -> tuple[Kind, str]:
        """A silence of the joints in words, and whether something moved meanwhile: by ``moved``, or at the ``rates`` before it."""
        until = min(silent_s, MOVED_S)
        motion = [max(abs(m), abs(r) * until) / s for m, r, s in zip(moved, rates, self.scale, strict=True)]
        i = motion.index(max(motion))
        silence = f"no usable joint state for {silent_s:.3f} s, limit {self.limits.gap_s:g} s"
        if motion[i] <= 1.0:
            return Kind.GAP, f"{silence}, at rest"
        unit = self.unit(i)
        return Kind.GAP_IN_MOTION, (
            f"{silence}, while {self.names[i]} moved at {abs(rates[i]):.3g} {unit}/s (by {abs(moved[i]):.3g} {unit}); "
            "the vibration from it is not known; look at the driver"
        )

    def apart_text(self, one: Values, other: Values) -> tuple[float, str, str]:
        """Two drivers in words: how far apart they are, the unit, and the text."""
        apart = [abs(a - b) / s for a, b, s in zip(one, other, self.scale, strict=True)]
        i = apart.index(max(apart))
        size, unit = apart[i] * self.scale[i], self.unit(i)
        zero = "" if any(other) else " (all zero)"
        text = (
            f"two publishers on one topic, {self.names[i]} {size:.3g} {unit} apart, limit {self.scale[i]:.3g} {unit}; "
            f"the train that was there first is used, the other{zero} left out; stop one driver"
        )
        return size, unit, text


class Unwrapping:
    """Whole turns added to angles that a driver gives modulo a turn.

    Args:
        n: number of tubes. turns: rad, by which wrapped angles jump.

    Attributes:
        offsets: (N,) rad added now. wraps: whether an angle has wrapped so far.
    """

    def __init__(self, n: int, turns: Sequence[float]) -> None:
        self.turns = tuple(turns)
        self.offsets: Values = (0.0,) * n
        self.wraps = False

    def next_offsets(
        self, last: Values, raw: Values, speeds: Values, scale: Values, elapsed_s: float
    ) -> Values:
        """Offsets for readings ``raw`` after the unwrapped values ``last``, ``elapsed_s`` before.

        An angle has wrapped where it has moved faster than its actuator, and by no more than that from a whole turn. Once a driver is known to
        wrap, the nearer of both ways is taken, however long it took.
        """
        offsets = list(self.offsets)
        for i, offset in enumerate(self.offsets):
            allowed = speeds[i] * elapsed_s + scale[i]
            change = raw[i] + offset - last[i]
            if abs(change) <= (min(allowed, math.pi) if self.wraps else allowed):
                continue
            for turn in self.turns:
                back = math.copysign(turn, change)
                if abs(change - back) <= min(allowed, 0.5 * turn):
                    offsets[i] = offset - back
                    break
        return tuple(offsets)

    def take(self, offsets: Values) -> int | None:
        """Use offsets from now on; returns the angle that has wrapped with them, None where none has."""
        if offsets == self.offsets:
            return None
        turned = next(i for i, (a, b) in enumerate(zip(self.offsets, offsets, strict=True)) if a != b)
        self.offsets, self.wraps = offsets, True
        return turned
