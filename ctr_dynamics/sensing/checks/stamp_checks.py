"""Checks of the stamps of one stream: zero, ahead, set back, in bursts, rounded.

Stamps are compared with each other and, where it is known, with the time of arrival. Stamps that only tell the arrival, or are rounded, are
corrected as far as an even rhythm allows (:mod:`retiming <ctr_dynamics.sensing.checks.retiming>`).
"""

from __future__ import annotations

import math
from collections import deque
from typing import Literal

from ctr_dynamics.sensing.checks.check_limits import CheckLimits
from ctr_dynamics.sensing.checks.retiming import Retiming, begins_burst
from ctr_dynamics.sensing.checks.verdicts import ACCEPT, Findings, Kind, Verdict

WINDOW = 32  # intervals between stamps that are looked at
QUICKEST_S = (
    5.0  # the quickest arrival of this long, and of as long before, tells the offset between the clocks
)
LEAP_S = 0.5  # a longer step of the stamps is a pause, and says nothing about the rhythm
WILD = 3  # messages in a row whose stamps agree that the clock has been set
AT_ONCE_NS = 2_000_000  # messages that arrive within it were handed over at once
STANDING = 8  # messages with one and the same stamp in a row
RHYTHM_FROM = 10  # steps from which the shortest usual one is first taken
RHYTHM_STEP = (
    0.0025  # of itself, by which a longer step raises it; a shorter one lowers it by four times as much
)
# later times (1973) are of a wall clock, and no simulation has run for so long
WALL_NS = 100_000_000 * 1_000_000_000
LOOK_EVERY = 4  # messages between two looks at the window
Mode = Literal["", "bursts", "grid", "unusable"]


