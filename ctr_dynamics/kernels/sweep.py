"""One sweep along the tubes, from the actuators to the tip, for any number of lanes.

The unknowns at s = 0+ are given; the sweep integrates the equations to the tip and says by how much the balance there and at the tubes' ends is
missed. Where the states at the mesh's cuts are unknowns as well (multiple shooting), the sweep goes on from each of them and says by how much
the state that arrives there differs.

Kernels are written for one number, which may stand for several lanes (:mod:`ctr_dynamics.kernels.simd`). Below :func:`sweep` arrays come as views: a
compiled function that passes an array on counts references to it, and those counts, atomic as they are, cost as much as the arithmetic.
"""

from typing import Any, NamedTuple

import numpy as np

from ctr_dynamics.kernels.base import base_plate, below_base
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.kinds import ONE_LANE, first_cut_row
from ctr_dynamics.kernels.layout import (
    base_field_count,
    field_rows,
    parameter_rows,
    residual_rows,
    state_rows,
    unknown_rows,
    workspace_rows,
)
from ctr_dynamics.kernels.physics import (
    bending_moments,
    curvature,
    derivative,
    move_grid,
    start_motion,
    start_section,
    tilt,
)
from ctr_dynamics.kernels.simd import fma, local_copy, view
from ctr_dynamics.kernels.transitions import carry_end_body, end_body, tip_residual, tube_friction


class Views(NamedTuple):
    """The buffers of a sweep as views of one batch of lanes, or of one lane.

    The history is each lane's own, or one that all share (``shared_history``), as ``own_history`` says. Empty fields and nodes are not written.
    """

    parameters: Any
    section_lengths: Any
    unknowns: Any
    history: Any
    shared_history: Any
    own_history: bool
    base_history: Any
    fields: Any
    base_fields: Any
    nodes: Any
    fields_kept: bool
    nodes_kept: bool
    residual: Any


@njit(forceinline=True)
def load_history(kind, W, v, point):
    """History parts of ``point`` into the workspace."""
    F, HI = field_rows(kind.tubes).size, workspace_rows(kind.tubes).history
    if v.own_history:
        for r in range(F):
            W[HI + r] = v.history[point * F + r]
    else:
        for r in range(F):
            W[HI + r] = v.shared_history[point * F + r]


@njit(forceinline=True, error_model="numpy")
def cells_of_section(kind, W, v, present, first, last, cells, h, point, node, ust, c0):
    """Runge-Kutta steps of length ``h`` through the cells ``first`` to ``last`` - 1 of a section's ``cells``, from and to the state at the current
    node; ``point`` and ``node`` are the section's first."""
    n = kind.tubes
    S, F, at = state_rows(n).size, field_rows(n).size, workspace_rows(n)
    point += 4 * first
    for cell in range(first, last):
        for r in range(S):
            if v.nodes_kept:
                v.nodes[(node + cell) * S + r] = W[at.state + r]
            W[at.stage + r] = W[at.state + r]
            W[at.increment + r] = 0.0
        for stage in range(4):
            load_history(kind, W, v, point)
            move_grid(kind, W, (cell + (0.0 if stage == 0 else 1.0 if stage == 3 else 0.5)) / cells)
            derivative(kind, W, present, ust, point * 3 * n, c0)
            if v.fields_kept:
                for r in range(F):
                    v.fields[point * F + r] = W[at.fields + r]
            point += 1
            weight = 1.0 if stage == 0 or stage == 3 else 2.0
            ahead = (0.5 if stage < 2 else 1.0) * h
            for r in range(S):
                W[at.increment + r] = fma(W[at.slope + r], weight, W[at.increment + r])
                if stage < 3:
                    W[at.stage + r] = fma(W[at.slope + r], ahead, W[at.state + r])
        for r in range(S):
            W[at.state + r] = fma(W[at.increment + r], h * (1.0 / 6.0), W[at.state + r])


@njit(forceinline=True, error_model="numpy")
def leave_cut(kind, W, v, cut):
    """The state that arrives at the ``cut``, minus the unknown one that leaves it, into the residual; and the latter as the state."""
    n = kind.tubes
    S, first, at = state_rows(n).size, first_cut_row(kind), workspace_rows(n)
    row = unknown_rows(n).size + cut * (S - first) - first
    for r in range(S):
        if r >= first:
            v.residual[row + r] = W[at.state + r] - v.unknowns[row + r]
            W[at.state + r] = v.unknowns[row + r]


