"""Robots built in memory for tests of the model, and small tools to run them."""

import copy
from collections.abc import Sequence

import numpy as np

from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict


def make_tube(
    inner: float = 0.514e-3,
    outer: float = 0.622e-3,
    *,
    E: float = 52e9,
    density: float = 6493.0,
    segments: Sequence[tuple[float, object]] = ((0.2, (0.0, 0.0, 0.0)),),
    bending_damping: float = 0.0,
    torsion_damping: float = 0.0,
    mass: float = 0.0,
    inertia: Sequence[float] = (0.0, 0.0, 0.0),
) -> dict:
    """A tube of a robot file; a segment is (length m, u* (3,) or 3 rows of polynomial coefficients)."""
    parts = []
    for length, curvature in segments:
        part: dict = {"length": {"value": length, "unit": "m"}}
        values = np.array(curvature, dtype=float)
        key = "curvature" if values.ndim == 1 else "curvature_polynomial"
        part[key] = {"value": values.tolist(), "unit": "1/m"}
        parts.append(part)
    tube = {
        "inner_radius": {"value": inner, "unit": "m"},
        "outer_radius": {"value": outer, "unit": "m"},
        "youngs_modulus": {"value": E, "unit": "Pa"},
        "density": {"value": density, "unit": "kg/m^3"},
        "bending_damping": {"value": bending_damping, "unit": "N m^2 s"},
        "torsion_damping": {"value": torsion_damping, "unit": "N m^2 s"},
        "precurvature": parts,
    }
    if mass or any(inertia):
        tube["end_body"] = {
            "mass": {"value": mass, "unit": "kg"},
            "inertia": {"value": list(inertia), "unit": "kg m^2"},
        }
    return tube


def make_robot(
    tubes: Sequence[dict],
    beta: Sequence[float],
    *,
    gravity: Sequence[float] = (0.0, 0.0, 0.0),
    base: tuple[float, float] = (0.0, 0.0),
    between: tuple[float, float] = (0.0, 0.0),
    epsilon: float = 15.0,
) -> Robot:
    """A robot of `tubes` (innermost first) at `beta` m; friction as (Coulomb, viscous)."""
    data = copy.deepcopy(robot_to_dict(load_robot("till2020_tissue")))
    data["name"] = "test"
    data["tubes"] = [{"name": f"tube{i + 1}", **copy.deepcopy(tube)} for i, tube in enumerate(tubes)]
    data["gravity"]["value"] = list(gravity)
    friction = data["friction"]
    for part, (coulomb, viscous) in (("base", base), ("tubes", between)):
        friction[part] = {
            "coulomb": {"value": coulomb, "unit": "1"},
            "viscous": {"value": viscous, "unit": "N m s/rad"},
        }
    friction["epsilon"]["value"] = epsilon
    data["rest"] = {
        "beta": {"value": list(beta), "unit": "m"},
        "alpha": {"value": [0.0] * len(tubes), "unit": "rad"},
    }
    return robot_from_dict(data)


def many_tubes(n: int) -> Robot:
    """A robot of `n` tubes with every term of the model switched on."""
    rng = np.random.default_rng(n)
    tubes, beta, radius = [], [], 0.3e-3
    for i in range(n):
        straight, curved = 0.20 - 0.045 * i, 0.06 - 0.005 * i
        bend = rng.uniform(-8, 8, 3) * (1, 1, 0.3)
        tubes.append(
            make_tube(
                radius,
                radius + 0.15e-3,
                E=(50 + 5 * i) * 1e9,
                segments=((straight, (1.0, 0.5, 0.2)), (curved, bend)),
                bending_damping=(2 + i) * 1e-6,
                torsion_damping=(1 + i) * 1e-6,
                mass=1e-3 * (1 + i),
                inertia=(1e-7 * (1 + i), 2e-7, 3e-7),
            )
        )
        beta.append(-0.08 + 0.02 * i)
        radius += 0.2e-3
    return make_robot(
        tubes,
        beta,
        gravity=(1.0, -9.0, 2.0),
        base=(0.8, 5e-6),
        between=(0.01, 2e-7),
        epsilon=5.0,
    )


def still(beta, alpha, force=(0, 0, 0), torque=(0, 0, 0)) -> Inputs:
    """Inputs with actuators at rest."""
    b, a = np.array(beta, float), np.array(alpha, float)
    return Inputs(a, np.zeros_like(a), b, np.zeros_like(b), np.array(force, float), np.array(torque, float))


def run(model: Model, scheme: str, dt: float, steps: int, at, *, start=None, alpha=-0.45, tolerance=1e-7):
    """Step `steps` times from rest at `start` (default: at time 0); returns simulator, states' tips (steps +
    1, 3) and last state.

    Every step must succeed.
    """
    simulator = Simulator(model, make_scheme(scheme, dt, alpha), tolerance=tolerance)
    state = simulator.rest(at(0.0) if start is None else start)
    tips = [state.nodes[-1, :3].copy()]
    for k in range(steps):
        result = simulator.step(state, k * dt, at)
        assert result.ok, (k, result)
        tips.append(state.nodes[-1, :3].copy())
    return simulator, np.array(tips), state


def dominant_frequency(values: np.ndarray, dt: float, guess: float) -> float:
    """Frequency in Hz of the largest spectral peak within 20 % of `guess`, of a signal sampled at `dt` s."""
    from scipy.optimize import minimize_scalar

    signal = (values - values.mean()) * np.blackman(len(values))
    t = dt * np.arange(len(values))

    def minus_power(f: float) -> float:
        return -abs(np.exp(-2j * np.pi * f * t) @ signal)

    grid = np.linspace(0.8, 1.2, 161) * guess
    best = grid[np.argmin([minus_power(f) for f in grid])]
    found = minimize_scalar(
        minus_power, bounds=(best * 0.99, best * 1.01), method="bounded", options={"xatol": 1e-9 * best}
    )
    return float(found.x)
