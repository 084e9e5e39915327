"""Checks of joint states: numbers, stamps, wrapped angles, jumps that no actuator makes, two drivers, gaps in motion.

A joint state is compared with the last one that was accepted. What an actuator cannot have reached since then is left out. It is believed
where other joint states confirm it and none continues the old position, as after a restart of the driver.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from ctr_dynamics.sensing.checks import rejection_texts
from ctr_dynamics.sensing.checks.actuator_motion import STAYS, ActuatorMotion, Jump, Unwrapping
from ctr_dynamics.sensing.checks.check_limits import CheckOptions
from ctr_dynamics.sensing.checks.frozen_encoders import FrozenEncoders
from ctr_dynamics.sensing.checks.stamp_checks import StampChecks
from ctr_dynamics.sensing.checks.value_trains import TOO_SOON, ReturnWatch, Train, TwoTrains, Values, distance
from ctr_dynamics.sensing.checks.verdicts import ACCEPT, Findings, Kind, Verdict

if TYPE_CHECKING:
    from ctr_dynamics.robot import Robot

BASELINE_S = 0.05  # rates are taken over this long, so that noise does not look like motion
POLLED_LIMIT_S = 0.05  # a driver that repeats its reading for longer is at rest, not polled too fast
ABSURD = 1e6  # rad or m; beyond it nothing is compared
LITTLE = 0.3  # part of the readings that equal the one before: of two drivers in step, one of which repeats itself, a quarter do at most
RECENT = 16  # messages among which values are looked for that come back bit by bit
REPEATING = 4  # times that they come where a driver repeats itself
RUNS = 8  # runs of equal readings that tell how often a driver repeats them


class _JointState(NamedTuple):
    """A joint state under way: times in ns (``at``: by which findings are dated), unwrapped values, and the offsets that unwrap them."""

    stamp_ns: int
    arrival_ns: int | None
    at: int
    values: Values
    offsets: Values
    equal: bool  # to the one before it, as they came


class JointChecks:
    """Joint states of one robot, in the order of arrival.

    Args:
        n: number of tubes. robot: for the noise of its encoders and its rest position; None: no noise is allowed for.

    Attributes:
        findings: what was found so far. stamps: of the stream. rates: (2 N,) rad/s and m/s of the last accepted joint states.
    """

    def __init__(self, n: int, robot: Robot | None = None, options: CheckOptions | None = None) -> None:
        self.n, self.options = n, options or CheckOptions()
        limits = self.limits = self.options.limits
        self.motion = ActuatorMotion(n, limits, robot)
        self.findings = Findings("joints")
        self.stamps = StampChecks("joint state", self.findings, limits, limits.joint_period)
        self._watch = ReturnWatch(
            self.motion.scale, limits.returns, limits.return_s, self.motion.acceleration
        )
        self._encoders = FrozenEncoders()
        self._rests_at_zero = robot is not None and not any((*robot.rest.beta.value, *robot.rest.alpha.value))
        self.forget()

    def forget(self) -> None:
        """Start again, as after a reset; findings stay."""
        self.stamps.forget()
        self._watch.forget()
        self._encoders.forget()
        self.rates = self.motion.still
        self._unwrapping = Unwrapping(self.n, self.options.turns if self.options.unwrap else ())
        self._train: Train | None = None  # the accepted joint states
        self._other: Train | None = None  # those that may replace it
        self._two: TwoTrains | None = None  # of two drivers
        # messages that were left out as strays, and the time of the last; those of them that were of a second driver and are not counted yet
        self._strays, self._of_other = (0, 0), 0
        self._unusable_ns = 0  # stamp of the last joint state without usable values
        self._pending = 0  # joint states left out since the last accepted one
        self._held = 0  # joint states that are zero throughout, at the start
        self._held_ns = 0  # stamp of the first of them
        self._last: tuple[int, Values] | None = None  # stamp and values as they came
        self._given = (-1, -1)  # stamp of the last accepted as it came, and as it was given out
        self._base: tuple[int, Values] = (0, ())  # what rates are taken from
        self._received, self._equal = 0, 0  # since the start, and of these equal to the one before
        self._recent = deque[Values](maxlen=RECENT)
        self._run = 1  # equal readings in a row
        self._runs = deque[int](maxlen=RUNS)  # the last such lengths in motion

    @property
    def moving(self) -> bool:
        """Whether the actuators move, as far as the last joint states tell."""
        return self.motion.moves(self.rates)

    def check(
        self,
        stamp_ns: int,
        arrival_ns: int | None,
        rotations: Sequence[float],
        translations: Sequence[float],
    ) -> Verdict:
        """Verdict on a joint state.

        Args:
            arrival_ns: time of arrival on any one clock; None where it is not known.
            rotations: (N,) rad as read, before gains and offsets. translations: (N,) m.
        """
        at = stamp_ns if arrival_ns is None else arrival_ns
        raw: Values = (*rotations, *translations)
        bad = self.motion.bad_value(raw)
        if bad is not None and (self._train is None or not bad[1] < ABSURD):
            kind, size, text = bad
            self._unusable_ns, self._other = stamp_ns, None  # the driver is still there
            return self._drop(kind, at, size, "", text)
        last, self._last = self._last, (stamp_ns, raw)
        if last is not None:
            self._received, self._equal = self._received + 1, self._equal + (last[1] == raw)
        if last == self._last and self._train is not None:
            text = "a joint state came twice; the first counts; look at the driver"
            return self._drop(Kind.REPEATED, at, 0.0, "", text)
        stamped = self.stamps.check(stamp_ns, arrival_ns, hold_zero=True)
        if stamped.use == "drop":
            return stamped
        train = self._train
        state = _JointState(
            stamp_ns, arrival_ns, at, raw, self._unwrapping.offsets, last is not None and last[1] == raw
        )
        if not any(raw) and not self._rests_at_zero and (train is None or self._jump(train, state)):
            return self._zero(state)
        if train is None:
            return self._start(state)
        newest = self.stamps.newest_ns
        assert newest is not None
        if stamped.retract_ns is not None:
            train.stamp_ns = newest
        state = self._unwrapped(train, state)
        if stamp_ns < newest:
            return self._late(train, state, stamped)
        return self._of_train(state, stamped)

    # -- the usual way --

    def _start(self, state: _JointState) -> Verdict:
        self._train, self._base = Train(state.stamp_ns, state.values), (state.stamp_ns, state.values)
        self._see(state, sure=False)
        self._given = state.stamp_ns, state.stamp_ns
        return self.stamps.take(state.stamp_ns, state.arrival_ns)

    def _of_train(self, state: _JointState, stamped: Verdict) -> Verdict:
        """Verdict on a joint state that is none before the newest: by the train that it continues."""
        self._see(state, sure=self._pending > 0)
        if self._watch.two is not None and self._two is None:
            self._separate()
        train = self._train
        assert train is not None
        if self._two is not None:
            place = self._two.place(state.stamp_ns, state.values)
            if place == "other":
                return self._drop_other(train, state)
            if place != "mine":
                train = self._one_again(place)
        jump = self._jump(train, state)
        if jump is not None:
            return self._jumped(train, state, jump, self.motion.jump_text(jump))
        if self._two is None:
            stray = self._stray(train, state)
            if stray is not None:
                recent = state.at - self._strays[1] <= self.limits.return_s * 1e9
                self._strays = (self._strays[0] if recent else 0) + 1, state.at
                return self._jumped(train, state, stray, self.motion.stray_text(stray))
        return self._accept(train, state, stamped)

    def _stray(self, train: Train, state: _JointState) -> Jump | None:
        """What a second driver sends first: between two messages of a driver that keeps a rhythm, and beside its motion."""
        before_ns, rhythm_ns = max(train.stamp_ns, self._unusable_ns), 1e9 * self._watch.rhythm_s
        since_ns = state.stamp_ns - before_ns
        if not self._watch.off_beat or not 0 < since_ns < TOO_SOON * rhythm_ns:
            return None
        # a message that is stamped late or early lies on the way there, too; but none behind one that was sent on time
        sent = self._unusable_ns > train.stamp_ns
        ahead = train.values if sent else train.at(train.stamp_ns + round(2.0 * rhythm_ns))
        return self.motion.beside(train.values, ahead, state.values, since_ns * 1e-9)

    def _accept(self, train: Train, state: _JointState, stamped: Verdict) -> Verdict:
        if state.values == train.values and self._encoders.noisy:
            return self._frozen(train, state)
        if self._pending and self._two is None:
            self._resolve(train, state)
        self._other = None
        again = state.stamp_ns == self.stamps.newest_ns
        timed = self.stamps.take(state.stamp_ns, state.arrival_ns)
        if timed.use == "drop":
            train.values = state.values
            return timed
        if again and not self.stamps.mode:
            text = rejection_texts.second_of_stamp("joint state", state.stamp_ns)
            return self._drop(Kind.DUPLICATE, state.at, 0.0, "", text)
        time_ns = state.stamp_ns if timed.stamp_ns is None else timed.stamp_ns
        kind, text = timed.kind or stamped.kind, timed.text or stamped.text
        turned = self._unwrapping.take(state.offsets)
        if turned is not None:
            kind = Kind.WRAPPED
            text = (
                f"{self.motion.names[turned]} jumped by a whole turn; unwrapped; let the driver count turns"
            )
            self.findings.add(kind, state.at, 1.0, "", text)
        silent_s = (time_ns - train.stamp_ns) * 1e-9
        if silent_s > self.limits.gap_s:
            moved = tuple(b - a for a, b in zip(train.values, state.values, strict=True))
            kind, text = self.motion.gap(silent_s, moved, self.rates)
            self.findings.add(kind, state.at, silent_s, "s", text)
        retract_ns = stamped.retract_ns
        if self._watch.glitch is not None and self._watch.glitch[0] == self._given[0]:
            retract_ns, kind, text = self._given[1], Kind.GLITCH, self._glitch(state.at)
        self._count_run(train, state)
        if not self.moving:
            self._encoders.take(train.values, state.values)
        train.extend(time_ns, state.values)
        self._follow_rates(time_ns, state.values)
        self._given = state.stamp_ns, time_ns
        if kind is None and timed is ACCEPT and not self._unwrapping.wraps:
            return ACCEPT
        return self._given_out(state, timed.stamp_ns, kind, text, retract_ns)

    def _given_out(
        self,
        state: _JointState,
        time_ns: int | None,
        kind: Kind | None,
        text: str,
        retract_ns: int | None = None,
    ) -> Verdict:
        """The verdict on a joint state that is used, with its values as they are now."""
        rotations = state.values[: self.n] if any(state.offsets) else None
        changed = rotations is not None or time_ns is not None
        return Verdict(
            "correct" if changed else "accept", kind, text, time_ns, rotations, retract_ns=retract_ns
        )

    def _late(self, train: Train, state: _JointState, stamped: Verdict) -> Verdict:
        """A joint state before the newest, within the time that is allowed for."""
        jump = self._jump(train, state)
        if jump is not None:
            text = self.motion.jump_text(jump).replace(STAYS, "left out")
            return self._drop(Kind.GLITCH, state.at, abs(jump.change), "", text)
        return self._given_out(state, None, stamped.kind, stamped.text, stamped.retract_ns)

    def _follow_rates(self, time_ns: int, values: Values) -> None:
        elapsed = (time_ns - self._base[0]) * 1e-9
        if elapsed >= BASELINE_S:
            self.rates = tuple((b - a) / elapsed for a, b in zip(self._base[1], values, strict=True))
            self._base = time_ns, values

    def _count_run(self, train: Train, state: _JointState) -> None:
        """Learn in motion how often a driver repeats a reading under new stamps."""
        if state.equal:
            self._run += 1
            return
        moved = zip(train.values, state.values, self.motion.scale, strict=True)
        if any(abs(b - a) > step for a, b, step in moved):
            self._runs.append(self._run)
        self._run = 1

    # -- wraps and jumps --

    def _elapsed_s(self, train: Train, stamp_ns: int) -> float:
        """Time in which the actuators can have moved since the last of a train, s: no less than one period of the readings."""
        period = self.stamps.least_period_s
        if len(self._runs) >= 3:
            repeats = sorted(self._runs)[len(self._runs) // 2]
            period *= max(1.0, min(repeats, POLLED_LIMIT_S / period))
        return max(abs(stamp_ns - train.stamp_ns) * 1e-9, period)

    def _unwrapped(self, train: Train, state: _JointState) -> _JointState:
        """The joint state with whole turns added to wrapped angles."""
        raw, n = state.values, self.n
        elapsed_s = self._elapsed_s(train, state.stamp_ns)
        motion = self.motion
        offsets = self._unwrapping.next_offsets(train.values, raw, motion.speeds, motion.scale, elapsed_s)
        if not any(offsets):
            return state._replace(offsets=offsets)
        values = tuple(r + o for r, o in zip(raw, offsets, strict=False)) + raw[n:]
        return state._replace(values=values, offsets=offsets)

    def _jump(self, train: Train, state: _JointState) -> Jump | None:
        return self.motion.jump(train.values, state.values, self._elapsed_s(train, state.stamp_ns))

    def _jumped(self, train: Train, state: _JointState, jump: Jump, text: str) -> Verdict:
        """Leave out what cannot be, until enough joint states in a row confirm it; ``text`` says what that is."""
        size = abs(jump.change)
        if self._two is not None:
            return self._drop(Kind.JUMP, state.at, size, "", text)
        other = self._other
        if other is not None and self._jump(other, state) is None:
            other.extend(state.stamp_ns, state.values)
        else:
            other = self._other = Train(state.stamp_ns, state.values)
        if not self._confirmed(train, other):
            self._pending += 1
            return self._drop(Kind.JUMP, state.at, size, "", text)
        self.findings.uncount(Kind.JUMP, self._pending)
        text = text.replace(STAYS, f"believed after {other.count} joint states")
        self.findings.add(Kind.JUMP, state.at, size, "", text)
        self._train, self._other, self._pending, self._held = other, None, 0, 0
        self._watch.forget()
        self._encoders.forget()
        timed = self.stamps.take(state.stamp_ns, state.arrival_ns)
        if timed.use == "drop":
            return timed
        time_ns = state.stamp_ns if timed.stamp_ns is None else timed.stamp_ns
        self._base, self.rates = (time_ns, state.values), self.motion.still
        self._given = state.stamp_ns, time_ns
        self._unwrapping.take(state.offsets)
        return self._given_out(state, timed.stamp_ns, Kind.JUMP, text)

    def _confirmed(self, train: Train, other: Train) -> bool:
        """Whether a position is believed though no actuator can have reached it from the last one."""
        if not any(other.values) or self.motion.bad_value(other.values) is not None:
            return False
        if not any(train.values):
            return other.count >= 2
        if train.count < self.limits.confirm_count:  # the start itself was never confirmed
            return other.count > train.count
        return other.count >= self.limits.confirm_count and other.span_s >= self.limits.confirm_s

    def _resolve(self, train: Train, state: _JointState) -> None:
        """What was left out did not stay, unless this joint state continues it: by now the actuators can have come that far."""
        pending, self._pending = self._pending, 0
        other, scale = self._other, self.motion.scale
        if other is None or Kind.JUMP not in self.findings:
            return
        here, there = train.at(state.stamp_ns), other.at(state.stamp_ns)
        stays = distance(state.values, there, scale) < distance(state.values, here, scale)
        jump = self.findings[Kind.JUMP]
        self.findings.uncount(Kind.JUMP, pending)
        kind, count, fate = (
            (Kind.JUMP, 1, f"believed after {pending} joint states")
            if stays
            else (Kind.GLITCH, pending, "left out")
        )
        self.findings.add(kind, state.at, jump.worst, "", jump.text.replace(STAYS, fate), count)

    def _glitch(self, at: int) -> str:
        """Count, and say of, a joint state that alone was off by more than any actuator accelerates."""
        assert self._watch.glitch is not None
        size = self._watch.glitch[1] * self.motion.scale[0]
        text = (
            f"one joint state was off by {size:.3g} rad (or as much for its unit) and back at once, "
            f"limit {self.limits.rotation_acceleration:g} rad/s^2; taken back; look at the encoder"
        )
        self.findings.add(Kind.GLITCH, at, size, "rad", text)
        return text

    def _frozen(self, train: Train, state: _JointState) -> Verdict:
        """Leave out a reading that noisy encoders cannot give: the driver has not measured again."""
        self._unusable_ns = state.stamp_ns  # the driver is still there
        lasted = (state.stamp_ns - train.stamp_ns) * 1e-9
        text = (
            f"the joints have repeated bit by bit for {lasted:.2f} s, though the encoders are noisy: the driver sends its last reading again; "
            "repeats are left out; look at the driver and its bus"
        )
        return self._drop(Kind.FROZEN, state.at, lasted, "s", text)

    # -- two drivers --

    def _see(self, state: _JointState, sure: bool) -> None:
        stamps = self.stamps
        self._recent.append(state.values)
        self._watch.add(state.stamp_ns, state.values, stamps.rhythm_s, stamps.least_period_s, sure)

    def _separate(self) -> None:
        """Two trains are told apart: go on with the one that keeps the rhythm; where it does not tell, with the accepted one.

        Which was accepted last tells little: while both lie within what actuators can do, each is in turn. One that repeats its values bit by bit is
        not that of encoders whose readings have not.
        """
        assert self._watch.two is not None
        assert self._train is not None
        mine, other = self._watch.two
        scale, accepted = self.motion.scale, self._train.values
        apart = self.motion.jump(mine.values, other.values, self.stamps.least_period_s) is not None
        nearer = distance(accepted, other.values, scale) < distance(accepted, mine.values, scale)
        repeats = [self._recent.count(train.values) >= REPEATING for train in (mine, other)]
        if self._watch.by_rhythm:
            swapped = False
        elif repeats[0] != repeats[1] and self._equal < LITTLE * self._received:
            swapped = repeats[0]
        else:
            swapped = apart and nearer
        if swapped or not any(mine.values):
            mine, other = other, mine
        mine.count = self.limits.confirm_count
        rhythm_s = max(self.stamps.rhythm_s, self._watch.rhythm_s)
        self._two = TwoTrains(mine, other, scale, rhythm_s, self.limits.return_s)
        strays, self._strays = self._strays[0], (0, 0)
        for kind in (Kind.GLITCH, Kind.JUMP):
            self.findings.uncount(kind, min(self.findings.count(kind), max(self.limits.returns, strays)))
        self._of_other = strays
        self._train, self._other, self._pending = mine, None, 0

    def _one_again(self, place: str) -> Train:
        """One of two drivers has stopped: go on with the train that continues."""
        assert self._two is not None
        two = self._two
        train = two.mine if place == "gone" or not any(two.other.values) else two.other
        if train is two.other:
            self._encoders.forget()
        self._train, self._two = train, None
        self._watch.forget()
        return train

    def _drop_other(self, train: Train, state: _JointState) -> Verdict:
        size, unit, text = self.motion.apart_text(train.values, state.values)
        before, self._of_other = self._of_other, 0
        return self._drop(Kind.TWO_PUBLISHERS, state.at, size, unit, text, 1 + before)

    # -- all zero --

    def _zero(self, state: _JointState) -> Verdict:
        """All joints exactly zero: what drivers send before they know better. At the start it is believed where nothing else comes."""
        train, limits = self._train, self.limits
        if train is not None:
            self._see(state, sure=True)
            if self._watch.two is not None and self._two is None:
                self._separate()
            if self._two is not None and not any(self._two.other.values):
                self._two.other.extend(state.stamp_ns, state.values)
                return self._drop_other(self._two.mine, state)
            text = "all joints are exactly zero, and cannot be there; left out; is there a second driver, or one that has lost its drives?"
            return self._drop(Kind.ALL_ZERO, state.at, 0.0, "", text)
        self._held += 1
        self._held_ns = self._held_ns if self._held > 1 else state.stamp_ns
        lasted_s = (state.stamp_ns - self._held_ns) * 1e-9
        confirmed = self._held >= limits.confirm_count and lasted_s >= limits.confirm_zero_s
        text = (
            f"all joints are exactly zero at the start, for {lasted_s:.2f} s; {'believed' if confirmed else 'left out'} "
            f"(limit {limits.confirm_zero_s:g} s); send none before the drives are homed"
        )
        dropped = self._drop(Kind.ALL_ZERO, state.at, lasted_s, "s", text)
        if not confirmed:
            return dropped
        started = self._start(state)
        return Verdict(started.use, Kind.ALL_ZERO, text, started.stamp_ns)

    def _drop(self, kind: Kind, at: int, worst: float, unit: str, text: str, count: int = 1) -> Verdict:
        self.findings.add(kind, at, worst, unit, text, count)
        return Verdict("drop", kind, text)
