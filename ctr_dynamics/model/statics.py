"""Static equilibrium: the dynamic model with every velocity zero, its branches and its stability."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from ctr_dynamics.kernels.end_angles import end_angles
from ctr_dynamics.kernels.kinds import ONE_LANE, lanes_for
from ctr_dynamics.kernels.layout import state_rows
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.shooting import CONVERGED, broadcast, solve
from ctr_dynamics.kernels.sweep import sweep
from ctr_dynamics.model.mesh import Key, Mesh
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.state import Inputs


@dataclass
class Equilibrium:
    """A static solution (or the reason why there is none).

    Attributes:
        converged: whether the shooting residual met the tolerance.
        x: (5 + N,) base torques (N m), n (N) and m_xy (N m) at s = 0+ in the frame of tube 1.
        fields: (points * F + base fields,) the fields at rest, as the dynamic model stores them.
        nodes: (nodes, S) state at the nodes.
        mesh, key: sections it was solved on.
        end_angles: (N,) psi_L, end angle of each tube about the tangent in a rotation-minimising frame, rad.
        stability: det of d alpha / d psi_L with the loads held; > 0 is stable; None unless asked for.
    """

    converged: bool
    x: np.ndarray
    fields: np.ndarray
    nodes: np.ndarray
    mesh: Mesh
    key: tuple
    end_angles: np.ndarray
    stability: float | None = None

    @property
    def tip_position(self) -> np.ndarray:
        """(3,) m in ``ctr_base``."""
        return self.nodes[-1, :3]

    @property
    def tip_quaternion(self) -> np.ndarray:
        """(4,) wxyz, unit, tube 1's tip frame in ``ctr_base``."""
        h = self.nodes[-1, 3:7]
        return h / np.linalg.norm(h)


