"""Whether the poses of a log can be those of the robot's tip: against the static model where the robot rests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.csv_import.column_layout import FORCE, POSITION, QUATERNION, TORQUE
from ctr_dynamics.csv_import.convert import Log
from ctr_dynamics.io.bag_checks import BagFinding
from ctr_dynamics.io.messages import topics
from ctr_dynamics.kernels.rotations import conjugate, multiply, to_vector
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
DISTANCE_M = 0.03  # a static model of a roughly known robot is nearer than this
ANGLE_RAD = 0.5
SAMPLES = 7


@dataclass(frozen=True)
class Agreement:
    """Median distance (m) and angle (rad) of the poses from the static tip, and what would fit better."""

    samples: int
    distance_m: float
    angle_rad: float
    hint: str


def compare(joints: Log, tracker: Log, robot: Robot, load: Log | None = None) -> Agreement | None:
    """Compare poses with the static tip at the slowest moments of the log; None when no equilibrium is found."""
    n = robot.n_tubes
    alphas = joints.columns(tuple(f"tube{i}_rotation" for i in range(1, n + 1)))
    betas = joints.columns(tuple(f"tube{i}_translation" for i in range(1, n + 1)))
    statics = Statics(Model(robot, nodes=24))
    stamps, at = np.array(tracker.stamp_ns), np.array(joints.stamp_ns)
    positions, quaternions = tracker.columns(POSITION), tracker.columns(QUATERNION)[:, [3, 0, 1, 2]]
    plant, now = statics.model.plant, np.zeros(1)
    expected_p, expected_h, measured_p, measured_h = [], [], [], []
    for index in _slow(stamps, positions):
        alpha = np.array([np.interp(stamps[index], at, column) for column in alphas.T])
        beta = np.array([np.interp(stamps[index], at, column) for column in betas.T])
        wrench = _wrench_at(load, stamps[index])
        drive = plant.actuators.forward(np.concatenate([alpha, beta]))
        found = statics.solve(drive[n:], drive[:n], wrench[:3], wrench[3:])
        if found.converged:
            p, h = plant.tracker.reported(now, found.tip_position[None], found.tip_quaternion[None])
            expected_p.append(p[0])
            expected_h.append(h[0])
            measured_p.append(positions[index])
            measured_h.append(quaternions[index])
    if not expected_p:
        return None
    measured, expected = np.array(measured_p), np.array(expected_p)
    distance = _median(measured, expected)
    angle = _angles(measured_h, expected_h)
    hints = []
    for name, turned in _position_readings(measured).items():
        if _median(turned, expected) < 0.3 * distance and distance > DISTANCE_M:
            hints.append(f"positions read as {name} are {1e3 * _median(turned, expected):.1f} mm away")
    for name, other in (("w, x, y, z", [1, 2, 3, 0]), ("x, y, z, w", [3, 0, 1, 2])):
        swapped = _angles([h[other] for h in measured_h], expected_h)
        if swapped < 0.3 * angle and angle > ANGLE_RAD:
            hints.append(f"quaternion columns in the order {name} are {np.degrees(swapped):.1f} deg away")
    inverse = _angles([conjugate(h) for h in measured_h], expected_h)
    if inverse < 0.3 * angle and angle > ANGLE_RAD:
        hints.append(f"inverse rotations are {np.degrees(inverse):.1f} deg away")
    return Agreement(len(measured), distance, angle, "; ".join(hints))


def findings(agreement: Agreement | None, has_orientation: bool) -> list[BagFinding]:
    """Warnings where poses and static model disagree by more than a roughly known robot explains."""
    if agreement is None:
        return [
            BagFinding(
                "warning",
                topics.JOINT_STATES,
                "no equilibrium of the robot at these joints: frames were not checked",
            )
        ]
    hint = f"; {agreement.hint}" if agreement.hint else ""
    found = []
    if agreement.distance_m > DISTANCE_M:
        text = (
            f"poses lie {1e3 * agreement.distance_m:.1f} mm (median of {agreement.samples}) from the robot's static tip, limit "
            f"{1e3 * DISTANCE_M:.0f} mm: another frame, registration, lever arm, load or tube order?{hint}"
        )
        found.append(BagFinding("warning", topics.TRACKER_TIP, text))
    if has_orientation and agreement.angle_rad > ANGLE_RAD:
        text = (
            f"orientations differ by {np.degrees(agreement.angle_rad):.1f} deg from the robot's static tip, limit "
            f"{np.degrees(ANGLE_RAD):.0f} deg: another axis convention?{hint}"
        )
        found.append(BagFinding("warning", topics.TRACKER_TIP, text))
    return found


def _slow(stamps: NDArray[np.int64], positions: Floats) -> list[int]:
    """Indices of the slowest moments, spread over the log."""
    if len(stamps) < 3:
        return list(range(len(stamps)))
    speed = np.linalg.norm(np.gradient(positions, stamps * 1e-9, axis=0), axis=1)
    parts = np.array_split(np.arange(len(stamps)), min(SAMPLES, len(stamps)))
    return [int(part[np.argmin(speed[part])]) for part in parts]


def _wrench_at(load: Log | None, stamp: int) -> Floats:
    """Known wrench on the tip (6,) N, N m; zero without a log of it."""
    if load is None:
        return np.zeros(6)
    return np.array(
        [
            np.interp(stamp, load.stamp_ns, load.column(axis)) if axis in load.names else 0.0
            for axis in (*FORCE, *TORQUE)
        ]
    )


def _median(a: Floats, b: Floats) -> float:
    return float(np.median(np.linalg.norm(a - b, axis=1)))


def _angles(measured: list[Floats], expected: list[Floats]) -> float:
    return float(
        np.median(
            [
                np.linalg.norm(to_vector(multiply(conjugate(e), m)))
                for m, e in zip(measured, expected, strict=True)
            ]
        )
    )


def _position_readings(p: Floats) -> dict[str, Floats]:
    """Common mistakes of frames, by name."""
    return {
        "(y, x, z)": p[:, [1, 0, 2]], "(z, y, x)": p[:, [2, 1, 0]], "(x, z, y)": p[:, [0, 2, 1]], "(y, z, x)": p[:, [1, 2, 0]],
        "(z, x, y)": p[:, [2, 0, 1]], "(x, -y, z)": p * [1, -1, 1], "(-x, y, z)": p * [-1, 1, 1], "(-x, -y, z)": p * [-1, -1, 1],
        "(x, -y, -z)": p * [1, -1, -1], "(-x, y, -z)": p * [-1, 1, -1],
    }  # fmt: skip
