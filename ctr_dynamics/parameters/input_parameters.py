"""Parameters about the inputs, ready for who reads or receives them."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ctr_dynamics.io.inputs.input_mapping import InputMapping
from ctr_dynamics.io.inputs.joint_readings import JointReadings
from ctr_dynamics.parameters.settings import Settings


def input_mapping(settings: Settings, remap: Mapping[str, str] | None = None) -> InputMapping:
    """What the inputs mean by the ``settings``, and by ``remap``, topic of a bag to the product's."""
    return InputMapping(
        remap or {},
        JointReadings(
            settings["joints.rotation_names"],
            settings["joints.translation_names"],
            settings["joints.rotation_scale"],
            settings["joints.rotation_offset_rad"],
            settings["joints.translation_scale"],
            settings["joints.translation_offset_m"],
        ),
        child_frame=settings["tracker.child_frame_id"],
        mount_xyzw=_quaternion(settings["tracker.mount_rotation_rad"]),
        arrival_stamps=settings["tracker.stamps"] == "arrival",
        frame_id=pose_frame(settings),
    )


def pose_frame(settings: Settings) -> str:
    """The frame that the tracker's poses are in."""
    return str(settings["tracker.frame_id"] or settings["output.frame_id"]).lstrip("/")


def _quaternion(vector: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Unit quaternion x, y, z, w of a rotation vector in rad."""
    angle = math.sqrt(sum(v * v for v in vector))
    factor = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.5
    x, y, z = (factor * v for v in vector)
    return x, y, z, math.cos(0.5 * angle)
