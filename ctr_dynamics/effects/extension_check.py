"""What a robot file names under `extensions`, held to the names and bounds of the catalogue of effects."""

from __future__ import annotations

import re
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from pydantic_core import PydanticCustomError

from ctr_dynamics.effects.registry import EFFECTS, EffectParameter
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot.quantity import number


def check_extensions(given: Mapping[str, Mapping[str, Any]], robot: Robot) -> None:
    """Reject what is no effect or parameter of the catalogue, tubes that the robot lacks, and values that are not finite or out of bounds.

    Args:
        given: values by effect and parameter, as a robot file holds them.
        robot: that it is for.

    Raises:
        InputError: the first problem, with the name and what is known.
    """
    for name, values in given.items():
        effect = EFFECTS.get(name)
        if effect is None:
            near = get_close_matches(name, EFFECTS, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"known extensions: {', '.join(sorted(EFFECTS))}"
            raise InputError(f"unknown extension '{name}'", do=hint)
        for key, x in values.items():
            if not effect.accepts(key):
                known = ", ".join(p.name for p in effect.parameters)
                raise InputError(f"extension '{name}' has no parameter '{key}'", do=f"known: {known}")
            tube = re.match(r"tube([1-9])\.", key)
            if tube and int(tube[1]) > robot.n_tubes:
                raise InputError(
                    f"extension '{name}' has '{key}', but the robot has {robot.n_tubes} tubes",
                    do="number them from 1, innermost first",
                )
            try:
                value = number(x)
            except PydanticCustomError as problem:
                raise InputError(problem.message()) from None
            _check_value(name, key, value, effect.find(key), robot)


def _check_value(name: str, key: str, value: float, parameter: EffectParameter, robot: Robot) -> None:
    """Bounds are those of the parameter's coordinate, a power of its value."""
    found = f"extension '{name}': '{key}' is {value:g} {parameter.unit}"
    if parameter.power < 0 and value <= 0.0:
        raise InputError(found, do="it must be above 0 (leave it out for none)")
    ends = [
        parameter.value(bound) if parameter.power != 1 else bound
        for bound in (parameter.lowest(robot), parameter.high)
    ]
    if not min(ends) <= value <= max(ends):
        raise InputError(found, do=f"it must lie between {min(ends):g} and {max(ends):g}")
