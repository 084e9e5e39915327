"""Numbers of a robot file: value, unit and tolerance, each held to its SI unit and range."""

from __future__ import annotations

import math
from collections.abc import Callable
from difflib import get_close_matches
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    ValidationError,
    WrapValidator,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from ctr_dynamics.units import FACTORS

Floats = NDArray[np.float64]


def problem(text: str) -> PydanticCustomError:
    """A validation error whose text is shown as it is."""
    return PydanticCustomError("robot", "{text}", {"text": text})


def problem_line(error: ValidationError) -> str:
    """The first problem of a file with its key path and value, and how many more there are."""
    errors = error.errors(include_url=False, include_context=True)
    first = errors[0]
    path = ""
    for part in first["loc"]:
        # pydantic puts validator names of unions into the path; keys and indices are what the file has.
        if isinstance(part, int):
            path += f"[{part}]"
        elif "[" not in str(part):
            path += f".{part}" if path else str(part)
    text = first["msg"]
    if first["type"] != "robot":
        text = text.removeprefix("Value error, ")
        text = f"{text[0].lower()}{text[1:]}"
        value = first.get("input")
        if isinstance(value, (str, int, float, type(None))):
            text += f", got {value!r}"
    line = f"{path}: {text}" if path else text
    return line + (f" (and {len(errors) - 1} more)" if len(errors) > 1 else "")


def number(x: Any) -> float:
    """A finite float; text, true/false and NaN is rejected with a reason.

    Raises:
        PydanticCustomError: `x` is not a finite number.
    """
    if isinstance(x, bool) or not isinstance(x, (int, float)):
        raise problem(f"{x!r} is not a number; write a plain number such as 0.001 or 52.0e9")
    try:
        value = float(x)
    except OverflowError:
        raise problem("the number is larger than 1.8e308; write a finite number") from None
    if not math.isfinite(value):
        raise problem(f"{x} is not finite; write a finite number")
    return value


Number = Annotated[float, BeforeValidator(number)]


class Block(BaseModel):
    """A mapping of a file whose keys are all known."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        if isinstance(data, BaseModel):
            return data
        known = [f.alias or n for n, f in cls.model_fields.items()]
        if not isinstance(data, dict):
            raise problem(f"{data!r} is not a mapping; write the keys {', '.join(known)}")
        for key in data:
            if key not in known and key not in cls.model_fields:
                near = get_close_matches(str(key), known, 1)
                hint = f"did you mean '{near[0]}'?" if near else f"known keys are {', '.join(known)}"
                raise problem(f"unknown key '{key}'; {hint}")
        for name, field in cls.model_fields.items():
            if field.is_required() and (field.alias or name) not in data:
                raise problem(f"key '{field.alias or name}' is missing; add it")
        return data


def _percent(data: Any, absolute: Callable[[float], Any]) -> Any:
    """Replace `tolerance_percent` by the absolute `tolerance` it stands for."""
    if not isinstance(data, dict) or "tolerance_percent" not in data:
        return data
    if "tolerance" in data:
        raise problem("both tolerance and tolerance_percent are given; keep one of them")
    data = dict(data)
    percent = number(data.pop("tolerance_percent"))
    if not 0 <= percent < 100:
        raise problem(f"tolerance_percent {percent:g} % is outside [0, 100) %; give the 1-sigma in percent")
    data["tolerance"] = absolute(percent / 100)
    return data


class Quantity(Block):
    """A scalar with its unit and tolerance.

    Attributes:
        value: in `unit`, always SI.
        unit: unit string, "1" when dimensionless.
        tolerance: standard deviation (1-sigma of an independent normal error) in `unit`, >= 0.
    """

    value: Number
    unit: str
    tolerance: Number = 0.0

    @model_validator(mode="before")
    @classmethod
    def _tolerance_from_percent(cls, data: Any) -> Any:
        return _percent(data, lambda p: p * abs(number(data.get("value"))))

    @field_validator("tolerance")
    @classmethod
    def _tolerance_positive(cls, tolerance: float) -> float:
        if tolerance < 0:
            raise problem(f"tolerance {tolerance:g} is negative; give the 1-sigma, 0 or more")
        return tolerance

    @property
    def relative(self) -> float:
        """Tolerance over the value's magnitude; 0 when the value is 0."""
        return self.tolerance / abs(self.value) if self.value else 0.0

    def __float__(self) -> float:
        return self.value


