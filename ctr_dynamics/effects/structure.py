"""Effects of the tubes and the payload: stiffness, precurvature, density, damping, cross-section, mass."""

from __future__ import annotations

import math

from ctr_dynamics.effects.plant import Plant
from ctr_dynamics.effects.registry import EffectParameter, Nominal, Values, effect
from ctr_dynamics.robot import Robot


def _one_tube(scale: float, what: str, tolerance: Nominal | None = None) -> EffectParameter:
    return EffectParameter(
        "tubeN.scale", "1", 1.0, scale, tolerance, low=0.1, text=f"factor on one tube's {what}"
    )


def _all_tubes(scale: float, what: str, tolerance: Nominal | None = None) -> EffectParameter:
    return EffectParameter(
        "all.scale", "1", 1.0, scale, tolerance, low=0.1, text=f"factor on every tube's {what}"
    )


def _scale(plant: Plant, values: Values, *groups: str) -> None:
    """Apply ``tubeN.scale`` and ``all.scale`` to groups of the parameter block."""
    for i in range(plant.n):
        factor = values.get(f"tube{i + 1}.scale", 1.0) * values.get("all.scale", 1.0)
        if factor != 1.0:
            for group in groups:
                plant.scale(group, i, factor)


def _payload_kg(robot: Robot) -> float:
    body = robot.tubes[0].end_body
    return body.mass.value if body else 0.0


def _payload_tolerance(robot: Robot, tube: int) -> float:
    body = robot.tubes[0].end_body
    return body.mass.tolerance if body else 0.0


def _density_tolerance(robot: Robot, tube: int) -> float:
    return float(max(t.density.relative for t in robot.tubes))


def _own_shear_tolerance(robot: Robot, tube: int) -> float:
    return 0.0 if robot.tubes[tube].shear_follows_youngs else robot.tubes[tube].shear.relative


_YOUNGS = "Young's modulus; G follows where the robot file gives none"


@effect(
    "youngs_modulus",
    _one_tube(0.04, _YOUNGS, lambda robot, i: robot.tubes[i].youngs_modulus.relative),
    _all_tubes(0.04, _YOUNGS),
    text="A tube is stiffer or softer than the robot file says.",
    source="Till et al. (2020), (16): E I",
    large_sizes=(-2.0, -1.0, 1.0, 2.0),
    combine="multiply",
)
def youngs_modulus(plant: Plant, values: Values) -> None:
    for i, tube in enumerate(plant.robot.tubes):
        factor = values[f"tube{i + 1}.scale"] * values["all.scale"]
        if factor != 1.0:
            plant.scale("bending_stiffness", i, factor)
            if tube.shear_follows_youngs:
                plant.scale("torsional_stiffness", i, factor)


@effect(
    "shear_modulus",
    _one_tube(0.08, "shear modulus", _own_shear_tolerance),
    _all_tubes(0.08, "shear modulus"),
    text="A tube is stiffer or softer in torsion.",
    source="Till et al. (2020), (16): G J",
    large_sizes=(-2.0, 2.0),
    combine="multiply",
)
def shear_modulus(plant: Plant, values: Values) -> None:
    _scale(plant, values, "torsional_stiffness")


@effect(
    "precurvature",
    _one_tube(0.03, "precurvature", lambda robot, i: robot.tubes[i].precurvature_tolerance),
    text="A tube is more or less curved at rest.",
    source="Till et al. (2020), (16): u*",
    combine="multiply",
)
def precurvature(plant: Plant, values: Values) -> None:
    _scale(plant, values, "precurvature")


@effect(
    "density",
    _all_tubes(0.05, "density", _density_tolerance),
    _one_tube(0.05, "density"),
    text="The tubes are heavier or lighter.",
    source="Till et al. (2020), (13): rho A, rho I",
    large_sizes=(-2.0, 2.0),
    combine="multiply",
)
def density(plant: Plant, values: Values) -> None:
    _scale(plant, values, "mass_per_length", "inertia_per_length")


@effect(
    "payload_mass",
    EffectParameter(
        "added_kg",
        "kg",
        0.0,
        lambda robot, i: max(0.08 * _payload_kg(robot), 2e-4),
        _payload_tolerance,
        text="mass at the tip that the robot file does not know; less than nothing hangs on no robot",
        least=lambda robot, i: -_payload_kg(robot),
    ),
    text="The payload is heavier or lighter, as by a point mass at the tip.",
    source="Till et al. (2020), (21)",
    large_sizes=(-2.0, -1.0, 1.0, 2.0),
    combine="add",
)
def payload_mass(plant: Plant, values: Values) -> None:
    if values["added_kg"] != 0.0:
        plant.add("body_mass", values["added_kg"])


