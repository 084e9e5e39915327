"""`ctr-dynamics info`: what is in a bag, and its rates, gaps, clock and unit problems."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated

import typer

from ctr_dynamics.cli.recording_options import (
    BAG_HELP,
    Assignments,
    Params,
    Remap,
    mapping_from,
    settings_from,
)
from ctr_dynamics.io.bag_checks import BagFinding
from ctr_dynamics.io.bag_info import GAP_PERIODS, BagReport, TopicReport, inspect
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.inputs.input_mapping import InputMapping
from ctr_dynamics.io.messages.topics import JOINT_STATES, TIP_LOAD, TRACKER_TIP
from ctr_dynamics.parameters import Settings, pose_frame
from ctr_dynamics.runtime.replay import plain
from ctr_dynamics.sensing.checks import CheckLimits, CheckOptions, Kind
from ctr_dynamics.sensing.checks.input_checks import check_messages

STREAMS = {"joints": JOINT_STATES, "tracker": TRACKER_TIP, "load": TIP_LOAD}
# The report of the bag has a line on these already.
REPORTED = {
    Kind.NOT_FINITE, Kind.OTHER_FRAME, Kind.DUPLICATE, Kind.LATE, Kind.GAP, Kind.CLOCK_OFFSET, Kind.QUATERNION, Kind.OUT_OF_RANGE,
}  # fmt: skip


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _topic_row(topic: TopicReport) -> tuple[str, ...]:
    offset = topic.log_minus_stamp_s
    return (
        topic.name,
        topic.ros_type,
        str(topic.messages),
        _cell(topic.rate_hz, ".1f"),
        _cell(topic.longest_gap_s, ".3f"),
        _cell(topic.first_s, ".3f"),
        _cell(topic.last_s, ".3f"),
        _cell(offset["median"] * 1e3 if offset else None, ".1f"),
        ", ".join(frame or "(empty)" for frame in topic.frames) or "-",
    )


_HEAD = ("topic", "type", "messages", "Hz", "longest gap s", "first s", "last s", "log - stamp ms", "frame")


def _text(report: BagReport) -> str:
    """The report as plain text."""
    try:
        start = datetime.fromtimestamp(report.start_ns * 1e-9, tz=timezone.utc).isoformat(
            timespec="milliseconds"
        )
    except (OverflowError, ValueError, OSError):
        start = f"{report.start_ns} ns"
    lines = [f"bag       {report.bag}"]
    for file in report.files:
        state = "" if file["complete"] else ", not closed properly"
        lines.append(
            f"file      {file['name']}, {file['bytes']} bytes, written by {file['library'] or '?'}{state}"
        )
    lines += [f"start     {start}", f"duration  {report.duration_s:.3f} s", ""]
    rows = [_HEAD, *(_topic_row(topic) for topic in report.topics)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEAD))]
    numeric = {2, 3, 4, 5, 6, 7}
    for row in rows:
        cells = (
            f"{cell:>{width}}" if i in numeric else f"{cell:<{width}}"
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        lines.append("  ".join(cells).rstrip())
    for topic in report.topics:
        joints = topic.values.get("joints", {})
        for name, extent in joints.items():
            unit = "m" if name.endswith("_translation") else "rad"
            low, high = _cell(extent["min"], ".4f"), _cell(extent["max"], ".4f")
            lines.append(f"{'' if name != next(iter(joints)) else chr(10)}{name}: {low} to {high} {unit}")
    if report.metadata:
        lines += ["", "metadata"]
        lines += [f"  {key}: {value[:100]}" for key, value in report.metadata.items()]
    lines.append("")
    if not report.problems:
        lines.append("no problems found")
    for finding in report.problems:
        where = f"{finding.topic}: " if finding.topic else ""
        lines.append(f"{finding.level}: {where}{finding.text}")
    return "\n".join(lines)


def _input_faults(
    bag: Path, report: BagReport, mapping: InputMapping, settings: Settings
) -> list[BagFinding]:
    """Faults of the inputs that node and replay leave out or mend, one line each, with times in s after its first message."""
    rate_hz = next((t.rate_hz for t in report.topics if t.name == JOINT_STATES), None)
    limits = CheckLimits()
    options = CheckOptions(
        limits=replace(limits, gap_s=max(limits.gap_s, GAP_PERIODS / rate_hz if rate_hz else 0.0)),
        pose_frame_id=pose_frame(settings),
        unwrap=bool(settings["joints.unwrap"]),
        turns=mapping.joints.turns,
    )
    return [
        BagFinding(found.level, STREAMS[found.stream], found.line(report.start_ns))
        for found in check_messages(open_bag(bag, mapping).inputs(), options=options)
        if found.kind not in REPORTED
    ]


def info(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help=BAG_HELP)],
    remap: Remap = None,
    params: Params = None,
    assignments: Assignments = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> int:
    """Say what is in a bag: topics, rates, gaps, clock and unit problems.

    Exit code 0 whatever is found, 2 when the file is not a bag.
    """
    settings = settings_from(params, assignments)
    mapping = mapping_from(settings, remap)
    report = inspect(bag, mapping, pose_frame(settings))
    report.problems += _input_faults(bag, report, mapping, settings)
    if as_json:
        print(json.dumps(plain(report.to_dict()), indent=1, allow_nan=False, ensure_ascii=False))
    else:
        print(_text(report))
    return 0