class StampChecks:
    """Stamps of one stream, in the order of arrival.

    Args:
        noun: of a message, for texts. findings: where faults are counted. period_s: assumed between messages until it is known, s.

    Attributes:
        newest_ns: the newest stamp as it came. mode: what the stamps are recognised as; empty where they are times of measurement.
    """

    def __init__(self, noun: str, findings: Findings, limits: CheckLimits, period_s: float) -> None:
        self.noun, self.findings, self.limits, self._given_period_s = noun, findings, limits, period_s
        self.forget()

    def forget(self) -> None:
        """Start again, as after a reset; findings stay."""
        self.newest_ns: int | None = None
        self.mode: Mode = ""
        self.retiming: Retiming | None = None
        self._steps: deque[tuple[int, int]] = deque(
            maxlen=WINDOW
        )  # ns between stamps, ns between arrivals or -1
        self._follow = 0  # steps seen
        self._total = 0  # ns, of these steps
        self._arrivals = 0  # arrivals seen
        self._quickest = self._quickest_before = (
            0  # ns, least arrival - stamp of this stretch, and of this and the one before
        )
        self._stretch_ns = 0  # arrival that this stretch began with
        self._arrival_ns: int | None = None
        self._period_ns = self._rhythm_ns = self._given_period_s * 1e9
        self._burst_ns, self._grid_ns = 0.0, 0
        self._resumes = False  # whether a pause was so short ago that the window is not full
        self._even = False  # whether enough stamps are known, and none follows another at once
        self._steady_ns = 0.0  # mean time between messages when that was even last; 0 where it is not usual
        self._zero_held = False
        self._taken = self._ahead = self._ahead_ago = self._back = 0
        self._standing, self._standing_since_ns, self._moving = 0, 0, 0
        self._back_ns = 0
        self._before_leap_ns: int | None = None
        self._since_leap = 0

    # -- what is known --

    @property
    def period_s(self) -> float:
        """Mean time between messages, s."""
        return self._period_ns * 1e-9

    @property
    def rhythm_s(self) -> float:
        """Shortest usual time between two messages (one in five is shorter), s. Lost messages do not change it, a second publisher slowly does."""
        return self._rhythm_ns * 1e-9

    @property
    def least_period_s(self) -> float:
        """Time that at least passes between two measurements, s: the mean where the rhythm is even, else no less than the one assumed."""
        return self.period_s if self._even else max(self.period_s, self._given_period_s)

    @property
    def clock_offset_ns(self) -> int | None:
        """Arrival minus stamp of the quickest of the last messages; None where too few arrivals are known."""
        return self._quickest_before if self._arrivals >= 5 else None

    @property
    def settled(self) -> bool:
        """Whether enough arrivals are known for the quickest of them to tell the offset of the clocks from delays on the way."""
        return self._arrivals >= 20

    @property
    def believed(self) -> bool:
        """Whether these stamps can be used to judge others."""
        return self.mode != "unusable" and Kind.STAMP_ZERO not in self.findings

    @property
    def error_s(self) -> float:
        """1-sigma of the times given out, s; 0 where stamps are believed."""
        return self.retiming.error_s if self.retiming is not None else 0.0

    # -- one message --

    def check(
        self,
        stamp_ns: int,
        arrival_ns: int | None,
        zero_is_wrong: bool = False,
        hold_zero: bool = False,
    ) -> Verdict:
        """Whether a stamp can be that of its message: accepted (perhaps with an earlier one retracted) or dropped.

        Args:
            zero_is_wrong: whether a first stamp of zero cannot be the begin of a simulation's clock.
            hold_zero: whether a first stamp of zero is left out where arrivals are those of a wall clock. It is counted once a second one tells that
                it is no simulation that begins.
        """
        at = stamp_ns if arrival_ns is None else arrival_ns
        if stamp_ns == 0:
            if self._taken or zero_is_wrong or self._zero_held:
                return self._zero(at)  # a simulation's clock may begin at zero, once
            if hold_zero and arrival_ns is not None and arrival_ns > WALL_NS:
                self._zero_held = True
                return Verdict("drop", Kind.STAMP_ZERO, self._zero_text)
        elif arrival_ns is not None and self._arrivals:
            offset, ahead = arrival_ns - stamp_ns, self._ahead_limit_ns()
            if offset < ahead:
                return self._stamped_ahead(at, offset, ahead)
            self._ahead_ago += 1
            if self._ahead_ago > 20:
                self._ahead = 0
        if self.newest_ns is not None and stamp_ns <= self.newest_ns:
            behind_ns = self.limits.late_s * 1e9 if self._back < WILD else 0.0
            if stamp_ns < self.newest_ns - behind_ns or (self._back >= WILD and stamp_ns > self._back_ns):
                return self._stamped_before(stamp_ns, arrival_ns, at)
            return ACCEPT
        self._back = 0
        return ACCEPT

    def take(self, stamp_ns: int, arrival_ns: int | None) -> Verdict:
        """Take in the stamp of a message that is otherwise good, in the order of arrival.

        Returns:
            "accept"; "correct" with the time to use; or "drop" where such stamps cannot be used.
        """
        self._taken += 1
        at = stamp_ns if arrival_ns is None else arrival_ns
        if arrival_ns is not None:
            self._note_arrival(arrival_ns, arrival_ns - stamp_ns)
        if self.newest_ns is None:
            self.newest_ns, self._arrival_ns = stamp_ns, arrival_ns
            return ACCEPT
        step = stamp_ns - self.newest_ns
        if step < 0:
            return ACCEPT  # late, and before others: nothing to learn from
        pause = -1 if arrival_ns is None or self._arrival_ns is None else arrival_ns - self._arrival_ns
        self._arrival_ns = arrival_ns
        hurried = not self.mode and 0 < step < self.limits.short_interval * self._steady_ns
        if hurried and self._even:  # the rhythm is over: look at what follows by itself
            self._forget_steps()
            self._even = False
        self._step(step, pause, at)
        self.newest_ns = stamp_ns
        if self._taken % LOOK_EVERY == 0 or hurried or (self.mode and step > 0):
            self._look()
        if hurried and not self.mode:
            text = (
                f"stamp of the {self.noun} follows the one before after {step * 1e-6:.2g} ms, usual are {self._steady_ns * 1e-6:.3g} ms: "
                "it tells the arrival; stamp at acquisition; left out"
            )
            self.findings.add(Kind.BURSTS, at, 1.0, "", text)
            return Verdict("drop", Kind.BURSTS, text)
        return self._retimed(stamp_ns, arrival_ns, at)

    def pass_over(self, stamp_ns: int, arrival_ns: int | None) -> None:
        """Take in the stamp of a message that is left out for its values: where stamps come in bursts, it has its place among the others."""
        if (
            self.mode == "bursts"
            and self.newest_ns is not None
            and 0 <= stamp_ns - self.newest_ns < LEAP_S * 1e9
        ):
            self.take(stamp_ns, arrival_ns)

    def _note_arrival(self, arrival_ns: int, offset: int) -> None:
        """Follow the least arrival - stamp, ns, over one to two stretches."""
        if not self._arrivals:
            self._quickest = self._quickest_before = offset
            self._stretch_ns = arrival_ns
        elif arrival_ns - self._stretch_ns > QUICKEST_S * 1e9:
            self._quickest_before, self._quickest, self._stretch_ns = (
                min(self._quickest, offset),
                offset,
                arrival_ns,
            )
        self._quickest, self._quickest_before = (
            min(self._quickest, offset),
            min(self._quickest_before, offset),
        )
        self._arrivals += 1

    # -- stamps that cannot be --

    @property
    def _zero_text(self) -> str:
        return f"stamp of the {self.noun} is zero; fill in header.stamp with the time of measurement"

    def _zero(self, at: int) -> Verdict:
        uncounted = self._zero_held or self.newest_ns == 0
        new = Kind.STAMP_ZERO not in self.findings and uncounted
        self.findings.add(Kind.STAMP_ZERO, at, 0.0, "s", self._zero_text, count=2 if new else 1)
        return Verdict("drop", Kind.STAMP_ZERO, self._zero_text)

    def _ahead_limit_ns(self) -> float:
        """The least arrival - stamp, ns, that a message can have: that of the quickest before it, or none on one clock, less a margin."""
        quickest = self._quickest_before
        floor = min(quickest, 0) if abs(quickest) <= self.limits.same_clock_s * 1e9 else quickest
        return floor - self.limits.ahead_s * 1e9

    def _stamped_ahead(self, at: int, offset: int, limit: float) -> Verdict:
        """One or two are wrong; more mean that the clock has been set, or that arrivals scatter more than was known."""
        excess = (limit - offset) * 1e-9
        if excess < self.limits.late_s and not self.settled:
            return ACCEPT  # earlier messages may all have been slow
        self._ahead = self._ahead + 1 if excess < self.limits.late_s or not self._ahead_ago else 1
        self._ahead_ago = 0
        if self._ahead < WILD:
            if limit <= 0.0:
                found = f"{-offset * 1e-9:.3f} s after its arrival, limit {-limit * 1e-9:.3f} s"
            else:  # by another clock than the arrivals
                found = f"{excess + self.limits.ahead_s:.3f} s ahead of those before it, by their arrivals, limit {self.limits.ahead_s:g} s"
            text = f"stamp of the {self.noun} is {found}; stamp at acquisition, with one clock"
            self.findings.add(Kind.STAMP_AHEAD, at, -offset * 1e-9, "s", text)
            return Verdict("drop", Kind.STAMP_AHEAD, text)
        self._ahead = 0
        if excess < self.limits.late_s:
            return ACCEPT
        self._arrivals = 0
        text = f"stamps of the {self.noun} went ahead by {excess:.3f} s against their arrival; keep the clock steady"
        self.findings.add(Kind.CLOCK_AHEAD, at, excess, "s", text)
        return Verdict("accept", Kind.CLOCK_AHEAD, text)

    def _stamped_before(self, stamp_ns: int, arrival_ns: int | None, at: int) -> Verdict:
        """A stamp long before the newest: late, or the clock went back; or the newest was wrong where hardly anything followed it."""
        assert self.newest_ns is not None
        back_s = (self.newest_ns - stamp_ns) * 1e-9
        leapt = self._before_leap_ns is not None and self._before_leap_ns < stamp_ns and self._since_leap <= 1
        if leapt and (arrival_ns is None or self._taken <= 2):
            text = f"stamp of the {self.noun} was {back_s:.3f} s ahead of the next; stamp at acquisition, with one clock"
            self.findings.add(Kind.STAMP_AHEAD, at, back_s, "s", text)
            wrong, self.newest_ns = self.newest_ns, self._before_leap_ns
            self._before_leap_ns = None
            return Verdict("accept", Kind.STAMP_AHEAD, text, retract_ns=wrong)
        self._back = self._back + 1 if self._back and stamp_ns > self._back_ns else 1
        self._back_ns = stamp_ns
        kind = Kind.LATE if self._back < WILD else Kind.CLOCK_BACK
        if self._back == WILD:
            self.findings.uncount(Kind.LATE, WILD - 1)
            self._arrivals = 0
        if kind is Kind.LATE:
            text = f"{self.noun} came after one that is {back_s:.3f} s newer, limit {self.limits.late_s:g} s; find out what holds it up"
        else:
            text = (
                f"stamps of the {self.noun} went back by {back_s:.3f} s, limit {self.limits.late_s:g} s{known_shift(back_s)}; "
                "reset the estimator where it is for good"
            )
        self.findings.add(kind, at, back_s, "s", text, count=WILD if self._back == WILD else 1)
        return Verdict("drop", kind, text)

    # -- the pattern of the stamps --

    def _step(self, step: int, pause: int, at: int) -> None:
        """Note the step from the newest stamp."""
        if step > max(LEAP_S * 1e9, 20.0 * self._period_ns) and self._standing < STANDING:
            self._before_leap_ns, self._since_leap, self._resumes = self.newest_ns, 1, True
            self._forget_steps()
            self._standing = 0
            return
        if step > max(2.0 * self.limits.gap_s * 1e9, 5.0 * self._period_ns):
            self._before_leap_ns, self._since_leap = self.newest_ns, 0
        self._since_leap += 1
        if self._follow == RHYTHM_FROM:
            self._rhythm_ns = float(sorted(s for s, _ in self._steps)[RHYTHM_FROM // 5])
        elif self._follow > RHYTHM_FROM and abs(step - self._rhythm_ns) > 0.02 * self._rhythm_ns:
            self._rhythm_ns *= 1.0 - 4.0 * RHYTHM_STEP if step < self._rhythm_ns else 1.0 + RHYTHM_STEP
        self._follow += 1
        self._total += step - (self._steps[0][0] if len(self._steps) == WINDOW else 0)
        self._steps.append((step, pause))
        if step:
            self._standing, self._moving = 0, self._moving + 1
        else:
            self._standing_since_ns = self._standing_since_ns if self._standing else at
            self._standing, self._moving = self._standing + 1, 0
        if len(self._steps) >= 8 and not self.mode:
            self._period_ns = max(self._total / len(self._steps), 1.0)

    def _forget_steps(self) -> None:
        """What follows is another stretch; a rhythm that is not known yet is its own."""
        self._steps.clear()
        self._total = 0
        if self._follow <= RHYTHM_FROM:
            self._follow = 0

    def _look(self) -> None:
        """Name the pattern of the last stamps."""
        self._resumes &= len(self._steps) < WINDOW
        if len(self._steps) < 6 or (self.mode and self._resumes):
            return  # after a pause, stamps are what they were before it until the window is full
        self._even = len(self._steps) == WINDOW and min(s for s, _ in self._steps) > 0.25 * self._period_ns
        if self._even:
            self._steady_ns = self._period_ns
        elif len(self._steps) == WINDOW:
            self._steady_ns = 0.0
        mode: Mode = ""
        if self._standing >= STANDING and not self._handed_over_at_once():
            mode, self._grid_ns = "unusable", 0
            if self.mode != mode:
                self.findings.uncount(Kind.DUPLICATE, self._standing)
        elif self._in_bursts():
            mode = "bursts"
        else:
            grid = self._grid()
            if grid:
                self._grid_ns = grid
                self._period_ns = max(self._total / len(self._steps), 1.0)
                mode = "grid" if grid < 2.0 * self._period_ns else "unusable"
        if self.mode == "unusable" and self._moving < STANDING:
            mode = "unusable"
        if mode != self.mode:
            self.mode = mode
            self.retiming = None

    def _handed_over_at_once(self) -> bool:
        """Whether the messages with the newest stamp arrived at once as well, as a packet does."""
        pauses = [pause for _, pause in list(self._steps)[-STANDING:]]
        return all(0 <= pause < AT_ONCE_NS for pause in pauses)

    def _in_bursts(self) -> bool:
        """Whether most stamps follow each other at once and the others after a pause."""
        steps = list(self._steps)
        mean = self._total / len(steps)
        limit = self.limits.short_interval * mean * (4.5 if len(steps) == WINDOW else 1.0)
        short = [s < limit and (s > 0 or 0 <= pause < limit) for s, pause in steps]
        ends = [i for i, (s, _) in enumerate(steps) if s > 1.2 * mean]
        if not _make_bursts(short, ends):
            # rounding may part the stamps of a burst, once: a packet of rounded times of measurement goes on with every message
            short = [s < mean and 0 <= pause < limit for s, pause in steps]
            ends = [i for i in ends if steps[i][1] >= limit]
            if 2 * sum(s > 0 for (s, _), is_short in zip(steps, short, strict=True) if is_short) > sum(short):
                return False
            if not _make_bursts(short, ends):
                return False
        whole = sum(s for s, _ in steps[ends[0] + 1 : ends[-1] + 1])
        self._period_ns = whole / (ends[-1] - ends[0])
        self._burst_ns = whole / (len(ends) - 1)
        return self._burst_ns > 1.5 * self._period_ns

    def _grid(self) -> int:
        """ns that all steps are multiples of, where that is not the sensor's rhythm; 0 where the stamps are fine enough."""
        steps = [s for s, _ in self._steps]
        rising = [s for s in steps if s]
        standing = sum(s == 0 and not 0 <= pause < AT_ONCE_NS for s, pause in self._steps)
        if not rising or (not standing and max(rising) == min(rising)):
            return 0
        grid = math.gcd(*rising)
        if standing >= 5:
            return grid if grid >= self.limits.stamp_grid_s * 1e9 else min(rising)
        if grid < self.limits.stamp_grid_s * 1e9:
            return 0
        pauses = [p for _, p in self._steps]
        usual = max(set(rising), key=rising.count)
        odd = sum(s != usual for s in steps)
        if odd < 2 or (odd < 0.2 * len(rising) and len(steps) < WINDOW):
            return 0
        if min(pauses) < 0:
            return grid if min(rising) >= 2 * grid else 0
        # rounded stamps are less even than their arrivals; where messages are lost or come late it is the other way round
        return grid if _scatter(pauses) < 0.5 * _scatter(steps) else 0

    def _retimed(self, stamp_ns: int, arrival_ns: int | None, at: int) -> Verdict:
        """The time to use for a stamp, by what the stamps are recognised as."""
        if not self.mode:
            return ACCEPT
        if self.mode == "bursts":
            size, every = self._burst_ns / self._period_ns, self._burst_ns * 1e-9
            text = (
                f"stamps of the {self.noun} come in bursts of about {size:.0f} every {every:.3f} s: they tell the arrival; "
                "stamp at acquisition; until then their times are spaced evenly"
            )
            self.findings.add(Kind.BURSTS, at, size, "", text)
            if self.retiming is None:
                if self._steps and not begins_burst(self._steps[-1][0], self._burst_ns):
                    # its place in its burst is not known
                    return Verdict("drop", Kind.BURSTS, text)
                self.retiming = Retiming(stamp_ns - round(self._burst_ns))
            time_ns = self.retiming.from_bursts(stamp_ns, self._period_ns, self._burst_ns)
            return Verdict("correct", Kind.BURSTS, text, time_ns, error_s=self.retiming.error_s)
        grid_s = self._grid_ns * 1e-9
        if self.mode == "unusable":
            size_s = grid_s or (at - self._standing_since_ns) * 1e-9
            text = (
                f"stamps of the {self.noun} stand still for {size_s:.3g} s and more: they are rounded; "
                "give header.stamp in nanoseconds; such messages cannot be used"
            )
            early = self._standing if Kind.ROUNDED not in self.findings else 0
            self.findings.add(Kind.ROUNDED, at, size_s, "s", text, count=1 + early)
            return Verdict("drop", Kind.ROUNDED, text)
        text = (
            f"stamps of the {self.noun} are rounded to {grid_s:g} s, limit {self.limits.stamp_grid_s:g} s; "
            "give header.stamp in nanoseconds; until then their times are spaced evenly"
        )
        self.findings.add(Kind.ROUNDED, at, grid_s, "s", text)
        self.retiming = self.retiming or Retiming(stamp_ns - round(self._period_ns))
        quickest = self._quickest_before if self._arrivals else 0
        # stamps ahead of their arrival by up to half the grid are rounded to the nearest, others down
        first_ns = stamp_ns - (self._grid_ns // 2 if quickest < -0.1 * self._grid_ns else 0)
        synchronous = self._arrivals and -self._grid_ns < quickest <= self.limits.same_clock_s * 1e9
        latest_ns = arrival_ns if synchronous else None
        time_ns = self.retiming.from_grid(first_ns, self._period_ns, self._grid_ns, latest_ns)
        return Verdict("correct", Kind.ROUNDED, text, time_ns, error_s=self.retiming.error_s)


def _make_bursts(short: list[bool], ends: list[int]) -> bool:
    """Whether steps are those of bursts, by which are ``short`` and which are the ``ends`` of bursts."""
    many = sum(short)
    return len(ends) >= 2 and many >= 0.45 * len(short) and many + len(ends) >= 0.9 * len(short)


def _scatter(values: list[int]) -> float:
    """Standard deviation."""
    mean = sum(values) / len(values)
    return math.sqrt(sum((v - mean) ** 2 for v in values) / len(values))


def known_shift(shift_s: float) -> str:
    """A hint where a shift of a clock is that of a day or of a time zone."""
    if abs(shift_s - 86400.0) < 60.0:
        return " (a day: the time of day began again at midnight?)"
    halves = shift_s / 1800.0
    if round(halves) and abs(halves - round(halves)) * 1800.0 < 60.0:
        return f" (about {round(halves) / 2:g} h: another time zone?)"
    return ""
