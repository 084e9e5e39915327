"""The solution of a multiple-shooting system by its inverse, condensed to the unknowns of the two-point problem where rounding allows.

With x the first 5 + N unknowns and s_j the state that begins segment j, the system is D_j s_j - s_j+1 = f_j (s_0 = x) and R s = g at the tubes'
ends. So s_j+1 = P_j x + what the f bring, with P_j = D_j .. D_0, and A x = R P x follows. P grows with exp(G)
(:mod:`ctr_dynamics.model.segments`), and
A loses as many digits: beyond :data:`~ctr_dynamics.model.segments.CONDENSED` the whole matrix is inverted, with pivots.

All is complex, real and imaginary parts apart, and stored by columns, so that the inner loops run along memory.
"""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit


@njit(nogil=True)
def _swap(matrix, i, k):
    for c in range(matrix.shape[1]):
        matrix[i, c], matrix[k, c] = matrix[k, c], matrix[i, c]


@njit(nogil=True, error_model="numpy")
def invert_complex(matrix, inverse):
    """Inverse (2, n, n) of the complex ``matrix`` (2, n, n), which is destroyed, by Gauss-Jordan elimination with pivoting; False if singular."""
    n = matrix.shape[1]
    re, im = matrix[0], matrix[1]
    inverse[:] = 0.0
    for i in range(n):
        inverse[0, i, i] = 1.0
    for k in range(n):
        pivot, largest = k, 0.0
        for i in range(k, n):
            size = re[i, k] * re[i, k] + im[i, k] * im[i, k]
            if size > largest:
                pivot, largest = i, size
        if not (largest > 1e-300 and math.isfinite(largest)):
            return False
        if pivot != k:
            for part in range(2):
                _swap(matrix[part], pivot, k)
                _swap(inverse[part], pivot, k)
        a, b = re[k, k] / largest, -im[k, k] / largest
        for both in (matrix, inverse):
            x, y = both[0, k], both[1, k]
            for c in range(n):
                x[c], y[c] = a * x[c] - b * y[c], a * y[c] + b * x[c]
        for i in range(n):
            a, b = re[i, k], im[i, k]
            if i != k and (a != 0.0 or b != 0.0):
                for both in (matrix, inverse):
                    x, y, u, v = both[0, i], both[1, i], both[0, k], both[1, k]
                    for c in range(n):
                        x[c] -= a * u[c] - b * v[c]
                        y[c] -= a * v[c] + b * u[c]
    return True


@njit(nogil=True)
def _transpose(matrix):
    for i in range(len(matrix)):
        for k in range(i):
            matrix[i, k], matrix[k, i] = matrix[k, i], matrix[i, k]


@njit(nogil=True, error_model="numpy")
def add_product(columns, vector, result):
    """``result`` (2, n) += matrix times ``vector`` (2, k), the matrix by its ``columns`` (2, k, n)."""
    x, y = result[0], result[1]
    for k in range(columns.shape[1]):
        a, b = vector[0, k], vector[1, k]
        u, v = columns[0, k], columns[1, k]
        for i in range(len(x)):
            x[i] += a * u[i] - b * v[i]
            y[i] += a * v[i] + b * u[i]