class Statics:
    """Solver of static equilibria: the dynamic model with every velocity zero.

    Args:
        model: the robot.
        tolerance: largest scaled residual at the tip.

    Example:
        >>> from ctr_dynamics import Model, Statics, load_robot
        >>> robot = load_robot("till2020_tissue")
        >>> shape = Statics(Model(robot)).solve(robot.rest.beta.value, robot.rest.alpha.value)  # m, rad
        >>> (1e3 * shape.tip_position).round(1).tolist()  # mm in ctr_base
        [83.5, -7.4, 105.1]
    """

    def __init__(self, model: Model, tolerance: float = 1e-9) -> None:
        self.model = model
        self.tolerance = tolerance

    def solve_at(
        self, inputs: Inputs, *, guess: np.ndarray, parameters: np.ndarray, key: Key | None = None
    ) -> Equilibrium:
        """Equilibrium at given actuators and load.

        Args:
            inputs: actuators and tip wrench; rates do not count.
            guess: x of a neighbouring equilibrium.
            parameters: (NP,) block instead of the robot file's.
            key: of sections to keep where they fit.
        """
        return self.solve(
            inputs.beta,
            inputs.alpha,
            inputs.force,
            inputs.torque,
            guess=guess,
            parameters=parameters,
            key=key,
        )

    def solve(
        self,
        beta: ArrayLike,
        alpha: ArrayLike,
        force: ArrayLike = (0, 0, 0),
        torque: ArrayLike = (0, 0, 0),
        *,
        guess: np.ndarray | None = None,
        end_angles: ArrayLike | None = None,
        parameters: np.ndarray | None = None,
        key: Key | None = None,
    ) -> Equilibrium:
        """Equilibrium at beta (N,) m, alpha (N,) rad (at beta) under a wrench on tube 1's tip (N, N m, ``ctr_base``).

        Args:
            guess: (5 + N,) unknowns to start from.
            end_angles: (N,) psi_L that choose the branch; without them and without a guess it is the first stable one that Newton from
                straight tubes, continuous growth of precurvature, weight and load, or a search over end angles finds.
            parameters: (NP,) block instead of the robot file's.
            key: of sections to keep where they fit, see :meth:`ctr_dynamics.model.model.Model.mesh`.
        Returns:
            Equilibrium
        """
        model, layout = self.model, self.model.layout
        beta = np.asarray(beta, float)
        key, mesh = model.mesh(beta, key)
        par = (model.parameters if parameters is None else parameters).copy()
        par[layout["alpha"]] = alpha
        par[layout["alpha_rate"]] = 0.0
        par[layout["beta"]] = beta
        par[layout["force"]] = force
        par[layout["torque"]] = torque
        problem = StaticProblem(model, mesh, beta, self.tolerance)
        if end_angles is not None:
            x, found = self._from_end_angles(problem, par, np.asarray(end_angles, float))
            found = found and self._to_loads(problem, par, x)
        elif guess is not None:
            x = np.array(guess, float)
            found = problem.newton(par, x)
            if not found:
                x[:] = 0.0
                found = self._grow(problem, par, x)
        else:
            x, found = self._stable(problem, par)
        return problem.result(key, x, par, found)

    def _stable(self, problem: StaticProblem, par: np.ndarray) -> tuple[np.ndarray, bool]:
        """The first stable equilibrium of several starts, or an unstable one when no start leads to a stable one."""
        fallback: np.ndarray | None = None
        alpha = par[self.model.layout["alpha"]]

        def starts() -> Iterator[tuple[np.ndarray, bool]]:
            x = np.zeros(self.model.unknown_count)
            yield x, problem.newton(par, x)
            x = np.zeros(self.model.unknown_count)
            yield x, self._grow(problem, par, x)
            # the energy has a minimum for some twist of each tube against the next: half turns apart in steps of 45 degrees
            for eighths in product((0, 1, -1, 2, -2, 3, -3, 4), repeat=min(self.model.n - 1, 2)):
                shift = np.zeros(self.model.n)
                shift[1 : 1 + len(eighths)] = np.cumsum(eighths) * (math.pi / 4)
                x, found = self._from_end_angles(problem, par, alpha + shift)
                yield x, found and self._to_loads(problem, par, x)

        for x, found in starts():
            if found:
                if problem.stability(par, x) > 0.0:
                    return x, True
                fallback = x.copy() if fallback is None else fallback
        return (np.zeros(self.model.unknown_count), False) if fallback is None else (fallback, True)

    def _grow(self, problem: StaticProblem, par: np.ndarray, x: np.ndarray) -> bool:
        """Continuation in one factor on precurvature, weight and load."""
        names = ("precurvature", "gravity", "force", "torque")
        rows = np.concatenate([self.model.layout.rows(name) for name in names])
        return _continue(problem, par, x, rows)

    def _to_loads(self, problem: StaticProblem, par: np.ndarray, x: np.ndarray) -> bool:
        """Continuation in the weight and the load alone, from an unloaded solution."""
        rows = np.concatenate([self.model.layout.rows(name) for name in ("gravity", "force", "torque")])
        if not np.any(par[rows]):
            return problem.newton(par, x)
        return _continue(problem, par, x, rows)

    def _from_end_angles(
        self, problem: StaticProblem, par: np.ndarray, end_angles: np.ndarray
    ) -> tuple[np.ndarray, bool]:
        """Unloaded solution whose end angles are near the given ones.

        The unloaded robot is an initial-value problem from its ends: with psi_L given and free ends, torsion integrates backward without
        iteration. Its base torques start the shooting.
        """
        unloaded = par.copy()
        for name in ("gravity", "force", "torque"):
            unloaded[self.model.layout[name]] = 0.0
        x, _ = problem.backward(unloaded, end_angles)
        return x, problem.newton(unloaded, x)

    def stability(
        self,
        equilibrium: Equilibrium,
        beta: ArrayLike,
        alpha: ArrayLike,
        force: ArrayLike = (0, 0, 0),
        torque: ArrayLike = (0, 0, 0),
    ) -> float:
        """det(d alpha / d psi_L) with the loads held, positive on stable branches (Gilbert et al. 2016, Ha et al. 2016).

        psi_L and the tip's residual r are smooth functions of (x, alpha), and their joint Jacobian is regular where the
        shooting one is not, so det(d alpha / d psi_L) = det(r_x) / det([r_x, r_alpha; psi_x, psi_alpha]) is exact through a fold.
        """
        layout = self.model.layout
        par = self.model.parameters.copy()
        par[layout["alpha"]] = alpha
        par[layout["beta"]] = beta
        par[layout["force"]] = force
        par[layout["torque"]] = torque
        return StaticProblem(self.model, equilibrium.mesh, np.asarray(beta, float), self.tolerance).stability(
            par, equilibrium.x
        )


