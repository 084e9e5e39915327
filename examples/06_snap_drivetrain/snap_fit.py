"""Hypotheses on a recorded snap, fitted one by one: what the rigid model gets wrong, which effect of the catalogue mends it, at which size.

Every hypothesis has the same nuisances: the robot file's values inside their tolerances, when the camera's clock started and where the
markers' angle is zero. A cause adds one or two parameters of an effect of `ctr_dynamics.effects` without a prior. Least squares on the angle between
the markers gives the likeliest values; BIC weighs hypotheses against each other.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.stats import chi2

from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.robot import Robot
from ctr_dynamics.snap.experiment import robot_for_snap
from ctr_dynamics.snap.features import LEVEL, crossing
from ctr_dynamics.snap.scurve import s_curve
from ctr_dynamics.snap.solver import SnapSolver

Floats = np.ndarray
Values = Mapping[str, Mapping[str, float]]  # effect to parameter to value

MARGIN = 0.006  # rad before the fold at which a simulation starts: the snap then comes some 4 ms later
LIMIT_S = 12e-3  # without a snap until then there is none
ZERO = 0.02  # rad, deviation of the markers' zero
CLOCK = 2e-5  # s, deviation of the time at which the angle is seen to pass 4 rad
NUMERICS = 0.25  # part of the difference between coarse and fine grids that may be left in the fine one, as a deviation
DECISIVE = 10.0  # difference of BIC from which on a hypothesis is better

NUISANCES = (
    ("youngs_modulus", "tube1.scale"),
    ("youngs_modulus", "tube2.scale"),
    ("density", "all.scale"),
    ("precurvature", "tube1.scale"),
    ("precurvature", "tube2.scale"),
    ("tube_coulomb", "mu"),
    ("tube_viscous", "nu"),
)


@dataclass(frozen=True)
class Grid:
    """Cells as in `SnapSolver`, and the step in s."""

    cells: tuple[int, ...]
    dt: float


COARSE, FINE = Grid((4, 3, 2, 8, 3, 2), 2e-5), Grid((14, 8, 3, 34, 10, 3), 4e-6)


@dataclass(frozen=True)
class Cause:
    """An effect whose parameters are free, varied in logarithms, as all are positive.

    Attributes:
        starts: where a fit may start; the best one counts.
        mix: (p, p), log(value / start) = mix @ z / 10 with unknowns z. steps: (p,) of z for derivatives.
    """

    effect: str
    starts: tuple[Mapping[str, float], ...]
    mix: Floats
    steps: Floats

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        return tuple(self.starts[0]) if self.starts else ()

    @property
    def title(self) -> str:
        """Effect and tube."""
        tubes = {name.split(".")[0] for name in self.names if name.startswith("tube") and "." in name}
        return " ".join([self.effect, *sorted(tubes)]) if self.effect else "nothing"

    def values(self, start: Mapping[str, float], z: Floats) -> dict[str, float]:
        """Parameters by name."""
        logs = 0.1 * self.mix @ z
        return {name: start[name] * math.exp(x) for name, x in zip(self.names, logs, strict=True)}


def one(effect: str, name: str, *values: float) -> Cause:
    """An effect of one parameter."""
    return Cause(effect, tuple({name: x} for x in values), np.eye(1), np.array([0.2]))


NOTHING = Cause("", (), np.zeros((0, 0)), np.zeros(0))


def drive() -> Cause:
    """Elastic drive of tube 1. Its own frequency is sharp and its stiffness is not, so that these two are the unknowns: J = k / (2 pi f)^2."""
    frequencies = (1600.0, 1800.0, *range(1950, 2700, 100), 2800.0, 3000.0)
    k, names = 0.3, ("tube1.stiffness_Nm_per_rad", "tube1.inertia_kgm2")
    starts = tuple({names[0]: k, names[1]: k / (2.0 * math.pi * f) ** 2} for f in frequencies)
    return Cause("drivetrain_compliance", starts, np.array([[1.0, 0.0], [1.0, -2.0]]), np.array([0.6, 0.04]))


def causes(robot: Robot) -> list[Cause]:
    """What may be behind a snap that the rigid model does not show."""
    friction = robot.friction.tubes
    torsion = robot.tubes[0].torsion_stiffness
    return [
        NOTHING,
        one("youngs_modulus", "tube1.scale", 0.96, 1.04),
        one("shear_modulus", "tube1.scale", 0.94, 1.06),
        one("payload_inertia", "scale", 0.9, 1.1),
        one("precurvature", "tube1.scale", 0.97, 1.03),
        one("tube_coulomb", "mu", 0.5 * friction.coulomb.value, 2.0 * friction.coulomb.value),
        one("tube_viscous", "nu", 0.5 * friction.viscous.value, 4.0 * friction.viscous.value),
        one("torsion_damping", "tube1.B_Nm2s", 3e-7 * torsion, 3e-6 * torsion),
        one("distributed_friction", "torque_Nm_per_m", 0.003, 0.02),
        Cause(
            "stribeck",
            tuple({"static_ratio": r, "speed_rad_s": s} for r in (0.4, 3.0) for s in (300.0, 3000.0)),
            np.eye(2),
            np.array([0.2, 0.2]),
        ),
        drive(),
    ]


@dataclass(frozen=True)
class Snap:
    """A recorded snap.

    Attributes:
        t: (k,) s, frames; theta_f: (k,) rad, angle between the markers; noise: rad, its deviation.
        beta1: m; rate: rad/s of the base; theta_b: rad, base angle at which theta_f passed 4 rad.
    """

    t: Floats
    theta_f: Floats
    noise: float
    beta1: float
    rate: float
    theta_b: float

    @property
    def passed(self) -> float:
        """s, at which theta_f passes 4 rad, by a cubic through the frames near it."""
        near = np.flatnonzero(np.abs(self.theta_f - LEVEL) < 1.2)
        near = near[: 1 + int(np.argmax(np.append(np.diff(near) > 1, True)))]  # the first time
        return float(np.polyval(np.polyfit(self.theta_f[near] - LEVEL, self.t[near], 3), 0.0))


def load(folder: Path) -> tuple[str, list[Snap]]:
    """Robot and snaps of a folder: `snaps.json` with the robot's name and one entry a snap, and the CSV files that it names (t_s, theta_f)."""
    described = json.loads((folder / "snaps.json").read_text())
    snaps = []
    for entry in described["snaps"]:
        t, theta = np.loadtxt(folder / entry["file"], delimiter=",", skiprows=1).T
        numbers = (entry[key] for key in ("noise_rad", "beta1_m", "rate_rad_s", "theta_b_rad"))
        snaps.append(Snap(t, theta, *numbers))
    return described["robot"], snaps


