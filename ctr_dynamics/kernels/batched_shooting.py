"""Shooting for several cases at once: each has its own unknowns and Jacobian, and all are swept together until the last has converged or failed.

A sweep of a few lanes takes as long as one of a single lane. Lanes that no case needs therefore renew the Jacobians: each perturbs one unknown of its
case, which gives that column of the case's Jacobian by a finite difference, another one in every sweep.
"""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.kinds import unknown_lanes
from ctr_dynamics.kernels.shooting import broyden, jacobian
from ctr_dynamics.kernels.sweep import sweep

OLD, ANOTHER, OWN = 0, 1, 2
SINGULAR = 1e-3  # of a determinant: a column that makes it smaller by that is not taken over


@njit(nogil=True, error_model="numpy")
def _norms(lanes, residual, scale, alive, norm):
    """Largest scaled residual of every case into ``norm`` (C,); cases that are not finite die."""
    L = lanes.count
    for j in range(len(norm)):
        worst = 0.0
        for i in range(len(scale)):
            value = abs(residual[i * L + j]) / scale[i]
            if not math.isfinite(value):
                alive[j] = False
                value = 0.0
            worst = max(worst, value)
        norm[j] = worst


@njit(nogil=True, error_model="numpy")
def _pick(lanes, values, j, one):
    """Lane ``j`` of ``values`` (rows * L,) into ``one`` (rows,)."""
    L = lanes.count
    for r in range(len(one)):
        one[r] = values[r * L + j]


@njit(nogil=True, error_model="numpy")
def _renew(kind, lanes, c0, mesh, batch, solver, cases, j, norm):
    """New inverse Jacobian of case ``j`` at its unknowns, with its residual and norm; False if it is singular or not finite."""
    single, wide, scale = solver.single, solver.jacobian, solver.options.scale
    L, C, width = lanes.count, len(norm), unknown_lanes(kind).count
    x = single.unknowns
    _pick(lanes, batch.parameters, j, single.parameters)
    _pick(lanes, batch.section_lengths, j, single.section_lengths)
    _pick(lanes, batch.history, j, single.history)
    _pick(lanes, batch.base_history, j, single.base_history)
    for i in range(len(x)):
        x[i] = cases.unknowns[i * C + j]
    if not jacobian(kind, c0, mesh, single, x, wide, solver.options.perturbation, cases.inverse[j]):
        return False
    norm[j] = 0.0
    for i in range(len(scale)):
        batch.residual[i * L + j] = wide.residual[i * width]
        norm[j] = max(norm[j], abs(batch.residual[i * L + j]) / scale[i])
        batch.unknowns[i * L + j] = x[i]
    return True


