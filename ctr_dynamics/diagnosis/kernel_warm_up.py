"""Kernel warm-up: a dry run of what diagnosis compiles, plain and extended simulations with their sensitivities, on a moment of rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.robot import Robot

MOMENT = 0.02  # s


def warm_up(robot: Robot, models: Sequence[str] = ("plain", "extended")) -> None:
    """Compile everything that a diagnosis of ``robot`` needs, or load it from the cache; ``models``: which kernels."""
    t = np.array([0.0, 0.5 * MOMENT, MOMENT])
    rest = np.concatenate([robot.rest.alpha.value, robot.rest.beta.value])
    still = Recording(
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
    known = {q.key: q for q in effect_quantities(robot)}
    forward_model = ForwardModel(still, robot)
    if "plain" in models:
        forward_model.predict({})
        forward_model.jacobian({}, [known["youngs_modulus", "tube1.scale"]])
    if "extended" in models:
        air = known["air_drag", "linear_Ns_per_m2"]
        forward_model.predict({air.key: 0.01})
        forward_model.jacobian({air.key: 0.01}, [air])
