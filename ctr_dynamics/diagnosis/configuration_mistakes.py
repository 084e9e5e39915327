"""Configuration mistakes: units, signs and orders.

In: a recording and a robot. Out: the mistake that makes a gross misfit, if one does. Each is undone in the data or the robot file, one by one.
A free vibration whose frequency is a little off also makes a gross misfit, and undoing a mistake can happen to shift it. What the robot's own
tolerances explain better is none (:mod:`ctr_dynamics.diagnosis.pipeline`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions, ForwardModelOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel, Point
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.step_choice import with_chosen_steps
from ctr_dynamics.diagnosis.time_steps import TimeSteps
from ctr_dynamics.diagnosis.whitening import Whitener, noise_floor
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import robot_from_dict, robot_to_dict

Pair = tuple[Recording, Robot]


@dataclass(frozen=True)
class FoundMistake:
    """A mistake of the configuration: its name, and the misfit in m with it and without."""

    name: str
    misfit: float
    misfit_undone: float


def _alpha(change: Callable[[Any, int], Any]) -> Callable[[Recording, Robot], Pair]:
    def apply(recording: Recording, robot: Robot) -> Pair:
        joints = recording.joints.copy()
        n = robot.n_tubes
        joints[:, 1 : 1 + n] = change(joints[:, 1 : 1 + n], n)
        return replace(recording, joints=joints), robot

    return apply


def _tubes_swapped(recording: Recording, robot: Robot) -> Pair:
    n = robot.n_tubes
    joints = recording.joints.copy()
    joints[:, 1 : 1 + n] = joints[:, 1 : 1 + n][:, ::-1]
    return replace(recording, joints=joints), robot


def _gravity(axis: int, sign: float) -> Callable[[Recording, Robot], Pair]:
    def apply(recording: Recording, robot: Robot) -> Pair:
        data = robot_to_dict(robot)
        value = [0.0, 0.0, 0.0]
        value[axis] = sign * float(np.linalg.norm(robot.gravity.value))
        data["gravity"]["value"] = value
        return recording, robot_from_dict(data)

    return apply


def _radii(factor: float) -> Callable[[Recording, Robot], Pair]:
    def apply(recording: Recording, robot: Robot) -> Pair:
        data = robot_to_dict(robot)
        for tube in data["tubes"]:
            for name in ("inner_radius", "outer_radius"):
                tube[name]["value"] *= factor
        return recording, robot_from_dict(data)

    return apply


def _quaternion(recording: Recording, robot: Robot) -> Pair:
    # (w, x, y, z) had been sent as (x, y, z, w)
    return replace(recording, quaternion=np.roll(recording.quaternion, -1, axis=1)), robot


def _inverse(recording: Recording, robot: Robot) -> Pair:
    return replace(recording, quaternion=recording.quaternion * np.array([1.0, -1.0, -1.0, -1.0])), robot


def _metres(factor: float) -> Callable[[Recording, Robot], Pair]:
    return lambda recording, robot: (replace(recording, position=recording.position * factor), robot)


def _load(factor: float) -> Callable[[Recording, Robot], Pair]:
    def apply(recording: Recording, robot: Robot) -> Pair:
        load = recording.load.copy()
        load[:, 1:] *= factor
        return replace(recording, load=load), robot

    return apply


MISTAKES: dict[str, Callable[[Recording, Robot], Pair]] = {
    "sign_of_alpha": _alpha(lambda a, n: -a),
    "sign_of_alpha_inner": _alpha(lambda a, n: a * np.r_[-1.0, np.ones(n - 1)]),
    "sign_of_alpha_outer": _alpha(lambda a, n: a * np.r_[np.ones(n - 1), -1.0]),
    "alpha_in_degrees": _alpha(lambda a, n: a * math.pi / 180.0),
    "tubes_swapped": _tubes_swapped,
    "radius_is_diameter": _radii(0.5),
    "diameter_is_radius": _radii(2.0),
    "gravity_along_minus_x": _gravity(0, -1.0),
    "gravity_along_plus_x": _gravity(0, 1.0),
    "gravity_along_plus_y": _gravity(1, 1.0),
    "gravity_along_minus_y": _gravity(1, -1.0),
    "gravity_along_plus_z": _gravity(2, 1.0),
    "gravity_along_minus_z": _gravity(2, -1.0),
    "quaternion_order": _quaternion,
    "quaternion_inverse": _inverse,
    "tracker_in_millimetres": _metres(1e-3),
    "load_sign": _load(-1.0),
}


def misfit(
    recording: Recording,
    robot: Robot,
    mask: NDArray[np.bool_],
    resolution: ForwardModelOptions,
    steps: TimeSteps | None = None,
    point: Point | None = None,
) -> float:
    """3-D rms in m of the measurement against the model at ``point``, the nominal one without; infinity where it fails.

    Rotations that the ``mask`` (6,) of measured axes holds count by the ratio of the noise of positions to theirs.
    """
    try:
        forward_model = ForwardModel(recording, robot, resolution, steps)
        prediction = forward_model.predict(point or {})
    except InputError:
        return math.inf
    if prediction.failure:
        return math.inf
    residual = forward_model.residual(prediction)
    noise = robot.tracker.noise
    rotation = residual[:, 3:] * mask[3:] * (noise.position.value / max(noise.rotation.value, 1e-6))
    squares = np.sum(residual[:, :3] ** 2, axis=1) + np.sum(rotation**2, axis=1)
    return math.sqrt(float(np.nanmean(squares)))


def find_mistake(
    recording: Recording,
    robot: Robot,
    mask: NDArray[np.bool_],
    options: DiagnosisOptions,
    context: RunContext,
) -> FoundMistake | None:
    """The mistake that leaves least when it is undone, where the misfit is gross and it explains nearly all; ``mask``: (6,) measured axes."""
    o, fine = options.configuration, options.forward_model.fine
    recording = beginning(recording, options)
    before = misfit(recording, robot, mask, fine)
    if before < o.gross * noise_floor(robot) * math.sqrt(2.0):
        return None
    context.report("gross misfit: trying mistakes of units, signs and orders")
    used = np.asarray(np.isfinite(recording.position).all(axis=1))
    whiten = Whitener(robot, recording.stamps, mask, used)
    steps = with_chosen_steps(ForwardModel(recording, robot, fine), whiten, {}, options.steps).steps
    after: dict[str, float] = {}
    for name, undo in MISTAKES.items():
        try:
            after[name] = misfit(*undo(recording, robot), mask, fine, steps)
        except InputError:
            continue
    best = min(after, key=lambda name: after[name])
    return FoundMistake(best, before, after[best]) if after[best] < o.improvement * before else None


def beginning(recording: Recording, options: DiagnosisOptions) -> Recording:
    """As much of ``recording`` as tells a mistake; all of it where nothing is measured so early."""
    first = recording.until(options.configuration.longest_s)
    return first if len(first.stamps) else recording
