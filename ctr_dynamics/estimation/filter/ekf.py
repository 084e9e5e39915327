"""The extended Kalman filter on the fields of the rod, in low rank.

The error of the fields and the uncertain parameters is V a (:class:`CovarianceFactor`); with the tracker states b it has the covariance
Pi = cov(a, b). Three files beside this one hold the process noise, the gate and the schedule of the factor. Derivation: docs/filter.md.
"""

from __future__ import annotations

import math

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.adapted_variances import AdaptedVariances, Constants, ForceRange
from ctr_dynamics.estimation.filter.covariance_factor import CovarianceFactor, Vibrating
from ctr_dynamics.estimation.filter.expected_tracker import ExpectedTracker
from ctr_dynamics.estimation.filter.factor_reduction import reduced
from ctr_dynamics.estimation.filter.factor_schedule import FactorSchedule
from ctr_dynamics.estimation.filter.filter_records import (
    FilterOptions,
    FilterState,
    ModelErrorSize,
    TipComparison,
    TipEstimate,
    Update,
)
from ctr_dynamics.estimation.filter.gating import Gate
from ctr_dynamics.estimation.filter.parameter_priors import (
    force_range,
    model_uncertainty,
    values_and_deviations,
)
from ctr_dynamics.estimation.filter.process_noise import ProcessNoise
from ctr_dynamics.estimation.filter.rational_step import ColumnStrides, Stride, exposed
from ctr_dynamics.estimation.filter.tip_comparison import compare_with_tip
from ctr_dynamics.estimation.filter.tip_window import TipWindow, insertion_fraction
from ctr_dynamics.estimation.filter.tolerances import Tolerances, gain_beside, release
from ctr_dynamics.estimation.step_output import FUSION_OFF
from ctr_dynamics.kernels.factor_operations import move_unknowns
from ctr_dynamics.kernels.rotations import matrix
from ctr_dynamics.kernels.tracker_measurement import fused_tip
from ctr_dynamics.kernels.variance_likelihood import position_density, pull_to_zero
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Simulator, State, StepResult
from ctr_dynamics.model.state import at_inputs
from ctr_dynamics.sensing import Tip, TrackerModel
from ctr_dynamics.sensing.tracker import DELAY, MODEL_POSITION, MODEL_ROTATION, SHIFT, STATES

Floats = NDArray[np.float64]


