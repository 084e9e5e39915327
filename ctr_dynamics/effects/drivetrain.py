"""Effects between the encoders and the tubes' bases."""

from __future__ import annotations

import math

from ctr_dynamics.effects.plant import Plant
from ctr_dynamics.effects.registry import EffectParameter, Values, effect, per_tube


@effect(
    "exposed_length",
    EffectParameter("tubeN.beta_offset_m", "m", 0.0, 2.5e-3, text="true beta minus reading"),
    text="A tube stands further out or in than its translation reads.",
    source="Till et al. (2020), fig. 2: beta",
    large_sizes=(-1.5, -0.7, 0.7, 1.5),
    combine="add",
)
def exposed_length(plant: Plant, values: Values) -> None:
    before = plant.actuators.beta_offset
    plant.change_actuators(beta_offset=before + per_tube(plant, values, "beta_offset_m"))


@effect(
    "encoder_offset",
    EffectParameter(
        "tubeN.offset_rad",
        "rad",
        0.0,
        0.03,
        lambda robot, i: robot.encoders.offset.tolerance,
        text="true angle minus gain times reading",
    ),
    text="A tube's true angle differs from its reading by a constant.",
    source="reading model: alpha = gain * reading + offset",
    combine="add",
)
def encoder_offset(plant: Plant, values: Values) -> None:
    plant.change_actuators(offset=plant.actuators.offset + per_tube(plant, values, "offset_rad"))


@effect(
    "encoder_gain",
    EffectParameter("tubeN.gain", "1", 1.0, 0.015, text="true angle's change over the reading's"),
    text="A tube turns more or less than its encoder says.",
    source="reading model: alpha = gain * reading + offset",
    combine="multiply",
)
def encoder_gain(plant: Plant, values: Values) -> None:
    plant.change_actuators(gain=plant.actuators.gain * per_tube(plant, values, "gain"))


@effect(
    "backlash",
    EffectParameter(
        "tubeN.width_rad", "rad", 0.0, 0.03, low=0.0, text="whole dead zone between the directions"
    ),
    text="A tube follows its drive only after the dead zone of a reversal.",
    source="Nordin and Gutman (2002): the play operator",
    finite_sizes=(0.7, 2.0),
    combine="add",
)
def backlash(plant: Plant, values: Values) -> None:
    plant.change_actuators(backlash=plant.actuators.backlash + per_tube(plant, values, "width_rad"))


@effect(
    "drivetrain_compliance",
    EffectParameter(
        "tubeN.stiffness_Nm_per_rad",
        "N m/rad",
        math.inf,
        4.0,
        low=0.0,
        power=-1,
        text="of the shaft between actuator and tube",
    ),
    EffectParameter(
        "tubeN.inertia_kgm2",
        "kg m^2",
        0.0,
        1e-6,
        low=0.0,
        shape=True,
        text="of what turns with the tube's base",
    ),
    text="The drive gives way to the tube's torque, with an inertia of its own.",
    source="two-mass drive: J psi_tt = k (alpha - psi) + m_z(beta)",
    extended=True,
)
def drivetrain_compliance(plant: Plant, values: Values) -> None:
    for i in range(plant.n):
        stiffness, inertia = values[f"tube{i + 1}.stiffness_Nm_per_rad"], values[f"tube{i + 1}.inertia_kgm2"]
        if math.isfinite(stiffness):
            plant.extend("drive_compliance", 1.0 / stiffness, i)
            plant.extend("drive_inertia", inertia, i)


@effect(
    "actuator_latency",
    EffectParameter("delay_s", "s", 0.0, 0.015, low=-0.1, text="tubes follow their readings this much later"),
    text="The tubes turn later than the encoders report.",
    source="alpha(t) = reading(t - delay)",
    large_sizes=(-2.0, -1.0, 1.0, 2.0),
    combine="add",
)
def actuator_latency(plant: Plant, values: Values) -> None:
    plant.change_actuators(delay=plant.actuators.delay + values["delay_s"])
