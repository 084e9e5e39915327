"""E of (25): the states on both sides of every node, with the boundary conditions held, and the residual of every cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import field_rows, state_rows, unknown_rows
from ctr_dynamics.kernels.snap_equations import Scratch, Side, base_slope, cross, drive, enter, slope, tip
from ctr_dynamics.kernels.structures import structure


@structure
class GridArrays(NamedTuple):
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


@structure
class SolverArrays(NamedTuple):
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


def solver_arrays(g: GridArrays) -> SolverArrays:
    """Arrays for the grid ``g``."""
    n, nodes = g.n, len(g.size)
    S = max(
        state_rows(n).size, 2 * n + unknown_rows(n).size
    )  # at the plate: (psi, psi_t, m_z) a tube, force and moment
    F = field_rows(n).size
    points = len(g.ds) - g.base + 2 * len(g.tubes)
    D = int(g.size.max())
    R = 2 * int(max(g.rows.max(), D))
    size = int(g.start[-1])
    return SolverArrays(
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


@njit(inline="always")
def special(g, k):
    """Whether the boundary conditions make the states at node ``k`` more than copies of its unknowns."""
    if k == 0 or k == g.base or k == len(g.size) - 1:
        return True
    return k > g.base and g.cell_section[k] != g.cell_section[k - 1]


@njit(nogil=True, error_model="numpy")
def states_at_node(g, k, x, par, hist, hist_drive, c0, out_near, out_far, out_drive, scratch, right, left):
    """States on both sides of node ``k`` from its unknowns ``x``, with every boundary condition held."""
    n = g.n
    passing = Scratch(scratch[0], scratch[1], scratch[2], scratch[3], scratch[4])
    cells = len(g.ds) - g.base
    if k == g.base:
        for i in range(3 * g.turning):
            right[i] = x[i]
        start = Side(g.ust_start[0], hist[cells], out_far)
        enter(x, g.turning, n, par, g.ust_behind, start, hist_drive, out_drive, c0, passing, left)
    elif k == 0:
        for i in range(g.turning):
            left[3 * i], left[3 * i + 1] = drive(i, n, par, x[i], hist_drive, c0, out_drive)
            left[3 * i + 2] = x[i]
    elif not special(g, k):
        for i in range(g.size[k]):
            right[i] = x[i]
            left[i] = x[i]
    else:
        section = g.cell_section[k - 1]
        m = g.tubes[section]
        after = g.tubes[section + 1] if section + 1 < len(g.tubes) else 0
        end = Side(g.ust_end[section], hist[cells + 2 * section + 1], out_near)
        if after == 0:
            for i in range(state_rows(n).force):
                right[i] = x[i]
            tip(right, n, par, end, c0, passing)
        else:
            skip = state_rows(m).moment_z + m - 1 if after < m else 10_000
            j = 0
            for i in range(state_rows(m).size):
                if i == skip:
                    right[i] = 0.0
                else:
                    right[i] = x[j]
                    j += 1
            beyond = Side(g.ust_start[section + 1], hist[cells + 2 * section + 2], out_far)
            cross(right, m, after, n, par, end, beyond, c0, passing, left)


@njit(nogil=True, error_model="numpy")
def residual(g, x, par, c0, work):
    """E of (25) into ``work.error`` and the fields into ``work.out``; returns its squared norm."""
    n = g.n
    cells = len(g.ds) - g.base
    scratch = work.real
    mean, f, w, out_near, out_far = scratch[5], scratch[6], scratch[7], scratch[8], scratch[9]
    last = len(g.size) - 1
    total = 0.0
    for k in range(last + 1):
        states_at_node(
            g, k, x[g.start[k] : g.start[k + 1]], par, work.hist, work.hist_drive, c0, out_near, out_far,
            work.out_drive, scratch, work.right[k], work.left[k],
        )  # fmt: skip
        if k >= g.base and special(g, k):
            if k > g.base:
                at = cells + 2 * g.cell_section[k - 1] + 1
                for i in range(field_rows(n).size):
                    work.out[at, i] = out_near[i]
            if k < last:
                at = cells + 2 * g.cell_section[k]
                for i in range(field_rows(n).size):
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
            size = state_rows(m).size
            for r in range(size):
                mean[r] = 0.5 * (before[r] + here[r])
            middle = Side(g.ust[cell], work.hist[cell - g.base], work.out[cell - g.base])
            slope(mean, m, n, par, middle, c0, w, f)
            for r in range(size):
                e = (here[r] - before[r]) / g.ds[cell] - f[r]
                work.error[row + r] = e
                total += e * e
    return total
