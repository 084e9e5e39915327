"""What drives both runs: joint states and the known load by stamp, and beside them the measurement queue.

Inputs are validated, and odd ones counted. A new one tells from which stamp on it changes what was known.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.inputs.actuator_error import ActuatorError
from ctr_dynamics.estimation.inputs.gap_bridge import KnownActuators, bridge
from ctr_dynamics.estimation.inputs.input_validation import Unusable, joint_values, wrench_values
from ctr_dynamics.estimation.inputs.measurement_queue import MeasurementQueue
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.timeline import Timeline
from ctr_dynamics.io.messages.topics import STEP_NS
from ctr_dynamics.model.model import Model
from ctr_dynamics.parameters import Settings, pose_frame
from ctr_dynamics.sensing import ActuatorSignal, TrackerModel
from ctr_dynamics.sensing.checks import Kind, rejection_texts
from ctr_dynamics.sensing.interpolation import Signal

Floats = NDArray[np.float64]
LOAD_GRACE_NS = 100_000_000  # a first load that comes this soon after the joints is there from the start: nodes start one after another
RETURNED = 0.1  # of a jump, within which a load has returned
QUIET_NS = 1_000_000_000  # a load that was wrong is trusted again when it has been back for so long: two publishers take turns

LONGEST_BRIDGE = 1000  # steps that are taken again where joints come back after a gap


class JointGap(NamedTuple):
    """Joints were missing from ``from_ns`` to ``until_ns`` and have changed by ``change`` (2 N,), rad and m, meanwhile."""

    from_ns: int
    until_ns: int
    change: Floats

    @property
    def words(self) -> str:
        """That they were missing, and for how long."""
        return f"joint states were missing for {(self.until_ns - self.from_ns) * 1e-9:.2f} s"


class LoadChange(NamedTuple):
    """A load that changes what was known: from the stamp ``from_ns`` on, and whether it has ``jumped``.

    ``begin_ns``, ``end_ns``: stamps between which it has changed by ``difference`` (6,) N, N m.
    """

    from_ns: int
    jumped: bool
    begin_ns: int
    end_ns: int
    difference: Floats


class LeftOutLoad(NamedTuple):
    """Loads that are left out: the one that ``held`` (6,) N, N m before them, the size of their ``jump`` from it, and the stamp (ns) since when they
    are back at it, None where they are not."""

    held: Floats
    jump: float
    back_ns: int | None

    def after(self, stamp_ns: int, value: Floats) -> LeftOutLoad | None:
        """With another load; None where loads have been back for long."""
        if self.back_ns is not None and stamp_ns - self.back_ns > QUIET_NS:
            return None
        if float(np.linalg.norm(value - self.held)) > RETURNED * self.jump:
            return self._replace(back_ns=None)
        return self if self.back_ns is not None else self._replace(back_ns=stamp_ns)


class InputBuffer:
    """Joints and loads, stored for as long as steps may be taken again, and the measurement queue.

    Args:
        model: the robot.
        tracker: measurement model.
        settings: the parameter table's values.
        health: where odd inputs are counted.

    Attributes:
        timeline: where the estimator stands.
        joints, load: by stamp. actuator_error: of the joints that steps were driven by. measurements: the measurement queue.
        backwards: joint states in a row whose time ran backwards.
        gap: the last one of the joints, until somebody sets it to None.
        window_ns: how late an input may come. timeout_ns: how long after the last joints steps are taken without.
        extrapolating: whether steps are taken on time, with extrapolated joints.
    """

    def __init__(self, model: Model, tracker: TrackerModel, settings: Settings, health: Health) -> None:
        self.model, self.health = model, health
        self.frame = str(settings["output.frame_id"])
        self.window_ns = round(float(settings["filter.window_s"]) * 1e9)
        self.timeout_ns = round(float(settings["input_timeout_s"]) * 1e9)
        self.extrapolating = settings["output.policy"] == "predict"
        self.timeline = Timeline()
        self.measurements = MeasurementQueue(
            tracker, pose_frame(settings), self.window_ns, self.timeline, health
        )
        self._load_delay_ns = round(model.plant.load_delay * 1e9)
        self._least_change = model.load_slope_limit / (STEP_NS * 1e-9)  # of the load's rate, 1/s
        self.load = Signal(6)
        self.clear()

    def clear(self) -> None:
        """Forget everything but the last known load, which goes on acting."""
        self.timeline.clear()
        self.joints = ActuatorSignal(self.model.plant.actuators)
        self.carry_load(self.load)
        self._opening: int | None = None  # ns of the value without load that was put before the first load
        self.measurements.clear()
        self.backwards = 0
        self._left_out: LeftOutLoad | None = None
        self.gap: JointGap | None = None
        self._after_gap: KnownActuators | None = None
        self._gaps: deque[tuple[int, int]] = deque(maxlen=20)  # the last ones, ns
        self.actuator_error = ActuatorError(self.joints)

    @property
    def joint_period_s(self) -> float:
        """s between the last two joint states; 0 before there are two."""
        return self.joints.interval_ns * 1e-9

    def carry_load(self, load: Signal) -> None:
        """Have of loads only the last one of ``load``: what hangs on the robot does so whatever the estimator is told.

        It is forgotten where joints then come from before its time: the clock was set back, or another bag begins.
        """
        self.load = Signal(6)
        self._carried = load.stamps[-1] if load.stamps else None
        if self._carried is not None:
            self.load.add(self._carried, load.values[-1])

    @property
    def t0_ns(self) -> int | None:
        """Stamp of step 0, that of the first complete joint state; None before it."""
        return self.timeline.t0_ns

    # -- what comes in --

    def add_joints(self, stamp_ns: int, names: Sequence[str], positions: Sequence[float]) -> int | None:
        """Take in a joint state; returns the ns from which on actuators are known otherwise than before, None where nothing changes."""
        try:
            value = joint_values(self.model.plant, stamp_ns, names, positions)
        except Unusable as problem:
            self.health.note("joints", problem.kind, problem.text)
            return None
        if self.joints.stamps and stamp_ns < self.joints.stamps[-1] - self.window_ns:
            self.backwards += 1
            back = (self.joints.stamps[-1] - stamp_ns) * 1e-9
            self.health.note(
                "joints",
                "time ran backwards",
                f"stamp {back:.3f} s before the last, limit {self.window_ns * 1e-9:g} s",
            )
            return None
        self.backwards = 0
        given, waiting = KnownActuators(stamp_ns, value), self._after_gap
        self._after_gap = None
        if waiting is not None and 0 < stamp_ns - waiting.stamp_ns <= self.timeout_ns:
            from_ns = self._end_gap(waiting, given)
            self._take(given)
            return from_ns
        changed: list[int | None] = []
        if waiting is not None:  # it was the only one for long
            changed.append(self._end_gap(waiting, None))
        last = self.joints.stamps[-1] if self.joints.stamps else None
        if last is None or stamp_ns - last <= self.timeout_ns:
            changed.append(self._take(given))
        elif stamp_ns - last <= LONGEST_BRIDGE * STEP_NS:
            self._after_gap = given  # the next one tells the rate there
        else:
            changed.append(self._end_gap(given, None))
        return min((from_ns for from_ns in changed if from_ns is not None), default=None)

    def _end_gap(self, first: KnownActuators, second: KnownActuators | None) -> int:
        """Have the actuators known over a gap of which ``first`` is the end; ``second`` is the one after it, None where that is not near.

        They took a cubic with the rates before and after, or a straight line.
        """
        stamp_ns, value = first
        last, taken = self.joints.stamps[-1], self.timeline.taken_ns
        self.gap = JointGap(last, stamp_ns, value - self.joints.drive_position)
        self._gaps.append((last, stamp_ns))
        if taken is not None and taken < stamp_ns and taken - last > LONGEST_BRIDGE * STEP_NS:
            # too many steps were taken with the held value to be taken again: go on from there, not from a line over the gap
            held, _ = Signal.at(self.joints, taken, self.timeout_ns if self.extrapolating else 0)
            self.joints.add(taken, held)
        elif second is not None:
            for point in bridge(self.joints.stamps, self.joints.drive_positions, first, second):
                self.joints.add(*point)
        self._take(first)
        return last + min(self.joints.delay_ns, 0)

    def _take(self, given: KnownActuators) -> int | None:
        """Store a joint state; see :meth:`add_joints`."""
        stamp_ns, value = given
        revised = self._driven(stamp_ns)
        kind = self.joints.add(stamp_ns, value)
        if kind == "duplicate":
            text = rejection_texts.second_of_stamp("joint state", stamp_ns)
            self.health.note("joints", Kind.DUPLICATE.value, text)
            return None
        self.health.joint_stamps.append(stamp_ns)
        if self.t0_ns is None:
            self.timeline.t0_ns = stamp_ns
            if self._carried is not None and self._carried > stamp_ns + LOAD_GRACE_NS:
                self.load.drop(self._carried)
            if self.load.stamps:
                self._open_load(stamp_ns)
            return None
        if revised is not None:
            self.actuator_error.revise(revised[1], self._at(revised[0]))
        i = self.joints.stamps.index(stamp_ns) if kind == "late" else len(self.joints.stamps) - 1
        return (self.joints.stamps[i - 1] if i else stamp_ns) + min(self.joints.delay_ns, 0)

    def retract_joints(self, stamp_ns: int) -> int | None:
        """Leave a joint state out that has turned out wrong; returns as :meth:`add_joints` does.

        The first one stays, as the time line begins with it. So does one whose place would be a gap: it is nearer the truth than nothing.
        """
        if self._after_gap is not None and self._after_gap.stamp_ns == stamp_ns:
            self._after_gap = None  # no step has used it
            return None
        stamps = self.joints.stamps
        i = bisect.bisect_left(stamps, stamp_ns)
        if not 0 < i < len(stamps) or stamps[i] != stamp_ns:
            return None
        since_ns = stamp_ns - stamps[i - 1]
        until_ns = stamps[i + 1] - stamp_ns if i + 1 < len(stamps) else since_ns
        if since_ns + until_ns > self.timeout_ns:
            return None
        taken_ns = self.timeline.taken_ns
        time_ns = stamp_ns if taken_ns is None else min(stamp_ns, taken_ns)
        before = self._at(time_ns)
        self.joints.drop(stamp_ns)
        if time_ns > stamps[i - 1]:
            self.actuator_error.revise(before, self._at(time_ns))
        return stamps[i - 1] + min(self.joints.delay_ns, 0)

    def _driven(self, stamp_ns: int) -> tuple[int, Floats] | None:
        """Where a joint state of that stamp changes most what steps were driven by: the time (ns), and actuators as they are known without it."""
        taken = self.timeline.taken_ns
        if taken is None or stamp_ns > taken:
            return None
        time_ns = taken if stamp_ns > self.joints.stamps[-1] else stamp_ns
        return time_ns, self._at(time_ns)

    def _at(self, time_ns: int) -> Floats:
        return self.joints.at(time_ns, self.timeout_ns if self.extrapolating else 0)[0]

    def add_load(
        self, stamp_ns: int, force: Sequence[float], torque: Sequence[float], frame_id: str
    ) -> LoadChange | None:
        """Take in a known wrench (N, N m); returns the change that it makes, None where there is none.

        One that comes later than the window counts only where it is the newest: it acts from the oldest step on that can be taken again.
        """
        try:
            value = wrench_values(stamp_ns, force, torque, frame_id, self.frame)
        except Unusable as problem:
            self.health.note("load", problem.kind, problem.text)
            return None
        stamp_ns += self._load_delay_ns
        load, taken = self.load, self.timeline.taken_ns
        if self._left_out is not None:
            self._left_out = self._left_out.after(stamp_ns, value)
        if self._left_out is not None and self._left_out.back_ns is None:
            self.health.note("load", "contradicted", "")
            return None
        if load.stamps and taken is not None and stamp_ns < min(load.stamps[-1], taken - self.window_ns):
            late = (taken - stamp_ns) * 1e-9
            self.health.note(
                "load",
                "too late",
                f"load came {late:.3f} s after its stamp and after newer ones, limit {self.window_ns * 1e-9:g} s",
            )
            return None
        known = load.at(stamp_ns)[0] if load.stamps else np.zeros(6)
        if load.stamps[:1] == [self._opening] and stamp_ns < load.stamps[0]:
            del load.stamps[0], load.values[0]  # it opened before a load that was taken for the first
            first = True
        else:
            first = not load.stamps
        kind = load.add(stamp_ns, value)
        if kind == "duplicate":
            self.health.note("load", Kind.DUPLICATE.value, rejection_texts.second_of_stamp("load", stamp_ns))
            return None
        if self.t0_ns is None:
            load.forget(stamp_ns - self.window_ns)
            return None
        i = load.stamps.index(stamp_ns)
        before = load.values[i - 1] if i else np.zeros(6)
        if first:
            self._open_load(self.t0_ns)
            from_ns = (self.t0_ns if self._opening is None else stamp_ns) - 1
        elif i == 0:
            from_ns = self.t0_ns - 1
        elif kind == "late" or not np.array_equal(value, before):
            from_ns = load.stamps[i - 1]
        else:
            return None
        i = load.stamps.index(stamp_ns)  # where the time without load may have been put before it
        begin_ns = load.stamps[i - 1] if i else stamp_ns
        difference = value - load.values[i - 1] if i else np.zeros(6)
        jumped = bool(np.any(np.abs(value - known) > self.model.load_slope_limit))
        return LoadChange(from_ns, jumped, begin_ns, stamp_ns, difference)

    def leave_load_out(self, from_ns: int) -> None:
        """Have the known load stay as it was at ``from_ns``: what came then contradicts the tracker. It counts again once it returns there."""
        load = self.load
        held = load.at(from_ns)[0]
        after = [each for each in zip(load.stamps, load.values, strict=True) if each[0] > from_ns]
        wrong = [value for _, value in after]
        while len(load.stamps) > 1 and load.stamps[-1] > from_ns:
            del load.stamps[-1], load.values[-1]
        jump = max(float(np.linalg.norm(value - held)) for value in wrong)
        self._left_out = LeftOutLoad(held, jump, None).after(*after[-1])
        most, before = (max(math.hypot(*v[:3].tolist()) for v in values) for values in (wrong, [held]))
        self.health.note(
            "load",
            "contradicted",
            f"the robot does not move as by a change of the load from {before:.3g} to {most:.3g} N, as the tracker shows: left out until it is "
            "back; check the sensor, its unit and its frame",
        )

    def _open_load(self, t0_ns: int) -> None:
        """Before the first load there is none, or that one if it comes soon enough after the first joints."""
        first = self.load.stamps[0]
        self._opening = first - 1 if first - t0_ns > LOAD_GRACE_NS else None
        if self._opening is not None:
            self.load.stamps.insert(0, self._opening)
            self.load.values.insert(0, np.zeros(6))

    # -- what steps need of it --

    def load_discontinuities(self, k: int) -> list[float]:
        """Times (s from t0) within step ``k`` at which the load's slope jumps."""
        t0_ns = self.t0_ns
        assert t0_ns is not None
        if len(self.load.stamps) < 2:
            return []
        end_ns = t0_ns + k * STEP_NS
        found = self.load.slope_changes(end_ns - STEP_NS, end_ns, self._least_change)
        return [(stamp - t0_ns) * 1e-9 for stamp in found]

    def covered_step(self, k: int) -> int:
        """The last step up to ``k`` that joints cover; ``k`` where they have been missing for too long to take steps again."""
        covered = (self.joints.stamps[-1] - self.timeline.stamp(0)) // STEP_NS
        return min(k, covered) if k - covered <= LONGEST_BRIDGE else k

    def missing_at(self, time_s: float) -> bool:
        """Whether no joint states around ``time_s`` (s from t0) tell what drove the robot then: a gap longer than the timeout, over or not."""
        assert self.t0_ns is not None
        stamps, time_ns = self.joints.stamps, self.t0_ns + time_s * 1e9
        if any(begin < time_ns < end for begin, end in self._gaps):
            return True
        i = bisect.bisect_left(stamps, time_ns)
        until = time_ns if i == len(stamps) else stamps[i]
        return i > 0 and until - stamps[i - 1] > self.timeout_ns

    def covers_no_more(self, k: int) -> bool:
        """Whether step ``k`` is the last one that a joint state covers; joints that are not in yet are taken to hold their rhythm."""
        stamp, stamps = self.timeline.stamp(k), self.joints.stamps
        i = bisect.bisect_left(stamps, stamp)
        if i < len(stamps):
            return stamps[i] < stamp + STEP_NS
        if len(stamps) < 2:
            return True
        period = stamps[-1] - stamps[-2]
        return -(stamp - stamps[-1]) % period < STEP_NS

    def awaits_joints(self, k: int, most: int) -> bool:
        """Whether step ``k`` is taken with extrapolated joints while real ones come at their rhythm, at least one in ``most`` steps."""
        ahead_ns, period_ns = self.timeline.stamp(k) - self.joints.stamps[-1], 1e9 * self.joint_period_s
        return self.extrapolating and period_ns <= most * STEP_NS and 0 < ahead_ns <= 1.5 * period_ns

    def forget(self, k: int) -> None:
        """Drop what no start at step ``k`` or later needs."""
        self.forget_inputs(k - self.window_ns // STEP_NS)
        self.measurements.forget(k)

    def forget_inputs(self, k: int) -> None:
        """Drop joints and loads that no step from ``k`` on needs."""
        horizon = self.timeline.stamp(k)
        self.joints.forget(horizon)
        self.load.forget(horizon)