class RodEkf:
    """Filter of one simulated robot.

    The owner steps the simulator with records and hands the result to :meth:`propagate`. The filter writes into the simulator's state and
    parameters when it corrects.

    Args:
        simulator: of the fused run.
        tracker: measurement model.
        options: tuning.

    Attributes:
        theta: (p,) estimated changes of the uncertain parameters. bias: (22,) tracker states b. pi: (r + 22, r + 22) Pi.
        factor: V. tips: those of the last steps. adapted: of the unknown tip force. gate: counts rejections. stride: of the columns in the last step.
        refuted: whether the estimate refutes the tolerances of the robot file. The delay is not estimated then.
        expected: the tracker as the filter counts on it; whoever changes its delay or reach has :meth:`start` called next. tracker: its model.
        insertion_fraction: of beta's rate, what the model's velocities hold already.
    """

    def __init__(self, simulator: Simulator, tracker: TrackerModel, options: FilterOptions) -> None:
        self.simulator, self.expected, self.options = simulator, ExpectedTracker(tracker), options
        self.model: Model = simulator.model
        self.uncertainty = model_uncertainty(self.model)
        self._force = self.uncertainty.force
        least, most = force_range(self.model.robot, options.force_sigma, options.force_sigma_max)
        sigma = np.where(self.uncertainty.sigma > 0, self.uncertainty.sigma, least)
        self._parameter_weights = (options.parameter_energy / sigma)[:, None]
        self._least_force = least
        self._length = float(self.model.robot.lengths[0])
        self.nominal = simulator.parameters.copy()
        self.theta = np.zeros(len(self.uncertainty.names))
        self.bias = np.zeros(STATES)
        self.pi = np.zeros((0, 0))
        self.factor = CovarianceFactor(self.model, self.uncertainty, options.rank)
        dt = simulator.scheme.dt
        self.tips = TipWindow(self._tips_stored)
        force = ForceRange(least, most, options.force_change)
        noise = self.model.robot.tracker.noise.position.value
        self.adapted = AdaptedVariances(force, noise, self.model.robot.tubes[0].length)
        self._tolerances = Tolerances(self.uncertainty.names, self.uncertainty.sigma, tracker.state_sigma)
        self.refuted = False
        self._noise = ProcessNoise(self.model.robot, dt, self._force, options.force_time, self.adapted)
        self.schedule = FactorSchedule()
        self._strides: ColumnStrides | None = None
        self.stride: Stride | None = None
        self.gate = Gate(options.gate)
        self._sees_position = bool(tracker.mask[:3].all())
        self.insertion_fraction = insertion_fraction(self.model)
        self._filters: dict[tuple[int, int], ExtendedKalmanFilter] = {}

    # -- start --

    def start(self, state: State, stamp: float, vibrating: Vibrating | None = None) -> None:
        """Begin at the static equilibrium in ``state``, of the time ``stamp`` (s), with the robot file's tolerances as the prior.

        ``vibrating``: what the robot may do about it; None where it rests.
        """
        inputs = state.inputs
        self.forget_parameters()
        block = at_inputs(self.model, self.simulator.parameters, inputs)
        pi_aa = self.factor.start(
            state.key, state.mesh, inputs.beta, inputs.alpha, block, state.unknowns_at_base, vibrating
        )
        if self._strides is None:  # of the first start; the exposed length tells how they change
            self._strides = ColumnStrides.of(self.model, state, block, self.simulator.scheme.dt)
        r = len(pi_aa)
        self.refuted = False
        self.bias[:] = 0.0
        self.bias[DELAY] = self.expected.delay
        self.pi = np.zeros((r + STATES, r + STATES))
        self.pi[:r, :r] = pi_aa
        self.pi[r:, r:] = np.diag(self.tracker.state_sigma**2)
        self.pi[r + DELAY, r + DELAY] = self.expected.delay_sigma**2
        for part, sigma in (
            (MODEL_POSITION, self.model_error.position),
            (MODEL_ROTATION, self.model_error.rotation),
        ):
            rows = np.arange(r + part.start, r + part.stop)
            self.pi[rows, rows] = sigma**2
        # the unknown force starts with its stationary deviation, in columns of its own
        scale = np.diag(self.factor.theta)[self._force]
        for axis, size in enumerate(scale):
            i = self._force.start + axis
            self.pi[i, i] = (self._least_force / size) ** 2
        self.adapted.start(self.pi, self._force)
        self.tips.size = self._tips_stored
        self.tips.clear(r)
        self._reduce()
        self.schedule.start(state.key)
        self._append_tip(state, stamp)

    @property
    def tracker(self) -> TrackerModel:
        """The tracker as the filter counts on it."""
        return self.expected.model

    @property
    def _tips_stored(self) -> int:
        """Steps of which the tip is stored: a measurement at the edge of the window shows tips that are older still."""
        return math.ceil((self.options.window + self.expected.reach_s) / self.simulator.scheme.dt) + 5

    @property
    def delay(self) -> float:
        """Estimated delay of the tracker beyond the nominal one, s."""
        return float(self.bias[DELAY])

    @property
    def model_error(self) -> ModelErrorSize:
        """Size of the model error that the filter counts on."""
        return self._noise.model_error

    def expect_model_error(self, size: ModelErrorSize) -> None:
        """Start with a model error of another ``size``; :meth:`start` is next."""
        self._noise.model_error = size

    def forget_parameters(self) -> None:
        """Have the parameters of the robot file again."""
        self.theta[:] = 0.0
        self._apply_theta()

    def _apply_theta(self) -> None:
        """Write the estimated parameters and force into the simulator's block."""
        self.simulator.parameters[:] = self.nominal + self.uncertainty.effect @ self.theta

    # -- time update --

    def propagate(
        self, state: State, result: StepResult, stamp: float, measured: bool = True, idle: bool = True
    ) -> bool:
        """The covariance after the simulator has stepped to ``stamp`` (s): V <- A V, with A the tangent of the step.

        Args:
            state, result: of the simulator after the step, with its records.
            stamp: s from the first step.
            measured: whether a measurement is fused after this step.
            idle: whether there is idle time behind this step.

        Returns:
            Whether the step could be linearised; where not, V stays.
        """
        # 1. Process noise and reduction that are due, if no idle time has done them.
        self.add_noise_and_reduce()
        # 2. The tip force decays: f <- exp(-dt / T) f.
        self._noise.decay_force(self.theta, self.factor)
        # 3. Is the factor propagated now, or later over this step and the next?
        skipped, records = self.schedule.skipped, result.records
        assert self._strides is not None
        stride = self.stride = self._strides.at(exposed(self._length, state))
        self.schedule.most_skipped = stride.steps - 1
        propagate = self.schedule.plan_step(
            records[0].key, records[-1].key, len(records) > 1, measured, idle, self.adapted.fraction
        )
        # 4. V <- A V over this step and those that were skipped. A step that is divided, at a slope discontinuity of the load or because it was too
        #    hard to be taken at once, is followed by its last part.
        ok = True
        if propagate:
            self.factor.fraction = stride.fraction
            over_s = self.simulator.scheme.dt * (skipped + 1)
            ok = self.factor.propagate(records[-1], self.simulator.parameters, over_s)
        # 5. The tip of this step; those of skipped steps get columns between their neighbours'.
        self._append_tip(state, stamp)
        if propagate and skipped:
            self.tips.interpolate(skipped)
        return ok

    def add_noise_and_reduce(self) -> bool:
        """Add process noise and reduce the factor, if that is due; returns whether it was.

        No output waits for this. The next step does it first, or the owner in idle time before it, which changes no number.
        """
        if not self.schedule.reduction_due:
            return False
        self.schedule.reduction_due = False
        self.pi = self._noise.add(self.schedule.since_reduction, self.pi, self.bias, self.factor)
        self._reduce()
        return True

    def _reduce(self) -> None:
        """Drop the directions of V a that are weakest in the energy norm."""
        factor = self.factor
        energy = factor.energy()
        r = factor.theta.shape[1]
        gram = np.zeros((r, r))
        gram[: len(energy), : len(energy)] = energy
        unit = max(float(energy.trace()) / r, 1e-12)
        scaled = (math.sqrt(unit) * self._parameter_weights) * factor.theta
        gram += scaled.T @ scaled
        self.pi, change, projection = reduced(self.pi, gram, factor.rank)
        self.adapted.project(projection)
        factor.change_basis(change)
        self.tips.change_basis(change, factor.theta.shape[1])
        self.schedule.since_reduction = 0

    def _append_tip(self, state: State, stamp: float) -> None:
        S = state.nodes.shape[1]
        self.tips.append(stamp, state.nodes[-1], self.factor.dnodes[-S:], self._insertion_rate(state))

    def _insertion_rate(self, state: State) -> float:
        return float(state.inputs.beta_rate[0]) * (1.0 - self.insertion_fraction)

    # -- measurement update --

    def update(
        self, state: State, stamp: float, position: Floats, quaternion: Floats, stamp_error_s: float = 0.0
    ) -> Update:
        """Correct fields, parameters and tracker states by a measurement.

        nu = z - h(tip(stamp - delay), b),  S = H Pi H^T + R,  K = Pi H^T S^-1,
        (a, b) = K nu,  Pi <- (I - K H) Pi (I - K H)^T + K R K^T,  y <- y + V a.

        Args:
            state: of the simulator; corrected in place.
            stamp: s from the first step, of the measurement.
            position, quaternion: (3,) m and (4,) wxyz, in the tracker's frame.
            stamp_error_s: 1-sigma that is stated of the stamp, s.
        """
        # 1. Innovation against the tip of the measurement's own time.
        self.adapted.jump(stamp, self.pi)
        compared = self._comparison(stamp, position, quaternion, stamp_error_s)
        if isinstance(compared, Update):
            return compared
        nu, H, S, extra_noise, record = compared
        dof, R = record.dof, self.tracker.noise
        # 2. What the innovation says of the sizes of tip force, tracker shift and tracker noise.
        if not self.adapted.noisy:
            S = S + (self.adapted.noise - 1.0) * R
        constants = Constants(self._tolerances.rows(self.factor.theta), self.pi)
        self.pi += self.adapted.adapt(stamp, nu, H, S, R, constants)
        if self._sees_position:
            changed = H @ self.pi @ H.T + self.adapted.noise * R + extra_noise
            predictive = position_density(nu, S, R), position_density(nu, changed, R)
            record = record._replace(predictive=predictive)
        # 3. Gate: a single measurement outside is rejected, and so are all that the tracker's state explains.
        outside = self.gate.outside(record.nis, dof)
        self.gate.count(outside and self.adapted.sound)
        if outside:
            if not (self.adapted.sound and self.gate.recovers):
                return record._replace(reason="outside the gate")
            # 4. After several rejections in a row, inflation until the measurement is plausible.
            inflated = self.gate.inflate(
                nu, H, R + extra_noise, self.pi, self.factor.theta.shape[1], self.adapted
            )
            if inflated is None:
                return record._replace(reason="outside the gate, farther than any covariance reaches")
            self.pi = inflated
            record = record._replace(
                reason=f"outside the gate {self.gate.rejections} times in a row: fused with an inflated covariance"
            )
        # 5. Gain and covariance, then what is left of a shift that is over; correction by both.
        x = self._judge_tolerances(nu, H)
        x += self._fuse(nu, H, R, extra_noise)
        self._end_shift(x)
        self._correct(state, x)
        self.schedule.since_correction = 0
        return record._replace(accepted=True)

    def _fuse(self, nu: Floats, H: Floats, R: Floats, extra_noise: Floats) -> Floats:
        """The correction (r + 22,) by an innovation ``nu`` (k,) of derivative ``H`` (k, r + 22), noise ``R`` as stated and ``extra_noise``, (k, k)
        each, and the covariance after it: Joseph form."""
        noise = self.adapted.noise * R + extra_noise
        if self.refuted:
            K, self.pi = gain_beside(len(self.pi) - STATES + DELAY, self.pi, H, noise)
            self.adapted.correct(K, H, R)
            return K @ nu
        size, dof = len(self.pi), len(nu)
        if (size, dof) not in self._filters:
            self._filters[size, dof] = ExtendedKalmanFilter(dim_x=size, dim_z=dof)
        ekf = self._filters[size, dof]
        ekf.x, ekf.P, ekf.R = np.zeros((size, 1)), self.pi, noise
        ekf.update(nu[:, None], HJacobian=lambda x: H, Hx=lambda x: np.zeros((dof, 1)))
        self.pi = 0.5 * (ekf.P + ekf.P.T)
        self.adapted.correct(ekf.K, H, R)
        correction: Floats = ekf.x[:, 0]
        return correction

    def _judge_tolerances(self, nu: Floats, H: Floats) -> Floats:
        """Where the estimate begins to refute the tolerances, the correction (r + 22,) that goes with the delay that was expected; else none.

        ``nu`` (k,), of derivative ``H`` (k, r + 22), is the innovation that is fused next; it is corrected in place.
        """
        before, states = self.refuted, self._from_file()
        self.refuted = self._tolerances.refuted(self.theta, states, before)
        at = len(self.pi) - STATES + DELAY
        if before or not self.refuted or not self.pi[at, at] > 0.0:
            return np.zeros(len(self.pi))
        # nobody knows which is right: the delay that was expected, or the one that was found
        gain = release(at, math.hypot(self.expected.delay_sigma, states[DELAY]), self.pi)
        correction: Floats = -states[DELAY] * gain
        nu -= H @ correction
        known = np.zeros((1, len(gain)))
        known[0, at] = 1.0
        self.adapted.correct(gain[:, None], known, np.zeros((1, 1)))
        return correction

    def _from_file(self) -> Floats:
        """(22,) tracker states, less what is expected of them."""
        states = self.bias.copy()
        states[DELAY] -= self.expected.delay
        return states

    def _end_shift(self, x: Floats) -> None:
        """Bring the tracker's shift back to zero where the tracker is sound and nothing speaks against it: the covariance changes, and the correction
        ``x`` (r + 22,) in place.

        That is a measurement of the shift, zero within the noise of a position. Odds are by Bayes' rule: a shift could be anything up to the
        robot's length, which is improbable beside none unless it is many of its deviations from zero.
        """
        first = self.factor.theta.shape[1] + SHIFT.start
        noise = float(self.tracker.variance[0])
        variance = self.pi.diagonal()[first : first + 3].sum()
        if not self.adapted.sound or variance < 0.01 * noise:
            return
        x[first : first + 3] += self.bias[SHIFT]
        gain = np.empty((len(x), 3))
        if pull_to_zero(self.pi, first, self.adapted.noise * noise, self.adapted.reach**2, x, gain):
            H = np.zeros((3, len(x)))
            H[:, first : first + 3] = np.eye(3)
            self.adapted.correct(gain, H, noise * np.eye(3))
        x[first : first + 3] -= self.bias[SHIFT]

    def compare(
        self, stamp: float, position: Floats, quaternion: Floats, stamp_error_s: float = 0.0
    ) -> Update:
        """The innovation of a measurement that is not fused; arguments as of :meth:`update`."""
        compared = self._comparison(stamp, position, quaternion, stamp_error_s)
        if isinstance(compared, Update):
            return compared
        nu, _, S, _, record = compared
        outside = self.gate.outside(record.nis, record.dof)
        if self._sees_position:
            predictive = position_density(nu, S, self.tracker.noise)
            record = record._replace(predictive=(predictive, predictive))
        return record._replace(reason="outside the gate" if outside else FUSION_OFF)

    def _tip_at(self, time: float) -> Tip | None:
        """The tip of that time (s) with its columns."""
        return self.tips.at(time, self.simulator.scheme.dt)

    def _comparison(
        self, stamp: float, position: Floats, quaternion: Floats, stamp_error_s: float
    ) -> Update | TipComparison:
        """A measurement against the tip of its time; the record alone where there is nothing to compare it with."""
        return compare_with_tip(
            self.expected, self._tip_at, self.simulator.scheme.dt, self.bias, self.pi, self.adapted, stamp, position, quaternion,
            stamp_error_s,
        )  # fmt: skip

    def _correct(self, state: State, x: Floats) -> None:
        """Move everything by the correction ``x`` = (a, b) (r + 22,)."""
        factor, u = self.factor, self.uncertainty
        r = factor.theta.shape[1]
        x = u.confined(x, self.theta, factor.theta, self.pi)
        a = x[:r]
        self.bias += x[r:]
        # beyond these a measurement on time would show a tip outside the window, and no later one could mend the delay
        earliest = min(self.expected.delay, 0.0) - self.simulator.scheme.dt
        self.bias[DELAY] = min(max(self.bias[DELAY], earliest), self.expected.delay + self.options.window)
        self.theta += factor.theta @ a
        np.clip(self.theta, u.lowest, u.highest, out=self.theta)
        self._apply_theta()
        state.bank[:2] += factor.fields_change(a)
        nodes = factor.nodes_change(a)
        if self.simulator.collocation is None:
            move_unknowns(factor.dx, a, state.unknowns, state.earlier)
        else:
            self.simulator.collocation.shift(state, factor.dx @ a, nodes)
        state.nodes += nodes
        self.tips.shift(a)

    # -- outputs --

    @property
    def force(self) -> Floats:
        """(3,) estimated tip force, N, ``ctr_base`` axes; the caller's own, as the filter goes on writing."""
        return self.theta[self._force].copy()

    def tip_estimate(self) -> TipEstimate:
        """Fused tip now."""
        tip = self.tips.last
        pose, covariance, sigma = np.empty(7), np.empty((12, 12)), np.empty(3)
        finite = fused_tip(
            tip.mean, tip.columns, self.tracker.rotation, self.tracker.lever, self.bias, self.pi, self.factor.theta[self._force],
            pose, covariance, sigma,
        )  # fmt: skip
        return TipEstimate(pose[:3], pose[3:], tip.mean[7:13].copy(), covariance, sigma, finite)

    def shift_in_base(self) -> Floats:
        """(3,) m, the estimated shift of measured positions in base axes."""
        shift: Floats = matrix(self.tracker.rotation).T @ self.bias[SHIFT]
        return shift

    def tracker_fault(self) -> tuple[float, float]:
        """By how much measured positions are shifted (m; 0 where that is within three deviations of their noise), and the tracker's noise by the
        stated deviation (1 while nothing else is established)."""
        shift = math.hypot(*self.bias[SHIFT].tolist())
        ratio = math.sqrt(self.adapted.noise) if self.adapted.noisy else 1.0
        return shift if shift > 3.0 * math.sqrt(self.tracker.variance[0]) else 0.0, ratio

    def refutation(self) -> str:
        """What refutes the tolerances of the robot file, in words; empty where nothing does."""
        if not self.refuted:
            return ""
        name, times = self._tolerances.farthest(self.theta, self._from_file())
        return f"{name} is found {times:.0f} of its tolerances away from the robot file"

    def parameters(self, known: bool = True) -> dict[str, dict[str, float | None]]:
        """Value and deviation of every uncertain parameter by its name; no deviations unless they are ``known``."""
        rows = self.factor.theta if known else None
        return values_and_deviations(self.uncertainty.names, self.theta, rows, self.pi)

    # -- checkpoints --

    def checkpoint(self) -> FilterState:
        """What :meth:`restore` returns to."""
        return FilterState(
            self.theta.copy(), self.bias.copy(), self.pi.copy(), self.adapted.checkpoint(), self.gate.rejections,
            self.schedule.checkpoint(), self.factor.checkpoint(), self.tips.checkpoint(), self.refuted,
        )  # fmt: skip

    def restore(self, state: FilterState) -> None:
        """Return to a checkpoint."""
        self._restore_all_but_tips(state)
        self.tips.restore(state.tips)

    def reuse_covariance(self, stored: FilterState, state: State) -> None:
        """After a step that was corrected for slightly other inputs: the covariance ``stored`` of that step, around the corrected tips.

        Good while no measurement has been fused since the first corrected step. ``state``: of the simulator after the step.
        """
        self._restore_all_but_tips(stored)
        self.tips.reuse_covariance(stored.tips, state.nodes[-1], self._insertion_rate(state))

    def _restore_all_but_tips(self, state: FilterState) -> None:
        self.theta, self.bias, self.pi = state.theta.copy(), state.bias.copy(), state.pi.copy()
        self.adapted.restore(state.adapted)
        self.gate.rejections, self.refuted = state.rejections, state.refuted
        self.schedule.restore(state.schedule)
        self.factor.restore(state.factor)
        self._apply_theta()
