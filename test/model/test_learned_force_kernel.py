"""The learned force of the kernels against a plain one of NumPy: the same force given from outside moves the robot in the same way."""

import copy

import numpy as np
import pytest
from model_cases import make_robot, make_tube
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from ctr_dynamics.effects.learned_force import MONOMIALS
from ctr_dynamics.kernels.rotations import matrix
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.model.trajectory import run
from ctr_dynamics.robot_files import robot_from_dict, robot_to_dict

BETA, DT, SPAN = np.array([-0.05, -0.04]), 2e-3, 0.3
SHAPE = {
    "origin_x_m": 0.01,
    "origin_y_m": -0.02,
    "origin_z_m": 0.13,
    "length_m": 0.04,
    "speed_m_per_s": 0.2,
    "dry_speed_m_per_s": 0.02,
    "memory_s": 0.06,
}


def robot_with(**values):
    """Two precurved tubes with a learned force."""
    tubes = [
        make_tube(
            inner=0.514e-3, outer=0.622e-3, segments=((0.11, (0.0, 0.0, 0.0)), (0.09, (9.0, 0.0, 0.0)))
        ),
        make_tube(inner=0.7e-3, outer=0.9e-3, segments=((0.07, (0.0, 0.0, 0.0)), (0.05, (5.0, 2.0, 0.0)))),
    ]
    data = copy.deepcopy(robot_to_dict(make_robot(tubes, BETA, gravity=(0.0, -9.81, 0.0))))
    data["extensions"] = {"learned_force": {**SHAPE, **values}} if values else {}
    return robot_from_dict(data)


def forces(values, p, v, z, alpha, beta):
    """(k, 3) N at positions, velocities and remembered positions (k, 3) and actuators (k, 2); see effects/learned_force.py."""
    origin = np.array([SHAPE[f"origin_{a}_m"] for a in "xyz"])
    q, r = np.clip((p - origin) / SHAPE["length_m"], -1.0, 1.0), v / SHAPE["speed_m_per_s"]
    out = np.zeros_like(p)
    for name, k in values.items():
        kind, _, which = name.removesuffix("_N").rpartition("_")
        unit = np.eye(3)["xyz".index(which[0])]
        if kind == "constant":
            out += k * unit
        elif kind == "potential":
            for i, axis in enumerate("xyz"):
                powers = [which.count(a) - (a == axis) for a in "xyz"]
                if min(powers) >= 0:
                    out[:, i] -= k * which.count(axis) * np.prod(q ** np.array(powers), axis=1)
        elif kind == "damping":
            matrix = np.zeros((3, 3))
            i, j = ("xyz".index(a) for a in which)
            matrix[i, j] = matrix[j, i] = k
            out -= r @ matrix
        elif kind == "drag":
            out -= k * np.linalg.norm(r, axis=1)[:, None] * r * unit
        elif kind == "dry":
            out -= k * v * unit / np.sqrt(np.sum(v**2, axis=1) + SHAPE["dry_speed_m_per_s"] ** 2)[:, None]
        elif kind == "memory":
            out -= k * (p - z) * unit / SHAPE["length_m"]
        else:
            tube, what = int(kind[4]) - 1, kind.split(".")[1]
            slide = (beta[:, tube] - BETA[tube]) / SHAPE["length_m"]
            g = {"sine": np.sin(alpha[:, tube]), "cosine": np.cos(alpha[:, tube]), "slide": slide}[what]
            out += k * g[:, None] * unit
    return out


def actuators(t):
    """Rows of inputs at times (k,), without a force, for the extended model."""
    rows = np.zeros((len(t), 14))
    # no jump of the rates: the force from outside is interpolated between steps
    rows[:, 0], rows[:, 1] = 0.5 - 0.5 * np.cos(9.0 * t), 0.3 * np.cos(6.0 * t)
    rows[:, 2], rows[:, 3] = 4.5 * np.sin(9.0 * t), -1.8 * np.sin(6.0 * t)
    rows[:, 4:6] = BETA
    rows[:, 5] -= 1e-4 * np.sin(8.0 * t)
    return rows


GROUPS = {
    "potential": {f"potential_{m}_N": 0.01 * (-1.0) ** k for k, m in enumerate(MONOMIALS)},
    "brakes": {"damping_xx_N": 0.02, "damping_yy_N": 0.03, "damping_xy_N": 0.01, "drag_x_N": 0.02, "drag_z_N": 0.05, "dry_y_N": 0.02},
    "memory": {"memory_x_N": 0.06, "memory_y_N": 0.08, "constant_x_N": 0.02},
    "actuators": {"tube1.sine_x_N": 0.03, "tube2.cosine_y_N": -0.02, "tube2.slide_x_N": 0.5, "tube1.cosine_z_N": 0.1},
}  # fmt: skip


@pytest.mark.parametrize("group", GROUPS)
def test_learned_force_is_that_of_its_terms(group):
    values = GROUPS[group]
    model, plain = Model(robot_with(**values), nodes=12), Model(robot_with(), nodes=12, extended=True)
    assert model.extended
    constant = np.array([values.get(f"constant_{a}_N", 0.0) for a in "xyz"])
    slid = sum(
        values.get(f"tube{i + 1}.slide_{a}_N", 0.0) * BETA[i] / SHAPE["length_m"] * np.eye(3)[j]
        for i in range(2)
        for j, a in enumerate("xyz")
    )

    def within(t):  # what the effect gives to the inputs
        rows = actuators(t)
        rows[:, 6:9] += constant - slid
        return rows

    scheme = make_scheme("sdirk3", DT)
    found = run(model, scheme, model.parameters, within, SPAN, tolerance=1e-10)
    assert not found.failure
    position = CubicSpline(found.t, found.tip[:, :3])
    slow = solve_ivp(
        lambda t, z: (position(t) - z) / SHAPE["memory_s"],
        (0.0, SPAN),
        found.tip[0, :3],
        t_eval=found.t,
        rtol=1e-9,
        atol=1e-12,
    ).y.T
    rows = actuators(found.t)
    velocity = np.array(
        [
            matrix(h / np.linalg.norm(h)) @ q
            for h, q in zip(found.tip[:, 3:7], found.tip[:, 7:10], strict=True)
        ]
    )
    force = CubicSpline(found.t, forces(values, found.tip[:, :3], velocity, slow, rows[:, :2], rows[:, 4:6]))

    def outside(t):
        rows = actuators(t)
        rows[:, 6:9] = force(t)
        return rows

    again = run(plain, scheme, plain.parameters, outside, SPAN, tolerance=1e-10)
    without = run(plain, scheme, plain.parameters, actuators, SPAN, tolerance=1e-10)
    error = np.linalg.norm(again.tip[:, :3] - found.tip[:, :3], axis=1)
    change = np.linalg.norm(without.tip[:, :3] - found.tip[:, :3], axis=1)
    assert change.max() > 5e-4
    assert error.max() < 0.01 * change.max()


def test_memory_does_nothing_at_rest():
    found = [
        Statics(Model(robot, nodes=12, extended=True)).solve(BETA, np.array([0.3, 0.8])).x
        for robot in (robot_with(memory_x_N=0.5, memory_y_N=0.5), robot_with())
    ]
    np.testing.assert_allclose(found[0], found[1], atol=1e-9)
