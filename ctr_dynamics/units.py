"""Units that logs and data sheets use, as factors to SI."""

from __future__ import annotations

import math
import re

from ctr_dynamics.errors import InputError

# What is often written instead of the SI unit, as a factor, for the hint in the error message.
FACTORS: dict[tuple[str, str], float] = {
    ("mm", "m"): 1e-3, ("cm", "m"): 1e-2, ("um", "m"): 1e-6, ("µm", "m"): 1e-6, ("inch", "m"): 0.0254,
    ("GPa", "Pa"): 1e9, ("MPa", "Pa"): 1e6, ("kPa", "Pa"): 1e3, ("N/mm^2", "Pa"): 1e6, ("N/m^2", "Pa"): 1.0,
    ("deg", "rad"): math.pi / 180, ("mrad", "rad"): 1e-3, ("deg/s", "rad/s"): math.pi / 180,
    ("rpm", "rad/s"): math.pi / 30, ("g", "kg"): 1e-3, ("mg", "kg"): 1e-6, ("g/cm^3", "kg/m^3"): 1e3,
    ("1/mm", "1/m"): 1e3, ("1/cm", "1/m"): 1e2, ("ms", "s"): 1e-3, ("us", "s"): 1e-6, ("µs", "s"): 1e-6,
    ("g mm^2", "kg m^2"): 1e-9, ("kg mm^2", "kg m^2"): 1e-6, ("mm/s^2", "m/s^2"): 1e-3, ("%", "1"): 1e-2,
    ("N mm s/rad", "N m s/rad"): 1e-3,
}  # fmt: skip

# Beside what people write into robot files: units of logs.
_MORE: dict[tuple[str, str], float] = {
    ("ns", "s"): 1e-9, ("N mm", "N m"): 1e-3, ("mN m", "N m"): 1e-3, ("mN", "N"): 1e-3, ("g/cm3", "kg/m^3"): 1e3,
    ("kg/m3", "kg/m^3"): 1.0, ("in", "m"): 0.0254, ("degrees", "rad"): FACTORS["deg", "rad"], ("°", "rad"): FACTORS["deg", "rad"],
    ("sec", "s"): 1.0, ("N mm^2", "N m^2"): 1e-6, ("N mm2", "N m^2"): 1e-6, ("N m2", "N m^2"): 1.0, ("g mm2", "kg m^2"): 1e-9,
}  # fmt: skip
_TEXT = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def units_of(si: str) -> list[str]:
    """Every unit that is understood for quantities of the SI unit `si`, that one first."""
    return [si, *sorted({unit for unit, target in (*FACTORS, *_MORE) if target == si})]


def factor(unit: str, si: str, where: str) -> float:
    """What a number in `unit` is multiplied by to be in `si`.

    Raises:
        InputError: an unknown unit, or one of another kind of quantity.
    """
    if unit == si:
        return 1.0
    found = FACTORS.get((unit, si), _MORE.get((unit, si)))
    if found is None:
        raise InputError(
            f"unit '{unit}' is none of {', '.join(units_of(si))}", do="name one of these", where=where
        )
    return found


def measure(text: str, si: str, where: str) -> float:
    """A number with its unit, such as "1.244 mm" or "52GPa", in `si`.

    Raises:
        InputError: no number, no unit, or a unit of another kind.
    """
    match = _TEXT.fullmatch(text)
    if match is None:
        raise InputError(
            f"'{text}' is not a number with a unit", do=f"write for example '1.5 {si}'", where=where
        )
    number, unit = float(match[1]), match[2]
    if not unit and si != "1":
        raise InputError(
            f"'{text}' has no unit", do=f"write one of {', '.join(units_of(si))} behind it", where=where
        )
    return number * factor(unit or "1", si, where)
