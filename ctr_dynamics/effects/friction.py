"""Effects of friction: at the base plate, between the tubes, along their overlap, against the air.

Prior scales are sizes at which an effect would be noticed on a robot of this size, such as a viscous torque that damps the first torsional
mode by some per cent; a robot file's own value widens them where it is larger.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from ctr_dynamics.effects.registry import Effect, Parameter, Values, register

if TYPE_CHECKING:
    from ctr_dynamics.effects.setup import Setup
    from ctr_dynamics.robot import Robot


def _put(group: str, name: str) -> Callable[[Setup, Values], None]:
    def apply(setup: Setup, values: Values) -> None:
        setup.put(group, values[name])

    return apply


def _of_file(
    where: str, kind: str, factor: float, floor: float, tolerance: bool = False
) -> Callable[[Robot, int], float]:
    def give(robot: Robot, tube: int) -> float:
        quantity = getattr(getattr(robot.friction, where), kind)
        return quantity.tolerance if tolerance else max(factor * quantity.value, floor)

    return give


for _id, _name, _unit, _where, _kind, _factor, _floor, _text in (
    (
        "base_coulomb",
        "mu_base",
        "1",
        "base",
        "coulomb",
        0.6,
        0.05,
        "Smoothed Coulomb friction of the outermost tube in the base plate.",
    ),
    (
        "base_viscous",
        "nu_base",
        "N m s/rad",
        "base",
        "viscous",
        1.0,
        2e-4,
        "Viscous friction of the outermost tube in the base plate.",
    ),
    (
        "tube_coulomb",
        "mu",
        "1",
        "tubes",
        "coulomb",
        4.0,
        0.15,
        "Smoothed Coulomb friction between neighbouring tubes.",
    ),
    (
        "tube_viscous",
        "nu",
        "N m s/rad",
        "tubes",
        "viscous",
        4.0,
        1e-4,
        "Viscous friction between neighbouring tubes.",
    ),
):
    register(
        Effect(
            _id,
            (
                Parameter(
                    _name,
                    _unit,
                    _of_file(_where, _kind, 1.0, 0.0),
                    _of_file(_where, _kind, _factor, _floor),
                    _of_file(_where, _kind, 1.0, 0.0, True),
                    low=0.0,
                    text="the coefficient itself, not a factor",
                ),
            ),
            _put(_id, _name),
            _text,
            "Till et al. (2020), (22)-(24)",
        )
    )


def _stribeck(setup: Setup, values: Values) -> None:
    if values["static_ratio"] != 1.0:
        setup.extend("stribeck_excess", values["static_ratio"] - 1.0)
        setup.extend("stribeck_inverse_speed", 1.0 / values["speed_rad_s"])


register(
    Effect(
        "stribeck",
        (
            Parameter(
                "static_ratio", "1", 1.0, 1.0, low=0.0, text="Coulomb friction at rest over that at speed"
            ),
            Parameter(
                "speed_rad_s",
                "rad/s",
                5.0,
                3.0,
                low=0.05,
                shape=True,
                text="speed at which the excess has fallen to 1/e",
            ),
        ),
        _stribeck,
        "Coulomb friction is larger near rest (stick-slip where epsilon is small).",
        "Armstrong-Helouvry, Dupont, Canudas de Wit (1994): Gaussian Stribeck curve",
        extended=True,
        presets=({"speed_rad_s": 0.5}, {"speed_rad_s": 1.6}, {"speed_rad_s": 5.0}),
        far=(2.0,),
    )
)


def _overlap(setup: Setup, values: Values) -> None:
    if values["torque_Nm_per_m"] != 0.0:
        setup.extend("overlap_friction", values["torque_Nm_per_m"])


register(
    Effect(
        "distributed_friction",
        (
            Parameter(
                "torque_Nm_per_m",
                "N m/m",
                0.0,
                0.03,
                low=0.0,
                text="torque per length of overlap beyond the plate",
            ),
        ),
        _overlap,
        "Neighbouring tubes rub along their whole overlap, with a torque per length and the smoothing of the Coulomb law.",
        "Lock and Dupont (2011), friction along concentric tubes",
        extended=True,
    )
)


def _drag(setup: Setup, values: Values) -> None:
    if values["linear_Ns_per_m2"] != 0.0 or values["quadratic_Ns2_per_m3"] != 0.0:
        setup.extend("drag_linear", values["linear_Ns_per_m2"])
        setup.extend("drag_quadratic", values["quadratic_Ns2_per_m3"])


register(
    Effect(
        "air_drag",
        (
            Parameter("linear_Ns_per_m2", "N s/m^2", 0.0, 0.15, low=0.0, text="drag per length and speed"),
            Parameter(
                "quadratic_Ns2_per_m3",
                "N s^2/m^3",
                0.0,
                0.5,
                low=0.0,
                text="drag per length and speed squared",
            ),
        ),
        _drag,
        "The fluid around the robot resists its motion, per length of backbone.",
        "Morison et al. (1950), drag term",
        extended=True,
    )
)
