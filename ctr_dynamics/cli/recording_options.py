"""Options of every command that reads bags: what the lab's topics, names, frames and units mean."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ctr_dynamics.io.bag_reader import Bag, open_bag
from ctr_dynamics.io.inputs.input_mapping import InputMapping, parse_remap
from ctr_dynamics.parameters import Settings, input_mapping, parse_assignments, read_parameter_file

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

    Raises:
        InputError: unreadable file, unknown name, wrong type or out of range.
    """
    values: dict[str, Any] = dict(defaults or {})
    if params is not None:
        values.update(read_parameter_file(params))
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
