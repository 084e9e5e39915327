"""How punctual the published steps are: lateness, step times, skipped steps; numbers without a clock."""

from __future__ import annotations

import heapq
from array import array
from collections import deque
from operator import add
from typing import Any, NamedTuple

LATE_NS = 3_000_000
"""A step published later than one step after it was due is late."""
VERY_LATE_NS = 20_000_000


RECENT_STEPS = 3330
"""Published steps that the diagnostics judge, about 10 s of them."""
STRETCHES = 10  # in which they are forgotten
_UNIT_NS = 1000
_PARTS = 64  # bins to a doubling of the duration
_BITS = 40  # of the longest duration in units: 12 days


class Histogram:
    """Counts of durations in bins of 1 us up to 128 us, and of a sixty-fourth of each doubling beyond, in constant memory; durations in ns.

    Quantiles are the upper edge of their bin, at most 1.6 % too large; the maximum is exact.
    """

    def __init__(self) -> None:
        self.counts = array("Q", bytes(8 * (_bin((1 << _BITS) - 1) + 1)))
        self.count = 0
        self.max_ns = 0

    def add(self, value_ns: int) -> None:
        units = min(max(value_ns, 0) // _UNIT_NS, (1 << _BITS) - 1)
        self.counts[_bin(units)] += 1
        self.count += 1
        self.max_ns = max(self.max_ns, value_ns)

    def quantile(self, fraction: float) -> float:
        """Duration in ms that `fraction` of the values do not exceed; 0 without values."""
        wanted, seen = fraction * self.count, 0
        for index, count in enumerate(self.counts):
            seen += count
            if count and seen >= wanted:
                return min(_upper_edge(index) * _UNIT_NS, self.max_ns) * 1e-6
        return self.max_ns * 1e-6

    def summary(self) -> dict[str, float]:
        """p50, p99, p999 and max in ms."""
        quantiles = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
        values = {name: self.quantile(fraction) for name, fraction in quantiles.items()}
        values["max"] = self.max_ns * 1e-6
        return {name: round(value, 4) for name, value in values.items()}


def _bin(units: int) -> int:
    """The bin of a duration in units."""
    shift = max(units.bit_length() - _PARTS.bit_length(), 0)
    return shift * _PARTS + (units >> shift)


def _upper_edge(index: int) -> int:
    """The least duration in units that belongs to a bin behind that one."""
    shift = max(index // _PARTS - 1, 0)
    return (index - shift * _PARTS + 1) << shift


class Punctuality(NamedTuple):
    """Of published steps: how many, how many of them late and very late, and how many were skipped."""

    steps: int
    late: int
    very_late: int
    skipped: int


NO_STEPS = Punctuality(0, 0, 0, 0)


class StepTiming:
    """Lateness of every published step against the moment it was due.

    Under `predict` a step is due at its own stamp t_k. Under `wait` it is due when the joint state that
    covers t_k arrived, or `input_timeout_ns` after t_k if none had arrived by then. All times are ns of the
    clock that stamps the messages.

    Steps that fall due while the start is still being solved (the static equilibrium of the first joints) are
    counted apart as `start`: the node cannot publish before it has a state.

    `totals`: since the start, and `recent`: of the last ten seconds.
    `period_ns`: between the stamps of the last two joint states; `next_arrival_ns`: when the next one is to be expected, None before two.
    """

    def __init__(self, policy: str, input_timeout_ns: int) -> None:
        self.policy = policy
        self.input_timeout_ns = input_timeout_ns
        self.lateness = Histogram()
        self.step_time = Histogram()
        self.totals = NO_STEPS
        self._stretches = deque([NO_STEPS], maxlen=STRETCHES)  # of the last steps
        self.withheld = self.too_old = 0
        self.restarts = 0
        self.start_steps = 0
        self.start_max_ns = 0
        self.corrections = Histogram()
        self._worst: list[tuple[int, int]] = []  # heap of (lateness, k)
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=4096)  # (joint stamp, arrival), stamps rising
        self._newest_ns: int | None = None  # stamp of the newest joint state
        self.period_ns = 0
        self.next_arrival_ns: int | None = None
        self._last_k: int | None = None
        self._start_until_ns: int | None = None

    def arrived(self, joint_stamp_ns: int, arrival_ns: int) -> None:
        """A joint state came in; ones that do not bring the stamps forward cover nothing new."""
        if self._newest_ns is not None:
            if joint_stamp_ns <= self._newest_ns:
                return
            self.period_ns = joint_stamp_ns - self._newest_ns
            self.next_arrival_ns = arrival_ns + self.period_ns
        self._newest_ns = joint_stamp_ns
        self._arrivals.append((joint_stamp_ns, arrival_ns))

    def restarted(self) -> None:
        """The estimator has reinitialised: k begins at 0 again."""
        self.restarts += 1
        self._last_k = None
        self._start_until_ns = None
        self._arrivals.clear()
        self._newest_ns = self.next_arrival_ns = None

    def stepped(self, steps: int, duration_ns: int) -> None:
        """One call of the estimator took `duration_ns` and gave `steps` steps, at least one."""
        for _ in range(steps):
            self.step_time.add(duration_ns // steps)

    def corrected(self, duration_ns: int) -> None:
        """Going back for an input and forth again took `duration_ns`."""
        self.corrections.add(duration_ns)

    def published(self, k: int, stamp_ns: int, now_ns: int) -> int:
        """Step k with this stamp is out at `now_ns`; returns its lateness in ns."""
        if self._last_k is not None and k > self._last_k + 1:
            self._count(0, 0, 0, k - self._last_k - 1)
        if self._last_k is None:
            self._start_until_ns = now_ns
        self._last_k = k
        lateness = max(now_ns - self._due_ns(stamp_ns, now_ns), 0)
        if self._start_until_ns is not None:
            if stamp_ns <= self._start_until_ns:
                self.start_steps += 1
                self.start_max_ns = max(self.start_max_ns, lateness)
                return lateness
            self._start_until_ns = None
        self._count(1, int(lateness > LATE_NS), int(lateness > VERY_LATE_NS), 0)
        self.lateness.add(lateness)
        if len(self._worst) < 10:
            heapq.heappush(self._worst, (lateness, k))
        elif lateness > self._worst[0][0]:
            heapq.heapreplace(self._worst, (lateness, k))
        return lateness

    def _count(self, *figures: int) -> None:
        """Count steps, late ones, very late ones and skipped ones."""
        self.totals = Punctuality(*map(add, self.totals, figures))
        if self._stretches[-1][0] >= RECENT_STEPS // STRETCHES:
            self._stretches.append(NO_STEPS)
        self._stretches[-1] = Punctuality(*map(add, self._stretches[-1], figures))

    @property
    def recent(self) -> Punctuality:
        """Of the last ``RECENT_STEPS`` steps, of which up to a tenth are forgotten already."""
        return Punctuality(*map(sum, zip(*self._stretches, strict=True)))

    def _due_ns(self, stamp_ns: int, now_ns: int) -> int:
        if self.policy == "predict":
            return stamp_ns
        while self._arrivals and self._arrivals[0][0] < stamp_ns:
            self._arrivals.popleft()
        covered_ns = self._arrivals[0][1] if self._arrivals else now_ns
        return min(covered_ns, stamp_ns + self.input_timeout_ns)

    def report(self) -> dict[str, Any]:
        """Everything as JSON-able numbers; durations in ms."""
        return {
            "policy": self.policy,
            "steps": self.totals.steps,
            "late_over_3ms": self.totals.late,
            "late_over_20ms": self.totals.very_late,
            "late_fraction": self.totals.late / self.totals.steps if self.totals.steps else 0.0,
            "skipped": self.totals.skipped,
            "withheld": self.withheld,
            "too_old": self.too_old,
            "restarts": self.restarts,
            "lateness_ms": self.lateness.summary(),
            "step_ms": self.step_time.summary(),
            "correction_ms": self.corrections.summary(),
            "start": {"steps": self.start_steps, "max_ms": round(self.start_max_ns * 1e-6, 3)},
            "worst": [
                {"k": k, "lateness_ms": round(late * 1e-6, 3)}
                for late, k in sorted(self._worst, reverse=True)
            ],
        }
