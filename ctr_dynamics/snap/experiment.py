"""The snap experiment: a slow static approach, then a base turning at a steady rate through the fold, and what comes of it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ctr_dynamics.errors import InputError
from ctr_dynamics.model.model import Model
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import robot_quantities, robot_with
from ctr_dynamics.snap.features import Extremum
from ctr_dynamics.snap.grid import default_cells
from ctr_dynamics.snap.scurve import SCurve
from ctr_dynamics.snap.solver import EQUATIONS, SnapSolver, Solved

MARGIN = 0.0128  # rad before the predicted snap at which a run starts when no start is given
DOUBLE_BELOW = 0.05  # a step whose error is below this share of the allowed one may double

SETTABLE = {
    "tube_coulomb": "friction.tubes.coulomb",
    "tube_viscous": "friction.tubes.viscous",
    "epsilon": "friction.epsilon",
}


def robot_for_snap(robot: Robot, values: Mapping[str, float]) -> Robot:
    """The robot with ``values`` by name: ``tube_coulomb``, ``tube_viscous`` (N m s/rad), ``epsilon`` (rad/s), ``beta1`` (m), or a key path of
    its file that holds one number.

    ``beta1`` moves the inner tube's actuator and changes its first, straight length by as much, so that everything beyond the plate
    stays where it is.

    Raises:
        InputError: unknown name, or a value that does not fit.
    """
    paths: dict[str, Any] = {}
    known = robot_quantities(robot)
    for name, value in values.items():
        if not math.isfinite(value):
            raise InputError(
                f"{name} {value} is not a finite number", do="give a number in SI units", where="--set"
            )
        if name == "beta1":
            if not -2.0 <= value < 0.0:
                raise InputError(f"beta1 {value:g} m is outside [-2, 0) m", do="give metres", where="--set")
            first = robot.tubes[0].precurvature[0]
            length = first.length.value - (value - robot.rest.beta.value[0])
            straight = first.curvature is not None and not any(first.curvature.value)
            if not straight or length <= 0.0:
                raise InputError(
                    f"beta1 {value:g} m would make the inner tube's first length {length:g} m"
                    if straight
                    else "beta1 needs an inner tube that begins straight",
                    do="the straight length changes with beta1",
                    where="--set",
                )
            paths["tubes[0].precurvature[0].length"] = length
            paths["rest.beta"] = (value, *robot.rest.beta.value[1:])
        elif name in SETTABLE:
            paths[SETTABLE[name]] = value
        elif name in known and not hasattr(known[name].value, "__len__"):
            paths[name] = value
        else:
            raise InputError(
                f"'{name}' is not known",
                do=f"names: {', '.join([*SETTABLE, 'beta1'])}, or a quantity of the robot file",
                where="--set",
            )
    changed = robot_with(robot, paths) if paths else robot
    changed._source, changed._sha256 = robot.source, robot.sha256
    return changed


@dataclass(frozen=True)
class Plan:
    """What a run does.

    Attributes:
        start: rad, theta_b on the static solution at t = 0; rate: rad/s, of theta_b from then on, by turning tube 1.
        dt: s, step (the shortest one when adaptive); duration: s.
        cells: behind the plate and in each section; None takes the robot's own.
        scheme, alpha: ``bdf2`` or another one-stage scheme; alpha of ``bdf_alpha``.
        adaptive: longest step in s, or None for equal steps; angle_error: rad, allowed for one of its steps.
        frames: about this many backbones are kept.
        equations: ``derived`` or ``printed``, see :class:`SnapSolver`.
    """

    start: float
    rate: float = 10.0
    dt: float = 1e-5
    duration: float = 12e-3
    cells: tuple[int, ...] | None = None
    scheme: str = "bdf2"
    alpha: float = -0.45
    adaptive: float | None = None
    angle_error: float = 1e-4
    frames: int = 240
    equations: str = "derived"

    def check(self) -> None:
        """Raises InputError for numbers out of range."""
        for name, value, low, high, unit in (
            ("dt", self.dt, 1e-8, 1e-2, "s"),
            ("duration", self.duration, self.dt, 10.0, "s"),
            ("rate", self.rate, -1e4, 1e4, "rad/s"),
            ("start", self.start, -4 * math.pi, 4 * math.pi, "rad"),
        ):
            if not low <= value <= high:
                raise InputError(f"{name} {value:g} {unit} is outside [{low:g}, {high:g}] {unit}")
        if self.equations not in EQUATIONS:
            raise InputError(
                f"equations '{self.equations}' are not known", do=f"one of {', '.join(EQUATIONS)}"
            )
        if self.duration / self.dt > 2e6:
            raise InputError(
                f"{self.duration / self.dt:.3g} steps are more than 2e6", do="raise dt or shorten duration"
            )
        if self.adaptive is not None and not self.dt <= self.adaptive <= 1e-2:
            raise InputError(
                f"longest step {self.adaptive:g} s is outside [dt = {self.dt:g}, 0.01] s",
                do="it cannot be below --dt",
            )
        if self.adaptive is not None and self.scheme != "bdf2":
            raise InputError(f"adaptive steps need scheme bdf2, not {self.scheme}")


@dataclass
class Trajectory:
    """What a run gave; rows are steps, the first at t = dt.

    Attributes:
        t: (k,) s; theta_b, theta_f: (k,) rad; marker_angle: (k,) rad, angle between the tubes' end frames, psi_L2 - psi_L1.
        inner_tip, outer_tip: (k, 3) m in ``ctr_base``.
        iterations, jacobians: (k,) of each step.
        frame_t: (f,) s, positions: (f, nodes, 3) m and quaternions: (f, nodes, 4) wxyz of the kept backbones.
        theta_b_rest, theta_f_rest: rad, at t = 0; wall_s, cpu_s: s by the clock and on the processor, of all steps;
        failure: why the run ended before its time, else empty.
    """

    t: np.ndarray
    theta_b: np.ndarray
    theta_f: np.ndarray
    marker_angle: np.ndarray
    inner_tip: np.ndarray
    outer_tip: np.ndarray
    iterations: np.ndarray
    jacobians: np.ndarray
    frame_t: np.ndarray
    positions: np.ndarray
    quaternions: np.ndarray
    theta_b_rest: float
    theta_f_rest: float
    unknowns: int
    cells: tuple[int, ...]
    wall_s: float
    cpu_s: float
    failure: str = ""


@dataclass
class _Log:
    rows: list[list[float]] = field(default_factory=list)
    frames: list[tuple[float, np.ndarray, np.ndarray]] = field(default_factory=list)


def run(robot: Robot, plan: Plan, progress: Callable[[float], None] | None = None) -> Trajectory:
    """Approach ``plan.start`` statically, then turn tube 1 at ``-plan.rate`` from a resting history; the outer tubes are held.

    A step that cannot be solved ends the run there; ``failure`` says why.

    Raises:
        InputError: the plan or the robot does not fit, or no equilibrium is reached at the start.
    """
    plan.check()
    if robot.n_tubes < 2:
        raise InputError(f"robot {robot.name} has one tube", do="a snap needs two")
    beta, held = np.array(robot.rest.beta.value), float(robot.rest.alpha.value[1])
    solver = SnapSolver(robot, beta, plan.cells, equations=plan.equations)

    def alpha(theta_b: float) -> np.ndarray:
        angles = np.full(robot.n_tubes, held)
        angles[0] = held - theta_b
        return angles

    rates = np.zeros(robot.n_tubes)
    rates[0] = -plan.rate
    solver.parameters[solver.model.layout["alpha"]] = alpha(0.0)
    found = solver.approach(alpha(plan.start))
    if not found.ok:
        raise InputError(
            f"no equilibrium on the way from theta_b = 0 to {plan.start:.4f} rad ({found.reason})",
            do="start before the fold of the S-curve",
        )
    rest = solver.theta_f
    log = _Log()
    every = plan.duration / plan.frames
    log.frames.append((0.0, *solver.backbone()))
    failure = ""
    dt, end = plan.dt, plan.duration * (1 - 1e-9)
    begin, begin_cpu = time.perf_counter(), time.thread_time()  # the approach has compiled everything
    count = 0
    while solver.t < end:
        if plan.adaptive is None:
            count += 1
            t = count * plan.dt
        else:
            t = solver.t + dt
        angles = alpha(plan.start + plan.rate * t)
        if plan.adaptive is None:
            solved = solver.step(plan.dt, angles, rates, plan.scheme, plan.alpha)
            solver.t = t
        else:
            solved, dt = _adaptive_step(
                solver, dt, plan, lambda at: alpha(plan.start + plan.rate * at), rates
            )
        if not solved.ok:
            failure = f"step to {t:.6f} s failed: {solved.reason}"
            break
        log.rows.append(
            [
                solver.t,
                plan.start + plan.rate * solver.t,
                solver.theta_f,
                solver.marker_angle,
                *solver.tube_end(0),
                *solver.tube_end(1),
                solved.iterations,
                solved.jacobians,
            ]
        )
        if solver.t >= log.frames[-1][0] + every * (1 - 1e-9):
            log.frames.append((solver.t, *solver.backbone()))
        if progress is not None and len(log.rows) % 20 == 0:
            progress(solver.t / plan.duration)
    table = np.array(log.rows).reshape(-1, 12)
    return Trajectory(
        t=table[:, 0],
        theta_b=table[:, 1],
        theta_f=table[:, 2],
        marker_angle=table[:, 3],
        inner_tip=table[:, 4:7],
        outer_tip=table[:, 7:10],
        iterations=table[:, 10].astype(int),
        jacobians=table[:, 11].astype(int),
        frame_t=np.array([f[0] for f in log.frames]),
        positions=np.array([f[1] for f in log.frames]),
        quaternions=np.array([f[2] for f in log.frames]),
        theta_b_rest=plan.start,
        theta_f_rest=rest,
        unknowns=solver.grid.unknowns,
        cells=solver.grid.cells,
        wall_s=time.perf_counter() - begin,
        cpu_s=time.thread_time() - begin_cpu,
        failure=failure,
    )


def _adaptive_step(
    solver: SnapSolver, dt: float, plan: Plan, alpha: Callable[[float], np.ndarray], rates: np.ndarray
) -> tuple[Solved, float]:
    """One step of variable BDF2 between ``plan.dt`` and ``plan.adaptive``, and the length of the next one.

    The error of a step is taken from the difference between the quadratic extrapolation of theta_f and the solution, which is five times
    the local error of BDF2 at equal steps.
    """
    # doublings of dt, so that a snap resolved by the shortest step has equal ones
    longest = plan.dt * 2.0 ** math.floor(math.log2((plan.adaptive or plan.dt) / plan.dt) + 1e-9)
    while True:
        kept = solver.copy_state()
        solved = solver.step(dt, alpha(solver.t + dt), rates)
        error = abs(solver.angle_surprise) / 5.0 if solved.ok else math.inf
        if (solved.ok and error <= plan.angle_error) or dt <= plan.dt * (1 + 1e-9):
            break
        solver.restore_state(kept)
        dt = max(plan.dt, 0.5 * dt)
    following = min(2.0 * dt, longest) if error < DOUBLE_BELOW * plan.angle_error else dt
    return solved, min(following, max(plan.duration - solver.t, plan.dt))


def refined_cells(robot: Robot, factor: int, cells: tuple[int, ...] | None = None) -> tuple[int, ...]:
    """``cells``, or the robot's own, with each count multiplied by ``factor``.

    Raises:
        InputError: factor outside 1 to 50.
    """
    if not 1 <= factor <= 50:
        raise InputError(f"--refine {factor} is outside 1 to 50", do="2 doubles the cells of every section")
    if cells is None:
        cells = default_cells(robot.name, Model(robot).segments, np.array(robot.rest.beta.value))
    return tuple(factor * c for c in cells)


def overshoot(run: Trajectory, curve: SCurve, found: list[Extremum]) -> float | None:
    """First peak of theta_f less the stable equilibrium behind the snap at the same theta_b, rad; None without either."""
    if not found or found[0].kind != "peak":
        return None
    at = float(np.interp(found[0].t_s, run.t, run.theta_b))
    snap_back = next((f for _, f, opens in curve.folds() if not opens), None)
    if snap_back is None:
        return None
    behind = curve.theta_f > snap_back
    return float(found[0].theta_f - np.interp(at, curve.theta_b[behind], curve.theta_f[behind]))
