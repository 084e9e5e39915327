"""What the covariance of the tip gets beside the covariance factor.

See :mod:`ctr_dynamics.estimation.monitoring.twist_error` and :mod:`ctr_dynamics.estimation.inputs.actuator_error`.
"""

import math

import numpy as np

from ctr_dynamics.kernels.compiled_rotations import matrix
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.covariance import covariance_of

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def follow_motion(moments, new, position, velocity):
    """Let a part ``new`` of ``moments`` (5,) be of a ``position`` (3,) and a ``velocity`` (3,): mean position, square of its excursion, and of the
    speed."""
    excursion = speed = 0.0
    for i in range(3):
        away = position[i] - moments[i]
        moments[i] += new * away
        excursion += away * away
        speed += velocity[i] * velocity[i]
    moments[3] += new * (excursion - moments[3])
    moments[4] += new * (speed - moments[4])


@compiled
def motion_square(moments, variance):
    """Square of the angular frequency, 1/s^2, by ``moments`` (5,). An excursion within the position's ``variance`` (m^2) is no motion."""
    return moments[4] / (moments[3] + variance) if moments[4] > 0.0 else 0.0


@compiled
def add_motion_error(moments, rows, pi, covariance):
    """Add to the twist in ``covariance`` (12, 12) what an error of the pose is at the frequency of the motion.

    ``moments`` (5,): of :func:`follow_motion`. ``rows`` (6, r): of the pose, by coefficients of covariance ``pi`` (r, r) or more.
    """
    pose = np.empty((6, 6))
    covariance_of(rows, pi, pose)
    square = motion_square(moments, pose[0, 0] + pose[1, 1] + pose[2, 2])
    for i in range(6):
        for k in range(6):
            covariance[6 + i, 6 + k] += square * pose[i, k]


@compiled
def add_frame_error(rotation, lever, twist, quaternion, covariance):
    """Add to the twist in ``covariance`` (12, 12) what deviations of the registration's ``rotation`` (3,) and of the ``lever`` arm (3,) make.

    ``twist`` (6,), ``quaternion`` (4,) wxyz: of the tip.
    """
    R, errors = matrix(quaternion), np.zeros((6, 6))
    for c in range(3):
        y, z = (c + 1) % 3, (c + 2) % 3
        for part in range(0, 6, 3):  # the twist turned about axis c
            errors[part + y, c] = -twist[part + z] * rotation[c]
            errors[part + z, c] = twist[part + y] * rotation[c]
        for i in range(3):  # the point moved along axis c of the sensor
            j, k = (i + 1) % 3, (i + 2) % 3
            errors[i, 3 + c] = (twist[3 + j] * R[k, c] - twist[3 + k] * R[j, c]) * lever[c]
    for i in range(6):
        for k in range(6):
            total = 0.0
            for c in range(6):
                total += errors[i, c] * errors[k, c]
            covariance[6 + i, 6 + k] += total


@compiled
def add_by_modes(variances, of_one, covariance):
    """Add to ``covariance`` (12, 12) the ``variances`` (m,) of modal coordinates times what each is of one (m, 144)."""
    for mode in range(len(variances)):
        for i in range(12):
            for k in range(12):
                covariance[i, k] += variances[mode] * of_one[mode, 12 * i + k]


@compiled
def add_hidden_vibrations(
    tolerance, told, most, fastest, frequency, amplitude, rate, direction, covariance
):  # fmt: skip
    """Add to ``covariance`` (12, 12) what a linear filter errs by in vibrations whose phases it does not hold for certain.

    ``tolerance``: relative deviation of a frequency; ``told`` (m,): 1/(m^2 s), what poses tell of the phase of a vibration, by the square of its
    amplitude; ``most``: of an unknown phase, by the mean square of the vibration; ``fastest``: Hz, of modes that the steps follow. ``frequency``,
    ``amplitude``, ``rate`` (m,) in Hz, m and m/s and ``direction`` (m, 3) of the modes.
    """
    for mode in range(len(frequency)):
        omega = 2.0 * math.pi * frequency[mode]
        square = amplitude[mode] ** 2 + (rate[mode] / omega) ** 2
        if square == 0.0 or frequency[mode] > fastest:
            continue
        part = most
        if told[mode] > 0.0:
            phase = (6.0 * tolerance * omega / (told[mode] * square)) ** (2.0 / 3.0) / 3.0
            part = min(0.75 * phase**2, most)
        variance = 0.5 * square * part
        for i in range(3):
            for k in range(3):
                along = variance * direction[mode, i] * direction[mode, k]
                covariance[i, k] += along
                covariance[6 + i, 6 + k] += omega**2 * along


@compiled
def add_actuator_error(error, length, actuators, position, duration, covariance):
    """Add to ``covariance`` (12, 12) what deviations ``error`` (2 N,) of the ``actuators`` (2 N,) make, in a ``duration`` (s) for the twist.

    ``length``: m, of tube 1; ``position`` (3,): of the tip. Returns the variance of a position, m^2 per axis.
    """
    n = len(error) // 2
    turned = moved = 0.0
    for i in range(n):
        turned += error[i] ** 2
        moved += error[n + i] ** 2
    if turned + moved == 0.0:
        return 0.0
    arm = max(0.5 * (length + actuators[n]), math.hypot(position[0], position[1]))
    moved += arm**2 * turned
    for i in range(6):
        variance = moved if i < 3 else turned
        covariance[i, i] += variance
        covariance[6 + i, 6 + i] += variance * (2.0 / duration) ** 2
    return moved
