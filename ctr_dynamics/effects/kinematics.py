"""Effects of how the tubes move in each other and through the base plate: clearance between them, and their speed of insertion."""

from __future__ import annotations

from ctr_dynamics.effects.plant import Plant
from ctr_dynamics.effects.registry import STRIKING_PARTS, EffectParameter, Values, effect


@effect(
    "insertion_velocity",
    EffectParameter("scale", "1", 0.0, 1.0, low=-2.0, text="1 is the full set of beta-rate terms"),
    text="The terms of moving tubes that the plain model leaves out: 2 beta_t p_st + beta_t^2 p_ss + beta_tt p_s.",
    source="Till et al. (2020), section III-A (neglected there); docs/model.md",
    extended=True,
)
def insertion_velocity(plant: Plant, values: Values) -> None:
    if values["scale"] != 0.0:
        plant.extend("insertion_velocity", values["scale"])


@effect(
    "clearance",
    EffectParameter(
        "play_rad",
        "rad",
        0.0,
        0.012,
        low=0.0,
        text="largest tilt of the inner tube at the outer tube's end",
    ),
    text="Tubes tilt within their clearance at the end of the outer one, about the moment that passes.",
    source="smooth saturation of the tilt, play * m / sqrt(m^2 + m0^2) with m0 = 0.01 N m; clearance: Ha, Fritzler, Park and Dupont (2016)",
    extended=True,
    presets=({"share": 0.0}, {"share": 1.0}),
    finite_sizes=(0.6, 1.2, 1.6),
    form=("play_kinematics",),
    form_error=STRIKING_PARTS,
)
def clearance(plant: Plant, values: Values) -> None:
    if values["play_rad"] != 0.0:
        plant.extend("clearance", values["play_rad"])


@effect(
    "play_kinematics",
    EffectParameter(
        "share",
        "1",
        1.0,
        0.7,
        lambda robot, i: 0.7,
        text="part of the tilt by which velocities turn; 1 for rigid tubes",
    ),
    text="Model-form uncertainty of the clearance: how velocities pass the tilt.",
    source="docs/diagnosis.md",
    extended=True,
    nuisance=True,
)
def clearance_kinematics(plant: Plant, values: Values) -> None:
    plant.put("clearance_kinematics", values["share"])
