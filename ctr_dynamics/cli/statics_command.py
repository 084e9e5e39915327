"""`ctr-dynamics statics`: static shapes for a table of actuator positions."""

from __future__ import annotations

import csv
import sys
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from ctr_dynamics.cli.measured_tips import read_measured
from ctr_dynamics.cli.recording_options import RecordingChoice, with_recording_options
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.atomic_files import atomic_file, check_targets
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.pose_table import output_cells, output_header, read_poses, solve_poses
from ctr_dynamics.robot_files import load_robot

SHOWN = 20  # failed rows named one by one


@with_recording_options
def statics(
    robot: Annotated[
        str, typer.Option("--robot", metavar="NAME_OR_FILE", help="A shipped robot or a robot file.")
    ],
    poses: Annotated[
        Path,
        typer.Option(
            "--poses",
            metavar="POSES.csv",
            help="Columns beta1,..,alpha1,..[,Fx,Fy,Fz][,psiL1,..] in m, rad, N; with --measured also a bag.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", metavar="OUT.csv", help="Table to write, one row for each pose.")
    ],
    nodes: Annotated[
        int, typer.Option("--nodes", metavar="N", help="Nodes from base plate to tip, 8 to 1000.")
    ] = 100,
    measured: Annotated[
        bool,
        typer.Option(
            "--measured",
            help="Compare with measured tips: columns tip_x,tip_y,tip_z[,qw,qx,qy,qz] of the table, or the tracker of a bag.",
        ),
    ] = False,
    *,
    choice: RecordingChoice,
) -> int:
    """Solve the static model for a table of actuator positions, or compare it with measured tips.

    Columns are matched by name. Fx,Fy,Fz is a force on tube 1's tip in the base frame; psiL1,.. are end
    angles that choose the branch where a pose has several stable shapes. Exit code 1 when a row failed or is
    invalid. With --measured, actuator positions are readings of encoders, tips are in the tracker's frame,
    and --remap, --params and --set say what they mean, as for a replay.
    """
    if not 8 <= nodes <= 1000:
        raise InputError(f"--nodes {nodes} is outside 8 to 1000", do="100 is accurate to a micrometre")
    check_targets({"output": output}, {"table of poses": poses, "robot file": robot})
    if measured:
        return _compared(poses, robot, output, nodes, choice)
    model = Model(load_robot(robot), nodes=nodes)
    table, spare = read_poses(poses, model)
    if spare:
        print(f"ctr-dynamics: note: columns not read: {', '.join(spare)}", file=sys.stderr)
    counts: Counter[str] = Counter()
    failed = []
    with atomic_file(output) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(output_header(model.n))
        for row in solve_poses(model, table):
            writer.writerow(output_cells(row, model.n))
            counts[row.status] += 1
            if row.reason:
                failed.append(row)
    for row in failed[:SHOWN]:
        print(f"ctr-dynamics: line {row.line}: {row.status}: {row.reason}", file=sys.stderr)
    if len(failed) > SHOWN:
        print(f"ctr-dynamics: and {len(failed) - SHOWN} more rows failed", file=sys.stderr)
    print(
        ", ".join(
            f"{counts[status]} {status}"
            for status in ("ok", "unstable", "failed", "invalid")
            if counts[status]
        )
    )
    print(f"output  {output}")
    return 1 if failed else 0


def _compared(poses: Path, robot: str, output: Path, nodes: int, choice: RecordingChoice) -> int:
    """Expected beside measured tips; 1 where the model has no solution."""
    from ctr_dynamics.calibration.comparison import HEADER, compare, table

    tips = read_measured(poses, robot, choice)
    found = compare(tips.robot, tips.measured.samples, nodes)
    with atomic_file(output) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(HEADER)
        writer.writerows([f"{value:.9g}" for value in row] for row in table(found, tips.measured.lines))
    print(f"{found.errors.count} tips  {found.errors.text()}")
    print(f"output  {output}")
    return 1 if found.errors.unsolved else 0