@dataclass(frozen=True)
class Motion:
    """A simulated snap: t (k,) s after passing 4 rad, angle (k,) rad, base angle at that moment (rad)."""

    t: Floats
    angle: Floats
    theta_b: float

    def __call__(self, t: Floats) -> Floats:
        """Angles at ``t`` (k,) s after passing 4 rad."""
        return CubicSpline(self.t, self.angle)(t)


def simulate(robot: Robot, extensions: Values, snap: Snap, grid: Grid) -> Motion | None:
    """The snap of the robot with effects; None where there is none."""
    changed = robot_for_snap(robot, {"beta1": snap.beta1}).model_copy(
        update={"extensions": {name: dict(values) for name, values in extensions.items()}}
    )
    beta = np.array(changed.rest.beta.value)
    curve = s_curve(changed, beta, points=40, last=2.8, nodes=24)
    if curve.snap is None:
        return None
    start = curve.snap[0] - MARGIN
    solver = SnapSolver(changed, beta, grid.cells)
    if not solver.approach(np.array([-start, 0.0]), largest=0.4).ok:
        return None
    rates, rows = np.array([-snap.rate, 0.0]), [(0.0, solver.marker_angle)]
    end, last = LIMIT_S, snap.t[-1] - snap.passed + 5.0 * CLOCK
    while solver.t < end:
        at = np.array([-start - snap.rate * (solver.t + grid.dt), 0.0])
        if not solver.step(grid.dt, at, rates, "trapezoid").ok:
            return None
        rows.append((solver.t, solver.marker_angle))
        if rows[-2][1] < LEVEL <= rows[-1][1] and end == LIMIT_S:
            end = solver.t + last
    t, angle = np.array(rows).T
    passed = crossing(t, angle)
    return None if passed is None else Motion(t - passed, angle, start + snap.rate * passed)


