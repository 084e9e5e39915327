"""Pose and twist of the tip with their rows of the covariance factor: from the last node, between steps, and after a correction."""

import math

import numpy as np

from ctr_dynamics.kernels.compiled_rotations import conjugate, from_vector, multiply, to_vector
from ctr_dynamics.kernels.compiler import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")
# sums in any order, so that the processor adds several at a time; what is not finite stays so
compiled_sums = njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})


@compiled
def tip_from_node(node, dnode, insertion_rate, mean, columns):
    """Tip from the last node's state (S,) and its rows (S, r): ``mean`` (13,) position, quaternion, velocity, rate; ``columns`` (12, r)."""
    w, x, y, z = node[3], node[4], node[5], node[6]
    norm2 = w * w + x * x + y * y + z * z
    k = 2.0 / norm2
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1 - k * (y * y + z * z), k * (x * y - w * z), k * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = k * (x * y + w * z), 1 - k * (x * x + z * z), k * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = k * (x * z - w * y), k * (y * z + w * x), 1 - k * (x * x + y * y)
    q2 = node[9] + insertion_rate
    norm = np.sqrt(norm2)
    for i in range(3):
        mean[i] = node[i]
        mean[7 + i] = R[i, 0] * node[7] + R[i, 1] * node[8] + R[i, 2] * q2
        mean[10 + i] = R[i, 0] * node[10] + R[i, 1] * node[11] + R[i, 2] * node[12]
    for i in range(4):
        mean[3 + i] = node[3 + i] / norm
    vx, vy, vz, ax, ay, az = mean[7], mean[8], mean[9], mean[10], mean[11], mean[12]
    for c in range(dnode.shape[1]):
        dw, dx, dy, dz = dnode[3, c], dnode[4, c], dnode[5, c], dnode[6, c]
        # rotation vector of dR in base axes: 2 vec(dh h*) / |h|^2
        tx = k * (-x * dw + w * dx - z * dy + y * dz)
        ty = k * (-y * dw + z * dx + w * dy - x * dz)
        tz = k * (-z * dw - y * dx + x * dy + w * dz)
        columns[3, c], columns[4, c], columns[5, c] = tx, ty, tz
        for i in range(3):
            columns[i, c] = dnode[i, c]
            columns[6 + i, c] = R[i, 0] * dnode[7, c] + R[i, 1] * dnode[8, c] + R[i, 2] * dnode[9, c]
            columns[9 + i, c] = R[i, 0] * dnode[10, c] + R[i, 1] * dnode[11, c] + R[i, 2] * dnode[12, c]
        columns[6, c] += ty * vz - tz * vy
        columns[7, c] += tz * vx - tx * vz
        columns[8, c] += tx * vy - ty * vx
        columns[9, c] += ty * az - tz * ay
        columns[10, c] += tz * ax - tx * az
        columns[11, c] += tx * ay - ty * ax


@compiled
def tip_between(a, b, a_columns, b_columns, x, dt, mean, columns):
    """Tip at the fraction ``x`` of the step ``dt`` (s) from tip ``a`` (13,) to ``b``, or a little outside, into ``mean`` (13,); with its columns
    where ``columns`` (12, r) has any.

    Cubic Hermite in position, linear turn on top of the nearer end's rotation.
    """
    w0, w1 = (1 + 2 * x) * (1 - x) ** 2, x * (1 - x) ** 2 * dt
    w2, w3 = x * x * (3 - 2 * x), x * x * (x - 1) * dt
    d0, d1 = 6 * x * (x - 1) / dt, (1 - x) * (1 - 3 * x)
    d2, d3 = 6 * x * (1 - x) / dt, x * (3 * x - 2)
    for i in range(3):
        mean[i] = w0 * a[i] + w1 * a[7 + i] + w2 * b[i] + w3 * b[7 + i]
        mean[7 + i] = d0 * a[i] + d1 * a[7 + i] + d2 * b[i] + d3 * b[7 + i]
        mean[10 + i] = (1 - x) * a[10 + i] + x * b[10 + i]
    turn = to_vector(multiply(b[3:7], conjugate(a[3:7])))
    mean[3:7] = multiply(from_vector(x * turn), a[3:7])
    for c in range(columns.shape[1]):
        for i in range(3):
            p, v, q, u = a_columns[i, c], a_columns[6 + i, c], b_columns[i, c], b_columns[6 + i, c]
            columns[i, c] = w0 * p + w1 * v + w2 * q + w3 * u
            columns[6 + i, c] = d0 * p + d1 * v + d2 * q + d3 * u
            columns[3 + i, c] = (1 - x) * a_columns[3 + i, c] + x * b_columns[3 + i, c]
            columns[9 + i, c] = (1 - x) * a_columns[9 + i, c] + x * b_columns[9 + i, c]


@compiled_sums
def shift_tips(columns, a, means):
    """Move tips ``means`` (tips, 13) by their columns (tips, 12, r) times ``a`` (r,)."""
    d = np.empty(12)
    for tip in range(len(means)):
        for row in range(12):
            total = 0.0
            for c in range(len(a)):
                total += columns[tip, row, c] * a[c]
            d[row] = total
        mean = means[tip]
        for i in range(3):
            mean[i] += d[i]
        for i in range(6):
            mean[7 + i] += d[6 + i]
        # the half turn, made a unit quaternion
        x, y, z = 0.5 * d[3], 0.5 * d[4], 0.5 * d[5]
        w = math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z))
        mean[3:7] = multiply(np.array([w, x, y, z]), mean[3:7])


@compiled
def interpolate_columns(columns, count):
    """Columns (tips, 12, r) of the ``count`` tips before the last, between those of their neighbours."""
    last = len(columns) - 1
    first = last - 1 - count
    for i in range(1, count + 1):
        for row in range(columns.shape[1]):
            for c in range(columns.shape[2]):
                change = columns[last, row, c] - columns[first, row, c]
                columns[first + i, row, c] = columns[first, row, c] + i * (change / (count + 1))
