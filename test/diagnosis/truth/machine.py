"""The machine as it really is: every physical number of a robot, which hidden effects change, and its equation of motion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ctr_dynamics.robot.schema import Robot

from .kernels import NODES, TIP, Plant, Scheme, integrate, jacobians, residual

CELL_M = 0.012  # longest quadrature cell
DRIVE = 3e4  # N m/rad of a rigid drive: 0.02 N m turn it by 7e-7 rad
TOLERANCE = 1e-5  # 1/m and rad, of the last Newton correction
INPUTS_BEYOND_ANGLES = 16
NO_PATH = np.empty((0, 0))  # coordinates of the steps are not kept


class NoMotionError(RuntimeError):
    """The equations could not be solved; the message says when."""


@dataclass
class Machine:
    """Numbers of a robot in SI units; arrays hold one entry a tube, innermost first. Effects change them in place.

    `clearance_rad` is the largest tilt of the inner tube where tube 2 ends, on the moment scale `clearance_Nm`.
    """

    beta: np.ndarray
    segments: list[list[tuple[float, np.ndarray]]]  # per tube (length m, precurvature (3,) 1/m)
    EI: np.ndarray  # (N, 2) about the principal axes
    axis: np.ndarray
    GJ: np.ndarray
    rho_a: np.ndarray
    rho_i: np.ndarray
    bend_damp: np.ndarray
    twist_damp: np.ndarray
    soft: np.ndarray  # 1 / curvature of the softening law
    mass: np.ndarray
    inertia: np.ndarray  # (N, 3)
    gravity: np.ndarray
    drive: np.ndarray  # (N, 2) stiffness, inertia
    mu_base: float
    nu_base: float
    mu: float
    nu: float
    epsilon: float
    static_ratio: float = 1.0
    stribeck_speed: float = 1.0
    distributed_Nm_per_m: float = 0.0
    drag: tuple[float, float] = (0.0, 0.0)
    clearance_rad: float = 0.0
    clearance_Nm: float = 0.01
    spring: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    contact: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0, 0.0)
    bob: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    @classmethod
    def of(cls, robot: Robot) -> Machine:
        """The machine that the robot file describes; precurvature must be piecewise constant.

        Raises:
            NotImplementedError: precurvature that is a polynomial.
        """
        if any(s.curvature is None for tube in robot.tubes for s in tube.precurvature):
            raise NotImplementedError("the truth generator knows piecewise constant precurvature only")
        tubes, zero = robot.tubes, [0.0, 0.0, 0.0]
        second = np.array([math.pi / 4 * (t.outer_radius.value**4 - t.inner_radius.value**4) for t in tubes])
        area = np.array([math.pi * (t.outer_radius.value**2 - t.inner_radius.value**2) for t in tubes])
        rho = np.array([t.density.value for t in tubes])
        stiff = second * [t.youngs_modulus.value for t in tubes]
        friction = robot.friction
        return cls(
            beta=np.array(robot.rest.beta.value, dtype=float),
            segments=[[(s.length.value, np.array(s.curvature.value)) for s in t.precurvature] for t in tubes],
            EI=np.stack([stiff, stiff], axis=1),
            axis=np.zeros(len(tubes)),
            GJ=2.0 * second * [t.shear.value for t in tubes],
            rho_a=rho * area,
            rho_i=rho * second,
            bend_damp=np.array([t.bending_damping.value for t in tubes]),
            twist_damp=np.array([t.torsion_damping.value for t in tubes]),
            soft=np.zeros(len(tubes)),
            mass=np.array([t.end_body.mass.value if t.end_body else 0.0 for t in tubes]),
            inertia=np.array([t.end_body.inertia.value if t.end_body else zero for t in tubes]),
            gravity=np.array(robot.gravity.value),
            drive=np.tile([DRIVE, 0.0], (len(tubes), 1)),
            mu_base=friction.base.coulomb.value,
            nu_base=friction.base.viscous.value,
            mu=friction.tubes.coulomb.value,
            nu=friction.tubes.viscous.value,
            epsilon=friction.epsilon.value,
        )

    @property
    def n(self) -> int:
        """Number of tubes."""
        return len(self.GJ)

    def curvature_at(self, tube: int, s: float) -> np.ndarray:
        """Precurvature (3,) of a tube at arc length s from the plate."""
        x = s - self.beta[tube]
        for length, curvature in self.segments[tube]:
            if x < length:
                return curvature
            x -= length
        return self.segments[tube][-1][1]


def plant_of(machine: Machine, refine: int = 1, cell_m: float = CELL_M) -> tuple[Plant, int]:
    """(plant, number of coordinates); `refine` divides the cells, at most `cell_m` long, and adds as many less one polynomials."""
    n = machine.n
    ends = machine.beta + [sum(length for length, _ in tube) for tube in machine.segments]
    edges = {0.0}
    for beta, tube in zip(machine.beta, machine.segments, strict=True):
        s = beta
        for length, _ in tube:
            s += length
            if s > 1e-9:
                edges.add(s)
    stations = np.array(sorted(edges))
    stations = stations[np.append(True, np.diff(stations) > 1e-9)]
    sections = len(stations) - 1
    middle = (stations[1:] + stations[:-1]) / 2
    present = np.array([int(np.sum(ends > m)) for m in middle])
    h, first, phi, ustar = [], [0], [], []
    offset, nb, nt = [], [], []
    at = 3 * n
    terms = 6 + refine
    for k in range(sections):
        length = stations[k + 1] - stations[k]
        count = refine * max(1, math.ceil(length / cell_m))
        degree = 1 + refine if length < 0.005 else (4 + refine if k == sections - 1 else 3 + refine)
        offset.append(at)
        nb.append(degree)
        nt.append(max(2, degree - 1))
        at += 2 * nb[-1] + nt[-1] * present[k]
        for cell in range(count):
            x = stations[k] + length * (cell + NODES) / count
            h.append(length / count)
            phi.append(np.polynomial.legendre.legvander(2 * (x - stations[k]) / length - 1, terms))
            ustar.append([[machine.curvature_at(i, s) for i in range(n)] for s in x])
        first.append(len(h))
    tiny = 1e-9
    ustar_ends = [
        [[machine.curvature_at(i, s) for i in range(n)] for s in (stations[k] + tiny, stations[k + 1] - tiny)]
        for k in range(sections)
    ]
    straight = -machine.beta
    kink = next((k for k in range(1, sections) if present[k] < present[k - 1]), -1) if n > 1 else -1
    plant = Plant(
        h=np.array(h),
        first=np.array(first),
        present=present,
        offset=np.array(offset),
        nb=np.array(nb),
        nt=np.array(nt),
        phi=np.array(phi),
        ustar=np.array(ustar),
        ustar_ends=np.array(ustar_ends),
        ustar_plate=np.array([machine.curvature_at(i, -tiny)[:2] for i in range(n)]),
        straight=straight,
        ustar_straight=np.array(
            [[machine.curvature_at(i, b * (1 - x))[2] for x in NODES] for i, b in enumerate(machine.beta)]
        ),
        EI=machine.EI.copy(),
        axis=machine.axis.copy(),
        GJ=machine.GJ.copy(),
        rho_a=machine.rho_a.copy(),
        rho_i=machine.rho_i.copy(),
        bend_damp=machine.bend_damp.copy(),
        twist_damp=machine.twist_damp.copy(),
        soft=machine.soft.copy(),
        mass=machine.mass.copy(),
        inertia=machine.inertia.copy(),
        gravity=machine.gravity.copy(),
        drive=machine.drive.copy(),
        friction=np.array(
            [
                machine.mu_base,
                machine.nu_base,
                machine.mu,
                machine.nu,
                machine.epsilon,
                machine.static_ratio,
                machine.stribeck_speed,
                machine.distributed_Nm_per_m,
            ]
        ),
        drag=np.array(machine.drag),
        clearance=np.array([machine.clearance_rad if kink >= 0 else 0.0, machine.clearance_Nm, float(kink)]),
        spring=np.array(machine.spring),
        contact=np.array(machine.contact),
        bob=np.array(machine.bob),
    )
    return plant, at + 5


def equilibrium(plant: Plant, count: int, inputs: np.ndarray, guess: np.ndarray | None = None) -> np.ndarray:
    """Coordinates (count,) at rest under `inputs` (N + 16,), reached from straight tubes by raising precurvature, weight and load together.

    Raises:
        NoMotionError: no equilibrium was found.
    """
    n = len(plant.GJ)
    c = np.zeros(count)
    c[:n] = inputs[:n]
    c[-3:] = plant.gravity / max(np.linalg.norm(plant.gravity), 1e-9) * plant.bob[1]
    if guess is not None:
        c = guess.copy()
    rest = np.zeros(count)
    r, tip = np.empty(count), np.empty(TIP)
    K, D, M = (np.empty((count, count)) for _ in range(3))
    for share in (1.0,) if guess is not None else np.linspace(0.0, 1.0, 9):
        now = plant._replace(
            ustar=plant.ustar * share,
            ustar_ends=plant.ustar_ends * share,
            ustar_plate=plant.ustar_plate * share,
            gravity=plant.gravity * share,
        )
        loads = inputs.copy()
        loads[n : n + 6] *= share
        for _ in range(60):
            residual(now, c, rest, rest, loads, r, tip)
            jacobians(now, c, rest, rest, loads, K, D, M)
            change = np.linalg.solve(K, -r)
            size = np.abs(change).max()
            c += change * min(1.0, 5.0 / max(size, 1e-300))
            if size < 1e-9:
                break
            if plant.bob[0] > 0 and share == 0.0:
                break
        else:
            if size > 1e-7:
                raise NoMotionError(f"no equilibrium: last change {size:.1e}")
    return c


def tip_at(plant: Plant, c: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Tip state (TIP,) at rest."""
    tip = np.empty(TIP)
    residual(plant, c, np.zeros(len(c)), np.zeros(len(c)), inputs, np.empty(len(c)), tip)
    return tip


