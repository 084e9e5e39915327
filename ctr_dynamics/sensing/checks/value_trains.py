"""Trains of values: which of two publishers on one topic a message continues, and single values that are off.

Values are compared in units of the smallest step that counts (``scale``), so that angles and lengths go together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

Values = tuple[float, ...]
NEW_RATE = 0.5  # share of the newest two messages in the rates of a train
TOO_SOON = (
    0.75  # of the usual time between two messages of a publisher, within which it does not send another
)
SILENT_S = 0.25  # a publisher that is silent for longer has stopped
LOOK_AHEAD_S = 0.1  # a train is continued along its rates for this long, then held
UNEVEN = 0.15  # of the time between two messages of one publisher: how far the other's lies from its middle; trackers keep time better
DENSE = 4  # messages within which returns must follow each other where their stamps say nothing
SMOOTH = 4.0  # a value off by more than this times what the values around it are off is off alone
OFF_BEAT = 0.05  # of a period, by which a message may miss a rhythm that it keeps
BEATS_LOST = 50  # periods after which a rhythm is taken up again
BEATS_KNOWN = 20  # messages after which a rhythm is known


def distance(one: Sequence[float], other: Sequence[float], scale: Sequence[float]) -> float:
    """Euclidean distance of two values in units of ``scale``."""
    return math.sqrt(sum(((a - b) / s) ** 2 for a, b, s in zip(one, other, scale, strict=True)))


class Train:
    """Messages that continue each other.

    Attributes:
        stamp_ns, values: of the newest. rates: 1/s, smoothed. count: messages. first_ns: stamp of the first.
    """

    def __init__(self, stamp_ns: int, values: Values) -> None:
        self.stamp_ns, self.values, self.count, self.first_ns = stamp_ns, values, 1, stamp_ns
        self.rates: Values = (0.0,) * len(values)

    def extend(self, stamp_ns: int, values: Values) -> None:
        """Append a message; one that is not newer is counted only."""
        self.count += 1
        elapsed = (stamp_ns - self.stamp_ns) * 1e-9
        if elapsed > 0:
            weight = 1.0 if self.count == 2 else NEW_RATE
            self.rates = tuple(
                r + weight * ((b - a) / elapsed - r)
                for r, a, b in zip(self.rates, self.values, values, strict=True)
            )
            self.stamp_ns, self.values = stamp_ns, values

    def at(self, stamp_ns: int) -> Values:
        """Values expected at a stamp, along the last rates."""
        ahead = min(max((stamp_ns - self.stamp_ns) * 1e-9, -LOOK_AHEAD_S), LOOK_AHEAD_S)
        return tuple(v + r * ahead for v, r in zip(self.values, self.rates, strict=True))

    @property
    def span_s(self) -> float:
        """From the first to the newest stamp, s."""
        return (self.stamp_ns - self.first_ns) * 1e-9


class TwoTrains:
    """Two publishers on one topic, told apart message by message.

    Attributes:
        mine, other: the train that is used, and the other one.

    Args:
        rhythm_s: usual time between two messages of ``mine``, s. gone_s: silence of ``other`` after which it is forgotten, s.
    """

    def __init__(
        self, mine: Train, other: Train, scale: Sequence[float], rhythm_s: float, gone_s: float
    ) -> None:
        self.mine, self.other, self.scale = mine, other, tuple(scale)
        self._mine_ns, self._gone_ns = rhythm_s * 1e9, gone_s * 1e9
        between = other.stamp_ns - other.first_ns
        self._other_ns = min(self._mine_ns, float(between)) if between > 0 else self._mine_ns

    def apart(self, stamp_ns: int) -> float:
        """How far apart both trains are at a stamp, in scales; infinite where the other is silent."""
        if stamp_ns - self.other.stamp_ns > SILENT_S * 1e9:
            return math.inf
        return distance(self.mine.at(stamp_ns), self.other.at(stamp_ns), self.scale)

    def place(self, stamp_ns: int, values: Values) -> Literal["mine", "other", "gone", "taken over"]:
        """Which train a message continues; "gone": the other one has ended; "taken over": it goes on where mine has stopped.

        A message of the other train is taken in; one of ``mine`` is left to the caller."""
        mine, other = self.mine, self.other
        since_mine, since_other = stamp_ns - mine.stamp_ns, stamp_ns - other.stamp_ns
        if since_other > self._gone_ns:
            return "gone"
        soon = 0 < since_mine < TOO_SOON * self._mine_ns
        soon_for_other = 0 < since_other < TOO_SOON * self._other_ns
        if soon != soon_for_other:
            goes_on = soon_for_other
        else:
            here, there = mine.at(stamp_ns), other.at(stamp_ns)
            goes_on = distance(values, here, self.scale) <= distance(values, there, self.scale)
        if goes_on:
            return "mine"
        if since_other > 0:
            self._other_ns = min(self._other_ns, float(since_other))
        other.extend(stamp_ns, values)
        return "taken over" if since_mine > SILENT_S * 1e9 else "other"


class Beat:
    """The rhythm that a stream had before another one mixed with it."""

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._period_ns = 0.0
        self._kept = 0

    @property
    def period_s(self) -> float:
        """Of the rhythm, s; 0 while none is known."""
        return 1e-9 * self._period_ns if self._kept >= BEATS_KNOWN else 0.0

    def error(self, stamp_ns: int) -> float:
        """Periods by which a stamp misses the rhythm, 0 to 0.5; 0 while none is known. A stamp that keeps it leads it on."""
        last, period = self._last_ns, self._period_ns
        if last is None or period <= 0.0 or not 0 <= stamp_ns - last < BEATS_LOST * period:
            self._period_ns = float(stamp_ns - last) if last is not None else 0.0
            self._last_ns, self._kept = stamp_ns, 0
            return 0.0
        beats = (stamp_ns - last) / period
        whole = round(beats)
        error = abs(beats - whole)
        if error <= OFF_BEAT and whole:
            self._period_ns += 0.1 * ((stamp_ns - last) / whole - period)
            self._last_ns, self._kept = stamp_ns, self._kept + 1
        elif self._kept < BEATS_KNOWN:
            self._last_ns, self._period_ns, self._kept = stamp_ns, float(stamp_ns - last), 0
        return error if self._kept >= BEATS_KNOWN else 0.0


class _Message(NamedTuple):
    stamp_ns: int
    values: Values
    off_beat: float  # periods by which it misses the rhythm


class _Foreign(NamedTuple):
    """A message from which the stream returned, and how far it lay from the messages around it, in scales."""

    message: _Message
    off: Values


class ReturnWatch:
    """Watches a stream for values that leave it and come back at once: b in a, b, a.

    Two publishers are told by the same foreign train coming several times *between* the messages of the stream. A vibration at a quarter or
    half of the sampling rate returns as well, but its messages keep the stream's even rhythm.

    Args:
        scale: (n,) smallest step of each value that counts.
        returns: times the same foreign train must come. within_s: longest time between two of them, s.
        acceleration: scales/s^2, beyond which a single value that is off cannot be motion; None: single values are not looked at.
    """

    def __init__(
        self, scale: Sequence[float], returns: int, within_s: float, acceleration: float | None = None
    ) -> None:
        self.scale, self.returns, self.within_ns = tuple(scale), returns, round(within_s * 1e9)
        self.acceleration = acceleration
        self.forget()

    def forget(self) -> None:
        """Start again."""
        self._last: list[_Message] = []  # three messages, the oldest first
        self._step: Values = ()  # the last change, in scales
        self._foreign: _Foreign | None = None
        self._count, self._score = 0, 0.0
        self._since = 0  # messages since the last return
        self._beat = Beat()
        # the stream and the foreign train, once both are told apart, and whether a rhythm has told which is which
        self.two: tuple[Train, Train] | None = None
        self.by_rhythm = False
        self.glitch: tuple[int, float] | None = (
            None  # stamp of the message before, where it alone was off, and by how many scales
        )

    @property
    def rhythm_s(self) -> float:
        """s between two messages of the stream by the rhythm that it has kept; 0 while none is known. A second one does not change it."""
        return self._beat.period_s

    @property
    def off_beat(self) -> bool:
        """Whether the newest message misses the rhythm that the stream has kept."""
        return bool(self._last) and self._last[-1].off_beat > UNEVEN

    def add(self, stamp_ns: int, values: Values, rhythm_s: float, least_s: float, sure: bool = False) -> None:
        """Take in a message of the stream in arrival order. Sets ``two``, ``by_rhythm`` and ``glitch`` again.

        Args:
            rhythm_s: shortest usual time between its messages, s. least_s: time that at least passes between two measurements, s.
            sure: whether it cannot be motion that it returns.
        """
        self.two = self.glitch = None
        self.by_rhythm = False
        last, scale, before = self._last, self.scale, self._step
        here = _Message(stamp_ns, values, self._beat.error(stamp_ns))
        rhythm_s = max(rhythm_s, self.rhythm_s)
        self._since += 1
        if last:
            self._step = tuple((y - x) / s for x, y, s in zip(last[-1].values, values, scale, strict=True))
        if len(last) >= 2:
            off = tuple(0.5 * (x - y) for x, y in zip(before, self._step, strict=True))
            if math.hypot(*off) > 1.0:
                self._turned(here, before, off, rhythm_s, least_s, sure)
        last.append(here)
        del last[:-3]

    def _turned(
        self, here: _Message, before: Values, off: Values, rhythm_s: float, least_s: float, sure: bool
    ) -> None:
        """The last message lies ``off`` the middle of those around it, after a step ``before`` it; lengths in scales."""
        a, b = self._last[-2:]
        first, second = b.stamp_ns - a.stamp_ns, here.stamp_ns - b.stamp_ns
        share = first / max(first + second, 1)
        chord = tuple(x + share * (y - x) for x, y in zip(a.values, here.values, strict=True))
        aside = distance(b.values, chord, self.scale)
        size = min(math.hypot(*before), math.hypot(*self._step))
        opposite = sum(x * y for x, y in zip(before, self._step, strict=True)) < 0.0
        if opposite and size > max(1.0, distance(a.values, here.values, self.scale)):
            returned = True
        else:  # of two messages with one stamp, both cannot be of one train
            size = aside
            returned = aside > 1.0 and (first == 0 or (second == 0 and self._continues(here)))
        if returned:
            short = min(first, second) < 0.75e9 * rhythm_s and abs(first - second) > UNEVEN * (first + second)
            if short or first + second < 1.5e9 * rhythm_s or (sure and self._since <= DENSE):
                self._count_foreign(a, _Foreign(b, off), here, 0.5 * size)
                self._since = 0
                return
            if sure:
                self._since = 0
            else:
                self._count, self._foreign = 0, None  # a vibration
        # off the line both by count and by time: stamps of arrival are uneven where the motion is even
        self._look_for_glitch(here, min(math.hypot(*off), aside), least_s)

    def _continues(self, here: _Message) -> bool:
        """Whether a message goes on from the messages before the last rather than the last does."""
        if self._foreign is not None or len(self._last) < 3:
            return True
        first, a, b = self._last
        ahead = (b.stamp_ns - a.stamp_ns) / max(a.stamp_ns - first.stamp_ns, 1)
        line = tuple(y + ahead * (y - x) for x, y in zip(first.values, a.values, strict=True))
        return distance(here.values, line, self.scale) < distance(b.values, line, self.scale)

    def _count_foreign(self, a: _Message, foreign: _Foreign, here: _Message, near: float) -> None:
        """Count a return from a foreign message to the train of ``a``; one from that train to the foreign one is the same, seen from there."""
        known, b = self._foreign, foreign.message
        again = known is not None and here.stamp_ns - known.message.stamp_ns <= self.within_ns
        if again and known is not None:
            opposite = math.hypot(*(x + y for x, y in zip(known.off, foreign.off, strict=True)))
            if min(distance(known.message.values, here.values, self.scale), opposite) <= near:
                return
            same = math.hypot(*(x - y for x, y in zip(known.off, foreign.off, strict=True)))
            if min(distance(known.message.values, b.values, self.scale), same) <= near:
                self._count += 1
                self._score += b.off_beat - here.off_beat
                if self._count >= self.returns:
                    trains = _train(a, here), _train(known.message, b)
                    self.two = trains if self._score >= 0.0 else (trains[1], trains[0])
                    self.by_rhythm = abs(self._score) > UNEVEN * self._count
                self._foreign = foreign
                return
        self._count, self._score, self._foreign = 1, b.off_beat - here.off_beat, foreign

    def _look_for_glitch(self, here: _Message, size: float, least_s: float) -> None:
        """Whether the message before was off alone: by more than any actuator accelerates, and its neighbours are on one line."""
        if self.acceleration is None or len(self._last) < 3:
            return
        first, a, b = self._last
        period = max(least_s, 0.5e-9 * (here.stamp_ns - a.stamp_ns))
        if size <= max(2.0, 0.5 * self.acceleration * period**2):
            return
        line = tuple(
            (x + 0.5 * z) / 1.5 for x, z in zip(first.values, here.values, strict=True)
        )  # at a, from the first and the last of the four
        if size > SMOOTH * 1.5 * distance(a.values, line, self.scale):
            self.glitch = b.stamp_ns, size


def _train(*messages: _Message) -> Train:
    """The train of some messages."""
    train = Train(messages[0].stamp_ns, messages[0].values)
    for message in messages[1:]:
        train.extend(message.stamp_ns, message.values)
    return train
