"""`ctr-dynamics align`: the time between tracker and joints, registration and mount, as a parameter file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from ctr_dynamics.cli.measured_tips import read_measured
from ctr_dynamics.cli.recording_options import BAG_HELP, RecordingChoice, with_recording_options
from ctr_dynamics.io.atomic_files import atomic_file, check_targets


@with_recording_options
def align(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help=BAG_HELP)],
    robot: Annotated[
        str, typer.Option("--robot", metavar="NAME_OR_FILE", help="A shipped robot or a robot file.")
    ],
    output: Annotated[
        Path, typer.Option("--output", metavar="FILE.yaml", help="Parameter file to write, for --params.")
    ],
    unknown_registration: Annotated[
        bool,
        typer.Option(
            "--unknown-registration", help="The robot file says nothing of where the tracker stands."
        ),
    ] = False,
    most_lag: Annotated[
        float, typer.Option("--most-lag", min=0.1, max=60.0, metavar="S", help="Largest lag to look for.")
    ] = 1.0,
    *,
    choice: RecordingChoice,
) -> int:
    """Find clock offset and latency between tracker and joints, registration and mount of the sensor.

    The bag must show every actuator in slow motion. Deviations count what the robot file leaves open and what
    the static model cannot say. The file holds the given parameters too, so it takes their place. Exit code 1,
    and no file, when what is left is more than a tenth of the robot's length.
    """
    from ctr_dynamics.calibration import alignment
    from ctr_dynamics.calibration.alignment_report import file_text, lines, mismatch
    from ctr_dynamics.calibration.reading import mount_of

    check_targets({"output": output}, {"bag": bag, "robot file": robot})
    tips = read_measured(bag, robot, choice)
    found = alignment.align(
        tips.robot,
        tips.measured.samples,
        file=tips.file,
        mount=mount_of(tips.settings),
        unknown_registration=unknown_registration,
        most_lag=most_lag,
    )
    print("\n".join(lines(found)))
    if shortfall := mismatch(found):
        print(f"ctr-dynamics: {shortfall}", file=sys.stderr)
        return 1
    text, warning = file_text(found, tips.settings, f"ctr-dynamics align {bag.name} --robot {robot}")
    with atomic_file(output) as temporary:
        temporary.write_text(text, encoding="utf-8")
    if warning:
        print(f"ctr-dynamics: warning: {warning}", file=sys.stderr)
    print(f"output  {output}")
    return 0
