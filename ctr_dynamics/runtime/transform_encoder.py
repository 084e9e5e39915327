"""Frames of the robot as transforms: the ends of its tubes in the base frame, and the base in the tracker's frame."""

from __future__ import annotations

import numpy as np

from ctr_dynamics.estimation.step_output import StepOutput
from ctr_dynamics.io.messages import templates, topics
from ctr_dynamics.io.messages.encode import Encoded
from ctr_dynamics.kernels.rotations import from_vector
from ctr_dynamics.parameters import Settings, pose_frame
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.tracker_parameters import with_tracker_parameters

_XYZW = [1, 2, 3, 0]


def tip_frame(frame_id: str, tube: int) -> str:
    """Name of the frame at the end of a ``tube`` (1 innermost) where the base is ``frame_id``: ``ctr_base`` makes ``ctr_tube1_tip``."""
    stem = frame_id.removesuffix("base")
    return f"{stem}tube{tube}_tip" if stem.endswith(("_", "/")) else f"{frame_id}_tube{tube}_tip"


class TransformEncoder:
    """Makes the message on /tf of a step.

    Args:
        settings: names of the frames and the registration; robot: lengths of the tubes, and the registration of its file.
    """

    def __init__(self, settings: Settings, robot: Robot) -> None:
        base, tracker_frame = str(settings["output.frame_id"]), pose_frame(settings)
        self._lengths = robot.lengths
        frames = [(base, tip_frame(base, i + 1)) for i in range(robot.n_tubes)]
        self._registration = np.zeros(0)
        if tracker_frame != base.lstrip("/"):
            tracker = with_tracker_parameters(robot, settings).tracker
            turned = from_vector(np.array(tracker.registration_rotation.value))[_XYZW]
            self._registration = np.concatenate((tracker.registration_translation.value, turned))
            frames.append((tracker_frame, base))
        self._template = templates.Template(templates.transforms(topics.TF, frames))

    def encode(self, out: StepOutput) -> Encoded:
        """The message of a valid step.

        Raises:
            NotFiniteError: the step holds a NaN or an infinity.
        """
        ends = np.array(out.beta) + self._lengths
        # every tube ends at a node; the nodes' places are float32
        rows = np.abs(out.backbone[:, :1] - ends).argmin(axis=0)
        poses = out.backbone[rows, 1:8].astype(float)
        poses[0] = (*out.tip_position, *out.tip_quaternion_wxyz[_XYZW])
        return Encoded(
            topics.TF, out.stamp_ns, *self._template.fill(out.stamp_ns, poses.ravel(), self._registration)
        )


def transform_encoder(settings: Settings, robot: Robot) -> TransformEncoder | None:
    """That of the robot, None where ``settings`` want no transforms."""
    return TransformEncoder(settings, robot) if settings["output.publish_tf"] else None
