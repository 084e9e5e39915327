"""Effects between the encoders and the tubes' bases."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from ctr_dynamics.effects.registry import Effect, Parameter, Values, register

if TYPE_CHECKING:
    from ctr_dynamics.effects.setup import Setup


def _tubes(setup: Setup, values: Values, name: str) -> list[float]:
    return [values[f"tube{i + 1}.{name}"] for i in range(setup.n)]


def _exposed(setup: Setup, values: Values) -> None:
    setup.beta_offset += _tubes(setup, values, "beta_offset_m")


register(
    Effect(
        "exposed_length",
        (Parameter("tubeN.beta_offset_m", "m", 0.0, 2.5e-3, text="true beta minus reading"),),
        _exposed,
        "A tube stands further out or in than its translation reads.",
        "Till et al. (2020), fig. 2: beta",
        far=(-1.5, -0.7, 0.7, 1.5),
    )
)


def _offset(setup: Setup, values: Values) -> None:
    setup.offset += _tubes(setup, values, "offset_rad")


def _gain(setup: Setup, values: Values) -> None:
    setup.gain *= _tubes(setup, values, "gain")


def _backlash(setup: Setup, values: Values) -> None:
    setup.backlash += _tubes(setup, values, "width_rad")


register(
    Effect(
        "encoder_offset",
        (
            Parameter(
                "tubeN.offset_rad",
                "rad",
                0.0,
                0.03,
                lambda robot, i: robot.encoders.offset.tolerance,
                text="true angle minus gain times reading",
            ),
        ),
        _offset,
        "A tube's true angle differs from its reading by a constant.",
        "reading model: alpha = gain * reading + offset",
    )
)
register(
    Effect(
        "encoder_gain",
        (Parameter("tubeN.gain", "1", 1.0, 0.015, text="true angle's change over the reading's"),),
        _gain,
        "A tube turns more or less than its encoder says.",
        "reading model: alpha = gain * reading + offset",
    )
)
register(
    Effect(
        "backlash",
        (
            Parameter(
                "tubeN.width_rad", "rad", 0.0, 0.03, low=0.0, text="whole dead zone between the directions"
            ),
        ),
        _backlash,
        "A tube follows its drive only after the dead zone of a reversal.",
        "Nordin and Gutman (2002): the play operator",
        probes=(0.7, 2.0),
    )
)


def _compliance(setup: Setup, values: Values) -> None:
    for i in range(setup.n):
        stiffness, inertia = values[f"tube{i + 1}.stiffness_Nm_per_rad"], values[f"tube{i + 1}.inertia_kgm2"]
        if math.isfinite(stiffness):
            setup.extend("drive_compliance", 1.0 / stiffness, i)
            setup.extend("drive_inertia", inertia, i)


register(
    Effect(
        "drivetrain_compliance",
        (
            Parameter(
                "tubeN.stiffness_Nm_per_rad",
                "N m/rad",
                math.inf,
                4.0,
                low=0.0,
                power=-1,
                text="of the shaft between actuator and tube",
            ),
            Parameter(
                "tubeN.inertia_kgm2",
                "kg m^2",
                0.0,
                1e-6,
                low=0.0,
                shape=True,
                text="of what turns with the tube's base",
            ),
        ),
        _compliance,
        "The drive gives way to the tube's torque, with an inertia of its own.",
        "two-mass drive: J psi_tt = k (alpha - psi) + m_z(beta)",
        extended=True,
    )
)


def _late(setup: Setup, values: Values) -> None:
    setup.actuator_delay += values["delay_s"]


register(
    Effect(
        "actuator_latency",
        (
            Parameter(
                "delay_s", "s", 0.0, 0.015, low=-0.1, text="tubes follow their readings this much later"
            ),
        ),
        _late,
        "The tubes turn later than the encoders report.",
        "alpha(t) = reading(t - delay)",
    )
)


def _insertion(setup: Setup, values: Values) -> None:
    if values["scale"] != 0.0:
        setup.extend("insertion", values["scale"])


register(
    Effect(
        "insertion_velocity",
        (Parameter("scale", "1", 0.0, 1.0, low=-2.0, text="1 is the full set of beta-rate terms"),),
        _insertion,
        "The terms of moving tubes that the plain model leaves out: 2 beta_t p_st + beta_t^2 p_ss + beta_tt p_s.",
        "Till et al. (2020), section III-A (neglected there); docs/model.md",
        extended=True,
    )
)


def _clearance(setup: Setup, values: Values) -> None:
    if values["play_rad"] != 0.0:
        setup.extend("play", values["play_rad"])


register(
    Effect(
        "clearance",
        (
            Parameter(
                "play_rad",
                "rad",
                0.0,
                0.012,
                low=0.0,
                text="largest tilt of the inner tube at the outer tube's end",
            ),
        ),
        _clearance,
        "Tubes tilt within their clearance at the end of the outer one, about the moment that passes.",
        "smooth saturation of the tilt, play * m / sqrt(m^2 + m0^2) with m0 = 0.01 N m; clearance: Ha, Fritzler, Park and Dupont (2016)",
        extended=True,
        presets=({"share": 0.0}, {"share": 1.0}),
        probes=(0.6, 1.2, 1.6),
        form=("play_kinematics",),
    )
)


def _share(setup: Setup, values: Values) -> None:
    setup.put("play_share", values["share"])


register(
    Effect(
        "play_kinematics",
        (
            Parameter(
                "share",
                "1",
                1.0,
                0.7,
                lambda robot, i: 0.7,
                text="part of the tilt by which velocities turn; 1 for rigid tubes",
            ),
        ),
        _share,
        "Model-form uncertainty of the clearance: how velocities pass the tilt.",
        "docs/diagnosis.md",
        extended=True,
        nuisance=True,
    )
)


def _shift(setup: Setup, values: Values) -> None:
    setup.load_shift += values["delay_s"]


register(
    Effect(
        "load_time",
        (
            Parameter(
                "delay_s",
                "s",
                0.0,
                0.001,
                lambda robot, i: 0.001,
                text="known loads act this much later than stamped",
            ),
        ),
        _shift,
        "Event times, such as the cut of a string, are known to about a millisecond.",
        "docs/diagnosis.md",
        nuisance=True,
    )
)
