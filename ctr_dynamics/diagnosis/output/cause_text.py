"""What an engineer would say of a cause: which part, its value and the robot file's, the change, and an interval with its level."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import takewhile
from typing import Any, NamedTuple

from ctr_dynamics.effects import EFFECTS
from ctr_dynamics.robot import Robot, Tube


class Scaled(NamedTuple):
    """What a factor multiplies: its symbol, its value for a tube, and unit."""

    symbol: str
    of: Callable[[Tube], float]
    unit: str


SCALED = {
    "youngs_modulus": Scaled("E", lambda tube: tube.youngs_modulus.value, "Pa"),
    "shear_modulus": Scaled("G", lambda tube: tube.shear.value, "Pa"),
    "density": Scaled("density", lambda tube: tube.density.value, "kg/m^3"),
}
# With which a parameter's name ends.
UNITS = ("rad", "N", "m", "kg", "s", "1", "Nm", "Nm2s", "kgm2", "Ns", "Ns2")
# Units for people: factor and text.
SHOWN = {
    "kg": (1e3, "g"),
    "m": (1e3, "mm"),
    "s": (1e3, "ms"),
    "rad": (57.29577951, "deg"),
    "m/s": (1e3, "mm/s"),
    "Pa": (1e-9, "GPa"),
    "N": (1e3, "mN"),
}


def shown(value: float | None, unit: str) -> str:
    """A value with a unit for people."""
    if value is None:
        return "-"
    text = SHOWN[unit][1] if unit in SHOWN else unit
    return f"{_number(value, unit)}{'' if unit == '1' else ' ' + text}"


def _number(value: float | None, unit: str) -> str:
    """Four digits, without the unit; what has no limit is said."""
    return "no limit" if value is None else f"{value * SHOWN.get(unit, (1.0,))[0]:.4g}"


def cause_text(robot: Robot, effect: str, parameters: dict[str, Any]) -> str:
    """One sentence without its stop: all parameters of a cause.

    Args:
        robot: as its file has it.
        effect: ID.
        parameters: of the cause, as the findings have them.
    """
    if effect == "unknown":
        return "outside the catalogue"
    said = [_parameter(robot, effect, name, entry) for name, entry in parameters.items()]
    return "; ".join(said) or effect.replace("_", " ")


def _parameter(robot: Robot, effect: str, name: str, entry: dict[str, Any]) -> str:
    value, nominal, unit, ends = entry["value"], entry["nominal"], entry["unit"], entry["ci90"]
    if isinstance(value, str):
        return f"configuration: {value}"
    part, _, own = name.rpartition(".")
    tube = robot.tubes[int(part.removeprefix("tube")) - 1] if part.startswith("tube") else None
    what = effect.replace("_", " ")
    before = robot.extensions.get(effect, {})
    if own == "scale" and effect in SCALED and tube is not None:
        what, of, unit = SCALED[effect]
        follows = effect == "shear_modulus" and tube.shear_follows_youngs
        known = [robot.extensions.get("youngs_modulus", {}), before] if follows else [before]
        file = of(tube) * math.prod(e.get(key, 1.0) for e in known for key in (name, "all.scale"))
        value, nominal, *ends = (None if x is None else x * file for x in (value, nominal, *ends))
    else:
        what = f"factor on the {what}" if own == "scale" else ", ".join([what, *_words(own, effect)])
        value, nominal, *ends = (
            _with_extension(x, effect, before.get(name)) for x in (value, nominal, *ends)
        )
    where = "all tubes: " if part == "all" else ""
    if tube is not None:
        where = f"{tube.name if 'tube' in tube.name else tube.name + ' tube'}: "
    change = f" ({100.0 * (value / nominal - 1.0):+.3g} %)" if value is not None and nominal else ""
    low, high = (_number(x, unit) for x in ends)
    return f"{where}{what} = {shown(value, unit)} instead of {_number(nominal, unit)}{change}, 90 % interval {low} to {high}"


def _with_extension(value: float | None, effect: str, before: float | None) -> float | None:
    """``value``, which is on top of the robot file, together with what the file's own extension of the effect has (``before``)."""
    if value is None or before is None:
        return value
    kind = EFFECTS[effect].combine
    return value + before if kind == "add" else value * before if kind == "multiply" else value


def _words(name: str, effect: str) -> list[str]:
    """A parameter's name without the unit that it ends with, where it says more than its ``effect``."""
    words = takewhile(lambda word: word not in UNITS, name.split("_"))
    said = " ".join(word for word in words if word not in effect.split("_"))
    return [said] if said else []
