"""The estimator: input signals in, one output for every 3 ms stamp out. No ROS, no clock; the node, replay and diagnosis use this door.

Steps are taken when their joints are known (``wait``) or on time with extrapolated joints (``predict``); what comes later is applied by returning
to a kept state and stepping again.
"""

from __future__ import annotations

import math
import time
from array import array
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.backbone import Backbone
from ctr_dynamics.estimation.inputs.input_buffer import DT_NS, InputBuffer, seconds
from ctr_dynamics.estimation.modes import ModeTracker
from ctr_dynamics.estimation.monitoring.consistency import misfit_monitor
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.runs import Kept, Runs
from ctr_dynamics.estimation.step_output import Innovation, SolverStats, StepOutput
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import StepResult
from ctr_dynamics.model.stability import StabilityWatch
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
STABILITY_EVERY = 33  # steps between looks at the elastic stability
MODES_EVERY = 132  # steps between refreshes of the vibration modes
MOST_UNPAUSED = 66  # steps before what waits for a pause is done without one
RETRY_EVERY = 33  # steps between starts while there is no equilibrium: looking for one in vain takes long
MAX_FAILURES = 10  # steps in a row that may fail before the model starts anew at rest
SAME_COURSE = 8  # steps: joints no later than that move the robot so little that the covariance stays
MOST_BEFORE_REDONE = 32  # steps: a course that waits for its correction is not continued farther than this
MARGIN = 1.0  # times the mean cost of a step: so much time must be left for taking one again
LOST = 1.0  # m: a tip that is known no better than that is not estimated any more
MAX_BEHIND = 1000  # steps to catch up at once; beyond, the model starts anew
LEAD_NS = 1_000_000  # what a live step takes, from waking to its messages
BACKWARDS = 3  # joint states in a row whose time ran backwards: the clock or the bag began anew


