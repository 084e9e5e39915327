"""Stamps against the clocks they are told apart by: the time on the stamps' clock at an arrival, and each stamp once."""

from __future__ import annotations

from collections import deque

LIMIT_NS = 1_000_000_000
"""Stamps farther than this from where they are expected are of another clock, or of one that has been set back."""
AGES = 100  # joint states of which the quickest tells how old stamps are at arrival
WILD = 3  # joint states in a row with stamps far from the known clock: they are of another


class StampClock:
    """Time on the clock of the joint stamps, from that of their arrival: a node's, or a recorder's log time.

    The smallest difference of the last joint states is taken as that of the clocks: clocks drift, and a stamp may be ahead of
    its time. One stamp that is wildly off changes nothing, three in a row do.

    Args:
        own: arrivals are on the clock that stamps (a node's), as long as the two differ by no more than ``limit_ns``; steps then follow
            real time, however old joints are when they arrive. A recorder's clock may be any.
        limit_ns: how far a stamp may lie from where it is expected.
    """

    def __init__(self, own: bool = True, limit_ns: int = LIMIT_NS) -> None:
        self.own, self.limit_ns = own, limit_ns
        self.known = False
        self.offset_ns = 0
        self.agrees = True
        self._streak = 0
        self._ages: deque[int] = deque(maxlen=AGES)

    def sample(self, stamp_ns: int, arrival_ns: int) -> bool:
        """A joint state with that stamp arrived at that time; False where it is wildly ahead, and nothing follows it yet: it is to be left out."""
        offset = arrival_ns - stamp_ns
        if self.known and abs(offset - self.offset_ns) > self.limit_ns:
            self._streak += 1
            if self._streak < WILD:
                return offset > self.offset_ns
            self._ages.clear()
        self._streak = 0
        self._ages.append(offset)
        self.agrees = abs(offset) <= self.limit_ns
        self.offset_ns = 0 if self.own and self.agrees else self.age_ns
        self.known = True
        return True

    def rejection(self, stamp_ns: int, arrival_ns: int) -> str:
        """What to say of a joint state that :meth:`sample` has rejected."""
        ahead_s = (stamp_ns - self.at(arrival_ns)) * 1e-9
        return f"stamp {ahead_s:.3f} s ahead, limit {self.limit_ns * 1e-9:g} s; left out unless others follow"

    @property
    def age_ns(self) -> int:
        """How old, by the clock of arrivals, the stamp of the quickest of the last joint states was at its arrival."""
        return min(self._ages, default=0)

    def at(self, now_ns: int) -> int:
        """The stamps' time at a time of the arrivals' clock."""
        return now_ns - self.offset_ns


class EachOnce:
    """Lets stamps through in their order: none that is not later than all before it, not even after a restart.

    Attributes:
        last_ns: the last that went through. behind_ns: how far the last one asked for lay before it; 0 where it went through.
    """

    def __init__(self) -> None:
        self.last_ns: int | None = None
        self.behind_ns = 0
        self._may_go_back = False

    def passes(self, stamp_ns: int) -> bool:
        """Whether that stamp may go out; it counts as gone then."""
        if self.last_ns is not None and stamp_ns <= self.last_ns:
            behind_ns = self.last_ns - stamp_ns
            if not (self._may_go_back and behind_ns > LIMIT_NS):
                self.behind_ns = max(behind_ns, 1)
                return False
        self.last_ns, self.behind_ns, self._may_go_back = stamp_ns, 0, False
        return True

    def forget(self) -> None:
        """The clock itself has gone back (a simulation starts again): earlier stamps are new."""
        self.last_ns = None

    def let_go_back(self) -> None:
        """After a reset: if the stamps have gone back by more than a second, start from there."""
        self._may_go_back = True
