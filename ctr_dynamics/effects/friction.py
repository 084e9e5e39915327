"""Effects of friction: at the base plate, between the tubes, along their overlap, against the air.

Prior scales are sizes at which an effect would be noticed on a robot of this size, such as a viscous torque that damps the first torsional
mode by some per cent; the scale grows with the value of a robot file where that is larger.
"""

from __future__ import annotations

from ctr_dynamics.effects.plant import Plant
from ctr_dynamics.effects.registry import Effect, EffectParameter, Values, effect
from ctr_dynamics.robot import Quantity, Robot


def _coefficient(row: str, name: str, unit: str, factor: float, floor: float, text: str) -> Effect:
    """The effect of one friction coefficient, ``row`` of the parameter block; its scale is ``factor`` times the robot file's, or the ``floor``."""
    place, kind = row.split("_")
    where = {"base": "base", "tube": "tubes"}[place]

    def in_file(robot: Robot) -> Quantity:
        found: Quantity = getattr(getattr(robot.friction, where), kind)
        return found

    @effect(
        row,
        EffectParameter(
            name,
            unit,
            lambda robot, tube: max(in_file(robot).value, 0.0),
            lambda robot, tube: max(factor * in_file(robot).value, floor),
            lambda robot, tube: in_file(robot).tolerance,
            low=0.0,
            text="the coefficient itself, not a factor",
        ),
        text=text,
        source="Till et al. (2020), (22)-(24)",
        large_sizes=(1.0,),
    )
    def apply(plant: Plant, values: Values) -> None:
        plant.put(row, values[name])

    return apply


base_coulomb = _coefficient(
    "base_coulomb",
    "mu_base",
    "1",
    0.6,
    0.05,
    "Smoothed Coulomb friction of the outermost tube in the base plate.",
)
base_viscous = _coefficient(
    "base_viscous",
    "nu_base",
    "N m s/rad",
    1.0,
    2e-4,
    "Viscous friction of the outermost tube in the base plate.",
)
tube_coulomb = _coefficient(
    "tube_coulomb", "mu", "1", 4.0, 0.15, "Smoothed Coulomb friction between neighbouring tubes."
)
tube_viscous = _coefficient(
    "tube_viscous", "nu", "N m s/rad", 4.0, 1e-4, "Viscous friction between neighbouring tubes."
)


@effect(
    "stribeck",
    EffectParameter(
        "static_ratio", "1", 1.0, 1.0, low=0.0, text="Coulomb friction at rest over that at speed"
    ),
    EffectParameter(
        "speed_rad_s",
        "rad/s",
        5.0,
        3.0,
        low=0.05,
        shape=True,
        text="speed at which the excess has fallen to 1/e",
    ),
    text="Coulomb friction is larger near rest (stick-slip where epsilon is small).",
    source="Armstrong-Helouvry, Dupont, Canudas de Wit (1994): Gaussian Stribeck curve",
    extended=True,
    presets=({"speed_rad_s": 0.5}, {"speed_rad_s": 1.6}, {"speed_rad_s": 5.0}),
    large_sizes=(2.0,),
)
def stribeck(plant: Plant, values: Values) -> None:
    if values["static_ratio"] != 1.0:
        plant.extend("stribeck_excess", values["static_ratio"] - 1.0)
        plant.extend("stribeck_inverse_speed", 1.0 / values["speed_rad_s"])


@effect(
    "distributed_friction",
    EffectParameter(
        "torque_Nm_per_m",
        "N m/m",
        0.0,
        0.03,
        low=0.0,
        text="torque per length of overlap beyond the plate",
    ),
    text="Neighbouring tubes rub along their whole overlap, with a torque per length and the smoothing of the Coulomb law.",
    source="Lock and Dupont (2011), friction along concentric tubes",
    extended=True,
    large_sizes=(1.0,),
)
def distributed_friction(plant: Plant, values: Values) -> None:
    if values["torque_Nm_per_m"] != 0.0:
        plant.extend("overlap_friction", values["torque_Nm_per_m"])


@effect(
    "air_drag",
    EffectParameter("linear_Ns_per_m2", "N s/m^2", 0.0, 0.15, low=0.0, text="drag per length and speed"),
    EffectParameter(
        "quadratic_Ns2_per_m3",
        "N s^2/m^3",
        0.0,
        0.5,
        low=0.0,
        text="drag per length and speed squared",
    ),
    text="The fluid around the robot resists its motion, per length of backbone.",
    source="Morison et al. (1950), drag term",
    extended=True,
    large_sizes=(1.0,),
)
def air_drag(plant: Plant, values: Values) -> None:
    if values["linear_Ns_per_m2"] != 0.0 or values["quadratic_Ns2_per_m3"] != 0.0:
        plant.extend("drag_linear", values["linear_Ns_per_m2"])
        plant.extend("drag_quadratic", values["quadratic_Ns2_per_m3"])
