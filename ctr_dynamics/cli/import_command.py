"""`ctr-dynamics import`: CSV logs of actuators and tracker as a bag."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from ctr_dynamics.csv_import import column_layout as layout
from ctr_dynamics.csv_import import convert
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot


def import_(
    joints: Annotated[Path, typer.Option("--joints", metavar="CSV", help="Log of the actuators.")],
    output: Annotated[Path, typer.Option("--output", metavar="OUT.mcap", help="Bag to write.")],
    tracker: Annotated[
        Path | None, typer.Option("--tracker", metavar="CSV", help="Log of the tip tracker.")
    ] = None,
    load: Annotated[
        Path | None, typer.Option("--load", metavar="CSV", help="Log of a known force on the tip.")
    ] = None,
    layout_file: Annotated[
        Path | None,
        typer.Option(
            "--layout", metavar="YAML", help="Columns, units and frames; without it the headers say so."
        ),
    ] = None,
    frame: Annotated[str, typer.Option("--frame", metavar="NAME", help="Frame of poses and forces.")] = "",
    robot: Annotated[
        str,
        typer.Option("--robot", metavar="NAME_OR_FILE", help="Check ranges and frames against this robot."),
    ] = "",
    force: Annotated[bool, typer.Option("--force", help="Write the bag in spite of errors.")] = False,
) -> int:
    """Write CSV logs of actuators and tracker as a bag.

    Headers name value and unit: 'time [s]', 'tube1_rotation [deg]', 'tube1_translation [mm]', 'x [mm]', 'qw';
    other headers are mapped by a layout file (docs/data.md). Exit code 1 when rows were left out.
    """
    chosen: Robot | None = load_robot(robot) if robot else None
    columns = layout.read_layout(layout_file) if layout_file else layout.Layout()
    files: dict[layout.Kind, Path | None] = {"joints": joints, "tracker": tracker, "load": load}
    given = {kind: path for kind, path in files.items() if path is not None}
    for path in given.values():
        if path.resolve() == output.resolve():
            raise InputError("output is a file that is read", do="give another name", where=str(output))
    logs = {kind: convert.read_log(kind, path, columns, frame) for kind, path in given.items()}
    found = convert.check(list(logs.values()), chosen)
    errors = [finding for finding in found if finding.level == "error"]
    if chosen is not None and "tracker" in logs and not errors:
        from ctr_dynamics.csv_import import frames

        agreement = frames.compare(logs["joints"], logs["tracker"], chosen, logs.get("load"))
        oriented = not any("no orientation" in note for note in logs["tracker"].notes)
        found += frames.findings(agreement, oriented)
        if agreement is not None:
            print(
                f"static tip of {chosen.name}: poses are {1e3 * agreement.distance_m:.1f} mm away"
                + (f" and {57.29578 * agreement.angle_rad:.1f} deg turned" if oriented else "")
            )
    for log in logs.values():
        for note in log.notes:
            print(f"ctr-dynamics: note: {note}", file=sys.stderr)
    for finding in found:
        print(f"ctr-dynamics: {finding.level}: {finding.topic}: {finding.text}", file=sys.stderr)
    if errors and not force:
        raise InputError(
            f"{len(errors)} errors, nothing was written", do="mend the logs or the layout, or say --force"
        )
    count = convert.write(output, list(logs.values()), list(given.values()), chosen)
    for kind, log in logs.items():
        span_s = (log.stamp_ns[-1] - log.stamp_ns[0]) * 1e-9
        print(f"{kind:<8}{len(log.stamp_ns)} rows, {span_s:.3f} s, {', '.join(log.names)}")
        if log.faults.count:
            print(
                f"ctr-dynamics: {given[kind]}: {log.faults.count} rows left out: {log.faults}",
                file=sys.stderr,
            )
    print(f"output  {output}, {count} messages")
    return 1 if any(log.faults.count for log in logs.values()) else 0
