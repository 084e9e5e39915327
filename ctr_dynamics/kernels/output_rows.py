"""Rows of the outputs: amplitudes of the vibration modes, the published backbone, and the Jacobian of a robot that has turned."""

import math

import numpy as np

from ctr_dynamics.kernels.compiled_rotations import matrix
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import field_rows
from ctr_dynamics.kernels.tracker_measurement import registration_error

compiled = njit(cache=True, nogil=True, error_model="numpy")
# sums in any order, so that the processor adds several at a time; what is not finite stays so
compiled_sums = njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})


@compiled_sums
def modal_coordinates(by_fields, fields, at_rest, by_inputs, inputs, by_rates, rates, values):
    """Amplitudes and rates of modes into ``values`` (2m,): ``by_fields`` (2m, fields) times the ``fields``, less what the equilibrium has at the
    inputs and by their rates. ``inputs``, ``rates``: of alpha, beta, force and torque."""
    for i in range(len(values)):
        total = -at_rest[i]
        for k in range(len(fields)):
            total += by_fields[i, k] * fields[k]
        column = 0
        for p in range(len(inputs)):
            part, rate = inputs[p], rates[p]
            for k in range(len(part)):
                total -= by_inputs[i, column] * part[k] + by_rates[i, column] * rate[k]
                column += 1
        values[i] = total


@compiled
def backbone_rows(s, nodes, fields, points, n, insertion_rate, rotation, bias, deviation, rows):
    """Fill ``rows`` (P, 15) float32: s, x, y, z, qx, qy, qz, qw, vx, vy, vz, ux, uy, uz, sd.

    ``nodes`` (P, S) states; ``fields`` (fields,) with ``points`` (P,) the point of each node; ``rotation`` (4,) nominal registration, ``bias``
    (22,) tracker states; ``deviation`` (P,) m, the position's per axis (root of the third of its covariance's trace).
    """
    F = field_rows(n).size
    quaternion, shift, _ = registration_error(rotation, bias)
    turn = matrix(quaternion)
    for i in range(len(nodes)):
        a, b, c, d = nodes[i, 3], nodes[i, 4], nodes[i, 5], nodes[i, 6]
        norm = math.sqrt(a * a + b * b + c * c + d * d)
        a, b, c, d = a / norm, b / norm, c / norm, d / norm
        r00, r01, r02 = 1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)
        r10, r11, r12 = 2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)
        r20, r21, r22 = 2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)
        qx, qy, qz = nodes[i, 7], nodes[i, 8], nodes[i, 9] + insertion_rate
        x, y, z = nodes[i, 0], nodes[i, 1], nodes[i, 2]
        rows[i, 0] = s[i]
        for k in range(3):
            rows[i, 1 + k] = turn[k, 0] * x + turn[k, 1] * y + turn[k, 2] * z + shift[k]
        # the registration's rotation is a fraction of a degree: q_turn h to first order, normalised
        ex, ey, ez = 0.5 * turn[2, 1], 0.5 * turn[0, 2], 0.5 * turn[1, 0]
        w = a - ex * b - ey * c - ez * d
        rows[i, 4] = b + ex * a + ey * d - ez * c
        rows[i, 5] = c + ey * a + ez * b - ex * d
        rows[i, 6] = d + ez * a + ex * c - ey * b
        rows[i, 7] = w
        scale = 1.0 / math.sqrt(1.0 + ex * ex + ey * ey + ez * ez)
        for k in range(4, 8):
            rows[i, k] *= scale
        rows[i, 8] = r00 * qx + r01 * qy + r02 * qz
        rows[i, 9] = r10 * qx + r11 * qy + r12 * qz
        rows[i, 10] = r20 * qx + r21 * qy + r22 * qz
        base = points[i] * F
        for k in range(3):
            rows[i, 11 + k] = fields[base + 6 + k]
        rows[i, 14] = deviation[i]


@compiled
def turned(jacobian, angle):
    """The tip's ``jacobian`` (6, 2N + 6) of a robot whose tubes have all turned by ``angle`` (rad) about the base's z axis, with their load.

    Rows are position and rotation, the last columns force and torque: these turn. Tubes' own rotations and translations do not.
    """
    c, s = math.cos(angle), math.sin(angle)
    rows, columns = jacobian.shape
    result = np.empty((rows, columns))
    for i in range(0, rows, 3):
        for k in range(columns):
            x, y = jacobian[i, k], jacobian[i + 1, k]
            result[i, k], result[i + 1, k], result[i + 2, k] = (
                c * x - s * y,
                s * x + c * y,
                jacobian[i + 2, k],
            )
    for k in range(columns - 6, columns, 3):
        for i in range(rows):
            x, y = result[i, k], result[i, k + 1]
            result[i, k], result[i, k + 1] = c * x - s * y, s * x + c * y
    return result
