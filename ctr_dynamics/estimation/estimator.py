"""The estimator: stamped inputs in, one output for every 3 ms stamp out. No ROS, no clock; node, replay and studies use this class.

:meth:`Estimator.advance` reads top down: go back if inputs came late, propagate both runs, update with the measurements that are due, publish.
Steps are taken when their joints are known (policy `wait`), or on time with extrapolated joints (`predict`).
"""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.backbone import Backbone
from ctr_dynamics.estimation.discretisation import discretise
from ctr_dynamics.estimation.estimator_options import EstimatorOptions
from ctr_dynamics.estimation.filter.filter_records import TipEstimate
from ctr_dynamics.estimation.inputs.input_buffer import InputBuffer
from ctr_dynamics.estimation.inputs.measurement_queue import tracker_of
from ctr_dynamics.estimation.mode_tracker import ModeTracker
from ctr_dynamics.estimation.monitoring.consistency_monitor import consistency_monitor
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.monitoring.innovation_log import InnovationLog
from ctr_dynamics.estimation.monitoring.statuses import all_statuses
from ctr_dynamics.estimation.out_of_sequence import OutOfSequence
from ctr_dynamics.estimation.published_covariance import PublishedCovariance
from ctr_dynamics.estimation.runs import Runs
from ctr_dynamics.estimation.step_output import Innovation, SolverStats, StepOutput
from ctr_dynamics.estimation.step_schedule import StepSchedule
from ctr_dynamics.estimation.timeline import seconds
from ctr_dynamics.estimation.tip_jacobian import JacobianTracker
from ctr_dynamics.estimation.unknown_motion import UnknownMotion
from ctr_dynamics.io.messages.topics import STEP_NS
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import StepResult
from ctr_dynamics.model.stability import StabilityWatch
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.tracker_parameters import with_least_noise, with_robot_file

Floats = NDArray[np.float64]


