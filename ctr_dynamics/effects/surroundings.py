"""Effects of what acts on the robot from outside: gravity, forces, springs and contact at the tip."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ctr_dynamics.effects.registry import Effect, Parameter, Values, register
from ctr_dynamics.kernels.rotations import from_vector, matrix

if TYPE_CHECKING:
    from ctr_dynamics.effects.setup import Setup


def _gravity(setup: Setup, values: Values) -> None:
    turn = np.array([values["rx_rad"], values["ry_rad"], values["rz_rad"]])
    if turn.any():
        rows = setup.layout["gravity"]
        setup.block[rows] = matrix(from_vector(turn)) @ setup.block[rows]


register(
    Effect(
        "gravity_direction",
        tuple(
            Parameter(
                f"r{axis}_rad",
                "rad",
                0.0,
                0.05,
                lambda robot, i: robot.gravity.direction_tolerance,
                text=f"turn of gravity about base {axis}",
            )
            for axis in "xyz"
        ),
        _gravity,
        "Gravity does not point where the robot file says.",
        "g = R g of the robot file",
        joint=True,
    )
)


def _force(setup: Setup, values: Values) -> None:
    setup.tip_force += np.array([values["Fx_N"], values["Fy_N"], values["Fz_N"]])


register(
    Effect(
        "tip_force",
        tuple(
            Parameter(f"F{axis}_N", "N", 0.0, 0.03, text=f"force on the tip along base {axis}")
            for axis in "xyz"
        ),
        _force,
        "A constant force acts on the tip.",
        "Till et al. (2020), (21): F",
        joint=True,
    )
)


def _spring(setup: Setup, values: Values) -> None:
    k, c = values["stiffness_N_per_m"], values["damping_Ns_per_m"]
    if k != 0.0 or c != 0.0:
        anchor = np.array([values[f"anchor_{axis}_m"] for axis in "xyz"])
        setup.extend("spring_stiffness", k)
        setup.extend("spring_damping", c)
        setup.extend("spring_force", k * anchor)


register(
    Effect(
        "tip_spring",
        (
            Parameter(
                "stiffness_N_per_m", "N/m", 0.0, 3.0, low=0.0, text="of a spring from the tip to the anchor"
            ),
            Parameter("damping_Ns_per_m", "N s/m", 0.0, 0.02, low=0.0, text="of a damper beside it"),
            Parameter("anchor_x_m", "m", 0.0, 0.05, shape=True, text="anchor in base axes"),
            Parameter("anchor_y_m", "m", -0.05, 0.05, shape=True, text="anchor in base axes"),
            Parameter("anchor_z_m", "m", 0.1, 0.05, shape=True, text="anchor in base axes"),
        ),
        _spring,
        "The tip hangs on something elastic, such as tissue.",
        "Kelvin-Voigt element: F = k (anchor - p) - c v",
        extended=True,
        far=(0.2, 0.5, 1.0, 2.0),
        joint=True,
    )
)


def _contact(setup: Setup, values: Values) -> None:
    stiffness = values["stiffness_N_per_m"]
    if stiffness != 0.0:
        normal = np.array([values["nx"], values["ny"], values["nz"]])
        setup.extend("contact_stiffness", stiffness)
        setup.extend("contact_normal", normal / max(float(np.linalg.norm(normal)), 1e-12))
        setup.extend("contact_offset", values["offset_m"])


register(
    Effect(
        "contact",
        (
            Parameter(
                "stiffness_N_per_m", "N/m", 0.0, 250.0, low=0.0, text="force per depth behind the plane"
            ),
            Parameter("nx", "1", 0.0, 0.5, shape=True, text="normal of the plane, pointing to the free side"),
            Parameter("ny", "1", 1.0, 0.5, shape=True, text="normal of the plane"),
            Parameter("nz", "1", 0.0, 0.5, shape=True, text="normal of the plane"),
            Parameter("offset_m", "m", -math.inf, 0.01, shape=True, text="the plane is normal . p = offset"),
        ),
        _contact,
        "The tip touches a wall and is pushed back in proportion to the depth.",
        "penalty contact: Johnson, Contact Mechanics (1985)",
        extended=True,
        probes=(0.7,),
        joint=True,
        impacts=True,
    )
)
