"""What robot file and parameters say of the tracker, brought together."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctr_dynamics.kernels.rotations import to_vector
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.tracker import TrackerModel

LEAST_NOISE_M = 1e-6  # per axis, below that of any tracker


def tracker_corrections(settings: Settings) -> dict[str, Any]:
    """What the parameters ``tracker.*`` correct of a tracker: arguments of :meth:`TrackerModel.corrected`."""
    return {
        "delay": float(settings["tracker.delay_s"]),
        "lever": np.array(settings["tracker.lever_arm_m"], float),
        "rotation": np.array(settings["tracker.registration_rotation_rad"], float),
        "translation": np.array(settings["tracker.registration_translation_m"], float),
    }


def with_tracker_parameters(robot: Robot, settings: Settings) -> Robot:
    """``robot`` with the delay, lever arm and registration of its tracker corrected by the parameters ``tracker.*``."""
    corrections = tracker_corrections(settings)
    if not any(np.any(part) for part in corrections.values()):
        return robot
    corrected = TrackerModel.of_robot(robot).corrected(**corrections)
    return robot.with_tracker(
        registration_rotation=tuple(to_vector(corrected.rotation).tolist()),
        registration_translation=tuple(corrected.translation.tolist()),
        lever_arm=tuple(corrected.lever.tolist()),
        delay=corrected.delay,
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
    """``settings`` with what the robot file says of the tracker's axes and mount, where no parameter was set."""
    tracker = robot.tracker
    stated: dict[str, Any] = {}
    if tracker.axes is not None:
        stated["tracker.axes"] = tracker.axes
    if tracker.mount_rotation is not None:
        stated["tracker.mount_rotation_rad"] = list(tracker.mount_rotation.value)
    stated = {k: v for k, v in stated.items() if not settings.was_set(k)}
    return settings.replace(stated) if stated else settings