class Estimator:
    """Dynamic model and filter of one robot, driven by stamped inputs: what node and replay run. Stamps in ns, outputs every 3 ms.

    Args:
        robot: from a robot file.
        settings: the parameter table's values.

    Attributes:
        discretisation: nodes of the model, and the errors to expect of it.
        health: counters and statuses.
        tracker: measurement model, with the parameters' corrections.
        step_times_s: s of every step, for those who set it to an empty array; else None.

    Example:
        Joint states of a robot at rest come every 10 ms; the steps that they cover are taken:

        >>> from ctr_dynamics import Estimator, Settings, load_robot
        >>> estimator = Estimator(load_robot("till2020_tissue"), Settings({"output.policy": "wait"}))
        >>> names = ["tube1_rotation", "tube1_translation", "tube2_rotation", "tube2_translation"]
        >>> for stamp_ns in range(1_000_000_000, 1_050_000_000, 10_000_000):
        ...     estimator.add_joint_state(stamp_ns, names, [1.57, -0.2521, 1.57, -0.1977])  # rad, m
        >>> outputs = estimator.advance()
        >>> len(outputs), outputs[-1].valid
        (14, True)
        >>> outputs[-1].tip_position.shape, outputs[-1].tip_covariance.shape  # m; m^2 and rad^2
        ((3,), (6, 6))
    """

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self.robot = robot = with_least_noise(robot)
        self.settings = settings = with_robot_file(settings, robot)
        self.options = EstimatorOptions()
        self._length = robot.tubes[0].length
        self._largest_deviation = (
            float(settings["output.largest_deviation_m"]) or self.options.deviation_fraction * self._length
        )
        accuracy_m = float(settings["model.accuracy_m"])
        self.discretisation = discretise(robot, int(settings["model.nodes"]), accuracy_m)
        self.model = Model(robot, nodes=self.discretisation.nodes)
        self.tracker = tracker_of(self.model, settings)
        self.health = Health(consistency=consistency_monitor(settings, robot))
        self.health.shortfall = self.discretisation.shortfall(accuracy_m)
        self.health.fusing = bool(settings["filter.enabled"])
        self.inputs = InputBuffer(self.model, self.tracker, settings, self.health)
        self.timeline = self.inputs.timeline
        self._schedule = StepSchedule(self.timeline, self.inputs, self.options)
        self.innovations = InnovationLog(self.health)
        modes = self.discretisation.vibration
        self.runs = Runs(self.model, settings, self.inputs, self.health, self.innovations, modes)
        self.late = OutOfSequence(self.runs, self.inputs, self.health, self.innovations)
        self.step_times_s: array[float] | None = None
        self._backbone = Backbone(self.model, self.runs.fused.ekf)
        self._motion = UnknownMotion(self.model, self.options, self.inputs, self.runs, self.late, modes)
        self._clear()

    def _clear(self) -> None:
        self._motion.clear()
        self._no_start: tuple[int, str] | None = None  # step and reason of a start that found no equilibrium
        self._stability = StabilityWatch(self.model)
        self._stability_due = False
        self._modes = ModeTracker(self.model, self.options.modes_every)
        self._jacobian = JacobianTracker(self._modes.coarse, self.options.jacobian_every)
        self._without_idle = 0  # steps since the last idle work
        largest = self._largest_deviation
        unseen = self.options.unseen_fraction * largest
        self._covariance = PublishedCovariance(self.discretisation, self.robot, largest, unseen)

    # -- inputs --

    @property
    def t0_ns(self) -> int | None:
        """Stamp of step 0, that of the first complete joint state; None before it."""
        return self.timeline.t0_ns

    @property
    def k(self) -> int:
        """The last step that was taken; -1 before the first."""
        return self.timeline.k

    def add_joint_state(self, stamp_ns: int, names: Sequence[str], positions: Sequence[float]) -> None:
        """Take in a joint state. Unusable ones are counted, not raised.

        Args:
            stamp_ns: of its header.
            names: ``tubeN_rotation`` and ``tubeN_translation``, in any order; others are left alone.
            positions: rad and m (negative), one for each name.
        """
        from_ns = self.inputs.add_joints(stamp_ns, names, positions)
        if self.inputs.backwards >= self.options.backwards:
            self.reset()
            self.health.restarts += 1
        if from_ns is not None:
            self.late.changed(from_ns)
        self._motion.look()

    def retract_joint_state(self, stamp_ns: int) -> None:
        """Leave the joint state of that stamp out, which the one after it has shown to be wrong; steps that used it are corrected."""
        from_ns = self.inputs.retract_joints(stamp_ns)
        if from_ns is not None:
            self.late.changed(from_ns)

    def add_tracker_pose(
        self, stamp_ns: int, position: Sequence[float], quaternion_xyzw: Sequence[float], frame_id: str = "", stamp_error_s: float = 0.0,
    ) -> None:  # fmt: skip
        """Take in a tracker pose. Unusable ones are counted, not raised.

        Args:
            stamp_ns: of its header.
            position: (3,) m in the tracker's frame.
            quaternion_xyzw: (4,) of the sensor in the tracker's frame.
            frame_id: of its header; empty stands for the expected one.
            stamp_error_s: 1-sigma of the stamp, s, where it is known to be no time of measurement.
        """
        joints_ns = next(reversed(self.inputs.joints.stamps), None)
        self.inputs.measurements.add(stamp_ns, position, quaternion_xyzw, frame_id, joints_ns, stamp_error_s)

    def retract_tracker_pose(self, stamp_ns: int) -> None:
        """Leave the tracker pose of that stamp out, which the one after it has shown to be wrong, unless it has been fused."""
        self.inputs.measurements.retract(stamp_ns)

    def add_tip_load(
        self, stamp_ns: int, force: Sequence[float], torque: Sequence[float], frame_id: str = ""
    ) -> None:
        """Take in a known wrench on the tip. Unusable ones are counted, not raised.

        Args:
            stamp_ns: of its header.
            force: (3,) N, ``ctr_base`` axes.
            torque: (3,) N m about the tip point, ``ctr_base`` axes.
            frame_id: of its header; empty stands for ``ctr_base``.
        """
        change = self.inputs.add_load(stamp_ns, force, torque, frame_id)
        if change is not None:
            self.runs.load_doubt.load_changed(change)
            self.late.load_changed(change.from_ns, change.jumped)
            self._covariance.load_changed(change)
            self._motion.load_changed(change)

    # -- time --

    def advance(
        self, now_ns: int | None = None, spare_s: Callable[[], float] | None = None, most: int | None = None,
        too_old: Callable[[int], str] = lambda stamp_ns: "",
    ) -> list[StepOutput]:  # fmt: skip
        """Take the steps that are due; once their outputs are on their way, :meth:`do_idle_work` does what they need not wait for.

        Args:
            now_ns: time on the stamps' clock. None takes only steps that the joints cover.
            spare_s: tells the time (s) until the next step is due. Given it, a correction of late inputs goes only as far as there is time.
                Steps on time are then taken uncorrected, and later calls go on with the correction.
            most: steps to take at most.
            too_old: tells, by its stamp, why an output is of no use any more; empty where it is. A step of no use is taken, and goes out invalid
                without an estimate: that makes catching up after a hold-up a quarter faster.

        Returns:
            One output for each step.
        """
        if self.t0_ns is None:
            return []
        self._skip_gap(now_ns)
        outputs: list[StepOutput] = []
        if self.correcting and not self._schedule.due(self.k + 1, now_ns):
            self._correct(spare_s)  # now, while nothing waits for it
        while self._schedule.due(self.k + 1, now_ns) and (most is None or len(outputs) < most):
            begin = time.perf_counter()
            wrong_ns = self.runs.leave_wrong_load_out()
            if wrong_ns is not None:
                self.late.load_changed(wrong_ns, jumped=True)
            # 1. Go back, if inputs came late and the step cannot go ahead.
            if self.late.pending and (spare_s is None or not self.late.may_go_ahead):
                self._correct(spare_s)
            # 2. Propagate, update, publish.
            self.timeline.k += 1
            outputs.append(self._step(self.k, too_old))
            if self.step_times_s is not None:
                self.step_times_s.append(time.perf_counter() - begin)
            self._without_idle += 1
            if self._without_idle >= self.options.longest_without_idle:
                self.do_idle_work()
        return outputs

    def finish(self) -> list[StepOutput]:
        """Steps up to the last joint stamp."""
        outputs = self.advance(None)
        self.do_idle_work()
        return outputs

    @property
    def lead_ns(self) -> int:
        """How long before its stamp a step is to be begun, so that it is out when it is due; 0 where steps wait for their joints."""
        return self._schedule.lead_ns

    @property
    def correcting(self) -> bool:
        """Whether inputs have changed steps that are out already, and the correction is not done."""
        return self.late.pending and self.inputs.extrapolating

    def do_idle_work(self) -> None:
        """A part of the work that no output waits for."""
        self._without_idle = 0
        self.innovations.judge()
        runs, history = self.runs, self.late.history
        if runs.fused.state is None:
            return
        self._conclude()
        runs.fused.ekf.adapted.settle()
        if runs.fused.ekf.add_noise_and_reduce() and history.last is not None and history.last.k == self.k:
            history.record(self.k)  # who returns to that step need not do it again
        if self._stability_due:
            self._stability_due = False
            now = runs.fused.state.inputs
            self.health.stability = self._stability.update(
                seconds(self.k), now.beta, now.alpha, now.force, now.torque, guess=runs.fused.state.unknowns_at_base
            )  # fmt: skip
        elif not self._jacobian.refresh(runs.fused.state, runs.fused.simulator.parameters):
            self._modes.refresh(runs.fused.state, runs.fused.simulator.parameters)

    def prefetch(self) -> None:
        """Take the next step and take it back, a moment before the joints that it waits for: it takes a third less time then."""
        if self.runs.running and not self.late.pending:
            history = self.late.history
            here = history.checkpoint(self.k)
            self.runs.prefetch(self.k + 1)
            history.restore(here)

    def reset(self) -> None:
        """Wait for the next complete joint state. Counters, last known load, and what was found of the tracker's timing and model's error stay."""
        self._clear()
        self.inputs.clear()
        self.runs.clear()
        self.late.clear()
        self.health.reinitialise()
        self.innovations.clear()

    def carry_load(self, other: Estimator) -> None:
        """Have the last known load of ``other``, whose place this one takes: what hangs on the robot still does."""
        self.inputs.carry_load(other.inputs.load)

    def set_fusion(self, on: bool) -> None:
        """Fuse tracker measurements, or go on open loop; measurements are compared all the same."""
        self.health.fusing = on

    def _skip_gap(self, now_ns: int | None) -> None:
        """Reinitialise at the newest joints when more steps are due than can be caught up with."""
        missed = self._schedule.gap(now_ns)
        if missed:
            text = f"{seconds(missed):.1f} s without joints; the model is reinitialised at rest"
            self.health.note("joints", "gap", text)
            self.health.restarts += 1
            self._schedule.skip_to_newest()
            self.runs.stop()
            self.late.forget()

    # -- steps --

    def _correct(self, spare_s: Callable[[], float] | None) -> None:
        """Take steps again that were taken with other inputs than are known now."""
        if self.late.correct(spare_s):
            self._modes.clear()
            self._jacobian.clear()
            self._motion.watch_start(self.timeline.stamp(0))

    def _step(self, k: int, too_old: Callable[[int], str]) -> StepOutput:
        """Take step ``k`` and describe it."""
        runs, late, health = self.runs, self.late, self.health
        health.steps += 1
        if not runs.running:
            return self._start(k)
        self._conclude()
        # Uncorrected steps say nothing of the robot: measurements wait for the correction. Where that is not soon, they are fused for the time being,
        # and counted when they are fused again; but not where they would be taken for what the actuators have done.
        lag = late.lag
        soon = lag <= late.options.reuse_lag
        awaited = self.inputs.awaits_joints(k, late.options.reuse_lag)
        mark = None if soon else self.innovations.mark()
        astray = self._covariance.driven_m > self.robot.tracker.noise.position.value
        result = runs.step(k, fuse=not awaited if lag == 0 else not (soon or astray), extrapolated=lag > 0)
        late.history.record(k)
        runs.judge(result)
        if mark is not None:
            self.innovations.discard(mark)
        health.sweeps += result.sweeps
        if not result.ok:
            return self._invalid(k, f"step failed: {result.reason}")
        return self._output(k, result, too_old(self.timeline.stamp(k)))

    def _conclude(self) -> None:
        """Have the filter count on something else, if the measurements up to the last step show that it is right."""
        runs, late, stamp = self.runs, self.late, self.timeline.stamp(self.runs.k)
        moves_as_modelled = not self._motion.settling.lacks_vibration(stamp)
        if late.lag <= late.options.reuse_lag and runs.conclude(moves_as_modelled):
            vibrating = self._motion.vibrations(self._modes, runs.fused.alternatives.timing.lacking_m)
            runs.fused.reinitialise(runs.open_loop, runs.k, vibrating)
            self.health.restarts += 1
            late.history.restart(runs.k)

    def _start(self, k: int) -> StepOutput:
        """Both runs at rest at step ``k``, unless there is no equilibrium."""
        if self._no_start and k < self._no_start[0] + self.options.retry_every:
            return self._invalid(k, self._no_start[1])
        reason = self.runs.start(k)
        self._no_start = (k, reason) if reason else None
        if reason:
            self.health.failed("no static equilibrium")
            self.inputs.forget(k)
            return self._invalid(k, reason)
        self.late.history.restart(k)
        self.inputs.actuator_error.corrected()
        self._modes.clear()
        self._jacobian.clear()
        self._motion.watch_start(self.timeline.stamp(k))
        return self._output(k, StepResult(True, "at rest", 0, 0, 0))

    # -- outputs --

    def _output(self, k: int, result: StepResult, too_old: str = "") -> StepOutput:
        """The output of a step that both runs have taken; invalid where it says nothing of the robot, or is ``too_old``: the reason."""
        fused, stamp = self.runs.fused, self.timeline.stamp(k)
        tip = fused.ekf.tip_estimate()
        lost = self._lost(k, tip)
        if lost:
            self.health.restarts += 1
            return self._invalid(k, lost)
        innovations = self.innovations.take()
        self.health.refutation = fused.ekf.refutation()
        unsettled = self._motion.problem(stamp, innovations)
        if self._motion.settling.begun:
            self._motion.begin_again(k, self._modes, apart=self._largest_deviation)
            self.health.restarts += 1
            return self._invalid(k, unsettled, innovations)
        confirmed = fused.agreed or bool(unsettled) or not self.health.fusing
        self._covariance.take(innovations, fused.ekf.refuted, confirmed)
        if unsettled:  # measurements tell nothing of the model's error either
            fused.alternatives.clear_model_error()
            self.innovations.pass_over()
        self._stability_due |= k % self.options.stability_every == 0
        if too_old:
            return self._invalid(k, too_old, innovations)
        return self._estimate(
            k, tip, unsettled, innovations, SolverStats(result.iterations, result.sweeps, result.reason)
        )

    def _lost(self, k: int, tip: TipEstimate) -> str:
        """Why the filter cannot go on from ``tip`` at step ``k``, and what is done about it; empty where it can."""
        predicted = self.runs.open_loop.tips.last.mean[:7]
        if not (tip.finite and math.isfinite(sum(predicted.tolist()))):
            self.runs.stop()
            self.health.failed("not finite")
            return "the estimate is not finite; the model is reinitialised at rest"
        deviation = tip.position_deviation
        if deviation <= self._length:
            return ""
        # a tip that is known no better than that is not estimated any more
        self.runs.fused.reinitialise(self.runs.open_loop, k)
        self.late.history.record(k)
        self.health.failed("led astray")
        return (
            f"the tracker has led the estimate astray: deviation of the tip {deviation:.2g} m, limit "
            f"{self._length:g} m; the filter is reinitialised from the open-loop run"
        )

    def _estimate(
        self, k: int, tip: TipEstimate, unsettled: str, innovations: list[Innovation], solver: SolverStats
    ) -> StepOutput:
        """The output of step ``k``: estimate, prediction and what follows from both; invalid where it cannot be trusted."""
        fused, stamp = self.runs.fused, self.timeline.stamp(k)
        state, predicted = fused.state, self.runs.open_loop.tips.last.mean[:7].copy()
        assert state is not None
        shown = fused.with_alternatives(tip, self.runs.open_loop, self._largest_deviation, stamp)
        since = self.timeline.stamp(0) if fused.measured_ns is None else fused.measured_ns
        self.health.tracker_age_s = max(0.0, (stamp - since) * 1e-9)
        modes = self._modes.measure(state, k)
        lag_ns = self.late.lag * STEP_NS
        self._covariance.inflate(tip, stamp, self.runs, self.inputs, self._motion.settling, modes, lag_ns)
        problem = self.health.problem = self._problem(stamp, tip.position_deviation, unsettled)
        return StepOutput(
            stamp, k, not problem, problem, tip.position, tip.quaternion, tip.covariance[:6, :6], tip.twist, tip.covariance[6:, 6:],
            predicted[:3], predicted[3:], self._backbone.rows(shown), modes, fused.ekf.force, tip.force_sigma, innovations, solver,
            state.inputs.beta.tolist(), self._jacobian.measure(state),
        )  # fmt: skip

    def _invalid(self, k: int, reason: str, taken: Sequence[Innovation] = ()) -> StepOutput:
        self.health.problem = reason
        return StepOutput.invalid(self.timeline.stamp(k), k, reason, [*taken, *self.innovations.take()])

    def _problem(self, stamp: int, deviation: float, unsettled: str) -> str:
        """Why the output of that stamp (ns) and ``deviation`` of the tip (m) cannot be trusted; empty when it can.

        ``unsettled``: why the motion is not known yet. It comes before the deviation, of which it is the reason.
        """
        age_s = (stamp - self.inputs.joints.stamps[-1]) * 1e-9
        limit_s = self.inputs.timeout_ns * 1e-9
        if age_s > limit_s:
            return f"joint states are missing: the last is {age_s:.3f} s old, limit {limit_s:g} s"
        if unsettled:
            return unsettled
        deviations = self._covariance.deviations(deviation)
        return deviations.problem(self.health, self.runs.fused.alternatives.late_by_m)

    # -- reports --

    def snapshot(self) -> dict[str, Any]:
        """Where the estimator stands, for a file."""
        ekf = self.runs.fused.ekf
        return {
            "k": self.k,
            "stamp_ns": self.timeline.taken_ns,
            "problem": self.health.problem,
            "parameters": ekf.parameters(known=self.runs.running),
            "tracker_bias": [float(x) for x in ekf.bias],
            "tip_force_drive_N": ekf.adapted.sigma,
            "statuses": [asdict(status) for status in all_statuses(self.health)],
        }

    def summary(self) -> dict[str, Any]:
        """The estimator's part of a replay's summary."""
        numerics = {
            **self.discretisation.numerics(),
            "substeps": self.health.substeps_summary(),
            "shortfall": self.health.shortfall,
        }
        return {**self.health.summary(), "numerics": numerics}
