"""Effects of what acts on the robot from outside: gravity, forces, springs and contact at the tip, and when known loads act."""

from __future__ import annotations

import math

import numpy as np

from ctr_dynamics.effects.plant import Plant
from ctr_dynamics.effects.registry import STRIKING_PARTS, EffectParameter, Values, effect
from ctr_dynamics.kernels.rotations import from_vector, matrix


@effect(
    "gravity_direction",
    *(
        EffectParameter(
            f"r{axis}_rad",
            "rad",
            0.0,
            0.05,
            lambda robot, i: robot.gravity.direction_tolerance,
            text=f"turn of gravity about base {axis}",
        )
        for axis in "xyz"
    ),
    text="Gravity does not point where the robot file says.",
    source="g = R g of the robot file",
    joint=True,
    combine="turn",
)
def gravity_direction(plant: Plant, values: Values) -> None:
    turn = np.array([values["rx_rad"], values["ry_rad"], values["rz_rad"]])
    if turn.any():
        rows = plant.layout["gravity"]
        plant.block[rows] = matrix(from_vector(turn)) @ plant.block[rows]


@effect(
    "tip_force",
    *(
        EffectParameter(f"F{axis}_N", "N", 0.0, 0.03, text=f"force on the tip along base {axis}")
        for axis in "xyz"
    ),
    text="A constant force acts on the tip.",
    source="Till et al. (2020), (21): F",
    joint=True,
    combine="add",
)
def tip_force(plant: Plant, values: Values) -> None:
    plant.tip_force += np.array([values["Fx_N"], values["Fy_N"], values["Fz_N"]])


@effect(
    "tip_spring",
    EffectParameter(
        "stiffness_N_per_m", "N/m", 0.0, 3.0, low=0.0, text="of a spring from the tip to the anchor"
    ),
    EffectParameter("damping_Ns_per_m", "N s/m", 0.0, 0.02, low=0.0, text="of a damper beside it"),
    EffectParameter("anchor_x_m", "m", 0.0, 0.05, shape=True, text="anchor in base axes"),
    EffectParameter("anchor_y_m", "m", -0.05, 0.05, shape=True, text="anchor in base axes"),
    EffectParameter("anchor_z_m", "m", 0.1, 0.05, shape=True, text="anchor in base axes"),
    text="The tip hangs on something elastic, such as tissue.",
    source="Kelvin-Voigt element: F = k (anchor - p) - c v",
    extended=True,
    large_sizes=(0.2, 0.5, 1.0, 2.0),
    joint=True,
)
def tip_spring(plant: Plant, values: Values) -> None:
    k, c = values["stiffness_N_per_m"], values["damping_Ns_per_m"]
    if k != 0.0 or c != 0.0:
        anchor = np.array([values[f"anchor_{axis}_m"] for axis in "xyz"])
        plant.extend("spring_stiffness", k)
        plant.extend("spring_damping", c)
        plant.extend("spring_force", k * anchor)


@effect(
    "contact",
    EffectParameter("stiffness_N_per_m", "N/m", 0.0, 250.0, low=0.0, text="force per depth behind the plane"),
    EffectParameter("nx", "1", 0.0, 0.5, shape=True, text="normal of the plane, pointing to the free side"),
    EffectParameter("ny", "1", 1.0, 0.5, shape=True, text="normal of the plane"),
    EffectParameter("nz", "1", 0.0, 0.5, shape=True, text="normal of the plane"),
    EffectParameter("offset_m", "m", -math.inf, 0.01, shape=True, text="the plane is normal . p = offset"),
    text="The tip touches a flat obstacle and is pushed back in proportion to the depth.",
    source="penalty contact: Johnson, Contact Mechanics (1985)",
    extended=True,
    finite_sizes=(0.7,),
    joint=True,
    impacts=True,
    form_error=STRIKING_PARTS,
)
def contact(plant: Plant, values: Values) -> None:
    stiffness = values["stiffness_N_per_m"]
    if stiffness != 0.0:
        normal = np.array([values["nx"], values["ny"], values["nz"]])
        plant.extend("contact_stiffness", stiffness)
        plant.extend("contact_normal", normal / max(float(np.linalg.norm(normal)), 1e-12))
        plant.extend("contact_offset", values["offset_m"])


@effect(
    "load_time",
    EffectParameter(
        "delay_s",
        "s",
        0.0,
        0.001,
        lambda robot, i: 0.001,
        text="known loads act this much later than stamped",
    ),
    text="Event times, such as the cut of a string, are known to about a millisecond.",
    source="docs/diagnosis.md",
    nuisance=True,
    combine="add",
)
def load_time(plant: Plant, values: Values) -> None:
    plant.load_delay += values["delay_s"]
