"""Effects of the tubes and the payload: stiffness, precurvature, density, damping, cross-section, mass."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from ctr_dynamics.effects.registry import Effect, Parameter, Values, register

if TYPE_CHECKING:
    from ctr_dynamics.effects.setup import Setup
    from ctr_dynamics.robot import Robot


def _scaled(*groups: str):  # type: ignore[no-untyped-def]
    """Apply ``tubeN.scale`` and ``all.scale`` to groups of the parameter block."""

    def apply(setup: Setup, values: Values) -> None:
        for i in range(setup.n):
            factor = values.get(f"tube{i + 1}.scale", 1.0) * values.get("all.scale", 1.0)
            if factor != 1.0:
                for group in groups:
                    setup.scale(group, i, factor)

    return apply


def _youngs(setup: Setup, values: Values) -> None:
    for i, tube in enumerate(setup.robot.tubes):
        factor = values[f"tube{i + 1}.scale"] * values["all.scale"]
        if factor != 1.0:
            setup.scale("bending_stiffness", i, factor)
            if tube.shear_follows_youngs:
                setup.scale("torsional_stiffness", i, factor)


def _scale(tolerance, scale: float, text: str, every: bool = True) -> tuple[Parameter, ...]:  # type: ignore[no-untyped-def]
    one = Parameter("tubeN.scale", "1", 1.0, scale, tolerance, low=0.1, text=f"factor on one tube's {text}")
    both = Parameter("all.scale", "1", 1.0, scale, low=0.1, text=f"factor on every tube's {text}")
    return (one, both) if every else (one,)


register(
    Effect(
        "youngs_modulus",
        _scale(
            lambda robot, i: robot.tubes[i].youngs_modulus.relative,
            0.04,
            "Young's modulus; G follows where the robot file gives none",
        ),
        _youngs,
        "A tube is stiffer or softer than the robot file says.",
        "Till et al. (2020), (16): E I",
        far=(-2.0, -1.0, 1.0, 2.0),
    )
)
register(
    Effect(
        "shear_modulus",
        _scale(
            lambda robot, i: 0.0 if robot.tubes[i].shear_follows_youngs else robot.tubes[i].shear.relative,
            0.08,
            "shear modulus",
        ),
        _scaled("torsional_stiffness"),
        "A tube is stiffer or softer in torsion.",
        "Till et al. (2020), (16): G J",
        far=(-2.0, 2.0),
    )
)
register(
    Effect(
        "precurvature",
        _scale(lambda robot, i: robot.tubes[i].precurvature_tolerance, 0.03, "precurvature", every=False),
        _scaled("precurvature"),
        "A tube is more or less curved at rest.",
        "Till et al. (2020), (16): u*",
    )
)


def _density_tolerance(robot: Robot, tube: int) -> float:
    return float(max(t.density.relative for t in robot.tubes))


register(
    Effect(
        "density",
        (
            Parameter(
                "all.scale",
                "1",
                1.0,
                0.05,
                _density_tolerance,
                low=0.1,
                text="factor on every tube's density",
            ),
            Parameter("tubeN.scale", "1", 1.0, 0.05, low=0.1, text="factor on one tube's density"),
        ),
        _scaled("mass_per_length", "inertia_per_length"),
        "The tubes are heavier or lighter.",
        "Till et al. (2020), (13): rho A, rho I",
    )
)


def _payload(robot: Robot) -> float:
    body = robot.tubes[0].end_body
    return body.mass.value if body else 0.0


def _added(setup: Setup, values: Values) -> None:
    if values["added_kg"] != 0.0:
        setup.add("body_mass", values["added_kg"])


register(
    Effect(
        "payload_mass",
        (
            Parameter(
                "added_kg",
                "kg",
                0.0,
                lambda robot, i: max(0.08 * _payload(robot), 2e-4),
                lambda robot, i: robot.tubes[0].end_body.mass.tolerance if robot.tubes[0].end_body else 0.0,
                text="mass at the tip that the robot file does not know",
            ),
        ),
        _added,
        "The payload is heavier or lighter, as by a point mass at the tip.",
        "Till et al. (2020), (21)",
        far=(-2.0, -1.0, 1.0, 2.0),
    )
)


def _inertia(setup: Setup, values: Values) -> None:
    if values["scale"] != 1.0:
        for axis in "xyz":
            setup.scale(f"body_inertia_{axis}", 0, values["scale"])


register(
    Effect(
        "payload_inertia",
        (
            Parameter(
                "scale",
                "1",
                1.0,
                lambda robot, i: 0.5 if robot.tubes[0].end_body else 0.0,
                low=0.0,
                text="factor on the payload's moments of inertia",
            ),
        ),
        _inertia,
        "The payload resists rotation more or less than its mass says.",
        "Till et al. (2020), (21): H",
        far=(-0.9, -0.5, 0.5, 0.9, 1.4),
    )
)


def _damping(group: str):  # type: ignore[no-untyped-def]
    def apply(setup: Setup, values: Values) -> None:
        for i in range(setup.n):
            setup.put(group, values[f"tube{i + 1}.B_Nm2s"], i)

    return apply


register(
    Effect(
        "bending_damping",
        (
            Parameter(
                "tubeN.B_Nm2s",
                "N m^2 s",
                lambda robot, i: robot.tubes[i].bending_damping.value,
                lambda robot, i: 5e-3 * robot.tubes[i].bending_stiffness,
                lambda robot, i: robot.tubes[i].bending_damping.tolerance,
                low=0.0,
                text="Kelvin-Voigt coefficient of bending",
            ),
        ),
        _damping("bending_damping"),
        "The material damps bending.",
        "Till et al. (2020), (16): B_xy",
    )
)
register(
    Effect(
        "torsion_damping",
        (
            Parameter(
                "tubeN.B_Nm2s",
                "N m^2 s",
                lambda robot, i: robot.tubes[i].torsion_damping.value,
                lambda robot, i: 1e-2 * robot.tubes[i].torsion_stiffness,
                lambda robot, i: robot.tubes[i].torsion_damping.tolerance,
                low=0.0,
                text="Kelvin-Voigt coefficient of torsion",
            ),
        ),
        _damping("torsion_damping"),
        "The material damps torsion.",
        "Till et al. (2020), (16): B_z",
    )
)


def _ovality(setup: Setup, values: Values) -> None:
    for i in range(setup.n):
        ratio, axis = values[f"tube{i + 1}.ratio"], values[f"tube{i + 1}.axis_rad"]
        if ratio != 1.0:
            e = (ratio - 1.0) / (ratio + 1.0)  # the mean stiffness stays
            setup.extend("oval_cos", e * math.cos(2.0 * axis), i)
            setup.extend("oval_sin", e * math.sin(2.0 * axis), i)


register(
    Effect(
        "ovality",
        (
            Parameter(
                "tubeN.ratio",
                "1",
                1.0,
                0.15,
                low=1.0,  # below, the other axis is the stiffer one: the same tube, described twice
                text="bending stiffness about the stiffer principal axis over that about the other",
            ),
            Parameter(
                "tubeN.axis_rad",
                "rad",
                0.3,
                0.8,
                shape=True,
                period=math.pi,
                text="angle of the stiffer axis in the tube's frame",
            ),
        ),
        _ovality,
        "A tube's cross-section is oval: it bends more easily about one axis, twice a turn.",
        "Timoshenko, Strength of Materials: unsymmetrical bending",
        extended=True,
        presets=tuple({"axis_rad": k * math.pi / 4} for k in range(4)),
        far=(1.0,),
        form=("oval_mean",),
    )
)


def _oval_mean(setup: Setup, values: Values) -> None:
    for i in range(setup.n):
        e2 = sum(float(setup.block[setup.layout[group]][i]) ** 2 for group in ("oval_cos", "oval_sin"))
        setup.scale("bending_stiffness", i, 1.0 + values["mean"] * e2)


register(
    Effect(
        "oval_mean",
        (
            Parameter(
                "mean",
                "1",
                0.0,
                0.4,
                lambda robot, i: 0.4,
                text="change of the mean bending stiffness over the square of (ratio - 1) / (ratio + 1)",
            ),
        ),
        _oval_mean,
        "Model-form uncertainty of the ovality: an oval tube of the same perimeter has -0.3, the same geometric mean of the stiffnesses +0.5.",
        "Timoshenko, Strength of Materials; perimeter and moments of inertia of a thin ellipse",
        extended=True,
        nuisance=True,
    )
)


def _softening(setup: Setup, values: Values) -> None:
    for i in range(setup.n):
        limit = values[f"tube{i + 1}.curvature_1_per_m"]
        if math.isfinite(limit):
            setup.extend("softening", limit**-2.0, i)


register(
    Effect(
        "softening",
        (
            Parameter(
                "tubeN.curvature_1_per_m",
                "1/m",
                math.inf,
                1e-3,
                low=0.0,
                power=-2,
                text="k_1 in M = E I k / sqrt(1 + (k / k_1)^2), k the departure from the precurvature",
            ),
        ),
        _softening,
        "The moment grows slower than the curvature, as in superelastic Nitinol before its plateau.",
        "Goldberg and Richard (1963), law of strain and stress that saturates, with exponent 2; Nitinol: Rucker et al. (2010)",
        extended=True,
    )
)
