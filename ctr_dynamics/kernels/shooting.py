"""Shooting: Newton's method on the residual of a sweep, with the Jacobian from perturbed lanes of one sweep and Broyden updates between."""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.kinds import ONE_LANE, SIMD_WIDTH, unknown_lanes
from ctr_dynamics.kernels.layout import (
    base_field_count,
    field_rows,
    parameter_rows,
    state_rows,
    unknown_rows,
    workspace_rows,
)
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.structures import SweepBuffers
from ctr_dynamics.kernels.sweep import sweep

CONVERGED, STALLED, NOT_FINITE = 0, 1, 2


@njit(nogil=True)
def scaled_norm(residual, scale):
    """Largest scaled residual; infinity where anything is not finite."""
    worst = 0.0
    for i in range(len(scale)):
        value = abs(residual[i]) / scale[i]
        if not math.isfinite(value):
            return math.inf
        worst = max(worst, value)
    return worst


@njit(nogil=True)
def broadcast(lanes, source, target):
    """Copy every number of ``source`` (rows,) to all lanes of ``target`` (rows, L), both flat."""
    L = np.uint64(lanes.count)
    for r in range(np.uint64(len(source))):
        value, start = source[r], r * L
        for j in range(L):
            target[start + j] = value


@njit(nogil=True)
def lane_lengths(kind, lanes, mesh, parameters, lengths):
    """Section lengths of every lane at the translations in its ``parameters`` (NP, L), into ``lengths`` (sections, L), both flat."""
    n, L, beta = kind.tubes, lanes.count, parameter_rows(kind.tubes).beta
    sections = len(mesh.sec_cells)
    given, found = np.empty(n), np.empty(sections)
    for j in range(L):
        for i in range(n):
            given[i] = parameters[(beta + i) * L + j]
        section_lengths(mesh.bp_tube, mesh.bp_offset, given, found)
        for k in range(sections):
            lengths[k * L + j] = found[k]


@njit(nogil=True)
def jacobian(kind, c0, mesh, single, x, b, perturbation, inverse):
    """Inverse of d(residual)/dx at ``x`` by one sweep of perturbed lanes into ``inverse`` (m, m); False if it is singular or not finite.

    ``single``: buffers of one lane with parameters, lengths and histories. ``b``: those of the perturbed lanes; the residual at ``x`` itself stays in
    the first lane of theirs.
    """
    lanes = unknown_lanes(kind)
    L, m = lanes.count, len(x)
    broadcast(lanes, single.parameters, b.parameters)
    broadcast(lanes, single.section_lengths, b.section_lengths)
    broadcast(lanes, x, b.unknowns)
    broadcast(lanes, single.base_history, b.base_history)
    for i in range(m):
        b.unknowns[i * L + i + 1] += perturbation[i]
    shared = SweepBuffers(
        b.workspace, b.parameters, b.section_lengths, b.unknowns, single.history, b.base_history, b.fields[:0],
        b.base_fields, b.nodes[:0], b.residual,
    )  # fmt: skip
    sweep(kind, lanes, c0, mesh, shared)
    matrix = np.empty((m, m))
    for i in range(m):
        for k in range(m):
            value = (b.residual[i * L + k + 1] - b.residual[i * L]) / perturbation[k]
            if not math.isfinite(value):
                return False
            matrix[i, k] = value
    return invert(matrix, inverse)


@njit(nogil=True)
def invert(matrix, inverse):
    """Inverse by Gauss-Jordan elimination with partial pivoting and row scaling; False if singular. Destroys ``matrix``."""
    m = matrix.shape[0]
    for i in range(m):
        for k in range(m):
            inverse[i, k] = 1.0 if i == k else 0.0
    for i in range(m):
        big = 0.0
        for k in range(m):
            big = max(big, abs(matrix[i, k]))
        if big == 0.0:
            return False
        for k in range(m):
            matrix[i, k] /= big
            inverse[i, k] /= big
    for col in range(m):
        pivot = col
        for i in range(col + 1, m):
            if abs(matrix[i, col]) > abs(matrix[pivot, col]):
                pivot = i
        if abs(matrix[pivot, col]) < 1e-300:
            return False
        if pivot != col:
            for k in range(m):
                matrix[pivot, k], matrix[col, k] = matrix[col, k], matrix[pivot, k]
                inverse[pivot, k], inverse[col, k] = inverse[col, k], inverse[pivot, k]
        d = 1.0 / matrix[col, col]
        for k in range(m):
            matrix[col, k] *= d
            inverse[col, k] *= d
        for i in range(m):
            if i != col:
                f = matrix[i, col]
                if f != 0.0:
                    for k in range(m):
                        matrix[i, k] -= f * matrix[col, k]
                        inverse[i, k] -= f * inverse[col, k]
    return True


