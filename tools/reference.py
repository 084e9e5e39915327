"""docs/reference.md, written from the code: commands with their options, nodes with their parameters and services, and the Python API."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import typer.main

import ctr_dynamics
from ctr_dynamics.cli.main import available, build_app
from ctr_dynamics.runtime.node_parameters import NODES

PAGE = Path("docs/reference.md")

# Module -> what the public names of `ctr_dynamics` return, and what else a program may use.
FURTHER: dict[str, tuple[str, ...]] = {
    "ctr_dynamics.robot": ("Robot", "Tube"),
    "ctr_dynamics.robot_files": ("robot_with", "robot_quantities", "robot_to_yaml"),
    "ctr_dynamics.model.statics": ("Equilibrium",),
    "ctr_dynamics.estimation.step_output": ("StepOutput", "Innovation", "Modes"),
    "ctr_dynamics.io": ("Bag", "write_bag", "BagWriter", "LiveRecorder"),
    "ctr_dynamics.runtime.replay": ("ReplayResult", "Player"),
    "ctr_dynamics.simulation": ("SimulatedRecording", "write_recording"),
    "ctr_dynamics.csv_import.convert": ("read_log", "write"),
    "ctr_dynamics.reporting": ("Page", "Panel", "figure_svg"),
}
SERVICES = {
    "/ctr/estimator/reset": (
        "std_srvs/srv/Trigger",
        "Reinitialises the estimator at the next complete joint state.",
    ),
    "/ctr/estimator/save_snapshot": (
        "std_srvs/srv/Trigger",
        "Writes the estimator's state, parameters and timing as JSON into the ROS log folder; the answer names the file.",
    ),
    "/ctr/estimator/enable_fusion": (
        "std_srvs/srv/SetBool",
        "Switches the fusion of tracker poses on and off.",
    ),
}

# What names mean wherever they occur, unless the text says otherwise; vectors in `ctr_base`, N tubes, innermost first.
GLOSSARY = {
    "accepted": "whether a tracker measurement was fused",
    "base_cells": "integration cells behind the base plate",
    "beta": "(N,) positions of the tubes' bases, m, zero or negative",
    "alpha": "(N,) actuator angles, rad",
    "content": "HTML of this package's own (`Markup`)",
    "data": "a serialised message (CDR with its encapsulation)",
    "delay_s": "time from the stamp of a measurement to its use, s",
    "dof": "degrees of freedom of a measurement",
    "end_body": "body fixed to a tube's end: mass (kg), inertia (3,) (kg m^2)",
    "equilibrium": "an `Equilibrium` of the same model",
    "files": "MCAP files of a bag",
    "force": "(3,) force on tube 1's tip, N",
    "torque": "(3,) torque about tube 1's tip, N m",
    "frame_id": "frame of a message; `ctr_base`, or it is rejected",
    "guess": "(5 + N,) unknowns of the shooting to start from",
    "innovations": "tracker measurements processed in this step",
    "malformed": "topic to number of messages that could not be decoded",
    "location_notes": "what was noticed while looking for the bag's files",
    "mesh": "sections and cells of the backbone",
    "metadata": "text entries of the record `ctr_dynamics` (version, hashes, parameters)",
    "modes": "the slowest vibration modes (`Modes`)",
    "name_or_path": "name of something shipped, or the path of a file",
    "names": "joint names, `tubeN_rotation` and `tubeN_translation`",
    "positions": "their values, rad and m",
    "nis": "normalised innovation squared",
    "notes": "what is missing or damaged, one line each",
    "path": "a file",
    "sources": "files that the data came from, for the record",
    "position": "(3,) m",
    "quaternion_xyzw": "(4,) unit quaternion in ROS order",
    "progress": "called now and then with the fraction done",
    "reason": "why not, in words; empty when there is no problem",
    "recording": "what a simulation gave (`SimulatedRecording`)",
    "robot": "a `Robot`",
    "scenario": "a `Scenario`",
    "solver": "work of the step's solver",
    "stamp_ns": "time stamp, ns",
    "tip_velocity_covariance": "(6, 6) of tip_velocity",
    "tolerance": "largest scaled residual at the tip at which the shooting ends",
    "valid": "whether the outputs of the step can be used",
    "bag": "an opened `Bag`",
    "text": "plain text; it is escaped",
    "value": "anything that JSON holds",
    "code": "JavaScript of this package's own",
    "panels": "axes above each other (`Panel`)",
    "ylabel": "label of an axis, with the unit",
    "xlabel": "label of the common axis",
    "k": "number of the step since the first stamp",
    "label": "name in the legend",
    "colour": "a key of `COLOURS`, or a colour",
    "lines": "what is drawn",
    "shaded": "(from, to) of marked stretches",
    "log": "logarithmic axis",
    "y": "(n,) values",
    "t": "(n,) times, s",
    "on": "true or false",
    "more": "`band` (n,) and `dots` of a line",
    # Keys of a robot file; docs/robot_file.md says how to measure them.
    "description": "free text",
    "gravity": "(3,) m/s^2",
    "friction": "Coulomb and viscous coefficients at the base plate and between tubes",
    "model_error": "what the model itself gets wrong at the tip: position (m), rotation (rad), correlation time (s)",
    "encoders": "offset and noise of the rotary encoders, rad",
    "tracker": "registration, lever arm, delay and noise of the tip tracker",
    "rest": "rest position of the actuators: beta (m), alpha (rad)",
    "extensions": "registered extensions of the model, with their parameters",
    "inner_radius": "m",
    "outer_radius": "m",
    "youngs_modulus": "Pa",
    "shear_modulus": "Pa; E / 2.6 when absent",
    "density": "kg/m^3",
    "bending_damping": "N m^2 s",
    "torsion_damping": "N m^2 s",
    "precurvature": "segments, each with length (m) and curvature (3,) 1/m or a polynomial",
}


def arguments(thing: Any) -> list[str]:
    """Names that a caller gives: arguments, or fields of a data class or model."""
    if inspect.isclass(thing) and hasattr(thing, "model_fields"):
        return list(thing.model_fields)
    if inspect.isclass(thing) and hasattr(thing, "__dataclass_fields__"):
        return [name for name in thing.__dataclass_fields__ if not name.startswith("_")]
    return [name for name in inspect.signature(thing).parameters if name != "self"]


def unexplained(name: str, thing: Any) -> list[str]:
    """Arguments that neither the docstring nor the glossary explains."""
    text = (inspect.getdoc(thing) or "") + (
        inspect.getdoc(thing.__init__) or "" if inspect.isclass(thing) else ""
    )
    words = set(re.findall(r"\w+", text))
    return [
        f"{name}: {argument}"
        for argument in arguments(thing)
        if argument not in words and argument not in GLOSSARY
    ]


def commands() -> Iterator[tuple[str, Any]]:
    """Every command as it is typed, with its click command; groups by their parts."""
    for name in available():
        command = typer.main.get_command(build_app(name)).commands[name]  # type: ignore[attr-defined]
        parts = getattr(command, "commands", None)
        if parts is None:
            yield name, command
        else:
            for part, sub in parts.items():
                yield f"{name} {part}", sub


def public() -> Iterator[tuple[str, Any]]:
    """Name and object of the public names and of everything in `FURTHER`, with the public methods of classes behind them."""
    for module, names in [("ctr_dynamics", tuple(ctr_dynamics.__all__)), *FURTHER.items()]:
        for name in names:
            thing = getattr(importlib.import_module(module), name)
            yield f"{module}.{name}", thing
            if inspect.isclass(thing):
                for key, method in vars(thing).items():
                    if inspect.isfunction(method) and not key.startswith("_") and method.__doc__:
                        yield f"{module}.{name}.{key}", method


def _signature(thing: Callable[..., Any]) -> str:
    """Names of the arguments, defaults where they are short; types stand in the source."""
    try:
        parameters = inspect.signature(thing).parameters.values()
    except (TypeError, ValueError):
        return "(...)"
    shown = []
    for p in parameters:
        if p.name == "self":
            continue
        mark = "*" if p.kind is p.VAR_POSITIONAL else "**" if p.kind is p.VAR_KEYWORD else ""
        default = ""
        if p.default is not p.empty:
            text = repr(p.default)
            default = f"={text}" if len(text) <= 20 and " at 0x" not in text else "=..."
        shown.append(f"{mark}{p.name}{default}")
    return f"({', '.join(shown)})"


def _option_rows(command: Any) -> list[str]:
    rows = []
    for p in command.params:
        if p.name == "help":
            continue
        names = (
            " / ".join(f"`{o}`" for o in [*p.opts, *p.secondary_opts])
            if p.param_type_name == "option"
            else f"`{p.metavar or p.name}`"
        )
        default = (
            "" if p.default in (None, "", [], ()) or p.required or callable(p.default) else f"`{p.default}`"
        )
        text = str(getattr(p, "help", "") or "").replace("|", "\\|")
        rows.append(f"| {names} | {default} | {text}{' Required.' if p.required else ''} |")
    return rows


def render() -> str:
    """The page."""
    lines = [
        "# Reference",
        "",
        "This page is written by `python -m tools.tables --write` from the code. Topics are in [msg_docs](../msg_docs/README.md), parameters of the",
        "estimator in [parameters](parameters.md).",
        "",
        "## Commands",
        "",
        "Exit codes: 0 finished; 1 finished, but some rows or steps failed (they are named) or next to nothing was estimated; 2 bad",
        "arguments or input, with one line that says what; 130 interrupted or terminated.",
        "",
    ]
    for name, command in commands():
        text = inspect.cleandoc(command.help or "")
        lines += [f"### ctr-dynamics {name}", "", text, ""]
        rows = _option_rows(command)
        if rows:
            lines += ["| option | default | |", "| --- | --- | --- |", *rows, ""]
    lines += ["## Nodes", "", "### /ctr/estimator", "", "| service | type | |", "| --- | --- | --- |"]
    lines += [f"| `{name}` | {kind} | {text} |" for name, (kind, text) in SERVICES.items()]
    for node, table in NODES.items():
        lines += ["", f"### {node}", "", "| parameter | default | unit | range | |"]
        lines += ["| --- | --- | --- | --- | --- |"]
        lines += [f"| `{p.name}` | `{p.default!r}` | {p.unit} | {p.range} | {p.text} |" for p in table]
    lines += [
        "",
        "## Python",
        "",
        "`import ctr_dynamics` offers the names of this section, imported at their first use.",
        "",
        "Names that recur mean the same everywhere, unless a text says otherwise:",
        "",
    ]
    lines += [
        "| name | |",
        "| --- | --- |",
        *(f"| `{name}` | {text} |" for name, text in sorted(GLOSSARY.items())),
        "",
    ]
    first_further = next(iter(FURTHER))
    for name, thing in public():
        if name == f"{first_further}.{FURTHER[first_further][0]}":
            lines += [
                "## Further names",
                "",
                "What the names above return, and what else a program may use. Import them from the modules shown.",
                "",
            ]
        short = name if name.count(".") < 2 else name.removeprefix("ctr_dynamics.")
        level = "####" if inspect.isfunction(thing) and "." in thing.__qualname__ else "###"
        fields = inspect.isclass(thing) and hasattr(thing, "model_fields")
        document = re.sub(r"``", "`", inspect.getdoc(thing) or "")
        lines += [
            f"{level} `{short}{'' if fields else _signature(thing)}`",
            "",
            "```text",
            document,
            "```",
            "",
        ]
    return "\n".join(lines).rstrip() + "\n"
