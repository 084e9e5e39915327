"""Numba kernels of the tracker: a measurement against the tip, its sensitivities, and the tip as the tracker realises it."""

import math

import numpy as np

from ctr_dynamics.kernels.compiled_rotations import (
    applied,
    conjugate,
    from_vector,
    matrix,
    multiply,
    to_vector,
)
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.covariance import covariance_of

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def registration_error(rotation, bias):
    """Estimated error of the registration in base axes: quaternion (4,) and shift (3,) m, from the nominal ``rotation`` (4,) and the tracker states
    ``bias`` (22,); and the registration's inverse (3, 3)."""
    back = matrix(conjugate(rotation))
    return from_vector(applied(back, bias[0:3])), applied(back, bias[3:6]), back


@compiled
def registered_pose(mean, rotation, lever, bias, pose):
    """Fill ``pose`` (7,) with that of :func:`ctr_dynamics.sensing.tracker.TrackerModel.registered`.

    ``mean`` (13,): the tip; ``rotation`` (4,), ``lever`` (3,): nominal geometry; ``bias`` (22,): tracker states. Returns the rotation of the
    tip, that of the registration's estimated error in base axes, and the registration's inverse, (3, 3) each.
    """
    turn, shift, N = registration_error(rotation, bias)
    R, C = matrix(mean[3:7]), matrix(turn)
    pose[3:7] = multiply(turn, multiply(from_vector(bias[12:15]), mean[3:7]))
    point = mean[0:3] + applied(R, lever + bias[6:9]) + bias[9:12]
    pose[0:3] = applied(C, point) + shift - applied(matrix(pose[3:7]), lever)
    return R, C, N


@compiled
def fused_tip(mean, columns, rotation, lever, bias, pi, force_rows, pose, covariance, sigma):
    """Pose (7,) of :func:`registered_pose` and the covariance (12, 12) of pose and twist (base axes) under ``pi`` (r + 22, r + 22).

    ``columns`` (12, r): of the tip; ``force_rows`` (3, r): of the tip force. ``sigma`` (3,): written, that force's deviations. Returns whether all
    is finite.
    """
    r = columns.shape[1]
    size = r + 15  # delay, drift and shift are left out
    R, C, N = registered_pose(mean, rotation, lever, bias, pose)
    arm = applied(R, bias[6:9])  # extra arm beyond the nominal lever moves the pose when the tip turns
    armx, army, armz = arm[0], arm[1], arm[2]
    nominal = applied(R, lever)  # taken off with the rotation of the pose, in which the model's error is
    J = np.zeros((15, size))
    for i in range(3):
        x, y, z = C[i, 0], C[i, 1], C[i, 2]
        for c in range(r):
            ax, ay, az = columns[3, c], columns[4, c], columns[5, c]
            dx = columns[0, c] + ay * armz - az * army
            dy = columns[1, c] + az * armx - ax * armz
            dz = columns[2, c] + ax * army - ay * armx
            J[i, c] = x * dx + y * dy + z * dz
            J[3 + i, c] = x * ax + y * ay + z * az
        J[6 + i, :r], J[9 + i, :r], J[12 + i, :r] = columns[6 + i], columns[9 + i], force_rows[i]
    for c in range(3):
        nx, ny, nz = N[0, c], N[1, c], N[2, c]
        J[0, r + c] = ny * pose[2] - nz * pose[1]
        J[1, r + c] = nz * pose[0] - nx * pose[2]
        J[2, r + c] = nx * pose[1] - ny * pose[0]
        for i in range(3):
            J[3 + i, r + c] = N[i, c]
            J[i, r + 3 + c] = N[i, c]
            J[i, r + 6 + c] = C[i, 0] * R[0, c] + C[i, 1] * R[1, c] + C[i, 2] * R[2, c]
            J[i, r + 9 + c] = C[i, c]
            J[3 + i, r + 12 + c] = C[i, c]
            J[i, r + 12 + c] = (
                C[i, (c + 1) % 3] * nominal[(c + 2) % 3] - C[i, (c + 2) % 3] * nominal[(c + 1) % 3]
            )
    whole = np.empty((15, 15))
    covariance_of(J, pi, whole)
    covariance[:] = whole[:12, :12]
    total = 0.0
    for i in range(3):
        sigma[i] = math.sqrt(max(whole[12 + i, 12 + i], 0.0))
    for i in range(15):
        for n in range(15):
            total += whole[i, n]
    for i in range(7):
        total += pose[i]
    return math.isfinite(total)


@compiled
def expected_measurement(mean, rotation, translation, lever, bias):
    """(7,) position and quaternion that a tip and tracker states predict."""
    registration = multiply(from_vector(bias[0:3]), rotation)
    point = mean[0:3] + applied(matrix(mean[3:7]), lever + bias[6:9]) + bias[9:12]
    pose = np.empty(7)
    pose[0:3] = applied(matrix(registration), point) + translation + bias[3:6] + bias[16:19] + bias[19:22]
    pose[3:7] = multiply(registration, multiply(from_vector(bias[12:15]), mean[3:7]))
    return pose


