"""A tracker whose poses are older than the robot file says, or whose clock is behind: the delay with which measurements follow the open-loop run.

A delay shows while the robot moves, and looks like a force to the filter, whose prior for it is narrow. The open-loop run does not depend on the
tracker, so every measurement is compared with its tips of the last 0.3 s. Delays and filter compete by how well each foretells the next position
(prequential evidence, Dawid 1984). A clock that is behind makes negative delays. A second search has these too; it must wait for the tips.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.adapted_variances import AdaptationOptions
from ctr_dynamics.estimation.monitoring.densities import density_of_filter, log_changed
from ctr_dynamics.estimation.monitoring.moved_tracker import Moved, MovedTracker
from ctr_dynamics.estimation.monitoring.taken_again import REMEMBERED, drop_from
from ctr_dynamics.kernels.delay_evidence import compare_delays, weigh_changes, weigh_delays

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DelaySearchOptions:
    """When a delay is believed.

    Attributes:
        earliest_s: by which poses may be stamped before their time. longest_s: largest delay beyond the nominal one.
            spacing_s: of those that are tried. A tip at 3 m/s moves by twice the noise of a tracker of 0.35 mm in it.
        least_s: a smaller difference is left to the filter's own estimate.
        prior: probability that a tracker is late beyond that. One in a hundred has a clock or a driver of that kind.
        believed: probability from which on the estimate begins again with the delay.
        near: probability of being near the likeliest delay, from which on that is known.
        drift_s: time in which the open-loop run goes astray by about the tracker's noise, beside a registration that is wrong for good.
        memory_s: s, for which evidence counts. Latency is the same for long. A vibration that gets out of phase was in phase before.
        changes: whether it may change at all. sound_s: s, mean time after which it does, as that of a network or of a driver that starts again.
        lasts_s: s, for which a change has been likely before it is believed. Other faults look like a latency for a moment, one that grows.
        settles_s: s, for which a delay since the start has been likely before it is believed.
        remembered: measurements that may be taken again.
    """

    earliest_s: float = 0.0
    longest_s: float = 0.3
    spacing_s: float = 0.00025
    least_s: float = 0.005
    prior: float = 0.01
    believed: float = 0.99
    near: float = 0.99
    drift_s: float = 1.0
    memory_s: float = 10.0
    changes: bool = True
    sound_s: float = AdaptationOptions.sound_s
    lasts_s: float = 0.2
    settles_s: float = 0.0
    remembered: int = REMEMBERED


CLOCK_BEHIND = DelaySearchOptions(earliest_s=0.1)


class Waiting(NamedTuple):
    """A measured tip that waits for the open-loop run; see :meth:`DelaySearch.add`."""

    stamp_ns: int
    time_s: float
    position: Floats
    predictive: tuple[float, float]
    present_s: float


class Vibrations(NamedTuple):
    """What is known of vibrations that the open-loop run lacks; see :mod:`ctr_dynamics.estimation.monitoring.moving_start`.

    Attributes:
        states: (g, d, 3, n) m, level and both phases of every mode, by amplitude, delay and axis.
        covariance: (g, n, n) m^2, of each axis.
        evidence: (g, d) logarithm.
    """

    states: Floats
    covariance: Floats
    evidence: Floats


class Evidence(NamedTuple):
    """What the measurements up to ``stamp_ns`` say.

    Attributes:
        level: (d, 3) m, how far measurements lie from the open-loop run for every delay, as known from the past. variance: m^2, of it.
        delays: (d,) logarithm of the evidence of every delay; filter: of what the filter foretold.
        changed: (d,) the same of a latency that has changed to every delay, at the time that speaks most for it; began_ns: (d,) stamp before that;
            changed_level: (d, 3) m, the level since then.
        moved: the same of a tracker that has been moved instead.
        vibrations: that the open-loop run lacks since a start in motion; None where none are looked for.
    """

    stamp_ns: int
    level: Floats
    variance: float
    delays: Floats
    filter: float
    changed: Floats
    began_ns: NDArray[np.int64]
    changed_level: Floats
    moved: Moved
    vibrations: Vibrations | None = None


class Belief(NamedTuple):
    """Probability that the tracker is ``late``; the most likely ``delay`` and its deviation ``spread``, s; probability of being ``near`` it.

    ``odds``: logarithm of the odds of being late.
    """

    late: float
    delay: float
    spread: float
    near: float
    odds: float = -math.inf


def tips_at(times: NDArray[np.floating[Any]], stamps: Floats, tips: Floats) -> Floats:
    """(t, 3) m at ``times`` (t,) s, on straight lines between ``tips`` (k, 3) m of ``stamps`` (k,) s."""
    found: Floats = np.stack([np.interp(times, stamps, path) for path in tips.T], axis=1)
    return found


class DelaySearch:
    """Evidence for every delay of the tracker against that of the filter.

    Args:
        noise: m per axis, deviation of a measured position.
        change_s: mean time between two changes of the unknown force. The filter may have met one with every measurement.
        length: m, of the robot outside the base plate at most. registered: m per axis, tolerance of the registration at the tip.
        options: when a delay is believed.
    """

    def __init__(
        self,
        noise: float,
        change_s: float,
        length: float,
        registered: float,
        options: DelaySearchOptions | None = None,
    ) -> None:
        self.options = options = options or DelaySearchOptions()
        self._noise, self._change_s = noise, change_s
        self._moved = MovedTracker(noise, length, registered)
        first, last = (
            round(-options.earliest_s / options.spacing_s),
            round(options.longest_s / options.spacing_s),
        )
        self.delays = options.spacing_s * np.arange(first, last + 1)
        self.clear()

    def clear(self) -> None:
        """Forget all measurements."""
        self._evidence: deque[Evidence] = deque(maxlen=self.options.remembered)
        self._waiting: deque[Waiting] = deque()
        self._belief: tuple[float, Belief] | None = None

    def add(
        self,
        stamp_ns: int,
        time_s: float,
        position: Floats,
        stamps: Floats,
        tips: Floats,
        predictive: tuple[float, float],
        present_s: float = 0.0,
    ) -> None:
        """Take in a measured tip that the filter has met; one of a stamp that is known takes its place.

        It counts as soon as the open-loop run has come to the last time that it may show.

        Args:
            stamp_ns: of its header. time_s: its own time with the nominal delay, s from the first step.
            position: (3,) m, base axes.
            stamps, tips: (k,) s and (k, 3) m of the open-loop run.
            predictive: logarithms of the densities that the filter predicted; see :class:`~ctr_dynamics.estimation.filter.filter_records.Update`.
            present_s: s beyond the nominal delay, with which the filter has met it.
        """
        drop_from(self._evidence, stamp_ns)
        drop_from(self._waiting, stamp_ns)
        self._waiting.append(Waiting(stamp_ns, time_s, position, predictive, present_s))
        while len(stamps) and self._waiting and self.newest(self._waiting[0].time_s) <= stamps[-1]:
            self._take(self._waiting.popleft(), stamps, tips)

    def newest(self, time_s: float) -> float:
        """The newest time (s) of the open-loop run that a measurement of ``time_s`` may show."""
        return time_s - float(self.delays[0])

    def shown(self, time_s: float, stamps: Floats, tips: Floats) -> Floats | None:
        """(d, 3) m of the open-loop run, that measurements of ``time_s`` (s) show with every delay; None where that is not known."""
        times = time_s - self.delays
        if len(stamps) < 2 or times[-1] < stamps[0]:
            return None
        return tips_at(times, stamps, tips)

    def _take(self, measured: Waiting, stamps: Floats, tips: Floats) -> None:
        """Have a measurement count that all tips (k, 3) m of the open-loop run are known for; ``stamps`` (k,) s."""
        shown = self.shown(measured.time_s, stamps, tips)
        if shown is not None:
            self._belief = None
            self._count(measured, measured.position - shown)

    def _count(self, measured: Waiting, residual: Floats) -> None:
        """Evidence with a measurement that lies ``residual`` (d, 3) m from the open-loop run with every delay."""
        stamp_ns, predictive, present_s = measured.stamp_ns, measured.predictive, measured.present_s
        noise = self._noise**2
        if not self._evidence:
            none, began = np.zeros(len(residual)), np.full(len(residual), stamp_ns)
            moved = self._moved.begin(residual[int(np.argmin(np.abs(self.delays - present_s)))])
            self._evidence.append(
                Evidence(stamp_ns, residual, noise, none, 0.0, none, began, residual, moved)
            )
            return
        # 1. The registration and the drift of the open-loop run: a random walk. What is known of the past counts less and less.
        last, options = self._evidence[-1], self.options
        elapsed = (stamp_ns - last.stamp_ns) * 1e-9
        before = last.variance + noise * elapsed / options.drift_s
        total, decay = before + noise, math.exp(-elapsed / options.memory_s)
        gain = before / total
        # 2. Density of the position.
        told = noise, total, gain, decay
        level, delays = np.empty_like(residual), np.empty(len(residual))
        weigh_delays(residual, (last.level, last.delays), told, level, delays)
        # 3. The latency may have changed just now. That leaves the registration as it is; a model that is wrong all of a sudden does not.
        present = int(np.argmin(np.abs(self.delays - present_s)))
        right_before = decay * max(last.filter, float(last.delays[present]))
        changed, began_ns, changed_level = last.changed, last.began_ns, last.changed_level
        if options.changes:
            now = right_before + log_changed(elapsed, options.sound_s)
            changed, began_ns = np.empty_like(delays), np.empty_like(began_ns)
            changed_level = np.empty_like(level)
            weigh_changes(
                residual, (last.changed_level, last.changed, last.began_ns), told, (last.level[present], now, last.stamp_ns),
                changed_level, changed, began_ns,
            )  # fmt: skip
        # 4. Or the tracker has been moved just now.
        own = density_of_filter(predictive, elapsed / self._change_s)
        of_filter = own + self._moved.filter_goes_on(last.filter, last.moved.evidence, elapsed, decay)
        moved = self._moved.add(last.moved, residual[present], elapsed, decay, right_before, of_filter)
        variance = before * (1.0 - gain)
        self._evidence.append(
            Evidence(stamp_ns, level, variance, delays, of_filter, changed, began_ns, changed_level, moved)
        )

    def belief(self, present_s: float) -> Belief:
        """How likely another delay than ``present_s`` (s, beyond the nominal one) is.

        The filter may be right; so may the open-loop run with the delay that the filter has, the tracker moved or not, and so may it with any other.
        """
        if self._belief is None or self._belief[0] != present_s:
            self._belief = present_s, self._judge(present_s)
        return self._belief[1]

    def _judge(self, present_s: float) -> Belief:
        """What :meth:`belief` keeps until another measurement counts."""
        return self._compare(present_s, self._evidence, self.options.changes)

    def _compare(self, present_s: float, known: Sequence[Evidence], changes: bool = True) -> Belief:
        if not known:
            return Belief(0.0, present_s, 0.0, 0.0)
        last, options = known[-1], self.options
        ways = np.stack([last.delays, last.changed] if changes else [last.delays])
        prior = math.log(options.prior / len(self.delays))
        as_now = max(last.filter, last.moved.evidence)
        odds, delay, spread, part = compare_delays(
            self.delays, ways, present_s, options.least_s, prior, as_now
        )
        late = 1.0 / (1.0 + math.exp(-odds)) if odds > 0.0 else math.exp(odds) / (1.0 + math.exp(odds))
        if not late:
            return Belief(0.0, present_s, 0.0, 0.0, odds)
        return Belief(late, delay, spread, late * part, odds)

    @property
    def knows(self) -> bool:
        """Whether any measurement has counted."""
        return bool(self._evidence)

    @property
    def apart(self) -> float:
        """m between the measurements and the open-loop run with the delay that brings them together most."""
        return float(np.linalg.norm(self._evidence[-1].level, axis=1).min()) if self._evidence else 0.0

    def found(self, present_s: float) -> tuple[float, float] | None:
        """The delay that is believed instead of ``present_s``, beyond the nominal one, and its deviation, s; None where there is none.

        One to which the latency has changed was likely as long ago as it is itself, and some time at least. What a model that is suddenly wrong
        does has shown by then: before, a long delay says that it has yet to come.
        """
        belief = self.belief(present_s)
        if not self._sure(belief):
            return None
        always = self.always(present_s)
        if always is not None or not self.options.changes:
            return always
        before = self._compare(present_s, self._until(max(belief.delay, self.options.lasts_s)))
        same = abs(before.delay - belief.delay) <= 2.0 * self.options.least_s
        return (belief.delay, belief.spread) if same and before.near > 0.5 else None

    def always(self, present_s: float) -> tuple[float, float] | None:
        """As :meth:`found`, of delays that have been there since the start."""
        belief = self._compare(present_s, self._evidence, changes=False)
        if self._sure(belief):
            settled = self._compare(present_s, self._until(self.options.settles_s), changes=False)
            if settled.late > 0.5:
                return belief.delay, belief.spread
        return None

    def explains_better(self, other: DelaySearch) -> bool:
        """Whether delays, since the start or since a change, explain what both have counted better, with their prior, than those of ``other``."""
        if not (self._evidence and other._evidence):
            return bool(self._evidence)
        since = max(search._evidence[0].stamp_ns for search in (self, other))
        until = min(search._evidence[-1].stamp_ns for search in (self, other))
        return until > since and self._explained(since, until) > other._explained(since, until)

    def _explained(self, since_ns: int, until_ns: int) -> float:
        """Logarithm of the evidence of all delays together, with their prior, from measurements after ``since_ns``."""
        before, now = (
            next((e for e in reversed(self._evidence) if e.stamp_ns <= stamp_ns), self._evidence[0])
            for stamp_ns in (since_ns, until_ns)
        )
        decay = math.exp((before.stamp_ns - now.stamp_ns) * 1e-9 / self.options.memory_s)
        each = math.log(self.options.prior / len(self.delays))
        ways = now.delays - decay * before.delays
        if self.options.changes:
            # before a change the delay was what it had been: no evidence counts that this had before ``since_ns``
            former = np.where(now.began_ns > before.stamp_ns, before.changed.max(), before.changed)
            ways = np.logaddexp(ways, now.changed - decay * former)
        return each + float(np.logaddexp.reduce(ways))

    def _until(self, seconds: float) -> list[Evidence]:
        """What was known ``seconds`` before the last measurement."""
        until_ns = self._evidence[-1].stamp_ns - round(seconds * 1e9)
        return [e for e in self._evidence if e.stamp_ns <= until_ns]

    def _sure(self, belief: Belief) -> bool:
        return belief.late > self.options.believed and belief.near > self.options.near

    def undecided(self, present_s: float) -> bool:
        """Whether the tracker has been late since the start, by a time that is not known yet."""
        believed = self.options.believed
        if self.belief(present_s).late <= believed:
            return False
        belief = self._compare(present_s, self._evidence, changes=False)
        return belief.late > believed and not self._sure(belief)

    def foretells_better(self, gain: float) -> None:
        """The filter goes on with something else, by which its evidence grows by the logarithm ``gain``."""
        self._belief = None
        if self._evidence:
            last = self._evidence.pop()
            self._evidence.append(last._replace(filter=last.filter + gain))

    def begin_again(self, present_s: float) -> float:
        """The filter goes on from the open-loop run with the delay ``present_s``, and foretells as well as that has done.

        Where no such delay is tried here, it foretells as well as the best that is. Returns by how much its evidence grows.
        """
        gain, self._belief = 0.0, None
        if self._evidence:
            last = self._evidence.pop()
            same = np.abs(self.delays - present_s) <= self.options.least_s
            if not same.any():
                same[:] = True
            known = [last.delays[same], last.changed[same]] if self.options.changes else [last.delays[same]]
            best = max(last.filter, *(float(evidence.max()) for evidence in known))
            self._evidence.append(last._replace(filter=best, moved=last.moved._replace(evidence=-math.inf)))
            gain = best - last.filter
        return gain
