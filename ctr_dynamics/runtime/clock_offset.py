"""The offset between the clock of the stamps and that of the arrivals; and outputs whose stamps only rise."""

from __future__ import annotations

from collections import deque

LIMIT_NS = 1_000_000_000
"""Stamps farther than this from their expected time belong to another clock, or to one that was set back."""
AGES = 100  # joint states: the youngest stamp at its arrival among them gives the offset
OUTLIERS_IN_A_ROW = 3  # so many stamps in a row far from the known clock belong to another one


class ClockOffset:
    """Time on the clock of the joint stamps, from the time of arrival: a node's clock, or the log time of a recording.

    The smallest difference of the last joint states is the offset: clocks drift, and messages are delayed. One outlier changes
    nothing; three in a row mean another clock.

    Args:
        own: arrivals and stamps are of one clock while they differ by no more than ``limit_ns``. Steps then follow real time,
            however late joints arrive. False for a recording, whose clock may be any.
        limit_ns: how far a stamp may lie from its expected time.
    """

    def __init__(self, own: bool = True, limit_ns: int = LIMIT_NS) -> None:
        self.own, self.limit_ns = own, limit_ns
        self.known = False
        self.offset_ns = 0
        self.agrees = True
        self._streak = 0
        self._ages: deque[int] = deque(maxlen=AGES)

    def sample(self, stamp_ns: int, arrival_ns: int) -> bool:
        """Take in stamp and arrival of a joint state. False: it is far ahead, and no others follow it yet; leave it out."""
        offset = arrival_ns - stamp_ns
        if self.known and abs(offset - self.offset_ns) > self.limit_ns:
            self._streak += 1
            if self._streak < OUTLIERS_IN_A_ROW:
                return offset > self.offset_ns
            self._ages.clear()
        self._streak = 0
        self._ages.append(offset)
        self.agrees = abs(offset) <= self.limit_ns
        self.offset_ns = 0 if self.own and self.agrees else self.age_ns
        self.known = True
        return True

    def rejection(self, stamp_ns: int, arrival_ns: int) -> str:
        """Text on a joint state that :meth:`sample` has rejected."""
        ahead_s = (stamp_ns - self.at(arrival_ns)) * 1e-9
        return f"stamp {ahead_s:.3f} s ahead, limit {self.limit_ns * 1e-9:g} s; left out unless others follow"

    @property
    def age_ns(self) -> int:
        """Smallest age of the last joint states at their arrival, by the clock of arrivals, ns."""
        return min(self._ages, default=0)

    def at(self, now_ns: int) -> int:
        """The stamps' time at a time of the arrivals' clock."""
        return now_ns - self.offset_ns


class RisingStamps:
    """Passes only stamps that are later than all before them, even after a restart.

    Attributes:
        last_ns: the last stamp that passed.
        behind_ns: how far the last stamp that was asked about lay before it; 0 where it passed.
    """

    def __init__(self) -> None:
        self.last_ns: int | None = None
        self.behind_ns = 0
        self._may_go_back = False

    def passes(self, stamp_ns: int) -> bool:
        """Whether that stamp may be published; it then counts as published."""
        if self.last_ns is not None and stamp_ns <= self.last_ns:
            behind_ns = self.last_ns - stamp_ns
            if not (self._may_go_back and behind_ns > LIMIT_NS):
                self.behind_ns = max(behind_ns, 1)
                return False
        self.last_ns, self.behind_ns, self._may_go_back = stamp_ns, 0, False
        return True

    def forget(self) -> None:
        """The clock itself was set back (a simulation starts again): earlier stamps are new."""
        self.last_ns = None

    def let_go_back(self) -> None:
        """After a reset: stamps that went back by more than a second pass again."""
        self._may_go_back = True
