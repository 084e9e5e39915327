"""Alignment of tracker and joints: time between them, registration and mount of the sensor.

First steps need no start: the lag at which a rigid motion carries the static tips best onto the measured ones, and the mean mount. The fit goes
on from there, with the robot's own parameters free inside their tolerances, so that their deviations are part of the result's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.calibration.rigid_motion import mean_rotation, rigid_motion, shortest_turn
from ctr_dynamics.calibration.tip_errors import TipErrors, tip_errors
from ctr_dynamics.calibration.tip_fit import (
    DELAY,
    MOUNT,
    Coordinate,
    Key,
    TipFit,
    TipModel,
    fit_tips,
    mount_coordinates,
)
from ctr_dynamics.calibration.tip_samples import TipSamples
from ctr_dynamics.diagnosis.inference.recalibration import nuisances_of
from ctr_dynamics.effects import EffectQuantity, effect_quantities, make_plant
from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.rotations import (
    conjugate,
    conjugate_rows,
    from_vector,
    matrix,
    multiply,
    multiply_rows,
    rotate_rows,
    to_vector,
)
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
# What moves the static tip; speeds, inertias and friction do not.
STATIC_EFFECTS = frozenset(
    (
        "encoder_offset", "youngs_modulus", "shear_modulus", "precurvature", "density", "payload_mass", "gravity_direction",
        "registration_rotation", "registration_translation", "tracker_lever_arm",
    )
)  # fmt: skip
REGISTRATION = ("registration_rotation", "registration_translation")
UNKNOWN_REGISTRATION = {"registration_rotation": np.pi, "registration_translation": 1.0}  # rad, m
SAMPLES = 300
LAG_STEP_S = 0.02  # of the first search; the fit goes on from there
MOST_LAG_S = 1.0


@dataclass(frozen=True)
class Alignment:
    """What was found; deviations are 1-sigma of the posterior.

    Attributes:
        lag, lag_sigma: s by which poses are older than their stamps say, the robot file's delay included.
        file_delay: s, the robot file's part of it.
        rotation, rotation_sigma: (3,) rad, translation, translation_sigma: (3,) m: composed with the robot file's registration.
        mount, mount_sigma: (3,) rotation vector of the sensor in the tip frame.
        file_delay_sigma: s, its tolerance.
        errors: what is left. fit: all that was fitted.
    """

    lag: float
    lag_sigma: float
    file_delay: float
    file_delay_sigma: float
    rotation: Floats
    rotation_sigma: Floats
    translation: Floats
    translation_sigma: Floats
    mount: Floats
    mount_sigma: Floats
    errors: TipErrors
    fit: TipFit

    @property
    def clock(self) -> float:
        """s, what the lag has beyond the robot file's delay: the offset between the clocks, if the file is right."""
        return self.lag - self.file_delay


def static_quantities(robot: Robot) -> list[EffectQuantity]:
    """Quantities with a tolerance that move the static tip."""
    weighs = bool(np.any(robot.gravity.value))
    quantities = [q for q in nuisances_of(robot) if q.effect in STATIC_EFFECTS]
    return [
        q for q in quantities if weighs or q.effect not in ("density", "payload_mass", "gravity_direction")
    ]


def delay_coordinate(robot: Robot, prior: float) -> Coordinate:
    """The delay of the tracker, with a ``prior`` deviation in s; its derivative is taken over a few ms of motion."""
    quantity = next(q for q in effect_quantities(robot) if q.key == DELAY)
    return replace(Coordinate.of(quantity, prior), difference=0.004)


def align(
    robot: Robot,
    samples: TipSamples,
    *,
    file: Robot | None = None,
    mount: Floats | None = None,
    unknown_registration: bool = False,
    most_lag: float = MOST_LAG_S,
) -> Alignment:
    """Time, registration and mount between the tracker and joints of ``samples``.

    Args:
        robot: with the registration and delay to start from. file: what the result is told against, by default the same.
        mount: (4,) wxyz, the mount that the samples' orientations are already rid of.
        unknown_registration: whether the robot file says nothing of it; else its tolerance holds.
        most_lag: s, largest lag that is looked for, to both sides.

    Raises:
        InputError: the samples have no times, or too few of them, or the static model has no solution.
    """
    if not samples.timed or len(samples.stamps) < 20:
        raise InputError("too few timed tips to align", do="record joints and tracker in motion")
    here = samples.thinned(SAMPLES)
    lag, rotation, translation = first_lag(robot, here, unknown_registration, most_lag)
    start = registered(robot, rotation, translation) if unknown_registration else robot
    model = TipModel(start, here)
    extra = lag - start.tracker.delay.value
    if here.axes[3:].any():
        model.mount = first_mount(model, {DELAY: extra})
    coordinates = [
        Coordinate.of(
            q, UNKNOWN_REGISTRATION[q.effect] if unknown_registration and q.effect in REGISTRATION else None
        )
        for q in static_quantities(start)
    ]
    coordinates.append(delay_coordinate(robot, most_lag))
    if here.axes[3:].any():
        coordinates += mount_coordinates()
    found = fit_tips(model, coordinates, {DELAY: extra})
    return _alignment(file or robot, model, found, mount)