@njit(nogil=True, error_model="numpy")
def perturb_spare_lanes(lanes, trial, cases, column, perturbation):
    """Unknowns of the lanes beyond the ``cases``: those of their case, with one perturbed, from ``column`` on."""
    L = lanes.count
    for lane in range(cases, L):
        for i in range(len(perturbation)):
            trial[i * L + lane] = trial[i * L + lane % cases]
        k = (column + lane // cases - 1) % len(perturbation)
        trial[k * L + lane] += perturbation[k]


@njit(nogil=True, error_model="numpy")
def renew_columns(lanes, residual, column, perturbation, inverse, work):
    """Take over into the ``inverse`` (C, m, m) the columns of the Jacobian that the spare lanes from ``column`` on have found (Sherman and Morrison);
    returns the next column. ``work`` (2, m) is written to."""
    L, cases, m = lanes.count, len(inverse), len(perturbation)
    moved, row = work[0], work[1]
    for lane in range(cases, L):
        k, case = (column + lane // cases - 1) % m, lane % cases
        moved[:] = 0.0
        for q in range(m):
            change = residual[q * L + lane] - residual[q * L + case]
            for i in range(m):
                moved[i] += inverse[case, i, q] * change
        if math.isfinite(moved.sum()) and abs(moved[k]) > SINGULAR * perturbation[k]:
            row[:] = inverse[case, k]
            pivot = 1.0 / moved[k]
            moved[k] -= perturbation[k]
            for i in range(m):
                for q in range(m):
                    inverse[case, i, q] -= moved[i] * pivot * row[q]
    return (column + L // cases - 1) % m


@njit(nogil=True, error_model="numpy")
def solve_cases(kind, lanes, c0, mesh, batch, solver, cases, column):
    """Unknowns of all living ``cases`` (:class:`~ctr_dynamics.kernels.structures.Cases`), in place.

    ``batch``: buffers of the ``lanes``, with the parameters, lengths and histories of the cases; ``solver``: for one case alone. The cases have the
    first lanes; spare lanes come to whole perturbations of all cases, each with the data of its case: lane j belongs to case j modulo C.
    ``column``: the unknown to perturb first. Cases that cannot be solved die; with spare lanes, all is over then. Without them a new Jacobian of one
    case serves all that want one: the cases are alike. A case that it does not help gets its own. Returns sweeps, new Jacobians and the next column.
    """
    scale, perturb, tolerance, limit = solver.options
    trial, res = batch.unknowns, batch.residual
    x, inverse, fresh, alive, spent = cases
    L, C, m = lanes.count, len(alive), len(scale)
    share, renewed = L == C, 0
    norm, new = np.empty(C), np.empty(C)
    # whose Jacobian a case has: an OLD one, a new one of ANOTHER case, a new one of its OWN
    newest = np.zeros(C, np.int64)
    dx, dr, work = np.empty(m), np.empty(m), np.empty((2, m))
    before = np.empty(m * L)
    shared = -1
    for j in range(C):
        if fresh[j] and alive[j]:
            if shared < 0:
                alive[j] = _renew(kind, lanes, c0, mesh, batch, solver, cases, j, norm)
                renewed += 1
                shared = j if alive[j] and share else -1
                newest[j] = OWN
            else:
                inverse[j] = inverse[shared]
                newest[j] = ANOTHER
            fresh[j] = False
    for i in range(m):
        for j in range(C):
            trial[i * L + j] = x[i * C + j]
    perturb_spare_lanes(lanes, trial, C, column, perturb)
    sweep(kind, lanes, c0, mesh, batch)
    column = renew_columns(lanes, res, column, perturb, inverse, work)
    sweeps = 1
    _norms(lanes, res, scale, alive, norm)
    for _ in range(limit):
        waiting = False
        before[:] = res
        shared = -1
        for j in range(C):
            if alive[j] and norm[j] > tolerance:
                waiting = True
                spent[j] += 1
                for i in range(m):
                    change = 0.0
                    for k in range(m):
                        change -= inverse[j, i, k] * res[k * L + j]
                    trial[i * L + j] = x[i * C + j] + change
        if not waiting or not (share or alive.all()):
            return sweeps, renewed, column
        perturb_spare_lanes(lanes, trial, C, column, perturb)
        sweep(kind, lanes, c0, mesh, batch)
        column = renew_columns(lanes, res, column, perturb, inverse, work)
        sweeps += 1
        _norms(lanes, res, scale, alive, new)
        for j in range(C):
            if not alive[j] or norm[j] <= tolerance:
                continue
            better = new[j] < norm[j]
            slow = new[j] > tolerance and new[j] > 0.6 * norm[j]
            if better:
                for i in range(m):
                    dx[i] = trial[i * L + j] - x[i * C + j]
                    dr[i] = res[i * L + j] - before[i * L + j]
                    x[i * C + j] = trial[i * L + j]
                broyden(inverse[j], dx, dr, work)
                norm[j] = new[j]
            if not better and newest[j] == OWN:
                alive[j] = False
            elif not better or slow:
                if newest[j] == OLD and shared >= 0:
                    inverse[j] = inverse[shared]
                    newest[j] = ANOTHER
                    if not better:  # back to where it was
                        for i in range(m):
                            res[i * L + j] = before[i * L + j]
                else:
                    alive[j] = _renew(kind, lanes, c0, mesh, batch, solver, cases, j, norm)
                    renewed += 1
                    newest[j] = OWN
                    shared = j if alive[j] and share else -1
            else:
                newest[j] = OLD
    for j in range(C):
        alive[j] &= norm[j] <= tolerance
    return sweeps, renewed, column
