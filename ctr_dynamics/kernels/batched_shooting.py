"""Shooting for several cases at once: each has its own unknowns and Jacobian, and all are swept together until the last has converged or failed.

A sweep of a few lanes takes as long as one of a single lane. Lanes that no case needs are therefore probes: each perturbs one unknown of its case
and so renews one column of that case's Jacobian, another one in every sweep.
"""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.rod import sweep
from ctr_dynamics.kernels.shooting import broyden, jacobian
from ctr_dynamics.kernels.workspace import lane_count

OLD, ANOTHER, OWN = 0, 1, 2
SINGULAR = 1e-3  # of a determinant: a column that makes it smaller by that is not taken over


@njit(cache=True, nogil=True, error_model="numpy")
def _norms(res, scale, lanes, alive, norm):
    """Largest scaled imbalance of every case into ``norm`` (C,); cases that are not finite die."""
    L = lane_count(lanes)
    for j in range(len(norm)):
        worst = 0.0
        for i in range(len(scale)):
            value = abs(res[i * L + j]) / scale[i]
            if not math.isfinite(value):
                alive[j] = False
                value = 0.0
            worst = max(worst, value)
        norm[j] = worst


@njit(cache=True, nogil=True, error_model="numpy")
def _pick(values, lanes, j, one):
    """Lane ``j`` of ``values`` (rows * L,) into ``one`` (rows,)."""
    L = lane_count(lanes)
    for r in range(len(one)):
        one[r] = values[r * L + j]


@njit(cache=True, nogil=True, error_model="numpy")
def _renew(tubes, lanes, few, mesh, c0, big, one, eight, x, j, perturb, inverse, scale, norm):
    """New inverse Jacobian of case ``j`` at its ``x``, with its imbalance and norm; False if it is singular or not finite."""
    W, par, seclen, trial, hist, histb, out, outb, nodes, res = big
    par1, seclen1, x1, hist1, histb1 = one
    L, C, lanes8 = lane_count(lanes), len(norm), lane_count(few)
    _pick(par, lanes, j, par1)
    _pick(seclen, lanes, j, seclen1)
    _pick(hist, lanes, j, hist1)
    _pick(histb, lanes, j, histb1)
    for i in range(len(x1)):
        x1[i] = x[i * C + j]
    if not jacobian(tubes, few, mesh, c0, par1, seclen1, x1, hist1, histb1, eight, perturb, inverse[j]):
        return False
    norm[j] = 0.0
    for i in range(len(scale)):
        res[i * L + j] = eight[9][i * lanes8]
        norm[j] = max(norm[j], abs(res[i * L + j]) / scale[i])
        trial[i * L + j] = x1[i]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _probe(lanes, trial, cases, column, perturb):
    """Unknowns of the probes: those of their case, with one perturbed, from ``column`` on."""
    L = lane_count(lanes)
    for lane in range(cases, L):
        for i in range(len(perturb)):
            trial[i * L + lane] = trial[i * L + lane % cases]
        k = (column + lane // cases - 1) % len(perturb)
        trial[k * L + lane] += perturb[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _learn(lanes, res, column, perturb, inverse, work):
    """Take over into the ``inverse`` (C, m, m) the columns of the Jacobian that the probes from ``column`` on have found (Sherman and Morrison);
    returns the next column. ``work`` (2, m) is written to."""
    L, cases, m = lane_count(lanes), len(inverse), len(perturb)
    moved, row = work[0], work[1]
    for lane in range(cases, L):
        k, case = (column + lane // cases - 1) % m, lane % cases
        moved[:] = 0.0
        for q in range(m):
            change = res[q * L + lane] - res[q * L + case]
            for i in range(m):
                moved[i] += inverse[case, i, q] * change
        if math.isfinite(moved.sum()) and abs(moved[k]) > SINGULAR * perturb[k]:
            row[:] = inverse[case, k]
            pivot = 1.0 / moved[k]
            moved[k] -= perturb[k]
            for i in range(m):
                for q in range(m):
                    inverse[case, i, q] -= moved[i] * pivot * row[q]
    return (column + L // cases - 1) % m


@njit(cache=True, nogil=True, error_model="numpy")
def solve_lanes(tubes, lanes, few, mesh, c0, big, one, eight, x, inverse, fresh, alive, scale, perturb, tolerance, limit, spent,
                column):  # fmt: skip
    """Unknowns ``x`` (m * C,) of all living cases, in place; returns sweeps, new Jacobians and the next column to probe. Cases that cannot be
    solved die; with probes, all is over then.

    The cases have the first lanes; if there are more, these come to whole probes of all cases, each with the data of its case: lane j belongs to
    case j modulo C. ``fresh`` (C,): cases whose ``inverse`` is not usable. ``spent`` (C,): sweeps of each case, counted on. ``column``: the
    unknown to probe first. Without probes a new Jacobian of one case serves all that want one: the cases are alike. A case that it does not
    help gets its own.
    """
    W, par, seclen, trial, hist, histb, out, outb, nodes, res = big
    L, C, m = lane_count(lanes), len(alive), len(scale)
    share, renewed = L == C, 0
    norm, new = np.empty(C), np.empty(C)
    newest = np.zeros(
        C, np.int64
    )  # whose Jacobian a case has: an OLD one, a new one of ANOTHER case, a new one of its OWN
    dx, dr, work = np.empty(m), np.empty(m), np.empty((2, m))
    before = np.empty(m * L)
    shared = -1
    for j in range(C):
        if fresh[j] and alive[j]:
            if shared < 0:
                alive[j] = _renew(
                    tubes, lanes, few, mesh, c0, big, one, eight, x, j, perturb, inverse, scale, norm
                )
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
    _probe(lanes, trial, C, column, perturb)
    sweep(tubes, lanes, W, c0, mesh, par, seclen, trial, hist, histb, out, outb, nodes, res)
    column = _learn(lanes, res, column, perturb, inverse, work)
    sweeps = 1
    _norms(res, scale, lanes, alive, norm)
    for _ in range(limit):
        waiting = False
        before[:] = res
        shared = -1
        for j in range(C):
            if alive[j] and norm[j] > tolerance:
                waiting = True
                spent[j] += 1
                for i in range(m):
                    step = 0.0
                    for k in range(m):
                        step -= inverse[j, i, k] * res[k * L + j]
                    trial[i * L + j] = x[i * C + j] + step
        if not waiting or not (share or alive.all()):
            return sweeps, renewed, column
        _probe(lanes, trial, C, column, perturb)
        sweep(tubes, lanes, W, c0, mesh, par, seclen, trial, hist, histb, out, outb, nodes, res)
        column = _learn(lanes, res, column, perturb, inverse, work)
        sweeps += 1
        _norms(res, scale, lanes, alive, new)
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
                    alive[j] = _renew(
                        tubes, lanes, few, mesh, c0, big, one, eight, x, j, perturb, inverse, scale, norm
                    )
                    renewed += 1
                    newest[j] = OWN
                    shared = j if alive[j] and share else -1
            else:
                newest[j] = OLD
    for j in range(C):
        alive[j] &= norm[j] <= tolerance
    return sweeps, renewed, column