@dataclass
class Fit:
    """One hypothesis, fitted.

    Attributes:
        values: of all effects, nuisances included. x: (n,) unknowns: nuisances in deviations, clock, zero, then those of the cause.
        covariance: (n, n) of x. residual: (k,) measured less simulated, rad. misfit: penalised sum of squares.
    """

    cause: Cause
    start: Mapping[str, float]
    x: Floats
    values: Values
    residual: Floats
    misfit: float
    samples: int
    covariance: Floats
    simulations: int

    @property
    def bic(self) -> float:
        """Bayesian information criterion, of which only differences count."""
        return self.misfit + len(self.cause.names) * math.log(self.samples)

    @property
    def rms(self) -> float:
        """Of the residual, rad."""
        return float(np.sqrt(np.mean(self.residual**2)))

    def interval(self, name: str, sigmas: float = 2.576) -> tuple[float, float, float]:
        """(value, low, high) of a parameter of the cause; 99 % by default."""
        cause = self.cause
        k, first = cause.names.index(name), len(self.x) - len(cause.names)
        z, spread = self.x[first:], self.covariance[first:, first:]
        value = cause.values(self.start, z)[name]
        reach = math.exp(0.1 * sigmas * math.sqrt(cause.mix[k] @ spread @ cause.mix[k]))
        return value, value / reach, value * reach


def whiteness(residual: Floats, lags: int = 20) -> float:
    """p of a Ljung-Box test: small where what is left is no white noise."""
    n, power = len(residual), float(residual @ residual)
    r = np.array([residual[k:] @ residual[:-k] for k in range(1, lags + 1)]) / power
    return float(chi2.sf(n * (n + 2) * np.sum(r**2 / (n - np.arange(1, lags + 1))), lags))


@dataclass(frozen=True)
class Check:
    """A snap that was not fitted: residual (k,) rad after clock and zero, its rms, and the base angle at which it was foretold, rad."""

    residual: Floats
    rms: float
    theta_b: float


def check(robot: Robot, fit: Fit, snap: Snap, grid: Grid = FINE) -> Check | None:
    """Foretell another snap by what has been fitted; its camera's clock and zero alone are taken from it."""
    motion, at = simulate(robot, fit.values, snap, grid), snap.t - snap.passed
    if motion is None:
        return None
    found = least_squares(lambda x: snap.theta_f - motion(at + CLOCK * x[0]) - ZERO * x[1], np.zeros(2))
    return Check(found.fun, float(np.sqrt(np.mean(found.fun**2))), motion.theta_b)