class Estimator:
    """Dynamic model and filter of one robot, driven by stamped inputs.

    Args:
        robot: from a robot file.
        settings: the parameter table's values.
    """

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self.robot, self.settings = robot, settings
        self.model = Model(robot, nodes=int(settings["model.nodes"]))
        self.health = Health(misfit=misfit_monitor(settings, robot.tracker.noise.position.value))
        self.health.fusing = bool(settings["filter.enabled"])
        self.inputs = InputBuffer(self.model, settings, self.health)
        self.runs = Runs(self.model, settings, self.inputs, self.health)
        self.fusion, self.tracker = self.runs.fusion, self.runs.tracker
        self.step_times_s: array[float] | None = None  # s of every step, where someone wants them
        self._reported: deque[Innovation] = deque(maxlen=200)
        self._unjudged: deque[Innovation] = deque()  # by the misfit monitor
        self._backbone = Backbone(self.model, self.fusion)
        self._clear()

    def _clear(self) -> None:
        self.k = -1
        self._return_to: int | None = None  # ns: inputs from here on have changed
        self._joints_only = True  # and nothing but joints
        self._urgent = False  # the load among them, by a jump: what goes on without it soon has nothing to do with the robot
        self._redo_s = 1e-3  # what stepping again costs in the mean, a step
        self._failures = 0
        self._no_start: tuple[int, str] | None = None  # step and reason of a start that found no equilibrium
        self._watch = StabilityWatch(self.model)
        self._modes = ModeTracker(self.model, MODES_EVERY)
        self._watch_due = False
        self._unpaused = 0  # steps since the last pause was used

    # -- inputs --

    @property
    def t0_ns(self) -> int | None:
        """Stamp of step 0, that of the first complete joint state; None before it."""
        return self.inputs.t0_ns

    def add_joint_state(self, stamp_ns: int, names: Sequence[str], positions: Sequence[float]) -> None:
        """Take in a joint state: ``tubeN_rotation`` (rad) and ``tubeN_translation`` (m, negative) by name. Wrong ones are counted, not raised."""
        from_ns = self.inputs.add_joints(stamp_ns, names, positions, self.k)
        if self.inputs.backwards >= BACKWARDS:
            self.reset()
            self.health.restarts += 1
        if from_ns is not None:
            self._changed(from_ns)

    def add_tracker_pose(
        self, stamp_ns: int, position: Sequence[float], quaternion_xyzw: Sequence[float], frame_id: str = ""
    ) -> None:
        """Take in a tracker pose (m, x y z w) of its header's stamp."""
        self.inputs.add_pose(stamp_ns, position, quaternion_xyzw, frame_id, self.k)

    def add_tip_load(
        self, stamp_ns: int, force: Sequence[float], torque: Sequence[float], frame_id: str = ""
    ) -> None:
        """Take in a known wrench on the tip (N, N m about the tip point, ``ctr_base`` axes)."""
        change = self.inputs.add_load(stamp_ns, force, torque, frame_id, self.k)
        if change is not None:
            from_ns, jumped = change
            self._changed(from_ns)
            self._joints_only = False
            self._urgent |= self._return_to is not None and jumped

    def _changed(self, from_ns: int) -> None:
        """Steps after ``from_ns`` were taken with other inputs than are known now."""
        taken = self.inputs.stamp(self.k)
        if taken is not None and from_ns < taken and self.runs.fused is not None:
            self._return_to = from_ns if self._return_to is None else min(self._return_to, from_ns)

    # -- time --

    def _due(self, k: int, now_ns: int | None) -> bool:
        inputs = self.inputs
        stamp = inputs.stamp(k)
        if stamp is None:
            return False
        if stamp <= inputs.joints.known_until:
            return True
        if now_ns is None:
            return False
        return stamp <= now_ns if inputs.predicting else stamp <= now_ns - inputs.timeout_ns

    def advance(
        self, now_ns: int | None = None, spare_s: Callable[[], float] | None = None, most: int | None = None
    ) -> list[StepOutput]:
        """Take every step that is due, or ``most`` of them. ``now_ns``: time on the stamps' clock; None takes only steps that the joints cover.

        ``spare_s``: tells the time (s) until the next step falls due. Given it, a correction by late inputs goes only as far as there is time;
        steps on time are then taken on the course that is not yet corrected, and later calls go on with the correction.
        Once the outputs are on their way, :meth:`use_pause` does what they need not wait for.
        """
        if self.t0_ns is None:
            return []
        self._skip_ahead(now_ns)
        outputs: list[StepOutput] = []
        if self.correcting and not self._due(self.k + 1, now_ns):
            self._go_back(spare_s)  # now, while nothing waits for it
        while self._due(self.k + 1, now_ns) and (most is None or len(outputs) < most):
            begin = time.perf_counter()
            if self._return_to is not None and (spare_s is None or not self._may_wait()):
                self._go_back(spare_s)
            self.k += 1
            outputs.append(self._take(self.k))
            if self.step_times_s is not None:
                self.step_times_s.append(time.perf_counter() - begin)
            self._unpaused += 1
            if self._unpaused >= MOST_UNPAUSED:
                self.use_pause()
        return outputs

    @property
    def lead_ns(self) -> int:
        """How long before its stamp a step is to be begun, so that it is out when it is due; 0 where steps wait for their joints."""
        return LEAD_NS if self.inputs.predicting else 0

    @property
    def correcting(self) -> bool:
        """Whether inputs have changed steps that are out already, and the correction is not done."""
        return self._return_to is not None and self.inputs.predicting

    def _may_wait(self) -> bool:
        """Whether the next step may be taken before the correction that is due: not where the load has jumped, or it is too far behind."""
        assert self.t0_ns is not None and self._return_to is not None
        begun = bool(self.runs.kept) and self.runs.kept[-1].k == self.k
        return self.inputs.predicting and begun and self._behind < MOST_BEFORE_REDONE and not self._urgent

    @property
    def _behind(self) -> int:
        """Steps that have been taken with other inputs than are known now; 0 only where none have been."""
        assert self.t0_ns is not None
        return 0 if self._return_to is None else self.k - (self._return_to - self.t0_ns) // DT_NS

    def use_pause(self) -> None:
        """A part of the work that no output waits for: the misfit monitor's, and a look at the stability or a part of the modes' refresh."""
        self._unpaused = 0
        while self._unjudged:
            self.health.misfit.add(self._unjudged.popleft())
        if self.runs.fused is None:
            return
        self.runs.settle(self.k)
        if self._watch_due:
            self._watch_due = False
            self._watch_stability(self.k)
        else:
            self._modes.refresh(self.runs.fused, self.runs.simulator.parameters)

    def rehearse(self) -> None:
        """Go through the next step without taking it, a moment before the joints that it waits for: it takes a third less time then."""
        if self.runs.fused is not None and self._return_to is None:
            self.runs.rehearse(self.k + 1)

    def finish(self) -> list[StepOutput]:
        """Steps up to the last joint stamp."""
        outputs = self.advance(None)
        self.use_pause()
        return outputs

    def reset(self) -> None:
        """Forget everything but the last known load, and wait for the next complete joint state. Counters stay."""
        self._clear()
        self.inputs.clear()
        self.runs.clear()
        self.health.begin_anew()
        self._unjudged.clear()
        self._reported.clear()

    def set_fusion(self, on: bool) -> None:
        """Use tracker samples, or let the model run alone; samples are compared all the same."""
        self.health.fusing = on

    def _skip_ahead(self, now_ns: int | None) -> None:
        """Start anew at the newest joints when more steps are due than can be caught up with."""
        assert self.t0_ns is not None
        until = (
            self.inputs.joints.stamps[-1]
            if now_ns is None or not self.inputs.predicting
            else max(now_ns, self.inputs.joints.stamps[-1])
        )
        behind = (until - self.t0_ns) // DT_NS - self.k
        if behind <= MAX_BEHIND or self.k < 0 or len(self.inputs.joints.stamps) < 2:
            return
        if self.inputs.joints.stamps[-1] - self.inputs.joints.stamps[-2] <= MAX_BEHIND * DT_NS:
            return  # a long call without a gap: take every step
        newest = self.inputs.joints.stamps[-1]
        self.health.note(
            "joints", "gap", f"{seconds(behind):.1f} s without joints; the model starts anew at rest"
        )
        self.health.restarts += 1
        self.k = (newest - self.t0_ns) // DT_NS - 1
        self.runs.fused = self.runs.alone = None
        self.runs.kept.clear()
        self._return_to = None

    # -- steps --

    def _start(self, k: int) -> str:
        """Both runs at rest at step ``k``; returns the reason when there is no equilibrium."""
        reason = self.runs.start(k)
        if not reason:
            self._modes.clear()
        return reason

    def _take(self, k: int) -> StepOutput:
        """Take step ``k`` and describe it."""
        self.health.steps += 1
        if self.runs.fused is None:
            if self._no_start and k < self._no_start[0] + RETRY_EVERY:
                return self._invalid(k, self._no_start[1])
            reason = self._start(k)
            self._no_start = (k, reason) if reason else None
            if reason:
                self.health.failed("no static equilibrium")
                self.inputs.forget(k)
                return self._invalid(k, reason)
            return self._output(k, StepResult(True, "at rest", 0, 0, 0))
        # A course that is known to be wrong says nothing of the robot: samples wait for its correction, or, where that is not soon, are
        # fused for the time being, and counted when they are fused again.
        behind, before = self._behind, len(self.runs.innovations)
        counters = self.health.of_samples() if behind > SAME_COURSE else None
        result = self.runs.step(k, fuse=behind == 0 or behind > SAME_COURSE, uncorrected=behind > 0)
        if counters is not None:
            self._recount(counters, before, [])
        self.health.sweeps += result.sweeps
        self._judge(result)
        return self._output(k, result) if result.ok else self._invalid(k, f"step failed: {result.reason}")

    def _judge(self, result: StepResult) -> None:
        """Count a step's outcome; after too many failures in a row the model is to start anew."""
        if result.ok:
            self._failures = 0
            return
        self.health.failed(result.reason)
        self._failures += 1
        if self._failures >= MAX_FAILURES:
            self._failures = 0
            self.runs.fused = None
            self.health.restarts += 1

    # -- roll-back --

    def _go_back(self, spare_s: Callable[[], float] | None = None) -> None:
        """Return to the last kept state before the changed inputs and step again, silently, to where the estimator was.

        With ``spare_s``, only while there is time: what has been corrected is kept, and the course goes on where it was.
        """
        if spare_s is not None and self._may_wait() and spare_s() < MARGIN * self._redo_s:
            return
        if self._urgent:
            spare_s, self._urgent = None, False
        from_ns, self._return_to = self._return_to, None
        joints_only, self._joints_only = self._joints_only, True
        assert from_ns is not None and self.t0_ns is not None
        reached = self.k
        usable = [kept for kept in self.runs.kept if self.t0_ns + kept.k * DT_NS <= from_ns]
        course: dict[int, Kept] = {}  # the steps that are taken again, as they were
        changed = 0.0  # first of them whose covariance is another now
        if not usable and self.runs.kept and self.runs.kept[0].k == 0:
            if self._start(0):
                return
            k = 0
        elif self.runs.kept:
            kept = usable[-1] if usable else self.runs.kept[0]
            k = kept.k
            while self.runs.kept and self.runs.kept[-1].k > k:
                once = self.runs.kept.pop()
                course[once.k] = once
            if joints_only and reached - k <= SAME_COURSE:
                changed = self.inputs.first_fusion(self.tracker, k)
            self.runs.restore(kept)
        else:
            return
        before = len(self.runs.innovations)
        counters = self.health.of_samples()
        # the next joints will return to the last step that these cover; what comes later than it should, to one of every eighth
        covered = (self.inputs.joints.stamps[-1] - self.t0_ns) // DT_NS
        for again in range(k + 1, reached + 1):
            if (
                spare_s is not None
                and reached in course
                and reached - again < MOST_BEFORE_REDONE
                and spare_s() < MARGIN * self._redo_s
            ):
                self._put_off(again - 1, course, joints_only and again <= changed)
                break
            begin = time.perf_counter()
            self.health.rolled_back += 1
            result = self.runs.step(
                again, course.get(again) if again < changed else None, keep=again >= covered
            )
            self._judge(result)
            if self.runs.fused is None:
                break
            if not result.ok:
                changed = 0.0
            self._redo_s += 0.1 * (time.perf_counter() - begin - self._redo_s)
        fused = self.runs.innovations[before:]
        if fused:
            # samples that were counted before are not counted again
            counted = {i.stamp_ns for i in (*self._reported, *self.runs.innovations[:before])}
            self._recount(counters, before, [i for i in fused if i.stamp_ns not in counted])

    def _put_off(self, corrected: int, course: dict[int, Kept], same: bool) -> None:
        """Leave the correction at the step ``corrected``, to be gone on with from there, and return to the end of the ``course`` as it was.

        ``same``: the covariance is that of the course still.
        """
        assert self.t0_ns is not None
        if self.runs.kept[-1].k != corrected:
            self.runs.keep(corrected, always=True)
        self.runs.kept.extend(course[k] for k in sorted(course) if k > corrected)
        self.runs.restore(self.runs.kept[-1])
        self._return_to = self.t0_ns + corrected * DT_NS
        self._joints_only = same

    def _recount(self, counters: tuple, before: int, fresh: list[Innovation]) -> None:
        """Count of the innovations that came since there were ``before``, and the health's ``counters``, only those that are ``fresh``."""
        h = self.health
        del self.runs.innovations[before:]
        h.return_to(counters)
        for innovation in fresh:
            h.measured(innovation)
        self.runs.innovations.extend(fresh)

    # -- outputs --

    def _take_innovations(self) -> list[Innovation]:
        innovations, self.runs.innovations = self.runs.innovations, []
        self._reported.extend(innovations)
        self._unjudged.extend(innovations)
        return innovations

    def _invalid(self, k: int, reason: str) -> StepOutput:
        self.health.problem = reason
        stamp = self.inputs.stamp(k)
        assert stamp is not None
        return StepOutput.invalid(stamp, k, reason, self._take_innovations())

    def _problem(self, k: int) -> str:
        """Why the output of step ``k`` cannot be trusted; empty when it can."""
        stamp = self.inputs.stamp(k)
        assert stamp is not None
        age = (stamp - self.inputs.joints.stamps[-1]) * 1e-9
        limit = self.inputs.timeout_ns * 1e-9
        if age > limit:
            return f"joint states are missing: the last is {age:.3f} s old, limit {limit:g} s"
        if self.health.fusing and self.health.rejecting:
            return "the tracker contradicts the model: most of its last samples are outside the gate"
        return ""

    def _output(self, k: int, result: StepResult) -> StepOutput:
        assert self.runs.fused is not None and self.runs.alone is not None
        stamp = self.inputs.stamp(k)
        assert stamp is not None
        tip = self.fusion.tip_estimate()
        alone = self.runs.alone_tips.last
        predicted = alone.mean[:7].copy()
        if not (tip.finite and math.isfinite(sum(predicted.tolist()))):
            self.runs.fused = None
            self.health.failed("not finite")
            self.health.restarts += 1
            return self._invalid(k, "the estimate is not finite; the model starts anew at rest")
        variance = tip.covariance[0, 0] + tip.covariance[1, 1] + tip.covariance[2, 2]
        if variance > LOST**2:
            self.runs.start_filter(k)
            self.health.failed("led astray")
            return self._invalid(
                k,
                f"the tracker has led the estimate astray: deviation of the tip {math.sqrt(variance):.2g} m, limit {LOST:g} m; "
                "the filter starts anew from the model alone",
            )
        since = self.runs.sampled_ns if self.runs.sampled_ns is not None else self.t0_ns
        self.health.tracker_age_s = max(0.0, (stamp - (since or stamp)) * 1e-9)
        problem = self._problem(k)
        self.health.problem = problem
        self._watch_due |= k % STABILITY_EVERY == 0
        return StepOutput(
            stamp, k, not problem, problem, tip.position, tip.quaternion, tip.covariance[:6, :6], tip.twist, tip.covariance[6:, 6:],
            predicted[:3], predicted[3:], self._backbone.rows(self.runs.fused), self._modes.measure(self.runs.fused), self.fusion.force,
            tip.force_sigma, self._take_innovations(), SolverStats(result.iterations, result.sweeps, result.reason),
        )  # fmt: skip

    def _watch_stability(self, k: int) -> None:
        """How far the equilibrium of the present actuators is from its fold, and when a snap is to be expected."""
        assert self.runs.fused is not None
        now = self.runs.fused.inputs
        self.health.stability = self._watch.update(
            seconds(k), now.beta, now.alpha, now.force, now.torque, guess=self.runs.fused.unknowns[-1]
        )

    def snapshot(self) -> dict[str, Any]:
        """Where the estimator stands, for a file."""
        return {
            "k": self.k,
            "stamp_ns": self.inputs.stamp(self.k),
            "problem": self.health.problem,
            "parameters": self.runs.parameters(),
            "tracker_bias": [float(x) for x in self.fusion.bias],
            "tip_force_drive_N": self.fusion.force_variance.sigma,
            "statuses": [
                {"name": s.name, "level": s.level, "message": s.message, "values": s.values}
                for s in self.health.statuses()
            ],
        }

    def summary(self) -> dict[str, Any]:
        """The estimator's part of a replay's summary."""
        h = self.health
        return {
            "steps": h.steps,
            "residual_rms_m": h.residual_rms(),
            "nis": h.nis_summary(),
            "rejected": h.rejected,
            "late": h.late,
            "dropped": h.dropped,
            "input_problems": h.input_problems(),
            "solver": {
                "failures": h.failures,
                "reasons": dict(h.reasons),
                "restarts": h.restarts,
                "substeps": h.substeps,
                "sweeps_per_step": h.sweeps / h.steps if h.steps else 0.0,
                "steps_taken_again": h.rolled_back,
            },
        }