@njit(nogil=True, error_model="numpy")
def section(kind, W, v, before, present, cells, length, point, node, ust, cut, cell0, c0):
    """From the state on the near side of a section's start, where ``before`` tubes lie, to its end.

    Friction from the jump of the inner tubes' moments, Runge-Kutta steps through its ``cells``, and at the end fields, moments on the near side and
    gravity in the frame of tube 1. ``cut``: of every cell of the mesh, as in it; ``cell0``: the section's first.
    """
    n = kind.tubes
    S, F, at = state_rows(n).size, field_rows(n).size, workspace_rows(n)
    moment, missed = at.state + state_rows(n).moment_z, residual_rows(n).moment_z
    V = local_copy(kind, W)  # nothing else points to it
    load_history(kind, V, v, point)
    for r in range(S):
        V[at.stage + r] = V[at.state + r]
    curvature(kind, V, present, ust, point * 3 * n, c0)
    bending_moments(kind, V, present, at.far_moments)
    tube_friction(kind, V, before)
    for i in range(1, n):
        # a tube that ended here has its own balance about its axis; its m_z holds the body's part already
        if i >= present and i < before:
            v.residual[missed + i] = -V[moment + i]
            V[moment + i] = 0.0
    divided, first = len(v.unknowns) > unknown_rows(n).size, np.int64(0)
    while first < cells:
        if divided and cut[cell0 + first] >= 0.0:
            leave_cut(kind, V, v, np.int64(cut[cell0 + first]))
        last = first + 1
        while last < cells and not (divided and cut[cell0 + last] >= 0.0):
            last += 1
        cells_of_section(kind, V, v, present, first, last, cells, length / cells, point, node, ust, c0)
        first = last
    point += 4 * cells
    load_history(kind, V, v, point)
    for r in range(S):
        if v.nodes_kept:
            v.nodes[(node + cells) * S + r] = V[at.state + r]
        V[at.stage + r] = V[at.state + r]
    move_grid(kind, V, 1.0)
    derivative(kind, V, present, ust, point * 3 * n, c0)
    if v.fields_kept:
        for r in range(F):
            v.fields[point * F + r] = V[at.fields + r]
    bending_moments(kind, V, present, at.near_moments)
    for r in range(S):
        W[at.state + r] = V[at.state + r]
    for r in range(F):
        W[at.history + r] = V[at.history + r]
    for r in range(2 * n):
        W[at.near_moments + r] = V[at.near_moments + r]
    for r in range(3):
        W[at.weight + r] = V[at.weight + r]


@njit(nogil=True, error_model="numpy")
def sweep_batch(kind, W, c0, mesh, v):
    """:func:`sweep` for the lanes of the views ``v``."""
    n = kind.tubes
    at = workspace_rows(n)
    first = at.bending_stiffness  # the parameters lie in the workspace as they do in their block
    for r in range(parameter_rows(n).size):
        W[first + r] = v.parameters[r]
    sec_cells, sec_tubes, ust = mesh.sec_cells, mesh.sec_tubes, view(ONE_LANE, mesh.ust, 0, 1)
    cut = view(ONE_LANE, mesh.cut, 0, 1)
    start_motion(kind, W, c0, v.base_history, v.base_fields)
    below_base(
        kind, W, c0, mesh.base_cells, view(ONE_LANE, mesh.ust_base, 0, 1), v.unknowns, v.base_history, v.base_fields
    )  # fmt: skip
    base_plate(kind, W, view(ONE_LANE, mesh.ust0, 0, 1))
    # no literals, for which the sections would be compiled once more
    point, node, cell = np.int64(0), np.int64(0), np.int64(0)
    before = n
    for k in range(len(sec_cells)):
        present = sec_tubes[k]
        start_section(kind, W, mesh.bp_tube, v.section_lengths, k)
        cells = sec_cells[k]
        section(kind, W, v, before, present, cells, v.section_lengths[k], point, node, ust, cut, cell, c0)
        point += 4 * cells + 1
        node += cells + 1
        cell += cells
        before = present
        after = sec_tubes[k + 1] if k + 1 < len(sec_cells) else 0
        if after < present:
            i = present - 1
            end_body(kind, W, i, c0)
            if i > 0:
                carry_end_body(kind, W, i)
                tilt(kind, W, c0, i, v.base_history, v.base_fields)
    tip_residual(kind, W, v.residual, c0, v.base_history, v.base_fields)


@njit(nogil=True, error_model="numpy", large=True)
def sweep(kind, lanes, c0, mesh, b):
    """Integrate (18), (19), (13), (20)-(24) from the actuators to the tip with the unknowns in the buffers ``b``; the residual stays there.

    ``kind``, ``lanes``: :mod:`ctr_dynamics.kernels.kinds`; ``mesh``, ``b``: :class:`~ctr_dynamics.kernels.structures.Mesh`,
    :class:`~ctr_dynamics.kernels.structures.SweepBuffers`. Unknowns: base torques of the tubes, n and m_xy at s = 0+. Residual: force (3), moment
    m_xy (2) and m_z of every tube's end. With more unknowns these are the states at the mesh's cuts, from row
    :func:`~ctr_dynamics.kernels.kinds.first_cut_row` on, and so are the residuals. c0 = 0 with zero history is the static model; c0 may be a
    :class:`~ctr_dynamics.kernels.coupling.Coupling`. With several lanes the history may be (points, F), which all share, or that of one batch,
    which all batches share, as the base history may be; ``fields`` and ``nodes`` may be empty: then they are not written.
    """
    L = lanes.count
    points = len(mesh.ust) // (3 * kind.tubes) * field_rows(kind.tubes).size
    base = base_field_count(kind.tubes, mesh.base_cells)
    own = len(b.history) > points or L == 1
    H = L if len(b.history) == points * L else lanes.width
    B = L if len(b.base_history) == base * L else lanes.width
    for first in range(0, L, lanes.width):
        views = Views(
            view(lanes, b.parameters, first, L),
            view(lanes, b.section_lengths, first, L),
            view(lanes, b.unknowns, first, L),
            view(lanes, b.history, first if H == L else 0, H),
            view(ONE_LANE, b.history, 0, 1),
            own,
            view(lanes, b.base_history, first if B == L else 0, B),
            view(lanes, b.fields, first, L),
            view(lanes, b.base_fields, first if B == L else 0, B),
            view(lanes, b.nodes, first, L),
            len(b.fields) > 0,
            len(b.nodes) > 0,
            view(lanes, b.residual, first, L),
        )
        sweep_batch(kind, view(lanes, b.workspace, 0, lanes.width), c0, mesh, views)
