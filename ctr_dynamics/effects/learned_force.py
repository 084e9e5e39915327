"""A force on the tip that is learned from data where no effect of the catalogue explains them: a sum of terms, each with a coefficient in N.

With q = (p - origin) / length of the tip's position p and r = v / speed of its velocity v, both in base axes, the force is

- minus the gradient by q of the polynomial sum of u_abc q_x^a q_y^b q_z^c of degree two to four: a field or a spring, which makes no energy;
  each component of q ends at 1 and -1 here, so that the force stays what it was where it was learned last;
- minus a symmetric matrix times r, minus |r| r, and minus v / sqrt(v^2 + dry_speed^2), axis by axis: what brakes;
- minus (p - z) / length, axis by axis, where z follows p with a delay, z_t = (p - z) / memory: what gives way in time;
- a constant, and sine, cosine and translation of every tube at its actuator, the translation from its place at rest over the length.
"""

from __future__ import annotations

import math

import numpy as np

from ctr_dynamics.effects.plant import Plant
from ctr_dynamics.effects.registry import EffectParameter, Values, effect
from ctr_dynamics.kernels.layout import LEARNED_DEGREE

AXES = "xyz"
MATRIX = ("xx", "yy", "zz", "xy", "xz", "yz")  # of a symmetric matrix, as the kernels have it
MONOMIALS = tuple(
    AXES[0] * a + AXES[1] * b + AXES[2] * c
    for a in range(LEARNED_DEGREE + 1)
    for b in range(LEARNED_DEGREE + 1 - a)
    for c in range(LEARNED_DEGREE + 1 - a - b)
    if a + b + c > 1
)
"""Of the potential, in the order of the kernels."""
FORCE = 0.03  # N, of a plausible term: that of the constant tip force


def _term(name: str, text: str) -> EffectParameter:
    # what brakes takes energy out, or simulations would run away
    brakes = name.startswith(("drag", "dry", "memory")) or name in (
        "damping_xx_N",
        "damping_yy_N",
        "damping_zz_N",
    )
    return EffectParameter(name, "N", 0.0, FORCE, low=0.0 if brakes else -math.inf, text=text)


def _each(name: str, text: str) -> list[EffectParameter]:
    return [_term(name.format(axis), text.format(axis)) for axis in AXES]


def _shape(
    name: str, unit: str, off: float, scale: float, text: str, low: float = -math.inf
) -> EffectParameter:
    """A parameter of the features."""
    return EffectParameter(name, unit, off, scale, low=low, shape=True, text=text)


@effect(
    "learned_force",
    *_each("constant_{}_N", "constant force along base {}"),
    *(_term(f"potential_{m}_N", f"coefficient of {' '.join(m)} in the potential") for m in MONOMIALS),
    *(_term(f"damping_{m}_N", f"linear damping, entry {m}") for m in MATRIX),
    *_each("drag_{}_N", "quadratic drag along base {}"),
    *_each("dry_{}_N", "dry friction along base {}"),
    *_each("memory_{}_N", "what gives way in time, along base {}"),
    *_each("tubeN.sine_{}_N", "with the sine of alpha, along base {}"),
    *_each("tubeN.cosine_{}_N", "with the cosine of alpha, along base {}"),
    *_each("tubeN.slide_{}_N", "with beta, along base {}"),
    *(_shape(f"origin_{axis}_m", "m", 0.0, 0.05, f"origin of q along base {axis}") for axis in AXES),
    _shape("length_m", "m", 0.05, 0.05, "length of q", low=1e-4),
    _shape("speed_m_per_s", "m/s", 0.1, 0.1, "speed of r", low=1e-6),
    _shape("dry_speed_m_per_s", "m/s", 0.005, 0.005, "speed at which friction turns", low=1e-6),
    _shape("memory_s", "s", 0.3, 0.3, "delay of z behind p", low=0.0),
    text="A force on the tip that no other effect explains, as a sum of terms learned from bags.",
    source="docs/diagnosis.md; Kelvin-Voigt, Maxwell and Rayleigh elements",
    extended=True,
    joint=True,
    searched=False,
)
def learned_force(plant: Plant, values: Values) -> None:
    if not any(value for name, value in values.items() if name.endswith("_N")):
        return
    robot = plant.robot

    def triple(name: str) -> list[float]:
        return [values[name.format(axis)] for axis in AXES]

    plant.extend("learned_origin", np.array(triple("origin_{}_m")))
    plant.extend("learned_inverse_length", 1.0 / values["length_m"])
    plant.extend("learned_inverse_speed", 1.0 / values["speed_m_per_s"])
    plant.extend("learned_dry_speed", values["dry_speed_m_per_s"])
    plant.extend("learned_memory_time", values["memory_s"])
    plant.extend("learned_potential", np.array([values[f"potential_{m}_N"] for m in MONOMIALS]))
    plant.extend("learned_damping", np.array([values[f"damping_{m}_N"] for m in MATRIX]))
    for name in ("drag", "dry", "memory"):
        plant.extend(f"learned_{name}", np.array(triple(name + "_{}_N")))
    constant = np.array(triple("constant_{}_N"))
    for tube in range(plant.n):
        for name in ("sine", "cosine", "slide"):
            plant.extend(f"learned_{name}", np.array(triple(f"tube{tube + 1}.{name}_{{}}_N")), index=3 * tube)
        at_rest = robot.rest.beta.value[tube] / values["length_m"]
        constant -= np.array(triple(f"tube{tube + 1}.slide_{{}}_N")) * at_rest
    plant.tip_force += constant
