"""Options of every command that reads bags: what the lab's topics, names, frames and units mean."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from inspect import Parameter
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_type_hints

import typer

from ctr_dynamics.io.bag_reader import Bag, open_bag
from ctr_dynamics.io.inputs.input_mapping import InputMapping, parse_remap
from ctr_dynamics.parameters import (
    Settings,
    input_mapping,
    parse_assignments,
    read_parameter_file,
    without_defaults,
)

BAG_HELP = "A file (.mcap, .db3, .bag, also .zstd), or a folder with one bag."
Remap = Annotated[
    list[str] | None,
    typer.Option(
        "--remap",
        metavar="FROM:=TO",
        help="Topic FROM of the bag is the input TO, as /aurora/pose:=/ctr/tracker/tip; may be repeated.",
    ),
]
Params = Annotated[
    Path | None,
    typer.Option("--params", metavar="FILE", help="YAML file with parameters of the estimator."),
]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="One parameter; may be repeated."),
]


def settings_from(
    params: Path | None, assignments: list[str] | None, defaults: dict[str, Any] | None = None
) -> Settings:
    """Parameters: ``defaults`` that differ from the table's, then the file, then single values.

    A value of the file that is the table's default does not count as set, as the shipped file holds them all; a single value always does.

    Raises:
        InputError: unreadable file, unknown name, wrong type or out of range.
    """
    values: dict[str, Any] = dict(defaults or {})
    if params is not None:
        given = read_parameter_file(params)
        values = {name: value for name, value in values.items() if name not in given}
        values.update(without_defaults(given))
    values.update(parse_assignments(assignments or []))
    return Settings(values)


def mapping_from(settings: Settings, remap: list[str] | None) -> InputMapping:
    """What the inputs mean by parameters and ``--remap``.

    Raises:
        InputError: a text that is not FROM:=TO.
    """
    return input_mapping(settings, parse_remap(remap or []))


def open_with(bag: Path, settings: Settings, remap: list[str] | None) -> Bag:
    """The bag, read as the options say; raises as :func:`open_bag` and :func:`mapping_from`."""
    return open_bag(bag, mapping_from(settings, remap))


class RecordingChoice(NamedTuple):
    """The three options together, for commands with many others."""

    remap: list[str]
    params: Path | None
    assignments: list[str]

    def words(self) -> list[str]:
        """As they stand on a command line."""
        given = [("--remap", self.remap), ("--params", [str(self.params)] if self.params else [])]
        return [
            word
            for option, values in (*given, ("--set", self.assignments))
            for v in values
            for word in (option, v)
        ]


def with_recording_options(command: Callable[..., int]) -> Callable[..., int]:
    """``command`` with the three options, which its argument ``choice`` holds together."""
    options = {"remap": Remap, "params": Params, "assignments": Assignments}
    signature = inspect.signature(command)
    hints = get_type_hints(command, include_extras=True)
    own = [p.replace(annotation=hints[p.name]) for p in signature.parameters.values() if p.name != "choice"]
    added = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=hint)
        for name, hint in options.items()
    ]

    @functools.wraps(command)
    def run(*args: Any, remap: Any, params: Any, assignments: Any, **others: Any) -> int:
        return command(*args, choice=RecordingChoice(remap or [], params, assignments or []), **others)

    run.__annotations__ = {**{p.name: p.annotation for p in own}, **options, "return": int}
    run.__signature__ = signature.replace(parameters=[*own, *added])  # type: ignore[attr-defined]
    del run.__wrapped__
    return run