@compiled
def pose_difference(position, quaternion, expected_position, expected_quaternion, free):
    """(6,) measurement minus expectation: position, then rotation vector in the sensor's axes, without the turn about the axis ``free``, 1 to 3, if
    not 0."""
    turned = multiply(conjugate(expected_quaternion), quaternion)
    if free:
        size = turned[0] ** 2 + turned[free] ** 2
        if size > 1e-12:
            twist = np.zeros(4)
            twist[0], twist[free] = turned[0] / math.sqrt(size), -turned[free] / math.sqrt(size)
            turned = multiply(turned, twist)
    difference = np.empty(6)
    difference[0:3] = position - expected_position
    difference[3:6] = to_vector(turned)
    return difference


@compiled
def pose_in_base(position, quaternion, rotation, translation, lever):
    """(7,) tip pose of :meth:`ctr_dynamics.sensing.tracker.TrackerModel.to_base`."""
    back = conjugate(rotation)
    pose = np.empty(7)
    pose[3:7] = multiply(back, quaternion)
    pose[0:3] = applied(matrix(back), position - translation) - applied(matrix(pose[3:7]), lever)
    return pose


@compiled
def sensitivity_rows(mean, columns, rotation, lever, bias, H):
    """Derivative H (6, r + 22) of the expected measurement; see :func:`ctr_dynamics.sensing.tracker.TrackerModel.innovation`."""
    r = columns.shape[1]
    R, Q = matrix(mean[3:7]), matrix(multiply(from_vector(bias[0:3]), rotation))
    position, velocity, rate = mean[0:3], mean[7:10], mean[10:13]
    arm = applied(R, lever + bias[6:9])
    d = np.empty(3)
    for c in range(r):
        tx, ty, tz = columns[3, c], columns[4, c], columns[5, c]
        d[0] = columns[0, c] + ty * arm[2] - tz * arm[1]
        d[1] = columns[1, c] + tz * arm[0] - tx * arm[2]
        d[2] = columns[2, c] + tx * arm[1] - ty * arm[0]
        for i in range(3):
            H[i, c] = Q[i, 0] * d[0] + Q[i, 1] * d[1] + Q[i, 2] * d[2]
            H[3 + i, c] = R[0, i] * tx + R[1, i] * ty + R[2, i] * tz
    H[:, r:] = 0.0
    px, py, pz = applied(Q, position + arm + bias[9:12])
    for i in range(3):
        for k in range(3):
            H[3 + i, r + k] = R[0, i] * Q[k, 0] + R[1, i] * Q[k, 1] + R[2, i] * Q[k, 2]
            H[i, r + 6 + k] = Q[i, 0] * R[0, k] + Q[i, 1] * R[1, k] + Q[i, 2] * R[2, k]
            H[i, r + 9 + k] = Q[i, k]
            H[3 + i, r + 12 + k] = R[k, i]
        H[i, r + 3 + i] = 1.0
        H[i, r + 16 + i] = 1.0
        H[i, r + 19 + i] = 1.0
        d[i] = velocity[i] + rate[(i + 1) % 3] * arm[(i + 2) % 3] - rate[(i + 2) % 3] * arm[(i + 1) % 3]
    H[0, r + 1], H[0, r + 2] = pz, -py
    H[1, r], H[1, r + 2] = -pz, px
    H[2, r], H[2, r + 1] = py, -px
    for i in range(3):
        H[i, r + 15] = -(Q[i, 0] * d[0] + Q[i, 1] * d[1] + Q[i, 2] * d[2])
        H[3 + i, r + 15] = -(R[0, i] * rate[0] + R[1, i] * rate[1] + R[2, i] * rate[2])


@compiled
def innovation_rows(
    position,
    quaternion,
    mean,
    columns,
    rotation,
    translation,
    lever,
    bias,
    free,
    measured,
    variance,
    pi,
    nu,
    H,
    S,
):
    """Fill ``nu``, ``H`` and ``S`` of :meth:`ctr_dynamics.sensing.tracker.TrackerModel.innovation` on the axes ``measured`` (k,).

    Returns the whitened innovation (k,).
    """
    pose = expected_measurement(mean, rotation, translation, lever, bias)
    difference = pose_difference(position, quaternion, pose[0:3], pose[3:7], free)
    whole = np.empty((6, len(pi)))
    sensitivity_rows(mean, columns, rotation, lever, bias, whole)
    size = len(measured)
    for i in range(size):
        nu[i], H[i] = difference[measured[i]], whole[measured[i]]
    covariance_of(H, pi, S)
    for i in range(size):
        S[i, i] += variance[measured[i]]
    root, white = np.zeros((size, size)), np.empty(size)
    for i in range(size):
        for k in range(i + 1):
            entry = S[i, k]
            for q in range(k):
                entry -= root[i, q] * root[k, q]
            root[i, k] = entry / root[k, k] if k < i else math.sqrt(entry)
        white[i] = nu[i]
        for k in range(i):
            white[i] -= root[i, k] * white[k]
        white[i] /= root[i, i]
    return white
