"""The tracker's measurement: registration, lever arm, delay and drift between the model's tip and a reported pose (docs/ekf.md).

reading = R_reg (p + R lever) + t_reg + drift, R_reading = R_reg R, both of the time stamp - delay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctr_dynamics.robot import Robot

from .rotations import conjugate, from_vector, matrix, multiply, skew, to_vector
from .tip import Tip

Floats = NDArray[np.float64]

ROTATION, TRANSLATION, LEVER, DELAY, DRIFT = slice(0, 3), slice(3, 6), slice(6, 9), 9, slice(10, 13)
STATES = 13


@dataclass(frozen=True)
class TrackerModel:
    """Nominal geometry and noise of the tracker.

    Attributes:
        rotation: (4,) wxyz of R_reg; translation: (3,) m; lever: (3,) m in the tip frame; delay: s, > 0 when a pose is older than its stamp.
        mask: (6,) measured axes: position x, y, z in the tracker's frame, then rotation about the sensor's x, y, z.
        variance: (6,) white noise.
    """

    rotation: Floats
    translation: Floats
    lever: Floats
    delay: float
    mask: NDArray[np.bool_]
    variance: Floats

    def to_base(self, position: Floats, quaternion: Floats) -> tuple[Floats, Floats]:
        """Reading as a tip pose in ``ctr_base`` with the nominal geometry."""
        q = multiply(conjugate(self.rotation), quaternion)
        return matrix(conjugate(self.rotation)) @ (position - self.translation) - matrix(q) @ self.lever, q


def tracker_model(
    robot: Robot,
    *,
    delay: float = 0.0,
    lever: Floats | None = None,
    rotation: Floats | None = None,
    translation: Floats | None = None,
    mask: tuple[bool, ...] = (True,) * 6,
) -> TrackerModel:
    """Tracker of ``robot`` with corrections: ``delay`` (s) and ``lever`` (3,) m are added, ``rotation`` (3,) rad and ``translation`` (3,) m composed."""
    t = robot.tracker
    own_rotation, own_translation = from_vector(np.array(t.registration_rotation.value)), np.array(t.registration_translation.value)
    extra = from_vector(np.zeros(3) if rotation is None else np.asarray(rotation, float))
    shift = np.zeros(3) if translation is None else np.asarray(translation, float)
    return TrackerModel(
        rotation=multiply(extra, own_rotation),
        translation=matrix(extra) @ own_translation + shift,
        lever=np.array(t.lever_arm.value) + (np.zeros(3) if lever is None else np.asarray(lever, float)),
        delay=t.delay.value + delay,
        mask=np.array(mask, dtype=bool),
        variance=np.array([t.noise.position.value**2] * 3 + [t.noise.rotation.value**2] * 3),
    )


def expected(model: TrackerModel, bias: Floats, tip: Tip) -> tuple[Floats, Floats]:
    """Reading (position (3,) m, quaternion (4,) wxyz) that the tip and the tracker states (13,) predict."""
    R = matrix(tip.quaternion)
    registration = multiply(from_vector(bias[ROTATION]), model.rotation)
    position = matrix(registration) @ (tip.position + R @ (model.lever + bias[LEVER])) + model.translation + bias[TRANSLATION]
    return position + bias[DRIFT], multiply(registration, tip.quaternion)


def residual(position: Floats, quaternion: Floats, expected_position: Floats, expected_quaternion: Floats) -> Floats:
    """(6,) reading minus expectation: position in the tracker's axes, rotation vector in the sensor's axes."""
    turn = to_vector(multiply(conjugate(expected_quaternion), quaternion))
    return np.concatenate([position - expected_position, turn])


def sensitivity(model: TrackerModel, bias: Floats, tip: Tip) -> Floats:
    """H (6, r + 13): derivative of the expected reading by the columns' coefficients and the tracker states."""
    r = tip.columns.shape[1]
    R = matrix(tip.quaternion)
    Q = matrix(multiply(from_vector(bias[ROTATION]), model.rotation))
    arm = R @ (model.lever + bias[LEVER])
    H = np.zeros((6, r + STATES))
    H[0:3, :r] = Q @ (tip.columns[0:3] - skew(arm) @ tip.columns[3:6])
    H[3:6, :r] = R.T @ tip.columns[3:6]
    b = H[:, r:]
    b[0:3, ROTATION] = -skew(Q @ (tip.position + arm))
    b[3:6, ROTATION] = R.T @ Q.T
    b[0:3, TRANSLATION] = np.eye(3)
    b[0:3, LEVER] = Q @ R
    b[0:3, DELAY] = -Q @ (tip.velocity + np.cross(tip.rate, arm))
    b[3:6, DELAY] = -R.T @ tip.rate
    b[0:3, DRIFT] = np.eye(3)
    return H


def registered(model: TrackerModel, bias: Floats, tip: Tip) -> Floats:
    """(7,) tip pose in ``ctr_base`` as the tracker realises it: position in m, quaternion wxyz.

    The base frame of a real robot is known through its registration only, so the estimated registration and lever-arm errors are part of the
    pose: it is where a perfect tracker with the nominal geometry would see the tip. Drift and delay are left out.
    """
    mean = np.concatenate([tip.position, tip.quaternion, tip.velocity, tip.rate])
    r = tip.columns.shape[1]
    pose = np.empty(7)
    registered_rows(mean, tip.columns, model.rotation, model.lever, bias, np.zeros((r + STATES, r + STATES)), pose, np.empty((12, 12)))
    return pose


