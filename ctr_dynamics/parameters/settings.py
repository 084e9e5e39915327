"""Checked values of all parameters, from defaults, a file and a command line."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from typing import Any

from ctr_dynamics.errors import InputError
from ctr_dynamics.parameters.parameter_table import PARAMETERS, parameter
from ctr_dynamics.parameters.parameter_types import Value


class GivenTwice(UserWarning):
    """A parameter stands twice on one command line, with two values."""


class Settings(Mapping[str, Value]):
    """Every parameter of the estimator with its checked value; an immutable mapping. docs/parameters.md lists names, units and ranges.

    Args:
        values: name to value; those not given have their default. One that is given counts as set, also where it equals the default.

    Raises:
        InputError: unknown name, wrong type or out of range.

    Example:
        >>> from ctr_dynamics import Settings
        >>> settings = Settings({"tracker.delay_s": 0.018, "output.policy": "wait"})
        >>> settings["tracker.delay_s"], settings["model.nodes"]
        (0.018, 12)
    """

    __slots__ = ("_set", "_values")

    def __init__(self, values: Mapping[str, Any] | None = None) -> None:
        checked = {p.name: p.default for p in PARAMETERS}
        for name, value in (values or {}).items():
            checked[name] = parameter(name).check(value)
        self._values = checked
        names = values._set if isinstance(values, Settings) else values or ()
        self._set: frozenset[str] = frozenset(names)
        least, most = self["filter.tip_force_sigma_N"], self["filter.tip_force_sigma_max_N"]
        if 0.0 < most < least:
            raise InputError(
                f"filter.tip_force_sigma_N is {least:g} N, limit filter.tip_force_sigma_max_N, {most:g} N",
                do="lower the one or raise the other",
            )

    def replace(self, values: Mapping[str, Any]) -> Settings:
        """A copy with some values set; raises as the constructor does."""
        changed = Settings({**self._values, **values})
        changed._set = self._set | frozenset(values)
        return changed

    def was_set(self, name: str) -> bool:
        """Whether somebody has set the value of ``name``, be it to the default: nothing else then takes its place."""
        return parameter(name).name in self._set

    def as_dict(self) -> dict[str, Any]:
        """Plain dict for JSON and YAML; arrays are lists."""
        return {name: list(v) if isinstance(v, tuple) else v for name, v in self._values.items()}

    # Any: a value's type is known from its parameter, which the type checker cannot follow.
    def __getitem__(self, name: str) -> Any:
        return self._values[parameter(name).name]

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        changed = {p.name: self[p.name] for p in PARAMETERS if self[p.name] != p.default}
        return f"Settings({changed})"


def without_defaults(values: Mapping[str, Any]) -> dict[str, Any]:
    """The ``values`` that differ from their defaults, checked: those of a parameter file. The shipped one holds every default, and sets none.

    Raises:
        InputError: unknown name, wrong type or out of range.
    """
    checked = {name: parameter(name).check(value) for name, value in values.items()}
    return {name: value for name, value in checked.items() if value != parameter(name).default}


def parse_assignments(assignments: list[str]) -> dict[str, str]:
    """`NAME=VALUE` texts of a command line by name; the values are checked later. Of two values the last one counts, with a warning.

    Raises:
        InputError: no "=", or an unknown name.
    """
    values: dict[str, str] = {}
    for text in assignments:
        name, equals, value = text.partition("=")
        name = name.strip()
        if not equals or not name:
            raise InputError(f"'{text}' is not NAME=VALUE", do="write for example tracker.delay_s=0.018")
        parameter(name)
        value = value.strip()
        if values.get(name, value) != value:
            message = f"parameter '{name}' is given as {values[name]} and as {value}; the last one counts"
            warnings.warn(message, GivenTwice, stacklevel=2)
        values[name] = value
    return values
