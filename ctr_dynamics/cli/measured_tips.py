"""What the commands that compare the static model with measured tips have in common."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ctr_dynamics.cli.recording_options import RecordingChoice, settings_from
from ctr_dynamics.io.inputs.input_mapping import parse_remap
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot

if TYPE_CHECKING:
    from ctr_dynamics.calibration.reading import Measured


class MeasuredTips(NamedTuple):
    """Measured tips of a robot.

    Attributes:
        file: the robot of the file. robot: with the parameters of the tracker.
        settings: parameters, with what the robot file says of the tracker. measured: what was read.
    """

    file: Robot
    robot: Robot
    settings: Settings
    measured: Measured


def read_measured(path: Path, robot: str, choice: RecordingChoice) -> MeasuredTips:
    """The tips of a bag or of a table at ``path``, as the options say; what was left out is said.

    Raises:
        InputError: no such robot, a parameter that cannot be used, or as for :func:`ctr_dynamics.calibration.reading.read_tips`.
    """
    from ctr_dynamics.calibration.reading import read_tips
    from ctr_dynamics.sensing.tracker_parameters import with_robot_file, with_tracker_parameters

    file = load_robot(robot)
    settings = with_robot_file(settings_from(choice.params, choice.assignments), file)
    measured = read_tips(path, file, settings, parse_remap(choice.remap))
    for note in measured.notes:
        print(f"ctr-dynamics: note: {note}", file=sys.stderr)
    return MeasuredTips(file, with_tracker_parameters(file, settings), settings, measured)