@njit(cache=True, nogil=True, error_model="numpy")
def _matrix(w, x, y, z):
    R = np.empty((3, 3))
    k = 2.0 / (w * w + x * x + y * y + z * z)
    R[0, 0], R[0, 1], R[0, 2] = 1 - k * (y * y + z * z), k * (x * y - w * z), k * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = k * (x * y + w * z), 1 - k * (x * x + z * z), k * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = k * (x * z - w * y), k * (y * z + w * x), 1 - k * (x * x + y * y)
    return R


@njit(cache=True, nogil=True, error_model="numpy")
def registered_rows(mean, columns, rotation, lever, bias, pi, pose, covariance):
    """Pose (7,) of :func:`registered` and the covariance (12, 12) of pose and twist (base axes) under ``pi`` (r + 13, r + 13).

    ``mean`` (13,), ``columns`` (12, r): the tip; ``rotation`` (4,), ``lever`` (3,): nominal geometry; ``bias`` (13,): tracker states.
    Returns False if anything is not finite.
    """
    r = columns.shape[1]
    size = r + 13
    R = _matrix(mean[3], mean[4], mean[5], mean[6])
    N = _matrix(rotation[0], -rotation[1], -rotation[2], -rotation[3])  # R_reg^T
    # estimated registration error seen in base axes, as a rotation vector
    e = np.empty(3)
    for i in range(3):
        e[i] = N[i, 0] * bias[0] + N[i, 1] * bias[1] + N[i, 2] * bias[2]
    angle = np.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    k = 0.5 * np.sin(0.5 * angle) / (0.5 * angle) if angle > 1e-8 else 0.5
    tw, tx, ty, tz = np.cos(0.5 * angle), k * e[0], k * e[1], k * e[2]
    C = _matrix(tw, tx, ty, tz)
    w, x, y, z = mean[3], mean[4], mean[5], mean[6]
    pose[3] = tw * w - tx * x - ty * y - tz * z
    pose[4] = tw * x + tx * w + ty * z - tz * y
    pose[5] = tw * y - tx * z + ty * w + tz * x
    pose[6] = tw * z + tx * y - ty * x + tz * w
    Q = _matrix(pose[3], pose[4], pose[5], pose[6])
    point, arm = np.empty(3), np.empty(3)
    for i in range(3):
        arm[i] = R[i, 0] * (lever[0] + bias[6]) + R[i, 1] * (lever[1] + bias[7]) + R[i, 2] * (lever[2] + bias[8])
    for i in range(3):
        point[i] = mean[i] + arm[i]
    for i in range(3):
        pose[i] = (
            C[i, 0] * point[0] + C[i, 1] * point[1] + C[i, 2] * point[2]
            + N[i, 0] * bias[3] + N[i, 1] * bias[4] + N[i, 2] * bias[5]
            - Q[i, 0] * lever[0] - Q[i, 1] * lever[1] - Q[i, 2] * lever[2]
        )  # fmt: skip
    # extra arm beyond the nominal lever moves the pose when the tip turns
    for i in range(3):
        arm[i] = R[i, 0] * bias[6] + R[i, 1] * bias[7] + R[i, 2] * bias[8]
    J = np.zeros((12, size))
    for c in range(r):
        ax, ay, az = columns[3, c], columns[4, c], columns[5, c]
        dx = columns[0, c] + ay * arm[2] - az * arm[1]
        dy = columns[1, c] + az * arm[0] - ax * arm[2]
        dz = columns[2, c] + ax * arm[1] - ay * arm[0]
        for i in range(3):
            J[i, c] = C[i, 0] * dx + C[i, 1] * dy + C[i, 2] * dz
            J[3 + i, c] = C[i, 0] * ax + C[i, 1] * ay + C[i, 2] * az
            J[6 + i, c] = columns[6 + i, c]
            J[9 + i, c] = columns[9 + i, c]
    for c in range(3):
        nx, ny, nz = N[0, c], N[1, c], N[2, c]
        J[0, r + c] = ny * pose[2] - nz * pose[1]
        J[1, r + c] = nz * pose[0] - nx * pose[2]
        J[2, r + c] = nx * pose[1] - ny * pose[0]
        for i in range(3):
            J[3 + i, r + c] = N[i, c]
            J[i, r + 3 + c] = N[i, c]
            J[i, r + 6 + c] = C[i, 0] * R[0, c] + C[i, 1] * R[1, c] + C[i, 2] * R[2, c]
    half = np.empty(size)
    total = 0.0
    for i in range(12):
        for q in range(size):
            value = 0.0
            for p in range(size):
                value += J[i, p] * pi[p, q]
            half[q] = value
        for n in range(i + 1):
            value = 0.0
            for q in range(size):
                value += half[q] * J[n, q]
            covariance[i, n] = value
            covariance[n, i] = value
            total += value
    for i in range(7):
        total += pose[i]
    return np.isfinite(total)
