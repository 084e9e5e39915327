"""Checks of the numbers in the input topics: units, signs, names, frames, NaN, quaternions."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, Protocol

from ctr_dynamics.io.messages import cdr
from ctr_dynamics.io.messages.topics import JOINT_STATES, TIP_LOAD, TRACKER_TIP, accepts_frame
from ctr_dynamics.io.messages.unit_quaternions import ROUNDED_WITHIN, is_unit, norm

FRAME = "ctr_base"
LENGTH_LIMIT_M = 1.0  # no laboratory robot is longer
ANGLE_LIMIT_RAD = 4 * math.pi  # two turns; 12.6 read as degrees is a small angle
FORCE_LIMIT_N = 50.0
_JOINT = re.compile(r"tube([1-9][0-9]?)_(rotation|translation)")


@dataclass(frozen=True)
class BagFinding:
    """Something about a bag that its user should know; `topic` is empty for the bag as a whole."""

    level: Literal["note", "warning", "error"]
    topic: str
    text: str


class Inspector(Protocol):
    """Takes in the messages of one topic, serialised (``add``) or decoded (``take``), and sums them up."""

    def add(self, data: bytes) -> None: ...
    def take(self, message: Any) -> None: ...
    def failed(self, error: cdr.CdrError) -> None: ...
    def values(self) -> dict[str, Any]: ...
    def findings(self) -> list[BagFinding]: ...


class _Range:
    """Smallest and largest finite value, and how many were not finite."""

    def __init__(self) -> None:
        self.low = math.inf
        self.high = -math.inf
        self.bad = 0

    def add(self, value: float) -> None:
        if math.isfinite(value):
            self.low = min(self.low, value)
            self.high = max(self.high, value)
        else:
            self.bad += 1

    @property
    def size(self) -> float:
        """Largest magnitude, 0 when there is no finite value."""
        return max(abs(self.low), abs(self.high)) if self.low <= self.high else 0.0

    def as_dict(self) -> dict[str, float | int | None]:
        seen = self.low <= self.high
        return {"min": self.low if seen else None, "max": self.high if seen else None, "not_finite": self.bad}


class _Base:
    """What all inspectors count: frames and messages that cannot be decoded."""

    topic = ""

    def __init__(self, frame: str = FRAME) -> None:
        self.frame = frame
        self.malformed = 0
        self.fault = ""
        self.frames: dict[str, int] = {}

    def failed(self, error: cdr.CdrError) -> None:
        self.malformed += 1
        self.fault = self.fault or str(error)

    def _frame(self, frame: str) -> None:
        if len(self.frames) < 20 or frame in self.frames:
            self.frames[frame] = self.frames.get(frame, 0) + 1

    def _common(self) -> list[BagFinding]:
        found = []
        if self.malformed:
            found.append(
                BagFinding("error", self.topic, f"{self.malformed} messages cannot be decoded ({self.fault})")
            )
        for frame, count in self.frames.items():
            if not accepts_frame(frame, self.frame):
                found.append(
                    BagFinding(
                        "error",
                        self.topic,
                        f"{count} messages are in frame {frame!r}, {self.frame!r} is expected; "
                        + (
                            f"if that is the tracker's frame, set tracker.frame_id={frame}"
                            if self.topic == TRACKER_TIP
                            else "transform them, or name the frame so if it is that one"
                        ),
                    )
                )
        return found

    def _not_finite(self, count: int) -> list[BagFinding]:
        return [BagFinding("warning", self.topic, f"{count} numbers are NaN or infinite")] if count else []


class JointInspector(_Base):
    """Joint names, ranges and units."""

    topic = JOINT_STATES

    def __init__(self, frame: str = FRAME) -> None:
        super().__init__(frame)
        self.ranges: dict[str, _Range] = {}
        self.others: set[str] = set()
        self.uneven = 0
        self.without_positions = 0
        self.disordered = 0
        self.incomplete = 0
        self.messages = 0

    def add(self, data: bytes) -> None:
        try:
            self.take(cdr.decode_joint_state(data))
        except cdr.CdrError as error:
            self.failed(error)

    def take(self, message: cdr.JointStateIn) -> None:
        self.messages += 1
        self.without_positions += not message.positions
        if len(message.names) != len(message.positions):
            self.uneven += 1
        betas: dict[int, float] = {}
        count = 0
        for name, value in zip(message.names, message.positions, strict=False):
            match = _JOINT.fullmatch(name)
            if match is None:
                if len(self.others) < 50:
                    self.others.add(name)
                continue
            count += 1
            self.ranges.setdefault(name, _Range()).add(value)
            if match[2] == "translation":
                betas[int(match[1])] = value
        if count < len(self.ranges):
            self.incomplete += 1
        ordered = [betas[tube] for tube in sorted(betas)]
        if any(inner > outer for inner, outer in pairwise(ordered)):
            self.disordered += 1

    @property
    def tubes(self) -> list[int]:
        return sorted({int(match[1]) for name in self.ranges if (match := _JOINT.fullmatch(name))})

    def values(self) -> dict[str, Any]:
        joints = {name: self.ranges[name].as_dict() for name in sorted(self.ranges)}
        return {"tubes": len(self.tubes), "joints": joints, "other_names": sorted(self.others)}

    def findings(self) -> list[BagFinding]:
        found = self._common()
        if not self.ranges:
            others = ", ".join(sorted(self.others)[:8]) or "none"
            text = (
                f"no joint is named tubeN_rotation or tubeN_translation (names found: {others}); "
                "name them, innermost tube first: --set joints.rotation_names=A,B and joints.translation_names=C,D"
            )
            if self.messages and self.without_positions == self.messages:
                text = f"none of {self.messages} messages holds positions; have the driver fill them in"
            return [*found, BagFinding("error", self.topic, text)]
        missing = [
            name
            for tube in range(1, max(self.tubes) + 1)
            for name in (f"tube{tube}_rotation", f"tube{tube}_translation")
            if name not in self.ranges
        ]
        if missing:
            found.append(BagFinding("error", self.topic, f"missing joints: {', '.join(missing)}"))
        if self.uneven:
            found.append(
                BagFinding("error", self.topic, f"{self.uneven} messages have not as many positions as names")
            )
        if self.incomplete:
            found.append(
                BagFinding(
                    "note",
                    self.topic,
                    f"{self.incomplete} of {self.messages} messages do not hold every joint",
                )
            )
        if self.disordered:
            found.append(
                BagFinding(
                    "error",
                    self.topic,
                    f"{self.disordered} messages break tube1_translation <= tube2_translation <= ... <= 0: "
                    "an inner tube's base lies behind the next outer one's; check tube numbers (1 is the "
                    "innermost)",
                )
            )
        found += self._not_finite(sum(r.bad for r in self.ranges.values()))
        for name, extent in sorted(self.ranges.items()):
            found += self._units(name, extent)
        return found

    def _units(self, name: str, extent: _Range) -> list[BagFinding]:
        if name.endswith("_translation"):
            if extent.size > LENGTH_LIMIT_M:
                text = (
                    f"{name} reaches {extent.size:g} m, limit {LENGTH_LIMIT_M:g} m: millimetres? Give metres"
                )
                return [BagFinding("error", self.topic, text)]
            if extent.high > 0:
                text = (
                    f"{name} reaches {extent.high:+g} m, it must be zero or negative (behind the base plate)"
                )
                return [BagFinding("error", self.topic, text)]
        elif extent.size > ANGLE_LIMIT_RAD:
            text = (
                f"{name} reaches {extent.size:g} rad, limit {ANGLE_LIMIT_RAD:.3g} rad: degrees? Give radians"
            )
            return [BagFinding("error", self.topic, text)]
        return []


class PoseInspector(_Base):
    """Tracker positions, quaternions, frame and units."""

    topic = TRACKER_TIP

    def __init__(self, frame: str = FRAME) -> None:
        super().__init__(frame)
        self.axes = (_Range(), _Range(), _Range())
        self.norm = _Range()
        self.unnormalised = 0
        self.zero = 0

    def add(self, data: bytes) -> None:
        try:
            self.take(cdr.decode_pose_stamped(data))
        except cdr.CdrError as error:
            self.failed(error)

    def take(self, message: cdr.PoseIn) -> None:
        self._frame(message.frame_id)
        for axis, value in zip(self.axes, message.position, strict=True):
            axis.add(value)
        if not all(math.isfinite(q) for q in message.quaternion_xyzw):
            self.norm.bad += 1
            return
        size = norm(message.quaternion_xyzw)
        self.norm.add(size)
        if size == 0.0:
            self.zero += 1
        elif not is_unit(size, ROUNDED_WITHIN):
            self.unnormalised += 1

    def values(self) -> dict[str, Any]:
        ranges = {name: axis.as_dict() for name, axis in zip("xyz", self.axes, strict=True)}
        return {"position_m": ranges, "quaternion_norm": self.norm.as_dict()}

    def findings(self) -> list[BagFinding]:
        found = self._common()
        found += self._not_finite(sum(axis.bad for axis in self.axes) + self.norm.bad)
        size = max(axis.size for axis in self.axes)
        if size > LENGTH_LIMIT_M:
            text = (
                f"positions reach {size:g} m, limit {LENGTH_LIMIT_M:g} m: "
                "millimetres, or another frame? Give metres"
            )
            found.append(BagFinding("error", self.topic, text))
        if self.zero:
            text = (
                f"{self.zero} quaternions are zero; "
                "if the tracker has no orientation, set tracker.axes to xyz"
            )
            found.append(BagFinding("warning", self.topic, text))
        if self.unnormalised:
            text = (
                f"{self.unnormalised} quaternions are not of unit length (norm {self.norm.low:g} to "
                f"{self.norm.high:g}, limit 1 +- {ROUNDED_WITHIN:g})"
            )
            found.append(BagFinding("warning", self.topic, text))
        return found


class WrenchInspector(_Base):
    """Loads: frame, size, NaN."""

    topic = TIP_LOAD

    def __init__(self, frame: str = FRAME) -> None:
        super().__init__(frame)
        self.force = _Range()
        self.torque = _Range()

    def add(self, data: bytes) -> None:
        try:
            self.take(cdr.decode_wrench_stamped(data))
        except cdr.CdrError as error:
            self.failed(error)

    def take(self, message: cdr.WrenchIn) -> None:
        self._frame(message.frame_id)
        for value in message.force:
            self.force.add(value)
        for value in message.torque:
            self.torque.add(value)

    def values(self) -> dict[str, Any]:
        return {"force_N": self.force.as_dict(), "torque_Nm": self.torque.as_dict()}

    def findings(self) -> list[BagFinding]:
        found = self._common() + self._not_finite(self.force.bad + self.torque.bad)
        if self.force.size > FORCE_LIMIT_N:
            text = (
                f"forces reach {self.force.size:g} N, limit {FORCE_LIMIT_N:g} N: millinewtons? Give newtons"
            )
            found.append(BagFinding("warning", self.topic, text))
        return found


def inspector_for(topic: str, frame: str = FRAME) -> Inspector:
    """A new inspector of an input topic, whose messages are in ``frame``."""
    kinds: dict[str, type[JointInspector] | type[PoseInspector] | type[WrenchInspector]] = {
        JOINT_STATES: JointInspector,
        TRACKER_TIP: PoseInspector,
        TIP_LOAD: WrenchInspector,
    }
    return kinds[topic](frame)
