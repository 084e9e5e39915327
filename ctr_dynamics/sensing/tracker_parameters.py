"""The tracker of a robot as the parameters say it is, for what knows robots but no parameters."""

from __future__ import annotations

import numpy as np

from ctr_dynamics.kernels.rotations import from_vector, matrix, multiply, to_vector
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import Robot


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
    values = {
        "registration_rotation": tuple(to_vector(turned).tolist()),
        "registration_translation": tuple(moved.tolist()),
        "lever_arm": tuple((np.array(tracker.lever_arm.value) + lever).tolist()),
        "delay": float(tracker.delay.value + delay),
    }
    changed = {name: getattr(tracker, name).model_copy(update={"value": v}) for name, v in values.items()}
    return robot.model_copy(update={"tracker": tracker.model_copy(update=changed)})
