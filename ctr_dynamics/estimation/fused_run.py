"""The fused run: the model whose fields and parameters the filter corrects by tracker measurements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.covariance_factor import Vibrating
from ctr_dynamics.estimation.filter.ekf import RodEkf
from ctr_dynamics.estimation.filter.filter_records import FilterState, TipEstimate, Update
from ctr_dynamics.estimation.inputs.input_buffer import InputBuffer
from ctr_dynamics.estimation.inputs.measurement_queue import DueMeasurement
from ctr_dynamics.estimation.inputs.run_inputs import InterpolatedInputs, RunInputs
from ctr_dynamics.estimation.monitoring.densities import allowance
from ctr_dynamics.estimation.monitoring.disagreement import Disagreement
from ctr_dynamics.estimation.monitoring.end_of_jitter import EndOfJitter
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.monitoring.innovation_log import InnovationLog
from ctr_dynamics.estimation.monitoring.model_error_search import ModelErrorSearch
from ctr_dynamics.estimation.monitoring.response_search import in_words
from ctr_dynamics.estimation.monitoring.tracker_timing import TrackerTiming
from ctr_dynamics.estimation.open_loop import OpenLoopRun
from ctr_dynamics.estimation.step_output import (
    FUSION_OFF,
    MOVING_FRAME,
    UNKNOWN_DELAY,
    Innovation,
    MotionPoint,
)
from ctr_dynamics.estimation.timeline import DT, seconds
from ctr_dynamics.kernels import rotations
from ctr_dynamics.kernels.layout import parameters_of_inputs
from ctr_dynamics.kernels.tracker_measurement import pose_difference
from ctr_dynamics.model.simulator import State
from ctr_dynamics.sensing.tracker import ROTATION, TRANSLATION

Floats = NDArray[np.float64]
NEGLIGIBLE = 1e-4  # probability of another delay or model error; less is no matter of the covariance
CONFIRMED = 8  # measurements without a shift, 0.2 s at 40 Hz; the registration is known to be right then


class FusedState(NamedTuple):
    """What a checkpoint stores of the :class:`FusedRun`."""

    state: State
    filter: FilterState


class FusedRun:
    """One simulation and its filter.

    Args:
        ekf: the filter, with the simulator that it corrects.
        interpolated: actuators and known load.
        load: (inputs,) load of the robot file.
        inputs: for the actuators at a measurement's time.
        health, innovations: where outcomes are counted and collected.

    Attributes:
        state: after the last step; None before the start and after what cannot be gone on from.
        measured_ns: stamp of the newest measurement that reached the gate.
        confirmed: measurements since the start that were fused and show no shift of the tracker.
        late: whether the tracker is late by a time that is not known yet. moving: whether its frame moves. Measurements are then compared and not
            fused.
    """

    def __init__(
        self, ekf: RodEkf, interpolated: InterpolatedInputs, load: Floats, inputs: InputBuffer, health: Health, innovations: InnovationLog
    ) -> None:  # fmt: skip
        self.ekf, self.simulator = ekf, ekf.simulator
        self._interpolated, self._load, self._inputs = interpolated, load, inputs
        self._health, self._innovations = health, innovations
        model = ekf.model
        rows = parameters_of_inputs(model.n)[: model.input_count]
        self._by_theta = ekf.uncertainty.effect[rows]  # encoder offsets and tip force
        noise, length = model.robot.tracker.noise, float(model.robot.lengths[0])
        file = ekf.tracker.state_sigma
        registered = math.hypot(file[TRANSLATION].max(), length * file[ROTATION].max())
        moves = noise.position.value, ekf.options.force_change, length, registered
        self.timing = TrackerTiming(*moves, ekf.tracker)
        self.disagreement = Disagreement(noise.position.value)
        self.end_of_jitter = EndOfJitter()
        self.model_error_search = ModelErrorSearch(
            noise.position.value,
            noise.rotation.value,
            length,
            registered,
            ekf.options.force_change,
        )
        self.state: State | None = None
        self.measured_ns: int | None = None
        self.confirmed, self.late, self.moving = 0, False, False
        self._scatters_since = 0  # step, since when stamps probably scatter
        self._apart = np.zeros(3)  # m, the last measurement from the open-loop run

    def clear(self) -> None:
        """Have no state, and the parameters of the robot file."""
        self.ekf.forget_parameters()
        self.timing.clear()
        self.model_error_search.clear()
        self.disagreement.clear()
        self.end_of_jitter.clear()
        self.state, self.measured_ns, self.confirmed, self.late, self.moving = None, None, 0, False, False

    def start(self, state: State, t: float, vibrating: Vibrating | None = None) -> None:
        """Begin at the static equilibrium ``state`` at the time ``t`` (s); ``vibrating``: what the robot may do about it."""
        self.state = state
        self.ekf.start(state, t, vibrating)

    @property
    def agreed(self) -> bool:
        """Whether measurements have agreed since the start."""
        return self.confirmed >= CONFIRMED

    @property
    def not_fused(self) -> str:
        """Why measurements are compared and not fused; empty where they are."""
        return UNKNOWN_DELAY if self.late else MOVING_FRAME if self.moving else ""

    @property
    def pose_period_s(self) -> float:
        """s between two measurements that are fused, at least the time since the last one; infinite while none are."""
        if not self._health.fusing or self.not_fused:
            return math.inf
        return max(self._inputs.measurements.period_s, self._health.tracker_age_s)

    @property
    def inputs_at(self) -> RunInputs:
        """Actuators and load with the estimated offsets and force."""
        return RunInputs(self._interpolated, self._load, self._by_theta, self.ekf.theta)

    def update(self, k: int, due: Sequence[DueMeasurement], open_loop: OpenLoopRun) -> None:
        """Compare the measurements that have come ``due`` after step ``k`` with the tips of their times, and fuse them."""
        assert self.state is not None
        for measurement, time_s, position, quaternion in due:
            measurement.fused_k = k
            motion, residual = self.residuals(time_s, position, quaternion, open_loop)
            if self._inputs.missing_at(time_s - self.ekf.tracker.age):
                update = Update.impossible("no joint states at its time")
            elif self._health.fusing and not self.not_fused:
                update = self.ekf.update(self.state, time_s, position, quaternion)
            else:
                update = self.ekf.compare(time_s, position, quaternion)
                if self.not_fused:
                    update = update._replace(reason=update.reason.replace(FUSION_OFF, self.not_fused))
            if motion is not None and residual is not None:
                seen = motion.position + motion.residual
                self.disagreement.add(measurement.stamp_ns, seen, motion.position, residual)
            if motion is not None and update.foretold is not None:
                self._apart = motion.residual
                self.end_of_jitter.add(measurement.stamp_ns, update.steadier)
                expected, tips = self.ekf.expected, open_loop.tips.positions()
                newest_s = time_s - expected.model.delay
                self.timing.add(
                    measurement.stamp_ns, newest_s, seen, tips, update.foretold, expected, self.ekf.delay
                )
                if expected.slower:
                    expected.refine(*self.timing.response.refined(expected.response))
                self.model_error_search.add(
                    measurement.stamp_ns,
                    seen,
                    motion.residual,
                    motion.velocity,
                    motion.acceleration,
                    self._turn(quaternion, motion.quaternion),
                    update.foretold,
                )
            newer = self.measured_ns is None or measurement.stamp_ns > self.measured_ns
            if not self.agreed and update.accepted and newer and not self.ekf.tracker_fault()[0]:
                self.confirmed += 1
            if update.dof:
                self.measured_ns = max(self.measured_ns or 0, measurement.stamp_ns)
            else:
                self._health.note(
                    "tracker",
                    "outside the window",
                    f"pose of t = {time_s:.3f} s at step {k}: {update.reason}",
                )
            self._innovations.add(
                Innovation(
                    measurement.stamp_ns, update.residual, update.variance, update.nis, update.dof, update.accepted,
                    measurement.late_s, update.reason, update.white, motion, residual,
                )
            )  # fmt: skip
        self._health.force_sigma = self.ekf.adapted.sigma
        self._health.shift_m, self._health.noise_ratio = self.ekf.tracker_fault()

    def residuals(
        self, time_s: float, position: Floats, quaternion: Floats, open_loop: OpenLoopRun
    ) -> tuple[MotionPoint | None, Floats | None]:
        """How far a measurement lies from both runs, before its update: the open-loop run there, and the residual (3,) m of the fused tip."""
        tracker, inputs, n = self.ekf.tracker, self._inputs, self.ekf.model.n
        own_s = time_s - tracker.delay - self.ekf.expected.delay
        fused = tracker.observed_tip(lambda s: self.ekf.tips.at(s, DT, columns=False), own_s)
        found = open_loop.observed(tracker, own_s)
        if fused is None or found is None:
            return None, None
        tip, acceleration = found
        position, _ = tracker.to_base(position, quaternion, fused.quaternion)
        estimate = tracker.registered(self.ekf.bias, fused)[:3]
        assert inputs.t0_ns is not None
        joints, rates = inputs.joints.at(inputs.t0_ns + (own_s - tracker.age + tracker.delay) * 1e9)
        motion = MotionPoint(
            position - tip.position, tip.position, tip.quaternion, tip.velocity, acceleration,
            joints[:n], rates[:n], rates[n:],
        )  # fmt: skip
        return motion, position - estimate

    def _turn(self, quaternion: Floats, open_loop: Floats) -> Floats:
        """Rotation vector (a,) rad from that of the ``open_loop`` tip to a measured ``quaternion``, (4,) wxyz each, on the measured axes."""
        tracker, none = self.ekf.tracker, np.zeros(3)
        expected = rotations.multiply(tracker.rotation, open_loop)
        return pose_difference(none, quaternion, none, expected, tracker.free)[3:][tracker.mask[3:]]

    def reinitialise(self, open_loop: OpenLoopRun, k: int, vibrating: Vibrating | None = None) -> None:
        """Go on from the open-loop run at step ``k``: a correction has led this run astray. ``vibrating``: how the robot may move beside it."""
        assert open_loop.state is not None
        self.start(open_loop.state.copy(), seconds(k), vibrating)
        self._health.restarts += 1

    def begin_again(self, open_loop: OpenLoopRun, k: int) -> bool:
        """Go on from the open-loop run at step ``k`` if measurements show that something else is right than the filter counts on."""
        return (
            self.follow_timing(open_loop, k)
            or self.follow_jitter(open_loop, k)
            or self.leave_moving_frame(open_loop, k)
            or self.follow_model_error(open_loop, k)
            or self.leave_refuted(open_loop, k)
        )

    def follow_timing(self, open_loop: OpenLoopRun, k: int) -> bool:
        """Go on from the open-loop run at step ``k`` with another delay or response of the tracker, if measurements follow it far better with that.

        Where they do with many delays, as before a late tracker shows the first motion, they are not fused until one is found.
        """
        if not self._health.fusing:
            return False
        expected, delay, was_late = self.ekf.expected, self.ekf.delay, self.late
        found = self.timing.found(expected, delay)
        self.late = found is None and self.timing.undecided(expected, delay)
        if found is None and (was_late or not self.late):
            return False
        kind, note = "latency", "poses are older than their stamps, by a time that is not known yet"
        if found is not None:
            if found.response is not None:
                expected.responds(found.response, found.deviation if found.delay is None else 0.0)
                expected.late_by(0.0, 0.0)  # a response tells by itself how late a tracker is,
                expected.jitter = 0.0  # and looks like jitter before it is known
                self.end_of_jitter.clear()
                kind, note = "response", in_words(found.response)
            if found.delay is not None:
                kind = "latency"
                expected.late_by(found.delay, found.deviation)
                whole_ms = 1e3 * (expected.model.delay + expected.delay)
                note = f"poses are {abs(whole_ms):.0f} ms {'older' if whole_ms > 0.0 else 'newer'} than their stamps"
            self._inputs.measurements.early_s = max(-expected.delay, 0.0)
            self.timing.followed(found)
            self._health.distances.clear()
        advice = "; check the tracker's clock, or set tracker.delay_s" if kind == "latency" else ""
        self._health.note("tracker", kind, note + advice)
        self.reinitialise(open_loop, k)
        return True

    def follow_jitter(self, open_loop: OpenLoopRun, k: int) -> bool:
        """Go on from the open-loop run at step ``k`` with stamps that scatter, if measurements follow it far better with that than the filter.

        Where they scatter less than they did, the filter goes on as it is, with half of that.
        """
        if not self._health.fusing or self.not_fused:
            return False
        search = self.model_error_search
        if self.ekf.expected.jitter and self.end_of_jitter.less:
            half = 0.5 * self.ekf.expected.jitter
            self.ekf.expected.jitter = half if half > 0.5 * search.jitter.options.smallest_s else 0.0
            self.end_of_jitter.clear()
        probability, deviation = search.stamp_jitter(self.ekf.expected.jitter)
        if probability <= 0.5 or self.timing.other(self.ekf.expected, self.ekf.delay) > 0.5:
            self._scatters_since = k
        lasts = seconds(k - self._scatters_since) > search.jitter.options.lasts_s
        if probability <= search.options.believed or not lasts:
            return False
        self.ekf.expected.jitter = deviation
        self.end_of_jitter.clear()
        search.begin_again()
        self.timing.begin_again(self.ekf.expected, self.ekf.delay)
        self._health.note(
            "tracker",
            "jitter",
            f"stamps scatter by {1e3 * deviation:.0f} ms; stamp poses when they are measured, not when they arrive",
        )
        self.reinitialise(open_loop, k)
        return True

    def leave_moving_frame(self, open_loop: OpenLoopRun, k: int) -> bool:
        """Go on from the open-loop run at step ``k`` if the frame of the tracker moves; measurements are not fused as long as it does."""
        was, frame = self.moving, self.model_error_search.frame
        self.moving = self._health.fusing and not self.late and frame.moves(was)
        if was or not self.moving:
            return False
        velocity, turn = frame.rates(open_loop.tips.last.mean[:3])
        self._health.note(
            "tracker",
            "moving frame",
            f"measured positions depart from the model as by a frame that moves by {1e3 * math.hypot(*velocity):.1f} mm/s and "
            f"{math.degrees(math.hypot(*turn)):.1f} deg/s; check the field generator, the tracker's stand and the robot's base",
        )
        self.reinitialise(open_loop, k)
        return True

    def follow_model_error(self, open_loop: OpenLoopRun, k: int) -> bool:
        """Go on from the open-loop run at step ``k`` with a larger model error, if measurements follow that far better than the filter.

        Without it, the filter takes the error of the model for a force and for wrong parameters, which move the velocities too.
        """
        if not self._health.fusing or self.not_fused:
            return False
        found = self.model_error_search.found(self.ekf.model_error)
        if found is None:
            return False
        self._health.model_error = found
        self.ekf.expect_model_error(found)
        self.model_error_search.begin_again()
        self.reinitialise(open_loop, k)
        return True

    def leave_refuted(self, open_loop: OpenLoopRun, k: int) -> bool:
        """Go on from the open-loop run at step ``k`` where that foretells measurements far better, and the estimate refutes the robot file.

        Inputs that were wrong for a while have bent parameters and registration then, which are certain by now and would not come back for long.
        """
        if (
            not self._health.fusing
            or self.not_fused
            or not (self.ekf.refuted and self.model_error_search.astray)
        ):
            return False
        self.model_error_search.forgive()
        self.reinitialise(open_loop, k)
        return True

    def inflate_covariance(self, tip: TipEstimate, open_loop: OpenLoopRun, farthest: float) -> None:
        """Have the covariance of ``tip`` hold what else may be right: the open-loop run where the tracker may be late, its frame may move, or the
        model may err more than the filter counts on, the tracker where it is not fused, has been shifted since the start, or lies apart without
        having jumped.

        A shift of more than ``farthest`` (m) is no error of a registration; outputs are invalid where tracker and model lie that far apart.
        """
        if self.agreed:
            tip.covariance[:3, :3] += self.disagreement.covariance
        elif not self.ekf.adapted.noisy:
            # a shift that has been there since the start may be one of the registration, which belongs to the pose
            shift = self.ekf.shift_in_base()
            if math.hypot(*shift.tolist()) < farthest:
                tip.covariance[:3, :3] += np.multiply.outer(shift, shift)
        timing, search = self.timing.other(self.ekf.expected, self.ekf.delay), self.model_error_search
        moves, scatter = search.frame.probability, search.stamp_jitter(self.ekf.expected.jitter)[0]
        other = max(timing, moves, scatter, search.probability(self.ekf.model_error))
        if not self._health.fusing or other < NEGLIGIBLE:
            return
        if self.not_fused:
            fusing = 1.0 - (timing if self.late else moves)
            tip.covariance[:3, :3] += allowance(fusing) * np.multiply.outer(self._apart, self._apart)
            return
        mean = open_loop.tips.last.mean
        turn = rotations.to_vector(rotations.multiply(tip.quaternion, rotations.conjugate(mean[3:7])))
        apart = np.concatenate([tip.position - mean[:3], turn, tip.twist - mean[7:13]])
        tip.covariance[:] += allowance(other) * np.multiply.outer(apart, apart)

    def checkpoint(self) -> FusedState:
        """What :meth:`restore` returns to."""
        assert self.state is not None
        return FusedState(self.state.copy(), self.ekf.checkpoint())

    def restore(self, stored: FusedState) -> None:
        """Return to a checkpoint."""
        self.state = stored.state.copy_into(self.state)
        self.ekf.restore(stored.filter)
