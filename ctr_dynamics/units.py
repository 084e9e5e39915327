"""Units that logs and data sheets use, as factors to SI."""

from __future__ import annotations

import re

from ctr_dynamics.errors import InputError
from ctr_dynamics.robot.quantity import FACTORS

# Beside what people write into robot files: units of logs.
_MORE: dict[tuple[str, str], float] = {
    ("ns", "s"): 1e-9, ("N mm", "N m"): 1e-3, ("mN m", "N m"): 1e-3, ("mN", "N"): 1e-3, ("g/cm3", "kg/m^3"): 1e3,
    ("kg/m3", "kg/m^3"): 1.0, ("in", "m"): 0.0254, ("degrees", "rad"): FACTORS["deg", "rad"], ("°", "rad"): FACTORS["deg", "rad"],
    ("sec", "s"): 1.0, ("g mm2", "kg m^2"): 1e-9,
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
