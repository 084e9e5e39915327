"""Writes the pages of ``msg_docs/`` from the topic table: `python -m tools.message_pages
msg_docs`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.messages.schemas import schema, typestore
from ctr_dynamics.io.messages.topics import INPUTS, OUTPUTS, TOPICS, TRANSFORM_TOPICS, Topic

INDEX = "README.md"


def leaf_fields(ros_type: str) -> list[str]:
    """Paths of every primitive field of a type, sequences marked with ``[]``: ``header.stamp.sec``, ..."""
    store = typestore()
    _, fields = store.fielddefs[ros_type]
    paths: list[str] = []
    description: Any  # a nested tuple whose form depends on its kind
    for name, description in fields:
        kind, detail = description
        mark = ""
        if kind.name in ("ARRAY", "SEQUENCE"):
            kind, detail = detail[0]
            mark = "[]"
        if kind.name == "NAME":
            paths += [f"{name}{mark}.{inner}" for inner in leaf_fields(str(detail))]
        else:
            paths.append(name + mark)
    return paths


def undocumented(topic: Topic) -> list[str]:
    """Fields of the message type that the table does not explain, and table entries that the type does not
    have."""
    leaves = leaf_fields(topic.ros_type)
    paths = {field.path: _prefixes(field.path) for field in topic.fields}
    missing = [
        leaf for leaf in leaves if not any((leaf + "\0").startswith(p) for ps in paths.values() for p in ps)
    ]
    unknown = [
        path
        for path, prefixes in paths.items()
        if not any((leaf + "\0").startswith(p) for leaf in leaves for p in prefixes)
    ]
    return missing + [f"{path} (not in {topic.ros_type})" for path in unknown]


def _prefixes(path: str) -> tuple[str, ...]:
    """What a leaf begins with when it is `path` itself or lies below it."""
    return (path + ".", path + "[]", path + "\0")


def page(topic: Topic) -> str:
    """The page of one topic, in Markdown."""
    qos = topic.qos
    direction = "subscribed by the estimator" if topic.direction == "in" else "published by the estimator"
    parameters = "qos.subscription_*" if topic.direction == "in" else "qos.publisher_*"
    lines = [
        f"# {topic.name}",
        "",
        topic.meaning,
        "",
        "| | |",
        "|---|---|",
        f"| type | `{topic.ros_type}` |",
        f"| direction | {direction} |",
        f"| rate | {topic.rate} |",
        f"| QoS | {qos.reliability.replace('_', ' ')}, {qos.history} {qos.depth}, {qos.durability.replace('_', ' ')} "
        f"(parameters `{parameters}`) |",
        "",
        "## Fields",
        "",
        "| field | unit | meaning |",
        "|---|---|---|",
        *(f"| `{field.path}` | {field.unit} | {field.text} |" for field in topic.fields),
        "",
    ]
    if topic.notes:
        lines += ["## Notes", "", *(f"- {note}" for note in topic.notes), ""]
    lines += ["## Definition", "", "```", schema(topic.ros_type).text.split("=" * 80)[0].strip(), "```", ""]
    return "\n".join(lines)


def index() -> str:
    """The list of pages."""
    lines = [
        "# Topics",
        "",
        "SI units and radians. Vectors and poses are in `ctr_base`: origin at the hole of the base plate, "
        "+z along the robot at the base, +y against gravity. The tip is the end of tube 1, the innermost; "
        "its frame is tube 1's.",
        "",
    ]
    for title, group in (("Inputs", INPUTS), ("Outputs", OUTPUTS), ("Frames", TRANSFORM_TOPICS)):
        lines += [f"## {title}", "", "| topic | type | rate | meaning |", "|---|---|---|---|"]
        lines += [f"| [`{t.name}`]({t.page}) | `{t.ros_type}` | {t.rate} | {t.meaning} |" for t in group]
        lines.append("")
    return "\n".join(lines)


def pages() -> dict[str, str]:
    """File name and content of every page."""
    return {INDEX: index(), **{topic.page: page(topic) for topic in (*TOPICS, *TRANSFORM_TOPICS)}}


def main(folder: Path) -> None:
    """Write all pages to `folder`.

    Raises:
        InputError: the folder does not exist.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder), do="create it first")
    for name, text in pages().items():
        (folder / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "msg_docs"))
