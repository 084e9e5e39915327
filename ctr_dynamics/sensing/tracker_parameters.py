"""What robot file and parameters say of the tracker, brought together."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctr_dynamics.kernels.rotations import from_vector, matrix, multiply, to_vector
from ctr_dynamics.parameters import Settings, parameter
from ctr_dynamics.robot import Robot

LEAST_NOISE_M = 1e-6  # per axis, below that of any tracker


def with_tracker_parameters(robot: Robot, settings: Settings) -> Robot:
    """``robot`` with the delay, lever arm and registration of its tracker corrected by the parameters ``tracker.*``.

    Composed as :meth:`TrackerModel.corrected` does it.
    """
    names = ("delay_s", "lever_arm_m", "registration_rotation_rad", "registration_translation_m")
    delay, lever, rotation, translation = (np.array(settings[f"tracker.{name}"], float) for name in names)
    if not any(np.any(part) for part in (delay, lever, rotation, translation)):
        return robot
    tracker = robot.tracker
    extra = from_vector(rotation)
    turned = multiply(extra, from_vector(np.array(tracker.registration_rotation.value)))
    moved = matrix(extra) @ np.array(tracker.registration_translation.value) + translation
    return robot.with_tracker(
        registration_rotation=tuple(to_vector(turned).tolist()),
        registration_translation=tuple(moved.tolist()),
        lever_arm=tuple((np.array(tracker.lever_arm.value) + lever).tolist()),
        delay=float(tracker.delay.value + delay),
    )


def with_least_noise(robot: Robot) -> Robot:
    """``robot`` whose tracker has at least the noise of the best: measurements are weighed by it, and an exact one has no finite weight."""
    noise = robot.tracker.noise
    if noise.position.value >= LEAST_NOISE_M:
        return robot
    position = noise.position.model_copy(update={"value": LEAST_NOISE_M})
    tracker = robot.tracker.model_copy(update={"noise": noise.model_copy(update={"position": position})})
    return robot.model_copy(update={"tracker": tracker})


def with_robot_file(settings: Settings, robot: Robot) -> Settings:
    """``settings`` with what the robot file says of the tracker's axes and mount, where a parameter is at its default."""
    tracker = robot.tracker
    stated: dict[str, Any] = {}
    if tracker.axes is not None:
        stated["tracker.axes"] = tracker.axes
    if tracker.mount_rotation is not None:
        stated["tracker.mount_rotation_rad"] = list(tracker.mount_rotation.value)
    stated = {k: v for k, v in stated.items() if settings[k] == parameter(k).default}
    return settings.replace(stated) if stated else settings
