"""Model extensions that a robot file may switch on under `extensions`: effects of the catalogue, held to its names and bounds."""

from __future__ import annotations

import re
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from ctr_dynamics.robot.quantity import number, problem


def check_extensions(given: Mapping[str, Mapping[str, Any]], n_tubes: int) -> None:
    """Refuse what is no effect or parameter of the catalogue, tubes that the robot lacks, and values that are not finite or out of bounds.

    Raises:
        PydanticCustomError: with the name and what is known.
    """
    if not given:
        return
    from ctr_dynamics.effects import EFFECTS  # here, because effects know robots

    for name, values in given.items():
        effect = EFFECTS.get(name)
        if effect is None:
            near = get_close_matches(name, EFFECTS, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"known extensions: {', '.join(sorted(EFFECTS))}"
            raise problem(f"unknown extension '{name}'; {hint}")
        for key, x in values.items():
            if not effect.accepts(key):
                known = ", ".join(p.name for p in effect.parameters)
                raise problem(f"extension '{name}' has no parameter '{key}'; known: {known}")
            tube = re.match(r"tube([1-9])\.", key)
            if tube and int(tube[1]) > n_tubes:
                raise problem(
                    f"extension '{name}' has '{key}', but the robot has {n_tubes} tubes; number them from 1, innermost first"
                )
            _check_value(name, key, number(x), effect.find(key))


def _check_value(name: str, key: str, value: float, parameter: Any) -> None:
    """Bounds are those of the parameter's coordinate, a power of its value."""
    if parameter.power < 0 and value <= 0.0:
        raise problem(
            f"extension '{name}': '{key}' is {value:g} {parameter.unit}; it must be above 0 (leave it out for none)"
        )
    ends = [
        parameter.value(bound) if parameter.power != 1 else bound for bound in (parameter.low, parameter.high)
    ]
    if not min(ends) <= value <= max(ends):
        raise problem(
            f"extension '{name}': '{key}' is {value:g} {parameter.unit}; it must lie between {min(ends):g} and {max(ends):g}"
        )
