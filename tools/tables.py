"""Generated parts of the documentation and config/estimator.yaml, written from the tables of the code.

`python -m tools.tables` says what is out of date (exit code 1); with `--write` it mends it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import yaml

from ctr_dynamics.diagnosis import diagnosis_options
from ctr_dynamics.diagnosis.output.findings_keys import KEYS
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.messages.topics import TOPICS
from ctr_dynamics.parameters import PARAMETERS, Parameter
from tools import effects_page, message_pages, reference, words

ESTIMATOR_YAML = Path("ctr_dynamics/config/estimator.yaml")


def _markdown(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if value == ():
        return "['']"  # ROS does not know the type of an empty array
    if isinstance(value, tuple):
        return "[" + ", ".join(_shown(v) for v in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


GROUPS = {
    "": "General",
    "joints": "Joints",
    "model": "Model",
    "filter": "Filter",
    "misfit": "Consistency monitor",
    "tracker": "Tracker",
    "output": "Outputs",
    "qos": "Quality of service",
    "record": "Recordings",
}
"""Heading of the parameters by the first part of their names."""


def parameter_tables() -> str:
    """A heading and a Markdown table for every group of parameters."""
    parts = [f"## {title}\n\n{_parameter_table(group)}" for group, title in GROUPS.items()]
    return "\n\n".join(parts)


def _parameter_table(group: str) -> str:
    types = {"str": "string", "texts": "string[]"}
    rows = [
        [
            f"`{p.name}`",
            f"float[{p.size or ''}]" if p.type == "floats" else types.get(p.type, p.type),
            f"`{_shown(p.default)}`" if p.default not in ("", ()) else "empty",
            p.unit,
            p.range,
            p.text + (" Read-only while the node runs." if p.read_only else ""),
        ]
        for p in PARAMETERS
        if p.name.rpartition(".")[0] == group
    ]
    return _markdown(["name", "type", "default", "unit", "range", "what it does"], rows)


def topic_table() -> str:
    """Markdown table of every topic, inputs first."""
    rows = [
        [t.direction, f"`{t.name}`", t.ros_type.replace("/msg/", "/"), t.rate, t.meaning]
        for t in sorted(TOPICS, key=lambda t: t.direction)
    ]
    return _markdown(["", "topic", "type", "rate", "meaning"], rows)


def diagnosis_option_tables() -> str:
    """A heading and a Markdown table for every group of the diagnosis' options."""
    parts = []
    for group, options in diagnosis_options.groups():
        title = (options.__doc__ or "").splitlines()[0]
        rows = [
            [f"`{name}`", f"`{_shown(value)}`", unit, reason]
            for name, value, unit, reason in diagnosis_options.rows(options)
        ]
        parts.append(
            f"## {title.rstrip('.')}\n\nGroup `{group}`.\n\n{_markdown(['name', 'value', 'unit', 'reason'], rows)}"
        )
    return "\n\n".join(parts)


def findings_table() -> str:
    """Markdown table of the keys of findings.json."""
    rows = [[f"`{key.path}`", key.type, key.unit, key.text] for key in KEYS]
    return _markdown(["key", "type", "unit", "meaning"], rows)


# Page -> name of its markers, and what stands between them.
SECTIONS = {
    Path("docs/topics.md"): ("topics", topic_table),
    Path("docs/parameters.md"): ("parameters", parameter_tables),
    Path("docs/diagnosis_options.md"): ("options", diagnosis_option_tables),
    Path("docs/findings.md"): ("findings", findings_table),
    Path("docs/glossary.md"): ("vocabulary", words.table),
}


def render(page: Path, text: str) -> str:
    """Text of a page with its generated part brought up to date.

    Raises:
        InputError: a marker is missing.
    """
    name, table = SECTIONS[page]
    begin, end = f"<!-- {name}: generated -->", f"<!-- {name}: end -->"
    head, found, rest = text.partition(begin)
    _, ended, tail = rest.partition(end)
    if not found or not ended:
        raise InputError(f"marker '{begin}' or '{end}' is missing", do="put both in", where=str(page))
    return f"{head}{begin}\n{table()}\n{end}{tail}"


def estimator_yaml() -> str:
    """A ROS 2 parameter file with every parameter at its default, each with its unit, range and text."""
    groups: dict[str, list[str]] = {}
    for p in PARAMETERS:
        head, dot, leaf = p.name.rpartition(".")
        indent = "      " if dot else "    "
        group = groups.setdefault(head, [f"    {head}:"] if dot else [])
        group += [f"{indent}# {_comment(p)}", f"{indent}{leaf}: {_yaml_value(p.default)}"]
    lines = [
        "# Every parameter of the estimator at its default, for the node (--ros-args --params-file) and for",
        "# `ctr-dynamics replay` (--params).",
        "/ctr/estimator:",
        "  ros__parameters:",
        *(line for group in groups.values() for line in group),
    ]
    return "\n".join(lines) + "\n"


def _comment(p: Parameter) -> str:
    notes = [part for part in (p.unit, p.range, "read-only while running" if p.read_only else "") if part]
    return p.text + (f" ({'; '.join(notes)})" if notes else "")


def _yaml_value(value: Any) -> str:
    if value == ():
        return "['']"  # ROS gives an empty list no type, and nodes cannot take it
    if isinstance(value, tuple):
        return "[" + ", ".join(repr(v) for v in value) + "]"
    if isinstance(value, float):
        # ROS reads a number with a point or an exponent after a point as a double, and 1e-09 as text
        mantissa, e, exponent = repr(value).partition("e")
        return f"{mantissa if '.' in mantissa else mantissa + '.0'}{e}{exponent}"
    return yaml.safe_dump(value).splitlines()[0]


def outdated(root: Path) -> dict[Path, str]:
    """Files below `root` whose generated parts are out of date, with the text they should have."""
    wanted = {
        **{root / page: render(page, (root / page).read_text(encoding="utf-8")) for page in SECTIONS},
        **{root / "msg_docs" / name: text for name, text in message_pages.pages().items()},
        root / ESTIMATOR_YAML: estimator_yaml(),
        root / reference.PAGE: reference.render(),
        root / effects_page.PAGE: effects_page.render(),
    }
    return {
        path: text
        for path, text in wanted.items()
        if not path.is_file() or path.read_text(encoding="utf-8") != text
    }


def main(argv: list[str] | None = None) -> int:
    """Check or write; 0 when everything is up to date."""
    parser = argparse.ArgumentParser(prog="python -m tools.tables", description=__doc__)
    parser.add_argument("--write", action="store_true", help="bring the files up to date")
    parser.add_argument("--root", type=Path, default=Path(), help="the source tree")
    options = parser.parse_args(argv)
    late = outdated(options.root)
    for path, text in late.items():
        if options.write:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
            print(f"wrote {path}")
        else:
            print(f"{path} is out of date; run python -m tools.tables --write", file=sys.stderr)
    return 0 if options.write or not late else 1


if __name__ == "__main__":
    sys.exit(main())
