"""Registry of the model extensions that a robot file may switch on under `extensions`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from ctr_dynamics.robot.quantity import number, problem


@dataclass(frozen=True)
class Extension:
    """One model extension.

    Attributes:
        name: its key under `extensions`.
        parameters: names it takes; N in `tubeN` stands for a tube number from 1.
        text: one line on what it models.
    """

    name: str
    parameters: tuple[str, ...]
    text: str = ""

    def accepts(self, parameter: str) -> bool:
        """Whether `parameter` is one of its names."""
        patterns = (re.escape(p).replace("tubeN", "tube[1-9]") for p in self.parameters)
        return any(re.fullmatch(pattern, parameter) for pattern in patterns)


EXTENSIONS: dict[str, Extension] = {}


def register_extension(extension: Extension) -> Extension:
    """Make `extension` known to robot files; a second registration of a name must be the same one.

    Raises:
        ValueError: another extension has that name.
    """
    if EXTENSIONS.setdefault(extension.name, extension) != extension:
        raise ValueError(f"extension '{extension.name}' is registered twice with different contents")
    return extension


def check_extensions(given: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse extensions and parameters that are not registered, and values that are not finite numbers.

    Raises:
        PydanticCustomError: with the name and what is known.
    """
    from ctr_dynamics.effects import EFFECTS

    for name, values in given.items():
        extension = EXTENSIONS.get(name) or EFFECTS.get(name)
        if extension is None:
            near = get_close_matches(name, EXTENSIONS, 1)
            known = ", ".join(sorted(EXTENSIONS)) or "none"
            hint = f"did you mean '{near[0]}'?" if near else f"known extensions: {known}"
            raise problem(f"unknown extension '{name}'; {hint}")
        for parameter, value in values.items():
            if not extension.accepts(parameter):
                known = ", ".join(p if isinstance(p, str) else p.name for p in extension.parameters)
                raise problem(f"extension '{name}' has no parameter '{parameter}'; known: {known}")
            number(value)