@njit(nogil=True)
def broyden(inverse, dx, dr, work):
    """Broyden's update of the inverse Jacobian (m, m) in place, (dx - inv dr) dx^T inv / (dx^T inv dr), after x moved by ``dx`` and the
    residual by ``dr`` (m,). ``work`` (2, m) is written to."""
    m = len(dx)
    product, left = work[0], work[1]
    product[:] = 0.0
    left[:] = 0.0
    for i in range(m):
        for k in range(m):
            product[i] += inverse[i, k] * dr[k]
            left[k] += dx[i] * inverse[i, k]
    denominator = 0.0
    for i in range(m):
        denominator += dx[i] * product[i]
    if abs(denominator) > 1e-300:
        for i in range(m):
            g = (dx[i] - product[i]) / denominator
            for k in range(m):
                inverse[i, k] += g * left[k]


@njit(nogil=True)
def solve(kind, c0, mesh, solver, x, inverse, fresh):
    """Find the unknowns ``x`` (m,) at which the residual vanishes; ``x`` and ``inverse`` are updated in place.

    ``solver``: :class:`~ctr_dynamics.kernels.structures.ShootingSolver`, with parameters, lengths and histories in its buffers of one lane, where the
    fields and nodes of the solution are left. ``fresh`` False if ``inverse`` holds a usable inverse Jacobian of an earlier solve.
    Returns (outcome, iterations, plain sweeps, Jacobian sweeps).
    """
    m = len(x)
    single, wide = solver.single, solver.jacobian
    scale, perturbation, tolerance, limit = solver.options
    trial, res = single.unknowns, single.residual
    dx = np.empty(m)
    previous = np.empty(m)
    work = np.empty((2, m))
    sweeps, jacobians = 0, 0
    newest = False
    L = unknown_lanes(kind).count
    if fresh:
        if not jacobian(kind, c0, mesh, single, x, wide, perturbation, inverse):
            return NOT_FINITE, 0, 0, 1
        jacobians += 1
        newest = True
        for i in range(m):
            res[i] = wide.residual[i * L]
        norm = scaled_norm(res, scale)
    else:
        norm = math.inf
    if norm <= tolerance or not fresh:  # the fields belong to the last plain sweep
        trial[:] = x
        sweep(kind, ONE_LANE, c0, mesh, single)
        sweeps += 1
        norm = scaled_norm(res, scale)
    for iteration in range(limit):
        if norm <= tolerance:
            return CONVERGED, iteration, sweeps, jacobians
        if math.isinf(norm):
            return NOT_FINITE, iteration, sweeps, jacobians
        for i in range(m):
            dx[i] = 0.0
            previous[i] = res[i]
            for k in range(m):
                dx[i] -= inverse[i, k] * res[k]
        factor = 1.0
        best = norm
        while True:
            for i in range(m):
                trial[i] = x[i] + factor * dx[i]
            sweep(kind, ONE_LANE, c0, mesh, single)
            sweeps += 1
            best = scaled_norm(res, scale)
            if best < (1.0 - 0.1 * factor) * norm or not newest or factor < 1e-3:
                break
            factor *= 0.5
        if best >= norm and newest:
            return STALLED, iteration, sweeps, jacobians
        if best < norm:
            for i in range(m):
                previous[i] = res[i] - previous[i]
                dx[i] = trial[i] - x[i]
                x[i] = trial[i]
            broyden(inverse, dx, previous, work)
            slow = best > 0.6 * norm
            norm = best
            newest = False
            if norm <= tolerance:
                return CONVERGED, iteration + 1, sweeps, jacobians
            if not slow:
                continue
        if not jacobian(kind, c0, mesh, single, x, wide, perturbation, inverse):
            return NOT_FINITE, iteration, sweeps, jacobians
        jacobians += 1
        newest = True
        if best >= norm:  # the trial was rejected: the residual belongs to it, so evaluate at x again
            trial[:] = x
            sweep(kind, ONE_LANE, c0, mesh, single)
            sweeps += 1
            norm = scaled_norm(res, scale)
    return STALLED, limit, sweeps, jacobians


def aligned_zeros(size: int) -> np.ndarray:
    """Zeros that begin with a line of the cache, so that every batch of lanes lies in one line."""
    block = np.zeros(size + SIMD_WIDTH - 1)
    first = -block.ctypes.data % (8 * SIMD_WIDTH) // 8
    return block[first : first + size]


def sweep_buffers(n, mesh, points, nodes, lanes, more=0):
    """Zeroed :class:`SweepBuffers` for ``lanes`` lanes, of a mesh with so many ``points`` and ``nodes``; ``more`` unknowns than 5 + N."""
    base = base_field_count(n, mesh.base_cells)
    sizes = SweepBuffers(
        workspace=workspace_rows(n).size,
        parameters=parameter_rows(n).size,
        section_lengths=len(mesh.sec_cells),
        unknowns=unknown_rows(n).size + more,
        history=points * field_rows(n).size,
        base_history=base,
        fields=points * field_rows(n).size,
        base_fields=base,
        nodes=nodes * state_rows(n).size,
        residual=unknown_rows(n).size + more,
    )
    return SweepBuffers(*(aligned_zeros(size * lanes) for size in sizes))
