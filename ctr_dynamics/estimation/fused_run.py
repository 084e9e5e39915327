"""The fused run: the model whose fields and parameters the filter corrects by tracker measurements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.alternatives import Alternatives, Compared
from ctr_dynamics.estimation.filter.covariance_factor import Vibrating
from ctr_dynamics.estimation.filter.ekf import RodEkf
from ctr_dynamics.estimation.filter.filter_records import FilterState, TipEstimate, Update
from ctr_dynamics.estimation.inputs.input_buffer import InputBuffer
from ctr_dynamics.estimation.inputs.measurement_queue import DueMeasurement
from ctr_dynamics.estimation.inputs.run_inputs import InterpolatedInputs, RunInputs
from ctr_dynamics.estimation.load_doubt import LoadDoubt
from ctr_dynamics.estimation.monitoring.densities import allowance
from ctr_dynamics.estimation.monitoring.disagreement import Disagreement
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.monitoring.innovation_log import InnovationLog
from ctr_dynamics.estimation.open_loop import OpenLoopRun
from ctr_dynamics.estimation.step_output import (
    DOUBTED_LOAD,
    FUSION_OFF,
    Innovation,
    MotionPoint,
)
from ctr_dynamics.estimation.timeline import DT, seconds
from ctr_dynamics.kernels import rotations
from ctr_dynamics.kernels.layout import parameters_of_inputs
from ctr_dynamics.model.simulator import State

Floats = NDArray[np.float64]
NEGLIGIBLE = 1e-4  # probability of another delay or model error; less is no matter of the covariance
CONTRADICTED_NS = 1_000_000_000  # for so long measurements contradict an estimate, as in the record that the tracker is judged by
LOST = 2.0  # times as far as measurements lie from the open-loop run, beyond which the deviation of the filter tells less than that
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
        alternatives: what else than the filter counts on may be right.
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
        self.disagreement = Disagreement(model.robot.tracker.noise.position.value)
        self.alternatives = Alternatives(ekf, inputs, health)
        self.state: State | None = None
        self.measured_ns: int | None = None
        self.confirmed = 0
        # stamp of the last measurement, and how far it lay from the open-loop run, m
        self._apart_ns, self._apart = 0, np.zeros(3)
        # the same where this run last went on from there; zero once a measurement has counted in full
        self._begun_ns, self._begun_apart = 0, np.zeros(3)

    def clear(self) -> None:
        """Have no state, and the parameters of the robot file."""
        self.ekf.forget_parameters()
        self.alternatives.clear()
        self.disagreement.clear()
        self.state, self.measured_ns, self.confirmed = None, None, 0
        self._begun_apart[:] = 0.0

    def start(self, state: State, t: float, vibrating: Vibrating | None = None) -> None:
        """Begin at the static equilibrium ``state`` at the time ``t`` (s); ``vibrating``: what the robot may do about it."""
        self.state = state
        self.ekf.start(state, t, vibrating)

    @property
    def agreed(self) -> bool:
        """Whether measurements have agreed since the start."""
        return self.confirmed >= CONFIRMED

    def on_time(self) -> bool:
        """Whether measurements show that the tracker has the delay that the filter counts on."""
        return self.alternatives.timing.on_time(self.ekf.delay)

    @property
    def pose_period_s(self) -> float:
        """s between two measurements that are fused, at least the time since the last one; infinite while none are."""
        if not self._health.fusing or self.alternatives.not_fused:
            return math.inf
        return max(self._inputs.measurements.period_s, self._health.tracker_age_s)

    @property
    def inputs_at(self) -> RunInputs:
        """Actuators and load with the estimated offsets and force."""
        return RunInputs(self._interpolated, self._load, self._by_theta, self.ekf.theta)

    def update(
        self, k: int, due: Sequence[DueMeasurement], open_loop: OpenLoopRun, load_doubt: LoadDoubt
    ) -> None:
        """Compare the measurements that have come ``due`` after step ``k`` with the tips of their times, and fuse them."""
        assert self.state is not None
        tracker = self.ekf.tracker
        for measurement, time_s, position, quaternion in due:
            measurement.fused_k = k
            given = time_s, position, quaternion, measurement.stamp_error_s
            motion, residual = self.residuals(time_s, position, quaternion, open_loop)
            if motion is not None:
                own_s = self._own_time(time_s)
                load_doubt.take(measurement.stamp_ns, own_s, motion.residual, motion.position, tracker)
            not_fused = self.alternatives.not_fused or (DOUBTED_LOAD if load_doubt.seems_wrong else "")
            if self._inputs.missing_at(time_s - self.ekf.expected.age):
                update = Update.impossible("no joint states at its time")
            elif self._health.fusing and not not_fused:
                update = self.ekf.update(self.state, *given)
            else:
                update = self.ekf.compare(*given)
                if not_fused:
                    update = update._replace(reason=update.reason.replace(FUSION_OFF, not_fused))
            if motion is not None and residual is not None:
                seen = motion.position + motion.residual
                self.disagreement.add(measurement.stamp_ns, seen, motion.position, residual)
            if motion is not None and update.predictive is not None:
                self._apart_ns, self._apart = measurement.stamp_ns, motion.residual
                tips = open_loop.tips.positions()
                compared = Compared(
                    measurement.stamp_ns, time_s, quaternion, motion, tips, update, self.ekf.delay, measurement.stamp_error_s,
                )  # fmt: skip
                self.alternatives.add(compared)
            newer = self.measured_ns is None or measurement.stamp_ns > self.measured_ns
            shift, noise_ratio = self.ekf.tracker_fault()
            if update.accepted and not shift:
                self.confirmed += newer and not self.agreed
                if noise_ratio == 1.0:
                    self._begun_apart[:] = 0.0
            if update.dof:
                self.measured_ns = max(self.measured_ns or 0, measurement.stamp_ns)
            self._innovations.add(
                Innovation(
                    measurement.stamp_ns, update.residual, update.variance, update.nis, update.dof, update.accepted,
                    measurement.late_s, update.reason, update.white, motion, residual,
                )
            )  # fmt: skip
        self._health.force_sigma = self.ekf.adapted.sigma
        self._health.shift_m, self._health.noise_ratio = self.ekf.tracker_fault()

    def _own_time(self, time_s: float) -> float:
        """When a measurement of the stamp ``time_s`` (s) was taken, by the delay that the filter counts on, s."""
        return time_s - self.ekf.tracker.delay - self.ekf.expected.delay

    def residuals(
        self, time_s: float, position: Floats, quaternion: Floats, open_loop: OpenLoopRun
    ) -> tuple[MotionPoint | None, Floats | None]:
        """How far a measurement lies from both runs, before its update: the open-loop run there, and the residual (3,) m of the fused tip."""
        tracker, inputs, n = self.ekf.tracker, self._inputs, self.ekf.model.n
        own_s = self._own_time(time_s)
        fused = tracker.observed_tip(lambda s: self.ekf.tips.at(s, DT, columns=False), own_s)
        found = open_loop.observed(tracker, own_s)
        if fused is None or found is None:
            return None, None
        tip, acceleration = found
        position, _ = tracker.to_base(position, quaternion, fused.quaternion)
        estimate = tracker.registered(self.ekf.bias, fused)[:3]
        assert inputs.t0_ns is not None
        joints, rates = inputs.joints.at(inputs.t0_ns + (time_s - self.ekf.expected.age) * 1e9)
        motion = MotionPoint(
            position - tip.position, tip.position, tip.quaternion, tip.velocity, acceleration,
            joints[:n], rates[:n], rates[n:],
        )  # fmt: skip
        return motion, position - estimate

    def reinitialise(self, open_loop: OpenLoopRun, k: int, vibrating: Vibrating | None = None) -> None:
        """Go on from the open-loop run at step ``k``: a correction has led this run astray. ``vibrating``: how the robot may move beside it.

        Until a measurement counts in full, the covariance reaches to the last one for a second: what was known of the difference is lost with the
        estimate.
        """
        assert open_loop.state is not None
        self._begun_ns, self._begun_apart = self._apart_ns, self._apart.copy()
        self.start(open_loop.state.copy(), seconds(k), vibrating)

    def with_alternatives(
        self, tip: TipEstimate, open_loop: OpenLoopRun, farthest: float, stamp_ns: int
    ) -> State:
        """Have ``tip`` hold what else may be right; returns the state that it belongs to. ``farthest``: see :meth:`_inflate_covariance`."""
        withdrawn = self.alternatives.doubted or self._knows_less(tip, stamp_ns)
        self._inflate_covariance(tip, open_loop, farthest)
        if stamp_ns - self._begun_ns < CONTRADICTED_NS:
            tip.covariance[:3, :3] += np.multiply.outer(self._begun_apart, self._begun_apart)
        if withdrawn:
            self._withdraw(tip, open_loop)
        state = open_loop.state if withdrawn else self.state
        assert state is not None
        return state

    def _knows_less(self, tip: TipEstimate, stamp_ns: int) -> bool:
        """Whether the filter knows its ``tip`` less well than the last measurements show of the open-loop run: it has lost its way."""
        variance = float(np.trace(tip.covariance[:3, :3]))
        # measurements show nothing that is smaller
        least = LOST * math.sqrt(3.0 * self.ekf.tracker.variance[0])
        return variance > least**2 and variance > (LOST * self.disagreement.of_open_loop(stamp_ns)) ** 2

    def _inflate_covariance(self, tip: TipEstimate, open_loop: OpenLoopRun, farthest: float) -> None:
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
        other = self.alternatives.probability
        if not self._health.fusing or other < NEGLIGIBLE:
            return
        if self.alternatives.not_fused:
            fusing = 1.0 - self.alternatives.reason_not_to_fuse
            tip.covariance[:3, :3] += allowance(fusing) * np.multiply.outer(self._apart, self._apart)
            return
        apart = _apart(tip, open_loop.tips.last.mean)
        tip.covariance[:] += allowance(other) * np.multiply.outer(apart, apart)

    def _withdraw(self, tip: TipEstimate, open_loop: OpenLoopRun) -> None:
        """Have ``tip`` be that of the open-loop run: what was fused has led the filter astray, as where the latency has probably changed.

        Its covariance holds the filter's tip, too.
        """
        mean = open_loop.tips.last.mean
        apart = _apart(tip, mean)
        tip.covariance[:] += np.multiply.outer(apart, apart)
        tip.position[:], tip.quaternion[:], tip.twist[:] = mean[:3], mean[3:7], mean[7:13]

    def checkpoint(self) -> FusedState:
        """What :meth:`restore` returns to."""
        assert self.state is not None
        return FusedState(self.state.copy(), self.ekf.checkpoint())

    def restore(self, stored: FusedState) -> None:
        """Return to a checkpoint."""
        self.state = stored.state.copy_into(self.state)
        self.ekf.restore(stored.filter)


def _apart(tip: TipEstimate, mean: Floats) -> Floats:
    """(12,) of pose and twist, by which ``tip`` differs from the ``mean`` (13,) of a tip: position, rotation vector, velocity and rate."""
    turn = rotations.to_vector(rotations.multiply(tip.quaternion, rotations.conjugate(mean[3:7])))
    return np.concatenate([tip.position - mean[:3], turn, tip.twist - mean[7:13]])