def first_lag(
    robot: Robot, samples: TipSamples, unknown_registration: bool, most_lag: float
) -> tuple[float, Floats, Floats]:
    """Lag (s) at which the static tips are nearest to the measured ones, and the registration there, quaternion and translation.

    Raises:
        InputError: joints and tracker overlap for too short a time at every lag.
    """
    t = samples.joints[:, 0]
    grid = np.linspace(t[0], t[-1], SAMPLES)
    model = TipModel(
        robot,
        replace(samples, stamps=grid, position=np.zeros((SAMPLES, 3)), quaternion=np.zeros((SAMPLES, 4))),
    )
    plant = make_plant(robot)
    tips = model.tips({DELAY: -robot.tracker.delay.value})
    if tips.found.mean() < 0.5:
        raise InputError(
            f"the static model has no solution at {int((~tips.found).sum())} of {SAMPLES} joint states",
            do="check the robot file, and the units and order of the joints",
        )
    pose, grid = tips.pose[tips.found], grid[tips.found]
    points = pose[:, :3] + rotate_rows(pose[:, 3:], plant.tracker.lever)
    best: tuple[float, float, Floats, Floats] | None = None
    for lag in np.arange(-most_lag, most_lag + 0.5 * LAG_STEP_S, LAG_STEP_S):
        times = samples.stamps - lag
        inside = (times >= t[0]) & (times <= t[-1])
        if inside.sum() < 0.5 * len(times):
            continue
        expected = np.stack([np.interp(times[inside], grid, column) for column in points.T], axis=1)
        h, shift = plant.tracker.rotation, plant.tracker.translation
        if unknown_registration:
            h, shift = rigid_motion(expected, samples.position[inside])
        error = samples.position[inside] - expected @ matrix(h).T - shift
        if not unknown_registration:
            error = error - np.median(error, axis=0)  # a constant one says nothing of the time
        size = float(np.mean(error**2))
        if best is None or size < best[0]:
            best = size, float(lag), h, shift
    if best is None:
        raise InputError("joints and tracker overlap for too short a time", do="check the clocks")
    return best[1:]


def first_mount(model: TipModel, point: dict[tuple[str, str], float]) -> Floats:
    """Mean orientation (4,) wxyz of the sensor in the static tip's frame; without a turn about the tip's z where that is not measured."""
    tips, samples = model.tips(point), model.samples
    seen = tips.found
    tracker = model.plant(point).tracker
    _, expected = tracker.reported(samples.stamps[seen], tips.pose[seen, :3], tips.pose[seen, 3:])
    between = multiply_rows(conjugate_rows(expected), samples.quaternion[seen])
    if samples.axes[3:].all():
        return mean_rotation(between)
    axis = rotate_rows(conjugate_rows(between), np.array([0.0, 0.0, 1.0])).mean(axis=0)
    return shortest_turn(axis / max(float(np.linalg.norm(axis)), 1e-9), np.array([0.0, 0.0, 1.0]))


def mount_angle(mount: Floats) -> float:
    """Angle (rad) of a quaternion (4,)."""
    return float(np.linalg.norm(to_vector(mount)))


def mount_vector(model: TipModel, point: Mapping[Key, float], beside: Floats | None) -> Floats:
    """Rotation vector (3,) of the sensor in the tip frame at ``point``, with the mount (4,) that the samples' orientations are already rid of."""
    found = model.mount_at(point)
    return to_vector(found if beside is None else multiply(found, beside))


def registered(robot: Robot, rotation: Floats, translation: Floats) -> Robot:
    """``robot`` with the registration ``rotation`` (4,) wxyz and ``translation`` (3,) m."""
    return robot.with_tracker(
        registration_rotation=tuple(to_vector(rotation).tolist()),
        registration_translation=tuple(translation.tolist()),
    )


def _alignment(robot: Robot, model: TipModel, found: TipFit, mount: Floats | None) -> Alignment:
    """``found`` in the terms of parameters, which are composed with the file of ``robot``."""
    point, sigma = found.point, found.deviations()
    tracker = model.plant(point).tracker
    own = robot.tracker
    before = from_vector(np.array(own.registration_rotation.value))
    extra = multiply(tracker.rotation, conjugate(before))
    shift = tracker.translation - matrix(extra) @ np.array(own.registration_translation.value)

    def deviation(effect: str, names: tuple[str, ...]) -> Floats:
        return np.array([sigma.get((effect, name), 0.0) for name in names])

    return Alignment(
        lag=tracker.delay,
        lag_sigma=sigma[DELAY],
        file_delay=own.delay.value,
        file_delay_sigma=own.delay.tolerance,
        rotation=to_vector(extra),
        rotation_sigma=deviation("registration_rotation", ("rx_rad", "ry_rad", "rz_rad")),
        translation=shift,
        translation_sigma=deviation("registration_translation", ("tx_m", "ty_m", "tz_m")),
        mount=mount_vector(model, point, mount),
        mount_sigma=np.array([sigma.get(key, 0.0) for key in MOUNT]),
        errors=tip_errors(found.residual, model),
        fit=found,
    )
