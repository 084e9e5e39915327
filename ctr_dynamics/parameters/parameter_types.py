"""What a parameter is: type, default, unit, range and the check of a value against them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from ctr_dynamics.errors import InputError

Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]
Kind = Literal["bool", "int", "float", "str", "floats", "texts"]

_AXES = re.compile(r"(x?)(y?)(z?)(r?)(p?)(y?)")
_KIND_TEXT = {
    "bool": "true or false",
    "int": "a whole number",
    "float": "a number",
    "str": "text",
    "texts": "a list of names",
}


@dataclass(frozen=True)
class Parameter:
    """One parameter.

    Attributes:
        name: dotted name.
        type: "bool", "int", "float", "str", "floats" (an array of `size` numbers) or "texts" (an array of names).
        default: value when nothing is given; tuple for arrays.
        unit: "" when it has none.
        text: one sentence, what it does.
        low, high: inclusive range of numbers, each component for arrays; None is unbounded.
        choices: the texts that are taken; empty: any.
        size: length of an array; 0: any. Where it is any, one number or name serves as an array of one.
        read_only: fixed once the node runs.
        syntax: called with a text; raises InputError when it is not one.
        syntax_text: the texts that `syntax` takes, for readers.
        nonzero: whether an array must hold a number other than zero.
    """

    name: str
    type: Kind
    default: Value
    unit: str
    text: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    size: int = 0
    read_only: bool = False
    syntax: Callable[[str], object] | None = None
    syntax_text: str = ""
    nonzero: bool = False

    @property
    def range(self) -> str:
        """The range as readers see it: "8 to 1000", "a, b or c", ""."""
        if self.choices:
            return f"{', '.join(self.choices[:-1])} or {self.choices[-1]}"
        if self.syntax_text:
            return self.syntax_text
        if self.low is None and self.high is None:
            return ""
        if self.low is not None and self.low == self.high:
            return f"{self.low:g}"
        if self.high is None:
            return f"{self.low:g} or more"
        if self.low is None:
            return f"{self.high:g} or less"
        return f"{self.low:g} to {self.high:g}"

    def check(self, value: Any) -> Value:
        """The value in its own type.

        Args:
            value: of the parameter's type (a whole number serves as a float, a list as an array), or a
                text as on the command line.

        Raises:
            InputError: wrong type or out of range.
        """
        if isinstance(value, str) and self.type not in ("str", "texts"):
            value = self._from_text(value)
        if self.type == "bool":
            if not isinstance(value, bool):
                raise self._wrong_type(value)
            return value
        if self.type == "str":
            if not isinstance(value, str):
                raise self._wrong_type(value)
            return self._check_text(value)
        if self.type == "texts":
            return self._check_texts(value)
        if self.type == "floats":
            if not self.size and not isinstance(value, bool) and isinstance(value, (int, float)):
                value = (value,)
            if isinstance(value, (str, bytes, Mapping)) or not hasattr(value, "__len__"):
                raise self._wrong_type(value)
            items = tuple(self._check_number(v) for v in value)
            if len(items) != (self.size or max(len(items), 1)):
                raise InputError(
                    f"has {len(items)} numbers, needs {self.size or 'at least one'}",
                    do=f"write {list(self.default) if isinstance(self.default, tuple) else self.default}",
                    where=f"parameter {self.name}",
                )
            if self.nonzero and not any(items):
                raise InputError(
                    "0 throughout: readings would tell nothing",
                    do="write a factor other than 0, 1 where readings are in SI units",
                    where=f"parameter {self.name}",
                )
            return items
        return self._check_number(value)

    def _check_texts(self, value: Any) -> tuple[str, ...]:
        if isinstance(value, str):
            inner = value.strip()
            inner = inner[1:-1] if inner[:1] == "[" and inner[-1:] == "]" else inner
            value = [part.strip().strip("'\"") for part in inner.split(",")]
        # ROS has no empty array of texts with a type: one empty text stands for none
        if not isinstance(value, (list, tuple)) or not all(isinstance(v, (str, int)) for v in value):
            raise self._wrong_type(value)
        return tuple(str(v) for v in value if str(v))

    def _from_text(self, text: str) -> Any:
        word = text.strip()
        if self.type == "bool":
            return {"true": True, "false": False}.get(word.lower(), text)
        if self.type == "floats":
            inner = word[1:-1] if word[:1] == "[" and word[-1:] == "]" else word
            try:
                return [float(part) for part in inner.split(",")]
            except ValueError:
                return text
        try:
            return int(word) if self.type == "int" else float(word)
        except ValueError:
            return text

    def _check_number(self, value: Any) -> int | float:
        # numpy scalars pass as the number they hold
        value = value.item() if hasattr(value, "item") else value
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self._wrong_type(value)
        if self.type == "int" and not isinstance(value, int):
            raise self._wrong_type(value)
        if not math.isfinite(value):
            raise InputError(f"{value} is not finite", do="write a number", where=f"parameter {self.name}")
        if (self.low is not None and value < self.low) or (self.high is not None and value > self.high):
            unit = f" {self.unit}" if self.unit else ""
            raise InputError(
                f"{value:g}{unit} is outside its range",
                do=f"write {self.range}{unit}",
                where=f"parameter {self.name}",
            )
        return value if self.type == "int" else float(value)

    def _check_text(self, value: str) -> str:
        where = f"parameter {self.name}"
        if self.choices and value not in self.choices:
            raise InputError(f"'{value}' is not known", do=f"write {self.range}", where=where)
        if self.syntax is not None:
            self.syntax(value)
        return value

    def _wrong_type(self, value: Any) -> InputError:
        wanted = _KIND_TEXT.get(
            self.type, f"a list of {self.size} numbers" if self.size else "a list of numbers"
        )
        return InputError(f"{value!r} is not {wanted}", do=f"write {wanted}", where=f"parameter {self.name}")


def axes_mask(axes: str) -> tuple[bool, bool, bool, bool, bool, bool]:
    """Which of x, y, z and the rotations about the tip's x, y, z a tracker measures.

    Args:
        axes: subset of "xyzrpy" in that order; a lone y after x or at the start is the position.

    Raises:
        InputError: anything else.
    """
    match = _AXES.fullmatch(axes)
    if not axes or match is None:
        raise InputError(
            f"'{axes}' is not a subset of 'xyzrpy' in that order",
            do="write for example 'xyz' or 'xyzrp'",
            where="parameter tracker.axes",
        )
    x, y, z, r, p, w = (bool(group) for group in match.groups())
    return x, y, z, r, p, w
