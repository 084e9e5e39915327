"""What a check says of a message, and what it has found in a stream so far."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Literal

Use = Literal["accept", "correct", "drop"]
Level = Literal["note", "warning", "error"]


class Kind(str, Enum):
    """What is the matter with a message; the value is how diagnostics count it."""

    NOT_FINITE = "not finite"
    OTHER_FRAME = "other frame"
    # stamps
    STAMP_ZERO = "stamp zero"
    STAMP_AHEAD = "stamp ahead"
    LATE = "late"
    CLOCK_BACK = "clock set back"
    CLOCK_AHEAD = "clock set ahead"
    OTHER_CLOCK = "other clock"
    CLOCK_OFFSET = "clock offset"
    DUPLICATE = "duplicate stamp"
    BURSTS = "stamps in bursts"
    ROUNDED = "rounded stamps"
    # values of any stream
    REPEATED = "repeated"
    TWO_PUBLISHERS = "two publishers"
    # joints
    WRAPPED = "angle wrapped"
    OUT_OF_RANGE = "out of range"
    GLITCH = "glitch"
    JUMP = "jump"
    ALL_ZERO = "all zero"
    GAP = "gap"
    GAP_IN_MOTION = "gap in motion"
    # poses
    QUATERNION = "quaternion"
    PLACEHOLDER = "placeholder"
    POLLED = "polled too fast"
    FROZEN = "frozen"
    OUT_OF_REACH = "out of reach"
    NO_ORIENTATION = "orientation not measured"
    SCALAR_FIRST = "scalar first"
    # loads
    BEYOND_REASON = "beyond reason"


_NOTES = {Kind.REPEATED, Kind.WRAPPED, Kind.GAP, Kind.LATE}
_ERRORS = {
    Kind.OTHER_FRAME,
    Kind.STAMP_ZERO,
    Kind.OTHER_CLOCK,
    Kind.TWO_PUBLISHERS,
    Kind.OUT_OF_RANGE,
    Kind.FROZEN,
    Kind.ROUNDED,
    Kind.BURSTS,
    Kind.SCALAR_FIRST,
    Kind.BEYOND_REASON,
}


def level_of(kind: Kind) -> Level:
    """How much a kind of fault matters: an error needs mending, a note costs nothing."""
    return "note" if kind in _NOTES else "error" if kind in _ERRORS else "warning"


@dataclass(frozen=True)
class Verdict:
    """What becomes of a message.

    Attributes:
        use: "accept" as it is; "correct": take it with what differs below; "drop".
        kind, text: what was found, with value, limit, unit and what to do; None and empty where nothing was. An accepted message may have one.
        stamp_ns: the time to use instead of its stamp. error_s: 1-sigma of that, s.
        rotations: (N,) rad to use instead of its own.
        orientation: False where only the position of a pose is to be used. quaternion_xyzw: (4,) to use instead of its own.
        retract_ns: stamp of a message accepted earlier that has turned out wrong and is not to count any more; as it was given out, so corrected
            where it was.
    """

    use: Use
    kind: Kind | None = None
    text: str = ""
    stamp_ns: int | None = None
    rotations: tuple[float, ...] | None = None
    orientation: bool = True
    quaternion_xyzw: tuple[float, float, float, float] | None = None
    retract_ns: int | None = None
    error_s: float = 0.0


ACCEPT = Verdict("accept")


@dataclass
class Finding:
    """One kind of fault in one stream.

    Attributes:
        stream: "joints", "tracker" or "load". count: messages. first_ns, last_ns: when, by arrival where that is known.
        worst: the largest value, in ``unit``. text: of the worst, with limit and what to do.
    """

    stream: str
    kind: Kind
    count: int
    first_ns: int
    last_ns: int
    worst: float
    unit: str
    text: str

    @property
    def level(self) -> Level:
        return level_of(self.kind)

    def line(self, start_ns: int = 0) -> str:
        """One line: how often, from when to when in s after ``start_ns``, and the text of the worst."""
        first, last = ((t - start_ns) * 1e-9 for t in (self.first_ns, self.last_ns))
        when = f"at {first:.3f} s" if self.first_ns == self.last_ns else f"from {first:.3f} to {last:.3f} s"
        return f"{self.kind.value} ({self.count} {when}): {self.text}"


class Findings:
    """Findings of one stream by kind."""

    def __init__(self, stream: str) -> None:
        self.stream = stream
        self._found: dict[Kind, Finding] = {}

    def __iter__(self) -> Iterator[Finding]:
        return iter(self._found.values())

    def __getitem__(self, kind: Kind) -> Finding:
        return self._found[kind]

    def __contains__(self, kind: object) -> bool:
        return kind in self._found

    def count(self, kind: Kind) -> int:
        """How many messages had that fault."""
        return self._found[kind].count if kind in self._found else 0

    def add(self, kind: Kind, at_ns: int, worst: float, unit: str, text: str, count: int = 1) -> None:
        """Count a fault; its text is kept where it is the worst of its kind."""
        worst = min(worst, sys.float_info.max)
        found = self._found.get(kind)
        if found is None:
            self._found[kind] = Finding(self.stream, kind, count, at_ns, at_ns, worst, unit, text)
            return
        found.count += count
        found.last_ns = max(found.last_ns, at_ns)
        found.first_ns = min(found.first_ns, at_ns)
        if worst >= found.worst:
            found.worst, found.text = worst, text

    def uncount(self, kind: Kind, count: int) -> None:
        """Take messages back that have turned out to be of another kind."""
        found = self._found.get(kind)
        if found is not None:
            found.count -= count
            if found.count <= 0:
                del self._found[kind]
