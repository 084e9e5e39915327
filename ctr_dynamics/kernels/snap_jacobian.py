"""Exact Jacobian of (25) by complex steps, and elimination of its blocks from the actuators to the tip.

The matrix is almost block diagonal: the equations of cell k hold the unknowns of nodes k and k + 1 only. Gaussian elimination with row
pivoting takes the columns of one node after the other; the rows that are left go on to the next one.
"""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.snap_equations import Side, base_slope, slope
from ctr_dynamics.kernels.snap_residual import special, states_at_node

TINY = 1e-30  # complex step: its square vanishes beside any number met here


@njit(nogil=True, error_model="numpy")
def _differentiate_nodes(g, x, par, c0, work):
    """d left / d x and d right / d x of the special nodes, by complex steps."""
    scratch = work.imag
    xc, right, left, out_near, out_far = scratch[5], scratch[6], scratch[7], scratch[8], scratch[9]
    out_drive = scratch[10]
    for k in range(len(g.size)):
        if not special(g, k):
            continue
        size = g.size[k]
        for j in range(size):
            xc[j] = x[g.start[k] + j]
        for j in range(size):
            right[:] = 0.0
            left[:] = 0.0
            xc[j] += TINY * 1j
            states_at_node(
                g, k, xc, par, work.hist, work.hist_drive, c0, out_near, out_far, out_drive, scratch, right, left
            )  # fmt: skip
            xc[j] = x[g.start[k] + j]
            for r in range(len(right)):
                work.d_right[k, r, j] = right[r].imag / TINY
                work.d_left[k, r, j] = left[r].imag / TINY


@njit(nogil=True, error_model="numpy")
def _cell_jacobian(g, cell, par, c0, work, D):
    """d f / d (mean state) of one cell into D (rows, rows)."""
    n = g.n
    scratch = work.imag
    mean, f, w, out = scratch[5], scratch[6], scratch[7], scratch[8]
    before, here = work.left[cell], work.right[cell + 1]
    rows = g.rows[cell]
    for r in range(rows):
        mean[r] = 0.5 * (before[r] + here[r])
        for c in range(rows):
            D[r, c] = 0.0
    if cell < g.base:
        for i in range(g.turning):
            for c in range(3):
                y = scratch[9]
                for r in range(3):
                    y[r] = mean[3 * i + r]
                y[c] += TINY * 1j
                base_slope(y, i, n, par, g.uz_base[cell, i], work.hist_base[cell, i], c0, out, f)
                for r in range(3):
                    D[3 * i + r, 3 * i + c] = f[r].imag / TINY
    else:
        m = g.tubes[g.cell_section[cell]]
        middle = Side(g.ust[cell], work.hist[cell - g.base], out)
        for c in range(3, rows):
            kept = mean[c]
            mean[c] = kept + TINY * 1j
            slope(mean, m, n, par, middle, c0, w, f)
            mean[c] = kept
            for r in range(rows):
                D[r, c] = f[r].imag / TINY


@njit(nogil=True, error_model="numpy")
def factorise(g, x, par, c0, work, D, G):
    """Jacobian of E at ``x``, eliminated node by node into ``work.factors``; False when it is singular.

    :func:`residual` must have been called at ``x``; ``D``, ``G`` (S, S) are scratch.
    """
    _differentiate_nodes(g, x, par, c0, work)
    A = work.factors
    carried = 0
    last = len(g.size) - 1
    for k in range(last + 1):
        d = g.size[k]
        d2 = 0
        total = carried
        if k < last:
            d2 = g.size[k + 1]
            rows = g.rows[k]
            _cell_jacobian(g, k, par, c0, work, D)
            for r in range(rows):
                a = A[k, carried + r]
                h = 1.0 / (g.base_ds[r // 3] if k < g.base else g.ds[k])
                for side in range(2):
                    sign = -h if side == 0 else h
                    node = k + side
                    width = g.size[node]
                    offset = side * d
                    if special(g, node):
                        for c in range(rows):
                            G[r, c] = -0.5 * D[r, c]
                        G[r, r] += sign
                        for c in range(width):
                            a[offset + c] = 0.0
                        for j in range(rows):
                            v = G[r, j]
                            if v != 0.0:
                                if side == 0:
                                    for c in range(width):
                                        a[offset + c] += v * work.d_left[node, j, c]
                                else:
                                    for c in range(width):
                                        a[offset + c] += v * work.d_right[node, j, c]
                    else:
                        for c in range(rows):
                            a[offset + c] = -0.5 * D[r, c]
                        a[offset + r] += sign
                largest = 0.0
                for c in range(d + d2):
                    largest = max(largest, abs(a[c]))
                if not (largest > 0.0 and largest < np.inf):
                    return False
                scale = 1.0 / largest
                work.row_scale[g.row_start[k] + r] = scale
                for c in range(d + d2):
                    a[c] *= scale
            total += rows
        if not _eliminate(A[k], work.pivots[k], total, d, d + d2):
            return False
        carried = total - d
        if k < last:
            for r in range(carried):
                for c in range(d2):
                    A[k + 1, r, c] = A[k, d + r, d + c]
                for c in range(d2, A.shape[2]):
                    A[k + 1, r, c] = 0.0
    return carried == 0


@njit(nogil=True, error_model="numpy")
def _eliminate(a, pivot, rows, columns, width):
    """LU of the first ``columns`` columns of a (rows, width) with row pivoting, in place."""
    for j in range(columns):
        p, best = j, abs(a[j, j])
        for r in range(j + 1, rows):
            if abs(a[r, j]) > best:
                p, best = r, abs(a[r, j])
        if not best > 0.0:
            return False
        pivot[j] = p
        if p != j:
            for c in range(j, width):
                a[j, c], a[p, c] = a[p, c], a[j, c]
        inverse = 1.0 / a[j, j]
        top = a[j]
        for r in range(j + 1, rows):
            factor = a[r, j] * inverse
            a[r, j] = factor
            if factor != 0.0:
                row = a[r]
                for c in range(j + 1, width):
                    row[c] -= factor * top[c]
    return True


@njit(nogil=True, error_model="numpy")
def back_solve(g, work, rhs, x):
    """x of (Jacobian) x = rhs with the factors at hand."""
    A = work.factors
    v = np.zeros(A.shape[1])
    carried = 0
    last = len(g.size) - 1
    for k in range(last + 1):
        d = g.size[k]
        total = carried
        if k < last:
            row = g.row_start[k]
            for r in range(g.rows[k]):
                v[total + r] = rhs[row + r] * work.row_scale[row + r]
            total += g.rows[k]
        for j in range(d):
            p = work.pivots[k, j]
            if p != j:
                v[j], v[p] = v[p], v[j]
            for r in range(j + 1, total):
                v[r] -= A[k, r, j] * v[j]
        for j in range(d):
            x[g.start[k] + j] = v[j]
        carried = total - d
        for r in range(carried):
            v[r] = v[d + r]
    for k in range(last, -1, -1):
        d = g.size[k]
        d2 = g.size[k + 1] if k < last else 0
        at = g.start[k]
        for j in range(d - 1, -1, -1):
            value = x[at + j]
            for c in range(j + 1, d + d2):
                value -= A[k, j, c] * x[at + c]
            x[at + j] = value / A[k, j, j]
