"""Synthetic streams for the tests of the input checks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ctr_dynamics.sensing.checks import InputChecks, JointChecks, Verdict

T0 = 1_700_000_000_000_000_000  # ns
PERIOD = 10_000_000  # ns between joint states
POSE_PERIOD = 25_000_000  # ns between poses
BETA = (-0.2521, -0.1977)  # m, of the tissue robot


def ns(seconds: float) -> int:
    return T0 + round(seconds * 1e9)


def sweep(t: float) -> tuple[float, float]:
    """Rotations (rad) in motion at up to 6 rad/s."""
    return 1.5 + 0.8 * math.sin(7.0 * t), 1.2 + 0.4 * math.cos(5.0 * t)


def still(t: float) -> tuple[float, float]:
    return 1.5, 1.2


def encoder_noise(seed: int = 0) -> Callable[[], float]:
    """Uniform within 0.02 deg, as the encoders of the shipped bags."""
    rng = np.random.default_rng(seed)
    return lambda: float(rng.uniform(-3.5e-4, 3.5e-4))


Row = tuple[int, int | None, tuple[float, ...], tuple[float, ...]]


def joint_rows(count: int, motion: Callable[[float], Sequence[float]] = sweep, start: int = 0) -> list[Row]:
    """(stamp, arrival, rotations, translations) at 100 Hz with encoder noise."""
    noise = encoder_noise()
    rows: list[Row] = []
    for k in range(start, start + count):
        stamp = T0 + k * PERIOD
        rotations = tuple(a + noise() for a in motion(k * PERIOD * 1e-9))
        rows.append((stamp, stamp + 300_000, rotations, BETA))
    return rows


def feed_joints(checks: JointChecks | InputChecks, rows: Iterable[Row]) -> list[Verdict]:
    take = checks.joint_state if isinstance(checks, InputChecks) else checks.check
    return [take(*row) for row in rows]


class PoseStream:
    """Poses of a tip that swings, with white noise: positions in m, quaternions x, y, z, w."""

    def __init__(self, noise_m: float = 3.5e-4, noise_rad: float = 5e-3, seed: int = 1) -> None:
        self.noise_m, self.noise_rad = noise_m, noise_rad
        self.rng = np.random.default_rng(seed)

    def truth(self, t: float) -> tuple[np.ndarray, np.ndarray]:
        """Position and quaternion w, x, y, z."""
        position = np.array([0.02 * math.sin(9.0 * t), 0.03 + 0.01 * math.cos(9.0 * t), 0.125])
        angle = 0.8 + 0.3 * math.sin(9.0 * t)
        return position, np.array([math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0])

    def pose(self, t: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
        position, (w, x, y, z) = self.truth(t)
        turn = 0.5 * self.noise_rad * self.rng.standard_normal(3)
        quaternion = np.array([x, y, z, w]) + np.array([*(w * turn), 0.0])
        quaternion /= np.linalg.norm(quaternion)
        return (
            tuple(float(v) for v in position + self.noise_m * self.rng.standard_normal(3)),
            tuple(float(v) for v in quaternion),
        )
