"""Tips of a bag or of a table, as a command's options say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.calibration.tip_samples import TipSamples, samples_of_recording, samples_of_table
from ctr_dynamics.diagnosis.diagnosis_options import RecordingOptions
from ctr_dynamics.diagnosis.recording import measured_axes, read_recording
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.pose_table import read_poses
from ctr_dynamics.parameters import Settings, axes_mask, input_mapping
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
TABLES = (".csv", ".txt")
# A static model has no vibration that could persist.
_QUASI_STATIC = replace(RecordingOptions(), settling_s=0.0, unsettled_s=0.0)


@dataclass(frozen=True)
class Measured:
    """Tips that were read. notes: what was left out. lines: rows of a table that they came from; empty for a bag."""

    samples: TipSamples
    notes: tuple[str, ...]
    lines: tuple[int, ...] = ()


def mount_of(settings: Settings) -> Floats | None:
    """The sensor's orientation (4,) wxyz in the tip frame that a bag is read with; None where the parameters name none."""
    if not any(settings["tracker.mount_rotation_rad"]):
        return None
    x, y, z, w = input_mapping(settings).mount_xyzw
    return np.array([w, x, y, z])


def read_tips(
    path: Path, robot: Robot, settings: Settings, remap: Mapping[str, str] | None = None
) -> Measured:
    """Measured tips and the joints behind them.

    Args:
        path: a table (.csv, .txt) with beta1.., alpha1.., tip_x, tip_y, tip_z and optionally Fx.. and qw.., or a bag.
        robot: whose joints they are.
        settings: parameters; ``joints`` and ``tracker`` say what a bag's names, units and frames mean.
        remap: topic of the bag to the product's.

    Raises:
        InputError: as for :func:`read_recording` and :func:`read_poses`.
    """
    if path.suffix.lower() not in TABLES:
        recording = read_recording(path, robot, _QUASI_STATIC, settings, remap)
        notes = [note for note in recording.notes if "begins in motion" not in note]
        axes = measured_axes([recording], notes)
        return Measured(samples_of_recording(recording, axes), tuple(notes))
    poses, spare = read_poses(path, Model(robot, nodes=8), measured=True)
    samples = samples_of_table(poses, str(path))
    samples = replace(samples, axes=samples.axes & np.array(axes_mask(settings["tracker.axes"])))
    notes = [f"columns not read: {', '.join(spare)}"] if spare else []
    notes += [f"line {pose.line}: {pose.problem}; left out" for pose in poses if pose.problem][:20]
    lines = tuple(pose.line for pose in poses if not pose.problem and pose.tip_position is not None)
    return Measured(samples, tuple(notes), lines)
