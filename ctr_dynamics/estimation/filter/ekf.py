"""The extended Kalman filter on the fields of the rod: predict with the tangent of the step, update with filterpy at the sample's own stamp.

Numbered steps (docs/filter.md): (1) columns follow the tangent of the step, or of up to three at once; (2) the tip force decays and is driven, the
drift likewise; (3) columns are reduced to the rank; (4) a sample is compared with the tip of its own time, whose columns have been kept;
(5) gate; (6) filterpy's update of (a, b); (7) fields, parameters, kept tips and the shooting unknowns move by the columns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from numpy.typing import NDArray
from scipy.stats import chi2

from ctr_dynamics.estimation.filter.covariance_factor import Columns
from ctr_dynamics.estimation.filter.parameter_priors import bias_sigma, model_uncertainty
from ctr_dynamics.estimation.filter.process_noise import ForceDrive
from ctr_dynamics.estimation.filter.reduction import APPENDED, reduced
from ctr_dynamics.estimation.filter.tip_window import TipWindow
from ctr_dynamics.estimation.step_output import FUSION_OFF
from ctr_dynamics.kernels.filter_steps import fade, move_unknowns, outside
from ctr_dynamics.kernels.tracker_measurement import fused_tip
from ctr_dynamics.model.mesh import Key
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator, State, StepResult
from ctr_dynamics.sensing.tracker import DELAY, DRIFT, STATES, TrackerModel, innovation

Floats = NDArray[np.float64]

VAGUE = 1.0  # m^2 and rad^2: a covariance is not widened beyond
MOST_DOUBLINGS = 40  # of the covariance, in one widening: a deviation grows a millionfold
FAR = 10.0  # times the gate: a reading that is farther than that from all that a widened covariance holds is not fused
LONGEST_REFUSAL = 32  # readings outside the gate in a row after which it is widened again
SKIP = 2  # steps that the columns may skip
APART = 4  # steps between a correction and a reduction where samples leave that room: of those that one joint state covers, none does both
DRIVEN = 0.25  # of an innovation's variance: where the tip force has more, columns follow every step and are reduced twice as often


@dataclass(frozen=True)
class FusionOptions:
    """Tuning of the filter; the parameter table says what each means."""

    rank: int = 24
    gate_probability: float = 0.9999
    force_sigma: float = 0.00005
    force_sigma_max: float = 0.2
    force_change: float = 20.0
    force_time: float = 0.3
    window: float = 0.2
    reduce_between: tuple[int, int] = (14, 28)  # steps: fewest behind a correction, most without one


class Update(NamedTuple):
    """One tracker sample's outcome: residual (6,), its predicted variance (6,), NIS, degrees of freedom, accepted, reason, and ``white`` (6,):
    the residual by the inverse root of its covariance, NaN on axes that are not measured."""

    residual: Floats
    variance: Floats
    nis: float
    dof: int
    accepted: bool
    reason: str
    white: Floats


class TipEstimate(NamedTuple):
    """Fused tip: position (3,) m, quaternion (4,) wxyz, twist (6,), covariance (12, 12) of pose and twist (base axes); deviation (3,) of the
    estimated tip force, N; and whether all is finite."""

    position: Floats
    quaternion: Floats
    twist: Floats
    covariance: Floats
    force_sigma: Floats
    finite: bool


def widens(refused: int) -> bool:
    """Whether the covariance is widened for the last of so many readings in a row outside the gate: for the second, fourth, eighth ..., as
    a tracker that contradicts the model for good would lead the runs astray with every reading that is fused."""
    return refused % LONGEST_REFUSAL == 0 or (refused > 1 and refused & (refused - 1) == 0)


class Fusion:
    """Filter of one simulated robot.

    The owner steps the simulator with ``record=True`` and hands the result to :meth:`predict`; the filter writes into the simulator's state and
    parameters when it corrects.
    """

    def __init__(self, simulator: Simulator, tracker: TrackerModel, options: FusionOptions) -> None:
        self.simulator, self.tracker, self.options = simulator, tracker, options
        self.model: Model = simulator.model
        self.uncertainty = model_uncertainty(self.model)
        sigma = np.where(self.uncertainty.sigma > 0, self.uncertainty.sigma, options.force_sigma)
        # parameters in the energy norm: a tenth of the fields' mean for each, in units of its prior
        self._of_parameters = (0.1 / sigma)[:, None]
        self.nominal = simulator.parameters.copy()
        self.columns = Columns(self.model, self.uncertainty, options.rank)
        self.theta = np.zeros(len(self.uncertainty.names))
        self.bias = np.zeros(STATES)
        # a sample at the edge of the window shows a tip that is older still by the delay
        self.tips = TipWindow(math.ceil((options.window + max(0.0, tracker.delay)) / simulator.scheme.dt) + 5)
        self.pi = np.zeros((0, 0))
        self.unreduced = 0  # steps since the columns were reduced
        self.inserted = 0.0  # share of beta's rate that the model's velocities hold already
        self.drive = ForceDrive(options.force_sigma, options.force_sigma_max, options.force_change)
        self.refused = 0  # readings in a row outside the gate, widened for or not
        self._rest = 0  # steps since the last correction; more than `unreduced` where none has come since the columns were reduced
        self._skipped = 0  # steps that the columns have not followed yet
        self._unsettled = False  # whether the columns are to be reduced before the next step
        self._followed: Key = ((), ())  # sections of the last step that they have
        self._force = self.uncertainty.force
        self._force_decay = math.exp(-simulator.scheme.dt / options.force_time)
        self._filters: dict[tuple[int, int], ExtendedKalmanFilter] = {}
        self._gate = {dof: float(chi2.ppf(options.gate_probability, dof)) for dof in range(1, 7)}

    # -- start and prediction --

    def start(self, state: State, stamp: float) -> None:
        """Begin at the static equilibrium in ``state`` with the robot file's tolerances as the prior."""
        inputs = state.inputs
        self.forget_parameters()
        pi_aa = self.columns.start(
            state.key, state.mesh, inputs.beta, inputs.alpha, self._block(inputs), state.unknowns[-1]
        )
        r = len(pi_aa)
        self.bias[:] = 0.0
        self.pi = np.zeros((r + STATES, r + STATES))
        self.pi[:r, :r] = pi_aa
        sigma = bias_sigma(self.model.robot)
        self.pi[r:, r:] = np.diag(sigma**2)
        force = self._force
        # the unknown force starts with its stationary spread, in columns of its own
        scale = np.diag(self.columns.theta)[force]
        for axis, size in enumerate(scale):
            i = force.start + axis
            self.pi[i, i] = (self.options.force_sigma / size) ** 2
        self.drive.start(self.pi, force)
        self._rest, self._skipped, self._unsettled = 1, 0, False
        self._followed = state.key
        self.tips.clear(r)
        self._reduce()
        self._keep_tip(state, stamp)

    def _block(self, inputs: Inputs) -> Floats:
        par = self.simulator.parameters.copy()
        layout = self.model.layout
        par[layout["force"]], par[layout["torque"]] = inputs.force, inputs.torque
        return par

    def predict(
        self, state: State, result: StepResult, stamp: float, sampled: bool = True, pause: bool = True
    ) -> bool:
        """Steps (1)-(3) after the simulator took a step to ``stamp`` (s). False where the tangent does not exist; the columns then stay.

        The columns follow every third step, and every one after which a sample is fused (``sampled``) or they are reduced: they change little
        within 3 ms. The tip of a step that they skipped gets those between its neighbours'. With a strong drive of the tip force they follow
        every step and are reduced twice as often. They are reduced, and the force's new randomness is taken in, some steps behind a correction:
        randomness taken in just before a sample has moved nothing yet that the sample could show. At the latest they are after
        ``reduce_between[1]`` steps, or, so that no step does all the work, at the first one within the next eight that has no sample and a
        ``pause`` behind it: the reduction itself is left to :meth:`settle`.
        """
        self.settle()
        dt = self.simulator.scheme.dt
        self.unreduced += 1
        fade(self._force_decay, self.theta[self._force], self.columns.theta[self._force])
        fewest, most = self.options.reduce_between
        driven = self.drive.share > DRIVEN
        if driven:
            fewest, most = fewest // 2, most // 2
        self._rest += 1
        corrected = self._rest <= self.unreduced  # since the columns were reduced
        behind = corrected and (self._rest >= APART or self.unreduced >= fewest + 2 * APART)
        crowded = sampled or not (pause or driven)
        reduce = self.unreduced >= (most + 2 * APART if crowded else fewest if behind else most)
        key = result.records[0].key
        follow = (
            driven
            or self._skipped >= SKIP
            or sampled
            or reduce
            or key != self._followed
            or len(result.records) > 1
        )
        ok = True
        if follow:
            # a step that is divided where a load bends is one step to them; one that was too hard to be taken at once is not
            records = result.records if result.substeps > 1 else result.records[-1:]
            skipped_s = dt * (self._skipped + 1) - sum(record.scheme.dt for record in records)
            ok = self.columns.propagate(records, self.simulator.parameters, skipped_s)
            self._followed = result.records[-1].key
        self._keep_tip(state, stamp)
        if follow and self._skipped:
            self.tips.interpolate(self._skipped)
        self._skipped = 0 if follow else self._skipped + 1
        self._unsettled = reduce
        return ok

    def settle(self) -> bool:
        """Steps (2) and (3), where they are due; returns whether they were. No output waits for them: the next step does them first, or the owner in
        a pause before it, which makes no difference to any number."""
        if not self._unsettled:
            return False
        self._unsettled = False
        self._drive_drift(self.unreduced)
        self._drive_force(self.unreduced)
        self._reduce()
        return True

    def _drive_drift(self, steps: int) -> None:
        """The tracker's drift over ``steps`` steps: it fades and is driven anew."""
        noise = self.model.robot.tracker.noise
        decay = math.exp(-steps * self.simulator.scheme.dt / noise.drift_time.value)
        r = self.columns.theta.shape[1]
        rows = slice(r + DRIFT.start, r + DRIFT.stop)
        self.bias[DRIFT] *= decay
        self.pi[rows, :] *= decay
        self.pi[:, rows] *= decay
        self.pi[rows, rows] += np.eye(3) * ((1 - decay**2) * noise.drift.value**2)
        self.drive.fade(rows, decay)

    def _drive_force(self, steps: int) -> None:
        """Append three columns that hold the tip force's new randomness of ``steps`` steps: so far they move nothing but that force."""
        decay2 = math.exp(-2 * steps * self.simulator.scheme.dt / self.options.force_time)
        c = self.columns
        r = c.theta.shape[1]
        wide = r + APPENDED
        theta = np.zeros((len(c.theta), wide))
        theta[:, :r] = c.theta
        theta[self._force, r:] = self.drive.sigma * np.eye(3)
        c.theta = theta
        pi = np.zeros((wide + STATES, wide + STATES))
        pi[:r, :r], pi[:r, wide:] = self.pi[:r, :r], self.pi[:r, r:]
        pi[wide:, :r], pi[wide:, wide:] = self.pi[r:, :r], self.pi[r:, r:]
        np.fill_diagonal(pi[r:wide, r:wide], 1.0 - decay2)
        self.pi = pi
        self.drive.append(r, APPENDED, 1.0 - decay2)

    def _reduce(self) -> None:
        """Step (3): drop the directions that are weakest in the energy norm."""
        c = self.columns
        energy = c.energy()
        r = c.theta.shape[1]
        gram = np.zeros((r, r))
        gram[: len(energy), : len(energy)] = energy
        unit = max(float(energy.trace()) / r, 1e-12)
        scaled = (math.sqrt(unit) * self._of_parameters) * c.theta
        gram += scaled.T @ scaled
        self.pi, change, kept = reduced(self.pi, gram, c.rank)
        self.drive.keep(kept)
        c.change(change)
        self.tips.change(change, c.theta.shape[1])
        self.unreduced = 0

    def forget_parameters(self) -> None:
        """Have the parameters of the robot file again."""
        self.theta[:] = 0.0
        self._apply_theta()

    def _apply_theta(self) -> None:
        """Write the estimated parameters and force into the simulator's block."""
        self.simulator.parameters[:] = self.nominal + self.uncertainty.effect @ self.theta

    def _keep_tip(self, state: State, stamp: float) -> None:
        rate = float(state.inputs.beta_rate[0]) * (1.0 - self.inserted)
        S = state.nodes.shape[1]
        self.tips.append(stamp, state.nodes[-1], self.columns.dnodes[-S:], rate)

    # -- update --

    def update(self, state: State, stamp: float, position: Floats, quaternion: Floats) -> Update:
        """Steps (4)-(7) with a reading of time stamp ``stamp`` (s): position (3,) m, quaternion (4,) wxyz, in the tracker's frame."""
        found = self._innovation(stamp, position, quaternion)
        if isinstance(found, Update):
            return found
        nu, H, S, compared = found
        dof, R = compared.dof, self.tracker.noise
        beyond = compared.nis > self._gate[dof]
        self.refused = self.refused + 1 if beyond else 0
        if beyond and not widens(self.refused):
            return compared._replace(reason="outside the gate")
        self.pi += self.drive.learn(stamp, nu, H, S)
        if beyond:
            if not self._inflate(nu, H, R, self._gate[dof]):
                return compared._replace(reason="outside the gate, farther than any covariance reaches")
            compared = compared._replace(
                reason=f"outside the gate {self.refused} times in a row: fused with a widened covariance"
            )
        self._rest = 0
        size = len(self.pi)
        if (size, dof) not in self._filters:
            self._filters[size, dof] = ExtendedKalmanFilter(dim_x=size, dim_z=dof)
        ekf = self._filters[size, dof]
        ekf.x, ekf.P, ekf.R = np.zeros((size, 1)), self.pi, R
        ekf.update(nu[:, None], HJacobian=lambda x: H, Hx=lambda x: np.zeros((dof, 1)))
        self.pi = 0.5 * (ekf.P + ekf.P.T)
        self.drive.corrected(ekf.K, H)
        self._correct(state, ekf.x[:, 0])
        return compared._replace(accepted=True)

    def compare(self, stamp: float, position: Floats, quaternion: Floats) -> Update:
        """The innovation of a reading that is not fused."""
        found = self._innovation(stamp, position, quaternion)
        if isinstance(found, Update):
            return found
        compared = found[3]
        within = compared.nis <= self._gate[compared.dof]
        return compared._replace(reason=FUSION_OFF if within else "outside the gate")

    def _innovation(
        self, stamp: float, position: Floats, quaternion: Floats
    ) -> Update | tuple[Floats, Floats, Floats, Update]:
        """Step (4): masked innovation, H, S and its record; or the record alone where there is nothing to compare with."""
        unknown = np.full(6, np.nan)
        tip = self.tips.at(stamp - self.tracker.delay - self.bias[DELAY], self.simulator.scheme.dt)
        if tip is None:
            return Update(unknown, unknown, math.nan, 0, False, "outside the window of kept steps", unknown)
        nu, H, S, whitened = innovation(self.tracker, self.bias, tip, self.pi, position, quaternion)
        if not math.isfinite(nu.sum() + S.sum() + whitened.sum()):
            return Update(unknown, unknown, math.nan, 0, False, "the innovation is not finite", unknown)
        axes = self.tracker.axes
        full, variance, white = np.full((3, 6), np.nan)
        full[axes], variance[axes], white[axes] = nu, S.diagonal(), whitened
        return (
            nu,
            H,
            S,
            Update(full, variance, float(whitened @ whitened), len(nu), False, "", white),
        )

    @property
    def force(self) -> Floats:
        """(3,) estimated tip force, N, ``ctr_base`` axes; the caller's own, as the filter goes on writing."""
        return self.theta[self._force].copy()

    def _inflate(self, nu: Floats, H: Floats, R: Floats, limit: float) -> bool:
        """Several readings in a row outside the gate are no outliers: the model has lost the robot. Raise the drive of the tip force, and where that
        does not do, widen the fields' part of the covariance, until the reading is plausible (a fading memory) or it is as wide as a robot is
        large. False where the reading is far from plausible even then: nothing is raised or widened."""
        plausible = min(limit, max(0.5 * limit, float(len(nu))))

        def nis(pi: Floats) -> float:
            return float(nu @ np.linalg.solve(H @ pi @ H.T + R, nu))

        raised, pi = 1.0, self.pi
        while nis(pi) > plausible and 2.0 * raised <= self.drive.headroom:
            raised *= 2.0
            pi = self.pi + (raised - 1.0) * self.drive.part
        wider = np.ones(len(pi))
        for _ in range(MOST_DOUBLINGS):
            widened = pi * np.multiply.outer(wider, wider)
            if nis(widened) <= plausible or (H @ widened @ H.T).diagonal().max() > VAGUE:
                break
            wider[: self.columns.theta.shape[1]] *= math.sqrt(2.0)
        if nis(widened) > FAR * limit:
            return False
        self.drive.scale(raised, wider)
        self.pi = widened
        return True

    def _confined(self, x: Floats) -> Floats:
        """The correction ``x`` (r + 13,), moved along the covariance where a parameter would leave its range: all else then takes the most likely
        values beside that parameter at the range's end (Simon 2010, projection of the estimate)."""
        u, rows = self.uncertainty, self.columns.theta
        r = rows.shape[1]
        if not outside(self.theta, rows, x[:r], u.lowest, u.highest):
            return x
        for _ in range(len(u.names)):
            theta = self.theta + rows @ x[:r]
            beyond = np.clip(theta, u.lowest, u.highest) - theta
            if not beyond.any():
                break
            i = int(np.argmax(np.abs(beyond) / np.maximum(u.sigma, 1e-300)))
            gain = self.pi[:, :r] @ rows[i]
            variance = float(rows[i] @ gain[:r])
            if variance <= 1e-12 * u.sigma[i] ** 2:
                break
            x = x + gain * (beyond[i] / variance)
        return x

    def _correct(self, state: State, x: Floats) -> None:
        """Step (7)."""
        c = self.columns
        r = c.theta.shape[1]
        x = self._confined(x)
        a = x[:r]
        self.bias += x[r:]
        # beyond these a reading on time would show a tip that is not kept, and no later one could mend the delay
        self.bias[DELAY] = min(max(self.bias[DELAY], -self.simulator.scheme.dt), self.options.window)
        self.theta += c.theta @ a
        np.clip(self.theta, self.uncertainty.lowest, self.uncertainty.highest, out=self.theta)
        self._apply_theta()
        state.bank[:2] += c.fields_change(a)
        move_unknowns(c.dx, a, state.unknowns, state.earlier)
        state.nodes += c.nodes_change(a)
        self.tips.shift(a)

    # -- outputs --

    def tip_estimate(self) -> TipEstimate:
        """Fused tip now."""
        tip = self.tips.last
        pose, covariance = np.empty(7), np.empty((12, 12))
        sigma, finite = fused_tip(
            tip.mean, tip.columns, self.tracker.rotation, self.tracker.lever, self.bias, self.pi, self.columns.theta[self._force],
            pose, covariance,
        )  # fmt: skip
        return TipEstimate(pose[:3], pose[3:], tip.mean[7:13].copy(), covariance, sigma, finite)

    # -- roll-back --

    def snapshot(self) -> tuple:
        """The filter's part of a state to which :meth:`restore` can return."""
        return (
            self.theta.copy(), self.bias.copy(), self.pi.copy(), self.unreduced, self.drive.snapshot(),
            (self.refused, self._rest, self._skipped, self._followed, self._unsettled), self.columns.snapshot(), self.tips.snapshot(),
        )  # fmt: skip

    def restore(self, snapshot: tuple) -> None:
        """Return to a snapshot."""
        self._restore(snapshot)
        self.tips.restore(snapshot[-1])

    def _restore(self, snapshot: tuple) -> None:
        """All but the tips."""
        theta, bias, pi, self.unreduced, drive, course, columns, _ = snapshot
        self.refused, self._rest, self._skipped, self._followed, self._unsettled = course
        self.theta, self.bias, self.pi = theta.copy(), bias.copy(), pi.copy()
        self.drive.restore(drive)
        self.columns.restore(columns)
        self._apply_theta()

    def follow(self, snapshot: tuple, state: State) -> None:
        """After a step that was taken again with slightly other inputs: the covariance as it was after that step in ``snapshot``, around the
        tips of the steps taken now. Good while no reading has been fused since the first of them."""
        self._restore(snapshot)
        self.tips.follow(
            snapshot[-1], state.nodes[-1], float(state.inputs.beta_rate[0]) * (1.0 - self.inserted)
        )