def _parabola(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(n, 3) weights that take values at three nodes to those of the parabola through them at `at` (n,)."""
    return np.stack(
        [np.prod([(at - nodes[m]) / (nodes[k] - nodes[m]) for m in range(3) if m != k], 0) for k in range(3)],
        axis=1,
    )


def radau() -> Scheme:
    """Coefficients of Radau IIA with three stages (Hairer and Wanner 1996, table IV.5.6)."""
    q = math.sqrt(6.0)
    nodes = np.array([(4 - q) / 10, (4 + q) / 10, 1.0])
    A = np.array(
        [
            [(88 - 7 * q) / 360, (296 - 169 * q) / 1800, (-2 + 3 * q) / 225],
            [(296 + 169 * q) / 1800, (88 + 7 * q) / 360, (-2 - 3 * q) / 225],
            [(16 - q) / 36, (16 + q) / 36, 1 / 9],
        ]
    )
    values, T = np.linalg.eig(A)
    order = np.argsort(np.abs(values.imag), kind="stable")
    values, T = values[order].astype(complex), T[:, order].astype(complex)
    return Scheme(nodes, A, A @ A, values, T, np.linalg.inv(T), _parabola(nodes, 1 + nodes))


RADAU = radau()


def stage_times(duration_s: float, step_s: float) -> np.ndarray:
    """(steps, 3) times at which `run` wants its inputs."""
    steps = round(duration_s / step_s)
    return step_s * (np.arange(steps)[:, None] + RADAU.nodes[None, :])


def run(
    plant: Plant,
    c: np.ndarray,
    inputs: np.ndarray,
    step_s: float,
    statistics: np.ndarray | None = None,
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Tip states (steps + 1, TIP) from rest at coordinates c under the inputs (steps, 3, N + 16) at the stage times.

    `start`: coordinates and their rates instead, which are moved on to the end.

    Raises:
        NoMotionError: Newton's method failed.
    """
    tips = np.empty((len(inputs) + 1, TIP))
    tips[0] = tip_at(plant, c, inputs[0, 0])
    counts = np.zeros(2, dtype=np.int64) if statistics is None else statistics
    c, v = (c.copy(), np.zeros(len(c))) if start is None else start
    if start is not None:
        residual(plant, c, v, np.zeros(len(c)), inputs[0, 0], np.empty(len(c)), tips[0])
    done = 0
    while done < len(inputs):
        done += integrate(plant, RADAU, c, v, inputs[done:], step_s, TOLERANCE, tips[done:], counts, NO_PATH)
        if done < len(inputs):
            if not _in_parts(plant, c, v, inputs[done], step_s, tips[done + 1], counts, 3):
                raise NoMotionError(f"the step at {done * step_s:.4f} s did not converge")
            done += 1
    return tips


def _in_parts(
    plant: Plant,
    c: np.ndarray,
    v: np.ndarray,
    inputs: np.ndarray,
    h: float,
    tip: np.ndarray,
    counts: np.ndarray,
    depth: int,
) -> bool:
    """Take one step in four parts, and parts that fail in four again, `depth` times at most; False when that fails too."""
    tips = np.empty((2, TIP))
    for part in range(4):
        times = (part + RADAU.nodes) / 4
        # inputs between the stages by the parabola through them
        now = _parabola(RADAU.nodes, times) @ inputs
        if not integrate(plant, RADAU, c, v, now[None], h / 4, TOLERANCE, tips, counts, NO_PATH) and (
            depth == 0 or not _in_parts(plant, c, v, now, h / 4, tips[1], counts, depth - 1)
        ):
            return False
    tip[:] = tips[1]
    return True