class Fitter:
    """Least squares on one snap.

    Residuals are those of the fine grid; derivatives are differences on the coarse one. Where a fit stands, the difference between
    both grids is taken once and added to the coarse prediction; a part of it stays uncertain, as a direction of its own.
    """

    def __init__(self, robot: Robot, snap: Snap, coarse: Grid = COARSE, fine: Grid = FINE) -> None:
        self.robot, self.snap, self.coarse, self.fine = robot, snap, coarse, fine
        known = {q.key: q for q in effect_quantities(robot)}
        self.nuisances = [known[key] for key in NUISANCES if known[key].tolerance > 0.0]
        self.simulations = 0
        self.frames = snap.t - snap.passed
        first = self._simulate({}, coarse)
        if first is None:
            raise ValueError("the robot of the file does not snap")
        self.count = len(self.nuisances)
        rest = np.zeros(self.count + 2)
        self.correction = self._correct(NOTHING, {}, rest)
        self.columns = self._columns(NOTHING, {}, rest)

    def _simulate(self, values: Values, grid: Grid) -> Motion | None:
        self.simulations += 1
        return simulate(self.robot, values, self.snap, grid)

    def values(self, cause: Cause, start: Mapping[str, float], x: Floats) -> dict[str, dict[str, float]]:
        """Effects at the unknowns ``x``."""
        found: dict[str, dict[str, float]] = {}
        for q, z in zip(self.nuisances, x, strict=False):
            found.setdefault(q.effect, {})[q.name] = q.parameter.value(max(q.off + z * q.tolerance, q.low))
        if cause.effect:
            found.setdefault(cause.effect, {}).update(cause.values(start, x[self.count + 2 :]))
        return found

    def predict(
        self, cause: Cause, start: Mapping[str, float], x: Floats, grid: Grid | None = None
    ) -> Floats | None:
        """Angles (k,) at the frames."""
        motion = self._simulate(self.values(cause, start, x), grid or self.coarse)
        if motion is None:
            return None
        return motion(self.frames + CLOCK * x[self.count]) + ZERO * x[self.count + 1]

    def _correct(self, cause: Cause, start: Mapping[str, float], x: Floats) -> Floats:
        fine, coarse = self.predict(cause, start, x, self.fine), self.predict(cause, start, x)
        return np.zeros(len(self.frames)) if fine is None or coarse is None else fine - coarse

    def _columns(self, cause: Cause, start: Mapping[str, float], x: Floats) -> Floats:
        """Derivatives (k, len(x)) of the prediction; half a deviation is the step of a nuisance."""
        n, base = self.count, self.predict(cause, start, x)
        assert base is not None
        columns = np.empty((len(base), len(x)))
        columns[:, n] = CLOCK * np.gradient(base, self.frames)
        columns[:, n + 1] = ZERO
        for k in [*range(n), *range(n + 2, len(x))]:
            step = 0.5 if k < n else float(cause.steps[k - n - 2])
            for signed in (step, -step):
                moved = x.copy()
                moved[k] += signed
                there = self.predict(cause, start, moved)
                if there is not None:
                    columns[:, k] = (there - base) / signed
                    break
            else:
                columns[:, k] = 0.0
        return columns

    def fit(self, cause: Cause, begin: Fit | None = None) -> Fit:
        """Least squares from the best start on, to 1 % of the sum of squares; from a fit ``begin`` on, twice, to 0.01 %.

        The grids' difference is taken where each begins.

        Raises:
            ValueError: no start of the cause snaps.
        """
        n, noise, k, before = self.count, self.snap.noise, len(self.frames), self.simulations
        start, x = self._begin(cause) if begin is None else (begin.start, begin.x)

        def residual(x: Floats) -> Floats:
            angles = self.predict(cause, start, x)
            if angles is None:
                return np.full(k + n + 2, 1e3)
            return np.concatenate([(angles + correction - self.snap.theta_f) / noise, x[: n + 2]])

        def jacobian(x: Floats) -> Floats:
            return np.vstack([self._columns(cause, start, x) / noise, np.eye(n + 2, len(x))])

        for _ in range(1 if begin is None else 2):
            correction = self._correct(cause, start, x)
            found = least_squares(
                residual, x, jacobian, max_nfev=10, xtol=1e-4, ftol=1e-2 if begin is None else 1e-4
            )
            x = found.x
        r, J = found.fun[:k], np.asarray(found.jac)
        # what the fine grid may be wrong by is noise along one direction
        lost = NUMERICS * correction / noise
        seen = J[:k].T @ lost
        share = 1.0 / (1.0 + lost @ lost)
        return Fit(
            cause=cause,
            start=start,
            x=x,
            values=self.values(cause, start, x),
            residual=-noise * r,
            misfit=2.0 * float(found.cost) - share * float(r @ lost) ** 2,
            samples=k,
            covariance=np.linalg.inv(J.T @ J - share * np.outer(seen, seen)),
            simulations=self.simulations - before,
        )

    def _begin(self, cause: Cause) -> tuple[Mapping[str, float], Floats]:
        """The start that leaves least, and the unknowns there."""
        best: tuple[float, Mapping[str, float], Floats] | None = None
        for start in cause.starts or ({},):
            x = np.zeros(self.count + 2 + len(cause.names))
            angles = self.predict(cause, start, x)
            if angles is not None:
                left, x[: self.count + 2] = self._project(angles + self.correction)
                if best is None or left < best[0]:
                    best = (left, start, x)
        if best is None:
            raise ValueError(f"no snap with {cause.title}")
        return best[1:]

    def _project(self, angles: Floats) -> tuple[float, Floats]:
        """What the nuisances, taken linearly as on the rigid robot, leave of the misfit of predicted ``angles``, and their values.

        They are held to three deviations, beyond which they are not linear.
        """
        J = self.columns / self.snap.noise
        r = (self.snap.theta_f - angles) / self.snap.noise
        x = np.clip(np.linalg.solve(J.T @ J + np.eye(J.shape[1]), J.T @ r), -3.0, 3.0)
        return float(np.sum((r - J @ x) ** 2) + x @ x), x
