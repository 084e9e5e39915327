"""Shooting: Newton's method on the tip's imbalance, with the Jacobian from perturbed lanes of one sweep and Broyden updates between."""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.lanes import PACK
from ctr_dynamics.kernels.rod import sweep
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.workspace import base_rows, field_rows, lane_count, parameter_rows, state_rows

CONVERGED, STALLED, NOT_FINITE = 0, 1, 2


@njit(cache=True, nogil=True)
def scaled_norm(res, scale):
    """Largest scaled imbalance; infinity where anything is not finite."""
    worst = 0.0
    for i in range(len(scale)):
        value = abs(res[i]) / scale[i]
        if not math.isfinite(value):
            return math.inf
        worst = max(worst, value)
    return worst


@njit(cache=True, nogil=True)
def broadcast(lanes, source, target):
    """Copy every number of ``source`` (rows,) to all lanes of ``target`` (rows, L), both flat."""
    L = np.uint64(lane_count(lanes))
    for r in range(np.uint64(len(source))):
        value, start = source[r], r * L
        for j in range(L):
            target[start + j] = value


@njit(cache=True, nogil=True)
def lane_lengths(tubes, lanes, mesh, par, seclen):
    """Section lengths of every lane at the translations in its parameters ``par`` (rows * L,), into ``seclen`` (sections * L,)."""
    n, L = len(tubes), lane_count(lanes)
    sections = len(mesh.sec_cells)
    beta, lengths = np.empty(n), np.empty(sections)
    for j in range(L):
        for i in range(n):
            beta[i] = par[(13 * n + i) * L + j]
        section_lengths(mesh.bp_tube, mesh.bp_offset, beta, lengths)
        for k in range(sections):
            seclen[k * L + j] = lengths[k]


@njit(cache=True, nogil=True)
def jacobian(tubes, lanes, mesh, c0, par, seclen, x, hist, histb, big, step, inverse):
    """Inverse of d(imbalance)/dx at ``x`` by one sweep of perturbed lanes into ``inverse`` (m, m); False if it is singular or not finite.

    The imbalance at ``x`` itself stays in the first lane of the last buffer of ``big``.
    """
    L = lane_count(lanes)
    m = len(x)
    W, parL, seclenL, xL, _, histbL, outL, outbL, nodesL, resL = big
    broadcast(lanes, par, parL)
    broadcast(lanes, seclen, seclenL)
    broadcast(lanes, x, xL)
    broadcast(lanes, histb, histbL)
    for i in range(m):
        xL[i * L + i + 1] += step[i]
    sweep(tubes, lanes, W, c0, mesh,
          parL, seclenL, xL, hist, histbL, outL[:0], outbL, nodesL[:0], resL)  # fmt: skip
    matrix = np.empty((m, m))
    for i in range(m):
        for k in range(m):
            value = (resL[i * L + k + 1] - resL[i * L]) / step[k]
            if not math.isfinite(value):
                return False
            matrix[i, k] = value
    return invert(matrix, inverse)


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def broyden(inverse, dx, dr, work):
    """Broyden's update of the inverse Jacobian (m, m) in place, (dx - inv dr) dx^T inv / (dx^T inv dr), after x moved by ``dx`` and the
    imbalance by ``dr`` (m,). ``work`` (2, m) is written to."""
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


@njit(cache=True, nogil=True)
def solve(
    tubes,
    lane,
    lanes,
    mesh,
    c0,
    par,
    seclen,
    x,
    hist,
    histb,
    small,
    big,
    scale,
    step,
    inverse,
    fresh,
    tolerance,
    limit,
):
    """Find the unknowns ``x`` (m,) at which the tip is in balance; ``x`` and ``inverse`` are updated in place.

    ``small`` and ``big`` are the buffers of one lane and of the Jacobian's lanes; ``scale`` (m,) the unit of each imbalance, ``step`` (m,)
    the perturbation of each unknown; ``fresh`` False if ``inverse`` holds a usable inverse Jacobian of an earlier solve.
    Returns (outcome, iterations, plain sweeps, Jacobian sweeps).
    """
    m = len(x)
    W, out, outb, nodes, res = small
    trial = np.empty(m)
    dx = np.empty(m)
    previous = np.empty(m)
    work = np.empty((2, m))
    sweeps, jacobians = 0, 0
    newest = False
    L = lane_count(lanes)
    if fresh:
        if not jacobian(tubes, lanes, mesh, c0, par, seclen, x, hist, histb, big, step, inverse):
            return NOT_FINITE, 0, 0, 1
        jacobians += 1
        newest = True
        for i in range(m):
            res[i] = big[9][i * L]
        norm = scaled_norm(res, scale)
    else:
        norm = math.inf
    if norm <= tolerance or not fresh:  # the fields belong to the last plain sweep
        sweep(tubes, lane, W, c0, mesh,
              par, seclen, x, hist, histb, out, outb, nodes, res)  # fmt: skip
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
            sweep(tubes, lane, W, c0, mesh,
                  par, seclen, trial, hist, histb, out, outb, nodes, res)  # fmt: skip
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
        if not jacobian(tubes, lanes, mesh, c0, par, seclen, x, hist, histb, big, step, inverse):
            return NOT_FINITE, iteration, sweeps, jacobians
        jacobians += 1
        newest = True
        if best >= norm:  # the trial was rejected: res belongs to it, so evaluate at x again
            sweep(tubes, lane, W, c0, mesh,
                  par, seclen, x, hist, histb, out, outb, nodes, res)  # fmt: skip
            sweeps += 1
            norm = scaled_norm(res, scale)
    return STALLED, limit, sweeps, jacobians


def lanes_for(count: int) -> tuple[int, ...]:
    """A lane tuple with room for ``count`` lanes: one, or a multiple of the vector width."""
    return () if count == 1 else (0,) * math.ceil(count / 8)


def lanes_free(count: int) -> int:
    """Lanes that a sweep with ``count`` lanes has beside them."""
    return max(1, 8 * len(lanes_for(count))) - count


def aligned_zeros(size: int) -> np.ndarray:
    """Zeros that begin with a line of the cache, so that every pack of lanes lies in one line."""
    block = np.zeros(size + PACK - 1)
    first = -block.ctypes.data % (8 * PACK) // 8
    return block[first : first + size]


def buffers(n: int, mesh, points: int, nodes: int, lanes: int, rows: int):
    """Zeroed buffers of a sweep with ``lanes`` lanes: (W, par, seclen, x, hist, histb, out, outb, nodes, res), flat."""
    S, F = state_rows(n), field_rows(n)
    base = base_rows(n, mesh.base_cells)
    sizes = (
        rows,
        parameter_rows(n),
        len(mesh.sec_cells),
        5 + n,
        points * F,
        base,
        points * F,
        base,
        nodes * S,
        5 + n,
    )
    return tuple(aligned_zeros(size * lanes) for size in sizes)
