"""`ctr-dynamics calibrate`: a robot file fitted to measured tips, judged on others."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from ctr_dynamics.cli.measured_tips import read_measured
from ctr_dynamics.cli.recording_options import RecordingChoice, with_recording_options
from ctr_dynamics.io.atomic_files import atomic_file, check_targets


@with_recording_options
def calibrate(
    tips: Annotated[
        Path,
        typer.Argument(
            metavar="BAG_OR_POSES.csv",
            help="A bag in slow motion, or a table with beta1,..,alpha1,..,tip_x,tip_y,tip_z[,qw,..][,Fx,..] in m, rad, N.",
        ),
    ],
    robot: Annotated[
        str,
        typer.Option(
            "--robot", metavar="NAME_OR_FILE", help="The robot file; its tolerances are the priors."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", metavar="NEW.yaml", help="Robot file to write.")],
    fit_until: Annotated[
        float | None,
        typer.Option(
            "--fit-until",
            metavar="S",
            help="Time up to which a bag is fitted; what comes after judges. Default: two thirds of the poses; every third row of a table judges.",
        ),
    ] = None,
    *,
    choice: RecordingChoice,
) -> int:
    """Fit a robot file to measured tips at rest or in slow motion, and judge it on tips that were held out.

    Fitted are precurvatures, stiffnesses, angle offsets, registration, lever arm and whatever else has a
    tolerance and moves the static tip, and the lag of a bag's tracker. Exit code 1 when the held-out error
    has not become smaller.
    """
    from ctr_dynamics.calibration.calibration_report import PARAMETERS_INSIDE, lines, robot_text
    from ctr_dynamics.calibration.reading import mount_of
    from ctr_dynamics.calibration.robot_calibration import calibrate as calibrate_robot

    check_targets({"output": output}, {"tips": tips, "robot file": robot})
    read = read_measured(tips, robot, choice)
    found = calibrate_robot(
        read.robot,
        read.measured.samples,
        until=fit_until,
        mount=mount_of(read.settings),
        note=f"on {tips.name}",
    )
    print("\n".join(lines(found)))
    with atomic_file(output) as temporary:
        temporary.write_text(robot_text(found, read.robot != read.file), encoding="utf-8")
    print(f"output  {output}")
    if read.robot != read.file:
        print(f"ctr-dynamics: note: {output}: {PARAMETERS_INSIDE}", file=sys.stderr)
    return 0 if found.after.rms < found.before.rms else 1
