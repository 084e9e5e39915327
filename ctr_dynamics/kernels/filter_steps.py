"""Numba kernels of the filter: inputs of the stages, tips with their columns, corrections, variances, and rows of the outputs."""

import math

import numpy as np

from ctr_dynamics.kernels import rotations
from ctr_dynamics.kernels.compiler import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")
# sums in any order, so that the processor adds several at a time; what is not finite stays so
compiled_sums = njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
matrix, multiply, conjugate = map(compiled, (rotations.matrix, rotations.multiply, rotations.conjugate))
from_vector, to_vector = map(compiled, (rotations.from_vector, rotations.to_vector))


@compiled
def applied(A, v):
    """Product (3,) of a matrix (3, 3) and a vector (3,)."""
    result = np.empty(3)
    for i in range(3):
        result[i] = A[i, 0] * v[0] + A[i, 1] * v[1] + A[i, 2] * v[2]
    return result


@compiled
def registration_error(rotation, bias):
    """Estimated error of the registration in base axes: quaternion (4,) and shift (3,) m, from the nominal ``rotation`` (4,) and the tracker states
    ``bias`` (13,); and the registration's inverse (3, 3)."""
    back = matrix(conjugate(rotation))
    return from_vector(applied(back, bias[0:3])), applied(back, bias[3:6]), back


@compiled
def on_lines(samples, time_ns, value, rate):
    """``value`` (size,) and its ``rate``, 1/s, at a time on the lines through three ``samples``: values, then stamps in ns. At the middle one the
    rate is that of the first line."""
    before, middle, after, before_ns, middle_ns, after_ns = samples
    first = time_ns <= middle_ns
    begin, end = (before, middle) if first else (middle, after)
    begin_ns, end_ns = (before_ns, middle_ns) if first else (middle_ns, after_ns)
    for i in range(len(value)):
        rate[i] = (end[i] - begin[i]) * (1e9 / (end_ns - begin_ns))
        value[i] = begin[i] + rate[i] * ((time_ns - begin_ns) * 1e-9)


@compiled
def stage_rows(times, t0_ns, joints, load, rows, beta_rate):
    """Fill ``rows`` (stages, inputs) and ``beta_rate`` (N,) as ``Signals.rows`` of :mod:`ctr_dynamics.estimation.inputs.actuation` gives them, from
    the samples around ``times`` (s after ``t0_ns``); see :func:`on_lines`."""
    n = len(beta_rate)
    value, rate = np.empty(2 * n), np.empty(2 * n)
    wrench, change = np.empty(6), np.empty(6)
    for k in range(len(times)):
        time_ns = t0_ns + np.int64(np.rint(times[k] * 1e9))
        on_lines(joints, time_ns, value, rate)
        on_lines(load, time_ns, wrench, change)
        for i in range(n):
            rows[k, i], rows[k, n + i], rows[k, 2 * n + i] = value[i], rate[i], value[n + i]
        for i in range(6):
            rows[k, 3 * n + i] = wrench[i]
        for i in range(rows.shape[1] - 3 * n - 6):
            rows[k, 3 * n + 6 + i] = rate[n + i]
    beta_rate[:] = rate[n:]


@compiled
def corrected_rows(bare, load, effect, theta):
    """(stages, inputs) rows ``bare`` with the ``load`` (inputs,) and what the parameters ``theta`` (p,) add by their ``effect`` (inputs, p)."""
    rows = np.empty_like(bare)
    for i in range(bare.shape[1]):
        shift = load[i]
        for k in range(len(theta)):
            shift += effect[i, k] * theta[k]
        for stage in range(len(bare)):
            rows[stage, i] = bare[stage, i] + shift
    return rows


@compiled
def fade(decay, theta, rows):
    """Multiply ``theta`` (p,) and its columns ``rows`` (p, r) by ``decay``, in place."""
    for i in range(len(theta)):
        theta[i] *= decay
        for k in range(rows.shape[1]):
            rows[i, k] *= decay


@compiled
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


@compiled
def sparse_product(indptr, indices, data, columns):
    """Product (rows, k) of a matrix in compressed rows with ``columns`` (columns, k)."""
    result = np.zeros((len(indptr) - 1, columns.shape[1]))
    for row in range(len(result)):
        for place in range(indptr[row], indptr[row + 1]):
            for k in range(columns.shape[1]):
                result[row, k] += data[place] * columns[indices[place], k]
    return result


@compiled
def outside(theta, rows, a, lowest, highest):
    """Whether ``theta`` (n,) moved by ``rows`` (n, r) times ``a`` (r,) leaves its range anywhere."""
    for i in range(len(theta)):
        moved = theta[i]
        for k in range(len(a)):
            moved += rows[i, k] * a[k]
        if not lowest[i] <= moved <= highest[i]:
            return True
    return False


@compiled
def move_unknowns(dx, a, unknowns, earlier):
    """Add ``dx`` (m, r) times ``a`` (r,) to the ``unknowns`` (stages, m) and the ``earlier`` (steps, stages, m)."""
    for i in range(len(dx)):
        shift = 0.0
        for k in range(len(a)):
            shift += dx[i, k] * a[k]
        for stage in range(len(unknowns)):
            unknowns[stage, i] += shift
            for step in range(len(earlier)):
                earlier[step, stage, i] += shift


@compiled_sums
def modal_coordinates(by_fields, fields, by_inputs, alpha, beta, force, torque, at_rest):
    """(2m,) amplitudes and rates of modes: ``by_fields`` (2m, fields) times the ``fields``, less what the equilibrium at the inputs has."""
    values = np.empty(len(at_rest))
    for i in range(len(values)):
        total = -at_rest[i]
        for k in range(len(fields)):
            total += by_fields[i, k] * fields[k]
        column = 0
        for part in (alpha, beta, force, torque):
            for k in range(len(part)):
                total -= by_inputs[i, column] * part[k]
                column += 1
        values[i] = total
    return values


@compiled
def backbone_rows(s, nodes, fields, points, n, insertion_rate, rotation, bias, deviation, rows):
    """Fill ``rows`` (P, 15) float32: s, x, y, z, qx, qy, qz, qw, vx, vy, vz, ux, uy, uz, sd.

    ``nodes`` (P, S) states; ``fields`` (fields,) with ``points`` (P,) the point of each node; ``rotation`` (4,) nominal registration, ``bias``
    (13,) tracker states; ``deviation`` (P,) m, the position's per axis (root of the third of its covariance's trace).
    """
    F = 7 + 2 * n
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