def _continue(problem: StaticProblem, par: np.ndarray, x: np.ndarray, rows: np.ndarray) -> bool:
    """Raise the parameters in ``rows`` from 0 to their values in adaptive steps; ``x`` follows. True when they are reached."""
    target = par[rows].copy()
    reached, step = 0.0, 0.1
    par[rows] = 0.0
    if not problem.newton(par, x):
        par[rows] = target
        return False
    before, x_before = reached, x.copy()
    while reached < 1.0:
        trial = min(1.0, reached + step)
        par[rows] = target * trial
        guess = x.copy()
        if reached > before:
            guess += (x - x_before) * (trial - reached) / (reached - before)
        if problem.newton(par, guess):
            before, x_before = reached, x.copy()
            x[:] = guess
            reached = trial
            step *= 1.5
        else:
            step *= 0.4
            if step < 1e-4:
                par[rows] = target
                return False
    return True


class StaticProblem:
    """A static problem on one mesh, with its buffers.

    Attributes:
        beta: (N,) m, translations that the section lengths are those of. single: buffers of one lane; what a sweep leaves is read from them.
    """

    def __init__(self, model: Model, mesh: Mesh, beta: np.ndarray, tolerance: float) -> None:
        self.model, self.mesh = model, mesh
        self._lanes = lanes_for(1 + model.unknown_count + model.n)  # base case, unknowns, alpha
        self._many = model.sweep_buffers(mesh, self._lanes.count)
        self._solver = model.shooting_solver(mesh, tolerance, jacobian=self._many)
        self.single = self._solver.single
        self._inverse = np.zeros((model.unknown_count, model.unknown_count))
        self.move(beta)

    def move(self, beta: np.ndarray) -> None:
        """Go to other translations (N,) m, of the same sections."""
        self.beta = np.array(beta, float)
        section_lengths(self.mesh.bp_tube, self.mesh.bp_offset, self.beta, self.single.section_lengths)

    def newton(self, par: np.ndarray, x: np.ndarray, fresh: bool = True) -> bool:
        """Solve for ``x`` in place; ``x`` is left as it was when there is no solution. ``fresh`` False: the Jacobian's inverse is at hand."""
        trial = x.copy()
        self.single.parameters[:] = par
        outcome, *_ = solve(self.model.kind, 0.0, self.mesh, self._solver, trial, self._inverse, fresh)
        if outcome == CONVERGED:
            x[:] = trial
        return outcome == CONVERGED

    def sweep(self, par: np.ndarray, x: np.ndarray) -> None:
        """One plain sweep at ``x``; results stay in the buffers."""
        self.single.parameters[:], self.single.unknowns[:] = par, x
        sweep(self.model.kind, ONE_LANE, 0.0, self.mesh, self.single)

    def result(self, key: tuple, x: np.ndarray, par: np.ndarray, converged: bool) -> Equilibrium:
        """Equilibrium at ``x``."""
        self.sweep(par, x)
        fields = self.single.fields
        states = self.single.nodes.reshape(-1, state_rows(self.model.n).size).copy()
        return Equilibrium(
            converged=converged,
            x=x.copy(),
            fields=np.concatenate([fields, self.single.base_fields]),
            nodes=states,
            mesh=self.mesh,
            key=key,
            end_angles=self.end_angles(fields[:, None], states[:, :, None])[:, 0],
        )

    def end_angles(self, fields: np.ndarray, states: np.ndarray) -> np.ndarray:
        """psi_L (N, lanes) from ``fields`` (points * F, lanes) and ``states`` (nodes, S, lanes): base angle plus the integral of u_1z, plus theta."""
        angles = np.zeros((self.model.n, fields.shape[1]))
        mesh = self.mesh
        end_angles(mesh.sec_cells, mesh.sec_tubes, self.single.section_lengths, fields, states, angles)
        return angles

    def joint_jacobian(self, par: np.ndarray, x: np.ndarray) -> np.ndarray:
        """d(r, psi_L)/d(x, alpha), (5 + 2N, 5 + 2N), by perturbed lanes."""
        model, L, b, step = self.model, self._lanes.count, self._many, self.model.perturbation
        n, m = model.n, model.unknown_count
        broadcast(self._lanes, par, b.parameters)
        broadcast(self._lanes, self.single.section_lengths, b.section_lengths)
        broadcast(self._lanes, x, b.unknowns)
        for i in range(m):
            b.unknowns[i * L + 1 + i] += step[i]
        for i, row in enumerate(model.layout.rows("alpha")):
            b.parameters[row * L + 1 + m + i] += 1e-7
        sweep(model.kind, self._lanes, 0.0, self.mesh, b)
        angles = self.end_angles(b.fields.reshape(-1, L), b.nodes.reshape(-1, state_rows(n).size, L))
        values = np.concatenate([b.residual.reshape(m, L), angles])
        steps = np.concatenate([step, np.full(n, 1e-7)])
        change = values[:, 1 : 1 + m + n] - values[:, :1]
        # the base angle is that of a quaternion, which begins anew after two turns
        change[m:] -= 4.0 * np.pi * np.round(change[m:] / (4.0 * np.pi))
        return change / steps

    def stability(self, par: np.ndarray, x: np.ndarray) -> float:
        """det(d alpha / d psi_L) at ``x``, see :meth:`Statics.stability`."""
        m = len(x)
        joint = self.joint_jacobian(par, x)
        if not np.isfinite(joint).all():
            return math.nan
        sign_x, log_x = np.linalg.slogdet(joint[:m, :m])
        sign_j, log_j = np.linalg.slogdet(joint)
        return float(sign_x * sign_j * math.exp(min(log_x - log_j, 700.0)))

    def backward(self, par: np.ndarray, end_angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unloaded torsion from the free ends back to the actuators: (x, alpha) with end angles (N,) rad; x holds base torques only.

        psi_i' = u_iz, m_iz' = E_i I_i (u x u*_i)_z with u the common curvature in a rotation-minimising frame; midpoint steps.
        """
        n, mesh, layout = self.model.n, self.mesh, self.model.layout
        EI, GJ = par[layout["bending_stiffness"]], par[layout["torsional_stiffness"]]
        KS = par[layout["precurvature"]]
        angles, torque = end_angles.copy(), np.zeros(n)
        ust = mesh.ust.reshape(-1, n, 3) * KS[:, None]

        def slope(
            angles: np.ndarray, torque: np.ndarray, present: int, reference: np.ndarray
        ) -> tuple[np.ndarray, np.ndarray]:
            c, s = np.cos(angles[:present]), np.sin(angles[:present])
            wx = c * reference[:present, 0] - s * reference[:present, 1]
            wy = s * reference[:present, 0] + c * reference[:present, 1]
            ei = EI[:present]
            ux, uy = (ei @ wx) / ei.sum(), (ei @ wy) / ei.sum()
            turn, wind = np.zeros(n), np.zeros(n)
            turn[:present] = torque[:present] / GJ[:present] + reference[:present, 2]
            wind[:present] = ei * (ux * wy - uy * wx)
            return turn, wind

        point = len(ust)
        for k in reversed(range(len(mesh.sec_cells))):
            cells, present = mesh.sec_cells[k], mesh.sec_tubes[k]
            point -= 4 * cells + 1
            fine = 8
            for cell in reversed(range(cells)):
                step = self.single.section_lengths[k] / cells / fine
                reference = ust[point + 4 * cell + 1]
                for _ in range(fine):
                    turn, wind = slope(angles, torque, present, reference)
                    turn, wind = slope(
                        angles - 0.5 * step * turn, torque - 0.5 * step * wind, present, reference
                    )
                    angles, torque = angles - step * turn, torque - step * wind
        x = np.zeros(self.model.unknown_count)
        x[:n] = torque
        # at s = 0 the frame of tube 1 is turned by psi_1(0): moments of the unloaded robot vanish in total
        alpha = angles + self.beta * torque / GJ
        return x, alpha