@njit(nogil=True, error_model="numpy")
def factorise(matrix, owner, factors, e):
    """Inverse of the system ``matrix`` (2, mt, mt), which is destroyed, into number ``e`` of the ``factors``
    (:class:`~ctr_dynamics.kernels.structures.SystemFactors`); False where it is singular. ``owner`` (5 + N,): as in the mesh."""
    if factors.whole.shape[2]:
        if not invert_complex(matrix, factors.whole[e]):
            return False
        for part in range(2):
            _transpose(factors.whole[e, part])
        return True
    m = len(owner)
    D, P, R, A = factors.along[e], factors.from_base[e], factors.ends[e], factors.inverse[e]
    cuts, size = D.shape[0], D.shape[2]
    work = np.zeros((2, m, m))
    P[:] = 0.0
    for part in range(2):
        for j in range(cuts):
            first, count = (0, m) if j == 0 else (m + (j - 1) * size, size)
            for k in range(count):
                for i in range(size):
                    D[j, part, k, i] = matrix[part, m + j * size + i, first + k]
        for q in range(m):
            first, count = (0, m) if owner[q] == 0 else (m + (owner[q] - 1) * size, size)
            for k in range(count):
                R[part, q, k] = matrix[part, q, first + k]
    for j in range(cuts):
        for c in range(m):
            if j == 0:
                P[0, :, c] = D[0, :, c]
            else:
                add_product(D[j], P[j - 1, :, c], P[j, :, c])
    for q in range(m):
        for c in range(m):
            if owner[q] == 0:
                work[0, q, c], work[1, q, c] = R[0, q, c], R[1, q, c]
            else:
                x, y = P[owner[q] - 1, 0, c], P[owner[q] - 1, 1, c]
                for k in range(size):
                    work[0, q, c] += R[0, q, k] * x[k] - R[1, q, k] * y[k]
                    work[1, q, c] += R[0, q, k] * y[k] + R[1, q, k] * x[k]
    if not invert_complex(work, A):
        return False
    for part in range(2):
        _transpose(A[part])
    return True


@njit(nogil=True, error_model="numpy")
def solve_system(owner, factors, e, F, z):
    """z = - J^-1 F, both (2, mt); ``F`` is written to.

    Written out in single loops: a slice counts references, which takes as long as the arithmetic.
    """
    along, from_base, ends, inverse, whole = factors
    mt, m, cuts, size = F.shape[1], len(owner), along.shape[1], along.shape[3]
    if whole.shape[2]:
        for i in range(mt):
            z[0, i] = z[1, i] = 0.0
        for k in range(mt):
            a, b = -F[0, k], -F[1, k]
            for i in range(mt):
                z[0, i] += a * whole[e, 0, k, i] - b * whole[e, 1, k, i]
                z[1, i] += a * whole[e, 1, k, i] + b * whole[e, 0, k, i]
        return
    # what the misses bring to the segments' starts with the first unknowns held
    for j in range(1, cuts):
        start, target = m + (j - 1) * size, m + j * size
        for k in range(size):
            a, b = F[0, start + k], F[1, start + k]
            for i in range(size):
                F[0, target + i] += a * along[e, j, 0, k, i] - b * along[e, j, 1, k, i]
                F[1, target + i] += a * along[e, j, 1, k, i] + b * along[e, j, 0, k, i]
    for q in range(m):
        if owner[q] > 0:
            start, x, y = m + (owner[q] - 1) * size, F[0, q], F[1, q]
            for k in range(size):
                a, b = F[0, start + k], F[1, start + k]
                x += ends[e, 0, q, k] * a - ends[e, 1, q, k] * b
                y += ends[e, 0, q, k] * b + ends[e, 1, q, k] * a
            F[0, q], F[1, q] = x, y
    for i in range(m):
        z[0, i] = z[1, i] = 0.0
    for k in range(m):
        a, b = -F[0, k], -F[1, k]
        for i in range(m):
            z[0, i] += a * inverse[e, 0, k, i] - b * inverse[e, 1, k, i]
            z[1, i] += a * inverse[e, 1, k, i] + b * inverse[e, 0, k, i]
    for j in range(cuts):
        start = m + j * size
        for i in range(size):
            z[0, start + i], z[1, start + i] = F[0, start + i], F[1, start + i]
        for k in range(m):
            a, b = z[0, k], z[1, k]
            for i in range(size):
                z[0, start + i] += a * from_base[e, j, 0, k, i] - b * from_base[e, j, 1, k, i]
                z[1, start + i] += a * from_base[e, j, 1, k, i] + b * from_base[e, j, 0, k, i]
