"""Damped Newton on (25): residual, exact Jacobian by complex steps, and elimination of its blocks from the actuators to the tip.

The matrix is almost block diagonal: the equations of cell k hold the unknowns of nodes k and k + 1 only. Gaussian elimination with row
pivoting takes the columns of one node after the other; the rows that are left go on to the next one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.snap_equations import Z, base_slope, cross, drive, enter, slope, state_size, tip

CONVERGED, NOT_CONVERGED, NOT_FINITE = 0, 1, 2
TINY = 1e-30  # complex step: its square vanishes beside any number met here
SLOW = 0.1  # a reused Jacobian that reduces ||E|| by less is renewed


class Arrays(NamedTuple):
    """What the kernels read of a grid.

    ``n`` tubes, ``turning`` of them begin behind the plate, on ``base`` cells each. Cells k = 0.. run from the actuators to the tip between
    nodes k and k + 1. ``cell_section`` (cells,): section, -1 behind the plate; ``ds`` (cells,) m; ``base_ds`` (N,) m; ``ust`` (cells, 3N)
    precurvature in the cells' middles, ``ust_start``, ``ust_end`` (sections, 3N) at both ends of each section, ``ust_behind`` (3N,) just
    behind the plate, ``uz_base`` (base, N) its z part in the cells there, 1/m. ``tubes`` (sections,): present in each;
    ``first_cell`` (sections + 1,). ``size`` (nodes,), ``start`` (nodes + 1,): unknowns of each node; ``rows`` (cells,), ``row_start``
    (cells + 1,): equations of each cell.
    """

    n: int
    turning: int
    base: int
    cell_section: np.ndarray
    ds: np.ndarray
    base_ds: np.ndarray
    ust: np.ndarray
    ust_start: np.ndarray
    ust_end: np.ndarray
    ust_behind: np.ndarray
    uz_base: np.ndarray
    tubes: np.ndarray
    first_cell: np.ndarray
    size: np.ndarray
    start: np.ndarray
    rows: np.ndarray
    row_start: np.ndarray


class Work(NamedTuple):
    """Arrays that a solve writes. ``hist``, ``out`` (points, F): points are the cells beyond the plate, then start and end of each section;
    ``hist_base``, ``out_base`` (base, N, 2): psi_t and u_z of the cells behind the plate; ``hist_drive``, ``out_drive`` (2N,): what each drive
    gives way and psi_t at the actuator."""

    hist: np.ndarray
    out: np.ndarray
    hist_base: np.ndarray
    out_base: np.ndarray
    hist_drive: np.ndarray
    out_drive: np.ndarray
    left: np.ndarray  # (nodes, S) state on the far side of each node: the left end of the next cell
    right: np.ndarray  # (nodes, S) state on its near side: the right end of the cell before
    error: np.ndarray  # (unknowns,) E of (25)
    step: np.ndarray  # (unknowns,)
    trial: np.ndarray  # (unknowns,)
    d_left: np.ndarray  # (nodes, S, D) d left / d x; filled where `left` is more than a copy of x
    d_right: np.ndarray
    factors: np.ndarray  # (cells + 1, R, C)
    pivots: np.ndarray  # (cells + 1, R)
    row_scale: np.ndarray  # (unknowns,)
    real: np.ndarray  # (12, S) scratch
    imag: np.ndarray  # (12, S) scratch, complex


def make_work(g: Arrays) -> Work:
    """Arrays for the grid ``g``."""
    n, nodes = g.n, len(g.size)
    S = max(16 + 3 * n, 3 * n + 5)
    F = 7 + 2 * n
    points = len(g.ds) - g.base + 2 * len(g.tubes)
    D = int(g.size.max())
    R = 2 * int(max(g.rows.max(), D))
    size = int(g.start[-1])
    return Work(
        hist=np.zeros((points, F)),
        out=np.zeros((points, F)),
        hist_base=np.zeros((max(g.base, 1), n, 2)),
        out_base=np.zeros((max(g.base, 1), n, 2)),
        hist_drive=np.zeros(2 * n),
        out_drive=np.zeros(2 * n),
        left=np.zeros((nodes, S)),
        right=np.zeros((nodes, S)),
        error=np.zeros(size),
        step=np.zeros(size),
        trial=np.zeros(size),
        d_left=np.zeros((nodes, S, D)),
        d_right=np.zeros((nodes, S, D)),
        factors=np.zeros((nodes, R, 2 * D)),
        pivots=np.zeros((nodes, R), dtype=np.int64),
        row_scale=np.zeros(size),
        real=np.zeros((12, S)),
        imag=np.zeros((12, S), dtype=complex),
    )


@njit(cache=True, inline="always")
def _special(g, k):
    """Whether the boundary conditions make the states at node ``k`` more than copies of its unknowns."""
    if k == 0 or k == g.base or k == len(g.size) - 1:
        return True
    return k > g.base and g.cell_section[k] != g.cell_section[k - 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _node(g, k, x, par, hist, hist_drive, c0, out_near, out_far, out_drive, scratch, right, left):
    """States on both sides of node ``k`` from its unknowns ``x``, with every boundary condition held."""
    n = g.n
    w, near, far, torque, wrench = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    cells = len(g.ds) - g.base
    if k == g.base:
        for i in range(3 * g.turning):
            right[i] = x[i]
        hist_start = hist[cells]
        enter(
            x, g.turning, n, par, g.ust_behind, g.ust_start[0], hist_start, hist_drive, c0, out_far, out_drive,
            w, near, far, torque, left,
        )  # fmt: skip
    elif k == 0:
        for i in range(g.turning):
            left[3 * i], left[3 * i + 1] = drive(i, n, par, x[i], hist_drive, c0, out_drive)
            left[3 * i + 2] = x[i]
    elif not _special(g, k):
        for i in range(g.size[k]):
            right[i] = x[i]
            left[i] = x[i]
    else:
        section = g.cell_section[k - 1]
        m = g.tubes[section]
        after = g.tubes[section + 1] if section + 1 < len(g.tubes) else 0
        hist_end = hist[cells + 2 * section + 1]
        if after == 0:
            for i in range(13):
                right[i] = x[i]
            tip(right, n, par, g.ust_end[section], hist_end, c0, out_near, w, wrench)
        else:
            skip = Z + m - 1 if after < m else 10_000
            j = 0
            for i in range(state_size(m)):
                if i == skip:
                    right[i] = 0.0
                else:
                    right[i] = x[j]
                    j += 1
            cross(
                right, m, after, n, par, g.ust_end[section], hist_end, out_near, g.ust_start[section + 1],
                hist[cells + 2 * section + 2], out_far, c0, w, near, far, torque, wrench, left,
            )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def residual(g, x, par, c0, work):
    """E of (25) into ``work.error`` and the fields into ``work.out``; returns its squared norm."""
    n = g.n
    cells = len(g.ds) - g.base
    scratch = work.real
    mean, f, w, out_near, out_far = scratch[5], scratch[6], scratch[7], scratch[8], scratch[9]
    last = len(g.size) - 1
    total = 0.0
    for k in range(last + 1):
        _node(
            g, k, x[g.start[k] : g.start[k + 1]], par, work.hist, work.hist_drive, c0, out_near, out_far,
            work.out_drive, scratch, work.right[k], work.left[k],
        )  # fmt: skip
        if k >= g.base and _special(g, k):
            if k > g.base:
                at = cells + 2 * g.cell_section[k - 1] + 1
                for i in range(7 + 2 * n):
                    work.out[at, i] = out_near[i]
            if k < last:
                at = cells + 2 * g.cell_section[k]
                for i in range(7 + 2 * n):
                    work.out[at, i] = out_far[i]
        if k == 0:
            continue
        cell = k - 1
        row = g.row_start[cell]
        before, here = work.left[cell], work.right[k]
        if cell < g.base:
            for i in range(g.turning):
                for r in range(3):
                    mean[r] = 0.5 * (before[3 * i + r] + here[3 * i + r])
                base_slope(
                    mean,
                    i,
                    n,
                    par,
                    g.uz_base[cell, i],
                    work.hist_base[cell, i],
                    c0,
                    work.out_base[cell, i],
                    f,
                )
                for r in range(3):
                    e = (here[3 * i + r] - before[3 * i + r]) / g.base_ds[i] - f[r]
                    work.error[row + 3 * i + r] = e
                    total += e * e
        else:
            m = g.tubes[g.cell_section[cell]]
            size = state_size(m)
            for r in range(size):
                mean[r] = 0.5 * (before[r] + here[r])
            slope(mean, m, n, par, g.ust[cell], work.hist[cell - g.base], c0, work.out[cell - g.base], w, f)
            for r in range(size):
                e = (here[r] - before[r]) / g.ds[cell] - f[r]
                work.error[row + r] = e
                total += e * e
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _differentiate_nodes(g, x, par, c0, work):
    """d left / d x and d right / d x of the special nodes, by complex steps."""
    scratch = work.imag
    xc, right, left, out_near, out_far = scratch[5], scratch[6], scratch[7], scratch[8], scratch[9]
    out_drive = scratch[10]
    for k in range(len(g.size)):
        if not _special(g, k):
            continue
        size = g.size[k]
        for j in range(size):
            xc[j] = x[g.start[k] + j]
        for j in range(size):
            right[:] = 0.0
            left[:] = 0.0
            xc[j] += TINY * 1j
            _node(
                g, k, xc, par, work.hist, work.hist_drive, c0, out_near, out_far, out_drive, scratch, right, left
            )  # fmt: skip
            xc[j] = x[g.start[k] + j]
            for r in range(len(right)):
                work.d_right[k, r, j] = right[r].imag / TINY
                work.d_left[k, r, j] = left[r].imag / TINY


@njit(cache=True, nogil=True, error_model="numpy")
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
        for c in range(3, rows):
            kept = mean[c]
            mean[c] = kept + TINY * 1j
            slope(mean, m, n, par, g.ust[cell], work.hist[cell - g.base], c0, out, w, f)
            mean[c] = kept
            for r in range(rows):
                D[r, c] = f[r].imag / TINY


@njit(cache=True, nogil=True, error_model="numpy")
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
                    if _special(g, node):
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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def solve(g, x, par, c0, work, D, G, fresh, tolerance, limit):
    """Solve E(x) = 0 in place. Returns (outcome, iterations, Jacobians, ||E||^2).

    The factors at hand serve while each step reduces ||E|| by the factor SLOW; a step of a fresh Jacobian that does not reduce it is
    halved, up to ten times. ``fresh``: the factors do not belong to this problem.
    """
    norm = residual(g, x, par, c0, work)
    if not np.isfinite(norm):
        return NOT_FINITE, 0, 0, norm
    jacobians = 0
    renew = fresh
    for iteration in range(limit):
        if norm < tolerance:
            return CONVERGED, iteration, jacobians, norm
        current = renew
        if renew:
            if not factorise(g, x, par, c0, work, D, G):
                return NOT_CONVERGED, iteration, jacobians, norm
            jacobians += 1
        back_solve(g, work, work.error, work.step)
        length = 1.0
        found = np.inf
        for _ in range(10 if current else 1):
            for i in range(len(x)):
                work.trial[i] = x[i] - length * work.step[i]
            found = residual(g, work.trial, par, c0, work)
            if found < norm or found < tolerance:
                break
            length *= 0.5
        if found < norm or found < tolerance:
            for i in range(len(x)):
                x[i] = work.trial[i]
            renew = found > SLOW * SLOW * norm
            norm = found
        elif current:
            return (NOT_CONVERGED if np.isfinite(found) else NOT_FINITE), iteration, jacobians, norm
        else:
            renew = True
            norm = residual(g, x, par, c0, work)
    return (CONVERGED if norm < tolerance else NOT_CONVERGED), limit, jacobians, norm
