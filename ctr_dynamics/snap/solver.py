"""The finite-difference solver in time: statics, steps of any size, and what is read from a solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.layout import RATE_NOW, Y_BEFORE, Y_NOW, field_rows, state_rows
from ctr_dynamics.kernels.snap_newton import CONVERGED, NOT_FINITE, solve
from ctr_dynamics.kernels.snap_residual import solver_arrays
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot import Robot
from ctr_dynamics.snap.grid import Grid, build_grid, default_cells

TOLERANCE = 1e-9  # of ||E||^2, SI units (section III-F)
# Effects on what (25) holds.
HELD = frozenset(
    (
        "base_coulomb", "base_viscous", "tube_coulomb", "tube_viscous", "stribeck", "distributed_friction", "youngs_modulus", "shear_modulus",
        "precurvature", "density", "payload_mass", "payload_inertia", "bending_damping", "torsion_damping", "gravity_direction",
        "drivetrain_compliance",
    )
)  # fmt: skip
# Those that do not concern it: its actuator angles are the true ones, its translations stand still, and nothing is measured.
OUTSIDE = frozenset(
    (
        "encoder_offset", "encoder_gain", "backlash", "actuator_latency", "insertion_velocity", "load_time", "registration_rotation",
        "registration_translation", "tracker_lever_arm", "tracker_latency", "tracker_averaging", "clock_skew", "tracker_scale", "drift",
    )
)  # fmt: skip
EQUATIONS = {"derived": 1.0, "printed": 0.0}
"""Factor of each form, for the last row of the parameters (docs/model.md, *Gyroscopic term of (12)*)."""
OUTCOMES = {
    CONVERGED: "ok",
    1: "Newton's method did not converge",
    NOT_FINITE: "Newton's method left the range of finite numbers",
}


@dataclass(frozen=True)
class Solved:
    """Outcome of one solve; after a failure the solver's state is as before."""

    ok: bool
    reason: str
    iterations: int
    jacobians: int
    residual: float  # ||E||^2


