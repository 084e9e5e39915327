"""Numba kernels of the filter's outputs: tip with its columns, registered pose with covariance, backbone rows."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def tip_rows(node, dnode, insertion_rate, mean, columns):
    """Tip from the last node's state (S,) and its columns (S, r): ``mean`` (13,) position, quaternion, velocity, rate; ``columns`` (12, r)."""
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
        arm[i] = (
            R[i, 0] * (lever[0] + bias[6]) + R[i, 1] * (lever[1] + bias[7]) + R[i, 2] * (lever[2] + bias[8])
        )
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


@njit(cache=True, nogil=True, error_model="numpy")
def backbone_rows(s, nodes, fields, points, n, insertion_rate, turn, shift, deviation, rows):
    """Fill ``rows`` (P, 15) float32: s, x, y, z, qx, qy, qz, qw, vx, vy, vz, ux, uy, uz, sd.

    ``nodes`` (P, S) states; ``fields`` (fields,) with ``points`` (P,) the point of each node; ``turn`` (3, 3) and ``shift`` (3,) the estimated
    registration; ``deviation`` (P,) m, the position's per axis (root of the third of its covariance's trace).
    """
    F = 7 + 2 * n
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


@njit(cache=True, nogil=True, error_model="numpy")
def sparse_product(indptr, indices, data, vector):
    """Product (rows,) of a matrix in compressed rows with ``vector`` (columns,)."""
    result = np.empty(len(indptr) - 1)
    for row in range(len(result)):
        total = 0.0
        for k in range(indptr[row], indptr[row + 1]):
            total += data[k] * vector[indices[k]]
        result[row] = total
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def position_deviations(dnodes, size, pi):
    """(nodes,) deviation of the position per axis in m: root of a third of the trace of its covariance under ``pi`` (r, r).

    ``dnodes`` (nodes * size, r): columns of the node states, position first.
    """
    nodes, r = len(dnodes) // size, len(pi)
    result = np.empty(nodes)
    product = np.empty(r)
    for node in range(nodes):
        total = 0.0
        for axis in range(3):
            row = dnodes[node * size + axis]
            product[:] = 0.0
            for i in range(r):
                x = row[i]
                for k in range(r):
                    product[k] += x * pi[i, k]
            for k in range(r):
                total += product[k] * row[k]
        result[node] = math.sqrt(max(total, 0.0) / 3.0)
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def blend_columns(a, b, w, d, x, columns):
    """Columns (12, r) between two tips with columns ``a``, ``b``: Hermite weights ``w`` (4,) of the position and ``d`` (4,) of its rate, and the
    fraction ``x`` of the step for rotation and angular velocity."""
    for c in range(a.shape[1]):
        for i in range(3):
            columns[i, c] = w[0] * a[i, c] + w[1] * a[6 + i, c] + w[2] * b[i, c] + w[3] * b[6 + i, c]
            columns[6 + i, c] = d[0] * a[i, c] + d[1] * a[6 + i, c] + d[2] * b[i, c] + d[3] * b[6 + i, c]
            columns[3 + i, c] = (1 - x) * a[3 + i, c] + x * b[3 + i, c]
            columns[9 + i, c] = (1 - x) * a[9 + i, c] + x * b[9 + i, c]


@njit(cache=True, nogil=True, error_model="numpy")
def sensitivity_rows(R, Q, lever, position, velocity, rate, columns, H):
    """Derivative H (6, r + 13) of the expected reading; see :func:`ctr_dynamics.estimation.tracker.sensitivity`.

    ``R``, ``Q`` (3, 3): rotations of the tip and of the registration, errors included; ``lever`` (3,) m with its error, tip frame.
    """
    r = columns.shape[1]
    arm = np.empty(3)
    for i in range(3):
        arm[i] = R[i, 0] * lever[0] + R[i, 1] * lever[1] + R[i, 2] * lever[2]
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
    for i in range(3):
        px = (
            Q[0, 0] * (position[0] + arm[0])
            + Q[0, 1] * (position[1] + arm[1])
            + Q[0, 2] * (position[2] + arm[2])
        )
        py = (
            Q[1, 0] * (position[0] + arm[0])
            + Q[1, 1] * (position[1] + arm[1])
            + Q[1, 2] * (position[2] + arm[2])
        )
        pz = (
            Q[2, 0] * (position[0] + arm[0])
            + Q[2, 1] * (position[1] + arm[1])
            + Q[2, 2] * (position[2] + arm[2])
        )
        for k in range(3):
            H[3 + i, r + k] = R[0, i] * Q[k, 0] + R[1, i] * Q[k, 1] + R[2, i] * Q[k, 2]
            H[i, r + 6 + k] = Q[i, 0] * R[0, k] + Q[i, 1] * R[1, k] + Q[i, 2] * R[2, k]
        H[i, r + 3 + i] = 1.0
        H[i, r + 10 + i] = 1.0
        d[i] = velocity[i] + rate[(i + 1) % 3] * arm[(i + 2) % 3] - rate[(i + 2) % 3] * arm[(i + 1) % 3]
    H[0, r + 1], H[0, r + 2] = pz, -py
    H[1, r], H[1, r + 2] = -pz, px
    H[2, r], H[2, r + 1] = py, -px
    for i in range(3):
        H[i, r + 9] = -(Q[i, 0] * d[0] + Q[i, 1] * d[1] + Q[i, 2] * d[2])
        H[3 + i, r + 9] = -(R[0, i] * rate[0] + R[1, i] * rate[1] + R[2, i] * rate[2])
