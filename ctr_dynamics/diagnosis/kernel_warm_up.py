"""Kernel warm-up: a dry run of what diagnosis compiles, on a moment of rest: simulations with their sensitivities, plain, with material damping, and
with extended physics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.robot import Robot

MOMENT = 0.02  # s
PLAIN, EXTENDED = ("plain", "damped"), ("extended", "extended damped")  # each has kernels of its own


def rest_recording(robot: Robot) -> Recording:
    """A moment of rest with three poses."""
    t = np.array([0.0, 0.5 * MOMENT, MOMENT])
    rest = np.concatenate([robot.rest.alpha.value, robot.rest.beta.value])
    return Recording(
        "rest",
        "",
        {},
        np.column_stack([t, np.tile(rest, (3, 1))]),
        np.zeros((0, 7)),
        t,
        np.zeros((3, 3)),
        np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
        (),
    )


def warm_up(robot: Robot, models: Sequence[str] = PLAIN + EXTENDED) -> None:
    """Compile everything that a diagnosis of ``robot`` needs, or load it from the cache; ``models``: which kernels."""
    known = {q.key: q for q in effect_quantities(robot)}
    damping, air = known["bending_damping", "tube1.B_Nm2s"], known["air_drag", "linear_Ns_per_m2"]
    forward_model = ForwardModel(rest_recording(robot), robot)
    if "plain" in models:
        forward_model.predict({})
        forward_model.jacobian({}, [known["youngs_modulus", "tube1.scale"]])
    if "damped" in models:
        forward_model.predict({damping.key: damping.off + damping.scale})
        forward_model.jacobian({}, [damping])
    if "extended" in models:
        forward_model.predict({air.key: 0.01})
        forward_model.jacobian({air.key: 0.01}, [air])
    if "extended damped" in models:
        forward_model.predict({air.key: 0.01, damping.key: damping.off + damping.scale})
        forward_model.jacobian({air.key: 0.01}, [air, damping])