class SnapSolver:
    """Finite differences (25) for one robot at fixed translations.

    Args:
        robot: the robot.
        beta: (N,) m.
        cells: behind the plate and in each section, base to tip; default :func:`ctr_dynamics.snap.grid.default_cells`.
        tolerance: largest ||E||^2.
        equations: ``derived``, or ``printed`` for (12) and (20) as the paper prints them and the published program solves them.

    Raises:
        InputError: translations or cells that do not fit the robot, or an extension that these equations lack.
    """

    def __init__(
        self,
        robot: Robot,
        beta: np.ndarray,
        cells: tuple[int, ...] | None = None,
        tolerance: float = TOLERANCE,
        equations: str = "derived",
    ) -> None:
        problem = robot.actuator_problem(np.asarray(beta, float))
        if problem:
            raise InputError(problem, do="mend beta", where=f"robot {robot.name}")
        absent = set(robot.extensions) - HELD - OUTSIDE
        if absent:
            raise InputError(
                f"extension '{min(absent)}' is not in the finite-difference solver",
                do="take it out of the robot file",
                where=f"robot {robot.name}",
            )
        self.model = model = Model(robot)
        self.beta = np.array(beta, float)
        self.grid: Grid = build_grid(
            model.segments, self.beta, cells or default_cells(robot.name, model.segments, self.beta)
        )
        self.tolerance = tolerance
        self.parameters = np.append(model.parameters, EQUATIONS[equations])
        self.parameters[model.layout["beta"]] = self.beta
        self.work = solver_arrays(self.grid.arrays)
        size = self.work.left.shape[1]
        self.scratch = (np.zeros((size, size)), np.zeros((size, size)))
        self.x = np.zeros(self.grid.unknowns)
        self.x_before = self.x.copy()
        self.x_earlier = self.x.copy()
        self.bank = np.zeros((3, len(self._fields())))  # y now, y before, rate now
        self.t = 0.0
        self.dt = self.dt_before = 0.0
        self.angle_surprise = 0.0  # rad, theta_f of the last step less its quadratic extrapolation
        self._angles = np.zeros(3)
        self._c0 = -1.0
        self._fresh = True
        self._straight()

    @property
    def n(self) -> int:
        """Number of tubes."""
        return self.model.n

    def _straight(self) -> None:
        """Unknowns of straight tubes at alpha = 0: the start of Newton's method."""
        g = self.grid.arrays
        for k, s in enumerate(self.grid.s):
            if k:
                at = g.start[g.base + k]
                self.x[at + 2], self.x[at + 3] = s, 1.0

    def _fields(self) -> np.ndarray:
        work = self.work
        return np.concatenate([work.out.ravel(), work.out_base.ravel(), work.out_drive])

    def _solve(self, c0: float, history: np.ndarray | None, guess: np.ndarray, limit: int) -> Solved:
        work, done = self.work, 0
        for part in (work.hist, work.hist_base, work.hist_drive):
            part.flat[:] = 0.0 if history is None else history[done : done + part.size]
            done += part.size
        x = guess.copy()
        outcome, iterations, jacobians, norm = solve(
            self.grid.arrays, x, self.parameters, c0, work, *self.scratch, self._fresh or c0 != self._c0, self.tolerance, limit
        )  # fmt: skip
        self._c0 = c0
        self._fresh = outcome != CONVERGED
        if outcome == CONVERGED:
            self.x_earlier, self.x_before, self.x = self.x_before, self.x, x
        return Solved(outcome == CONVERGED, OUTCOMES[outcome], iterations, jacobians, float(norm))

    def statics(self, alpha: np.ndarray) -> Solved:
        """Static equilibrium near the present shape at ``alpha`` (N,) rad; the solver rests there afterwards, at t = 0.

        Friction is absent from it: nothing slides.
        """
        layout = self.model.layout
        before = self.parameters.copy()
        self.parameters[layout["alpha"]] = alpha
        self.parameters[layout["alpha_rate"]] = 0.0
        solved = self._solve(0.0, None, self.x, 60)
        if not solved.ok:
            self.parameters = before
            return solved
        self.rest()
        return solved

    def rest(self) -> None:
        """Make the present shape the resting history of the motion to come."""
        fields = self._fields()
        self.bank[Y_NOW], self.bank[Y_BEFORE], self.bank[RATE_NOW] = fields, fields, 0.0
        self.x_before, self.x_earlier = self.x.copy(), self.x.copy()
        self.t = self.dt = self.dt_before = 0.0
        self._angles[:] = self.theta_f if self.n > 1 else 0.0

    def copy_state(self) -> tuple:
        """Everything that a step changes, for :meth:`restore_state`."""
        arrays = (
            self.x,
            self.x_before,
            self.x_earlier,
            self.bank,
            self.parameters,
            self._angles,
            self.work.left,
            self.work.right,
            self.work.out,
        )
        return tuple(a.copy() for a in arrays), (self.t, self.dt, self.dt_before)

    def restore_state(self, kept: tuple) -> None:
        """Go back to a state of :meth:`copy_state`."""
        arrays, (self.t, self.dt, self.dt_before) = kept
        x, before, earlier, bank, parameters, angles, left, right, out = (a.copy() for a in arrays)
        self.x, self.x_before, self.x_earlier, self.bank, self.parameters, self._angles = (
            x,
            before,
            earlier,
            bank,
            parameters,
            angles,
        )
        self.work.left[:], self.work.right[:], self.work.out[:] = left, right, out
        self._fresh = True

    def approach(self, alpha: np.ndarray, largest: float = 0.1) -> Solved:
        """Slow static approach: equilibria on the way from the present alpha to ``alpha`` (N,) rad, at most ``largest`` rad apart.

        A failed stride is halved; the branch that the robot is on is followed up to its fold.
        """
        rows = self.model.layout["alpha"]
        target = np.asarray(alpha, float)
        here = self.parameters[rows].copy()
        done, stride = 0.0, min(1.0, largest / max(float(np.abs(target - here).max()), 1e-12))
        solved = self.statics(here)
        last_x, last_done = self.x.copy(), 0.0
        while solved.ok and done < 1.0:
            aim = min(1.0, done + stride)
            kept = self.x.copy()
            if done > last_done:  # along the secant
                self.x = kept + (kept - last_x) * (aim - done) / (done - last_done)
            solved = self.statics(here + aim * (target - here))
            if solved.ok:
                last_x, last_done, done = kept, done, aim
                stride *= 1.3
                stride = min(stride, largest / max(float(np.abs(target - here).max()), 1e-12))
            else:
                self.x = kept
                stride *= 0.5
                if stride < 1e-6:
                    return solved
                solved = Solved(True, "", 0, 0, 0.0)
        return solved

    def step(
        self,
        dt: float,
        alpha: np.ndarray,
        alpha_rate: np.ndarray,
        scheme: str = "bdf2",
        bdf_alpha: float = -0.45,
    ) -> Solved:
        """Advance by ``dt`` s to the actuator angles ``alpha`` (N,) rad with rates (N,) rad/s.

        ``scheme`` is ``bdf2``, with coefficients for unequal steps, or another one-stage scheme of
        :mod:`ctr_dynamics.model.time_scheme`, for equal steps.
        """
        layout = self.model.layout
        ratio = dt / self.dt if self.dt else 1.0
        if scheme == "bdf2":  # the derivative at the end of the parabola through three unequal steps
            c0 = (1.0 + 2.0 * ratio) / (1.0 + ratio) / dt
            weights = np.array([-(1.0 + ratio), ratio**2 / (1.0 + ratio), 0.0]) / dt
        else:
            made = make_scheme(scheme, dt, bdf_alpha)
            if made.stages > 1:
                raise InputError(
                    f"time scheme '{scheme}' has {made.stages} stages", do="use bdf2 or bdf_alpha"
                )
            if not made.one_step and abs(ratio - 1.0) > 1e-9:
                raise InputError(
                    f"time scheme '{scheme}' needs equal steps", do="use bdf2 with steps that change"
                )
            c0, weights = float(made.c0[0]), made.weights[0, :3]
        kept = self.parameters.copy()
        self.parameters[layout["alpha"]] = alpha
        self.parameters[layout["alpha_rate"]] = alpha_rate
        history = weights @ self.bank
        # quadratic in time, through three solutions; those before the start are the resting one
        a, b = dt, self.dt or dt
        c = b + (self.dt_before or b)
        ahead = np.array(
            [(a + b) * (a + c) / (b * c), -a * (a + c) / (b * (c - b)), a * (a + b) / (c * (c - b))]
        )
        guess = ahead[0] * self.x + ahead[1] * self.x_before + ahead[2] * self.x_earlier
        solved = self._solve(c0, history, guess, 30)
        if not solved.ok:
            self._fresh = True
            again = self._solve(c0, history, self.x, 40)
            solved = Solved(
                again.ok,
                again.reason,
                solved.iterations + again.iterations,
                solved.jacobians + again.jacobians,
                again.residual,
            )
        if not solved.ok:
            self.parameters = kept
            return solved
        fields = self._fields()
        self.bank[RATE_NOW] = c0 * fields + history
        self.bank[Y_BEFORE] = self.bank[Y_NOW]
        self.bank[Y_NOW] = fields
        self.t += dt
        self.dt_before, self.dt = b, dt
        if self.n > 1:
            angle = self.theta_f
            self.angle_surprise = float(angle - ahead @ self._angles)
            self._angles[1:], self._angles[0] = self._angles[:-1].copy(), angle
        return solved

    # What is read from the present solution.

    def end_angles(self) -> np.ndarray:
        """(N,) psi_L: base angle of tube 1 plus its twist up to each tube's end plus theta there, rad."""
        g, work = self.grid.arrays, self.work
        psi = self.parameters[self.model.layout["alpha"]][0] + work.out_drive[0]
        if g.turning:
            psi = work.right[g.base, 0]
        twist = work.out[: len(g.ds) - g.base, field_rows(self.n).curvature_z] * g.ds[g.base :]
        angles = np.zeros(self.n)
        for k, m in enumerate(g.tubes):
            after = g.tubes[k + 1] if k + 1 < len(g.tubes) else 0
            if after < m:
                node = g.first_cell[k + 1]
                theta = work.right[node, state_rows(m).theta + m - 2] if m > 1 else 0.0
                angles[m - 1] = psi + twist[: node - g.base].sum() + theta
        return angles

    @property
    def marker_angle(self) -> float:
        """psi_L2 - psi_L1: angle between the end frames of tubes 2 and 1, rad."""
        angles = self.end_angles()
        return float(angles[1] - angles[0])

    @property
    def theta_f(self) -> float:
        """Tip angle as the authors' published example counts it, rad: theta_2 at tube 2's end plus the twist of tube 1 from there to its tip.

        At rest this is psi_L2 - psi_L1. In motion the marker on tube 1 twists the length beyond tube 2, and the published program counts
        this twist with the other sign than :attr:`marker_angle` (docs/snap.md).
        """
        g, work = self.grid.arrays, self.work
        node = g.first_cell[int(np.max(np.flatnonzero(g.tubes > 1))) + 1]
        twist = work.out[node - g.base : len(g.ds) - g.base, field_rows(self.n).curvature_z] @ g.ds[node:]
        m = int(g.tubes[g.cell_section[node - 1]])
        return float(work.right[node, state_rows(m).theta] + twist)

    def tube_end(self, i: int) -> np.ndarray:
        """(3,) m in ``ctr_base``, end of tube ``i`` (0 is the innermost)."""
        g = self.grid.arrays
        section = int(np.max(np.flatnonzero(g.tubes > i)))
        return self.work.right[g.first_cell[section + 1], :3].copy()

    def backbone(self) -> tuple[np.ndarray, np.ndarray]:
        """(nodes, 3) m positions and (nodes, 4) unit quaternions wxyz of tube 1 from the plate to the tip, in ``ctr_base``."""
        g, work = self.grid.arrays, self.work
        states = np.concatenate([work.left[g.base : g.base + 1], work.right[g.base + 1 :]])
        h = states[:, 3:7]
        return states[:, :3].copy(), h / np.linalg.norm(h, axis=1, keepdims=True)