@effect(
    "payload_inertia",
    EffectParameter(
        "scale",
        "1",
        1.0,
        lambda robot, i: 0.5 if robot.tubes[0].end_body else 0.0,
        low=0.0,
        text="factor on the payload's moments of inertia",
    ),
    text="The payload resists rotation more or less than its mass says.",
    source="Till et al. (2020), (21): H",
    large_sizes=(-0.9, -0.5, 0.5, 0.9, 1.4),
    combine="multiply",
)
def payload_inertia(plant: Plant, values: Values) -> None:
    if values["scale"] != 1.0:
        for axis in "xyz":
            plant.scale(f"body_inertia_{axis}", 0, values["scale"])


@effect(
    "bending_damping",
    EffectParameter(
        "tubeN.B_Nm2s",
        "N m^2 s",
        lambda robot, i: robot.tubes[i].bending_damping.value,
        lambda robot, i: 5e-3 * robot.tubes[i].bending_stiffness,
        lambda robot, i: robot.tubes[i].bending_damping.tolerance,
        low=0.0,
        text="Kelvin-Voigt coefficient of bending",
    ),
    text="The material damps bending.",
    source="Till et al. (2020), (16): B_xy",
    large_sizes=(1.0,),
)
def bending_damping(plant: Plant, values: Values) -> None:
    for i in range(plant.n):
        plant.put("bending_damping", values[f"tube{i + 1}.B_Nm2s"], i)


@effect(
    "torsion_damping",
    EffectParameter(
        "tubeN.B_Nm2s",
        "N m^2 s",
        lambda robot, i: robot.tubes[i].torsion_damping.value,
        lambda robot, i: 1e-2 * robot.tubes[i].torsion_stiffness,
        lambda robot, i: robot.tubes[i].torsion_damping.tolerance,
        low=0.0,
        text="Kelvin-Voigt coefficient of torsion",
    ),
    text="The material damps torsion.",
    source="Till et al. (2020), (16): B_z",
    large_sizes=(1.0,),
)
def torsion_damping(plant: Plant, values: Values) -> None:
    for i in range(plant.n):
        plant.put("torsion_damping", values[f"tube{i + 1}.B_Nm2s"], i)


@effect(
    "ovality",
    EffectParameter(
        "tubeN.ratio",
        "1",
        1.0,
        0.15,
        low=1.0,  # below, the other axis is the stiffer one: the same tube, described twice
        text="bending stiffness about the stiffer principal axis over that about the other",
    ),
    EffectParameter(
        "tubeN.axis_rad",
        "rad",
        0.3,
        0.8,
        shape=True,
        period=math.pi,
        text="angle of the stiffer axis in the tube's frame",
    ),
    text="A tube's cross-section is oval: it bends more easily about one axis, twice a turn.",
    source="Timoshenko, Strength of Materials: unsymmetrical bending",
    extended=True,
    presets=tuple({"axis_rad": k * math.pi / 4} for k in range(4)),
    large_sizes=(1.0,),
    form=("oval_mean",),
)
def ovality(plant: Plant, values: Values) -> None:
    for i in range(plant.n):
        ratio, axis = values[f"tube{i + 1}.ratio"], values[f"tube{i + 1}.axis_rad"]
        if ratio != 1.0:
            e = (ratio - 1.0) / (ratio + 1.0)  # the mean stiffness stays
            plant.extend("oval_cos", e * math.cos(2.0 * axis), i)
            plant.extend("oval_sin", e * math.sin(2.0 * axis), i)


@effect(
    "oval_mean",
    EffectParameter(
        "mean",
        "1",
        0.0,
        0.4,
        lambda robot, i: 0.4,
        text="change of the mean bending stiffness over the square of (ratio - 1) / (ratio + 1)",
    ),
    text="Model-form uncertainty of the ovality: an oval tube of the same perimeter has -0.3, the same geometric mean of the stiffnesses +0.5.",
    source="Timoshenko, Strength of Materials; perimeter and moments of inertia of a thin ellipse",
    extended=True,
    nuisance=True,
)
def oval_mean(plant: Plant, values: Values) -> None:
    for i in range(plant.n):
        e2 = sum(float(plant.block[plant.layout[group]][i]) ** 2 for group in ("oval_cos", "oval_sin"))
        plant.scale("bending_stiffness", i, 1.0 + values["mean"] * e2)


@effect(
    "softening",
    EffectParameter(
        "tubeN.curvature_1_per_m",
        "1/m",
        math.inf,
        1e-3,
        low=0.0,
        power=-2,
        text="k_1 in M = E I k / sqrt(1 + (k / k_1)^2), k the departure from the precurvature",
    ),
    text="The moment grows slower than the curvature, as in superelastic Nitinol before its plateau.",
    source="Goldberg and Richard (1963), law of strain and stress that saturates, with exponent 2; Nitinol: Rucker et al. (2010)",
    extended=True,
)
def softening(plant: Plant, values: Values) -> None:
    for i in range(plant.n):
        limit = values[f"tube{i + 1}.curvature_1_per_m"]
        if math.isfinite(limit):
            plant.extend("softening", limit**-2.0, i)