class VectorQuantity(Block):
    """Three components with one unit; `tolerance` (3,) is the 1-sigma of each axis.

    In a file the tolerance may be one number for every axis.
    """

    value: tuple[Number, Number, Number]
    unit: str
    tolerance: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)

    @model_validator(mode="before")
    @classmethod
    def _shapes(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        if "value" in data:
            value = data["value"]
            if not isinstance(value, (list, tuple)) or len(value) != 3:
                raise problem(f"value {value!r} does not have three components; write [x, y, z]")
            data = _percent(data, lambda p: [p * abs(number(v)) for v in value])
        tolerance = data.get("tolerance", 0.0)
        if isinstance(tolerance, (list, tuple)):
            if len(tolerance) != 3:
                raise problem(f"tolerance {tolerance!r} has {len(tolerance)} components, not 1 or 3")
            return data
        return {**data, "tolerance": (tolerance,) * 3}

    @field_validator("tolerance")
    @classmethod
    def _tolerance_positive(cls, tolerance: tuple[float, ...]) -> tuple[float, ...]:
        if min(tolerance) < 0:
            raise problem(f"tolerance {min(tolerance):g} is negative; give the 1-sigma, 0 or more")
        return tolerance

    @property
    def array(self) -> Floats:
        """Components as a (3,) array."""
        return np.array(self.value)

    @property
    def relative(self) -> float:
        """Norm of the tolerances over the norm of the value; 0 when the value is 0."""
        size = float(np.linalg.norm(self.value))
        return float(np.linalg.norm(self.tolerance)) / size if size else 0.0


def check_unit(data: Any, unit: str) -> None:
    """Reject a bare number and any unit but `unit`, with the conversion where it is known."""
    if isinstance(data, BaseModel):
        data = data.model_dump()
    if not isinstance(data, dict):
        raise problem(f"{data!r} carries no unit; write {{value: ..., unit: {unit}, tolerance: ...}}")
    if "unit" not in data:
        raise problem(f"key 'unit' is missing; write unit: {unit}")
    given = data["unit"]
    if str(given) == unit:
        return
    text = f"unit '{given}' must be '{unit}'"
    factor = FACTORS.get((str(given), unit))
    value = data.get("value")
    if factor is None:
        raise problem(f"{text}; files hold SI units and radians only")
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        raise problem(f"{text}; write value: {value * factor:.9g} and unit: {unit}")
    raise problem(f"{text}; multiply the value by {factor:.9g} and write unit: {unit}")


def check_range(values: list[float], unit: str, low: float, high: float, above: bool, hint: str) -> None:
    """Reject values outside [low, high], or (low, high] when `above`."""
    for value in values:
        if value < low or value > high or (above and value == low):
            interval = f"{'(' if above else '['}{low:g}, {high:g}]"
            if low >= 0.0 and value <= 0.0:  # no other unit makes it right
                hint = "it must be positive" if above or low > 0.0 else "it must not be negative"
            raise problem(f"{value:g} {unit} is outside {interval} {unit}; {hint}")


def rule(
    unit: str, low: float, high: float, *, above: bool = False, hint: str = "check value and unit"
) -> WrapValidator:
    """Annotation of a Quantity or VectorQuantity: in `unit`, each component within [low, high].

    Args:
        unit: the only unit string that is taken.
        low: smallest value; excluded when `above`.
        high: largest value.
        above: whether values must be above `low`.
        hint: what to do about a value outside, for the error message.
    """

    def check(data: Any, handler: Callable[[Any], Any]) -> Any:
        check_unit(data, unit)
        # YAML reads the dimensionless unit `1` as a number.
        if isinstance(data, dict):
            data = {**data, "unit": unit}
        quantity = handler(data)
        value = quantity.value
        check_range(list(value) if isinstance(value, tuple) else [value], unit, low, high, above, hint)
        return quantity

    return WrapValidator(check)
