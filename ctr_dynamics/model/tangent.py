"""Tangent of a step: how fields, tip and nodes after it depend on fields and parameters before it, for many columns at once.

Every stage is linearised where it was solved. One sweep carries the base case, one lane for each unknown and one for each column; the lanes of
the unknowns give the Jacobian of the shooting problem, through which every column's boundary values follow (implicit function theorem).
"""

import numpy as np
from numba import njit

from ctr_dynamics.model.kernels import sweep
from ctr_dynamics.model.newton import broadcast, invert, lane_lengths
from ctr_dynamics.model.scheme import RATE_NOW, RATES, Y_BEFORE, Y_NOW
from ctr_dynamics.model.step import history
from ctr_dynamics.model.workspace import input_row, lane_count

THETA = 0.55  # of the one-stage tangent: nearly the trapezoidal rule, with a little damping of what the step does not resolve


@njit(cache=True, nogil=True, error_model="numpy")
def _combine(lanes, values, rows, m, columns, scale, perturb, dx, target):
    """d(values)/d(column) with the boundary values following: target (rows, columns) from perturbed lanes of ``values`` (rows, L)."""
    # unsigned indices: a signed one may count from the end of the array, and LLVM does not vectorise over that choice
    L, first = np.uint64(lane_count(lanes)), np.uint64(1 + m)
    count, unknowns, one = np.uint64(columns), np.uint64(m), np.uint64(1)
    inverse = 1.0 / perturb
    for r in range(np.uint64(rows)):
        start = r * L
        base = values[start]
        for k in range(count):
            target[r, k] = (values[start + first + k] - base) * scale
        for i in range(unknowns):
            slope = (values[start + one + i] - base) * inverse[i]
            if slope != 0.0:
                for k in range(count):
                    target[r, k] += slope * dx[i, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _perturb(lanes, values, rows, m, columns, epsilon, change):
    """Add ``epsilon`` times the columns ``change`` (rows, r) to their lanes of ``values`` (rows, L)."""
    L, first, count = np.uint64(lane_count(lanes)), np.uint64(1 + m), np.uint64(columns)
    for r in range(np.uint64(rows)):
        start = r * L + first
        for k in range(count):
            values[start + k] += epsilon * change[r, k]


@njit(cache=True, nogil=True, error_model="numpy")
def linearise(
    tubes,
    lanes,
    mesh,
    c0,
    par,
    dpar,
    x,
    hist,
    histb,
    dhist,
    epsilon,
    perturb,
    big,
    inverse,
    dx,
    dfields,
    dnodes,
):
    """Linearise one solved two-point problem.

    ``par`` (NP,) and ``x`` (m,): where it was solved, with ``hist``, ``histb``. ``dpar`` (NP, r), ``dhist`` (fields, r): columns of perturbations
    in units in which a step of ``epsilon`` is small. Writes ``dx`` (m, r), ``dfields`` (fields, r), ``dnodes`` (rows, r; the last rows of the
    node states, nodes * S for all of them) and the inverse shooting Jacobian ``inverse`` (m, m). False if that is singular or anything is not finite.
    """
    n = len(tubes)
    L = lane_count(lanes)
    m = 5 + n
    columns = dpar.shape[1]
    W, parL, seclenL, xL, histL, histbL, outL, outbL, nodesL, resL = big
    broadcast(lanes, par, parL)
    broadcast(lanes, x, xL)
    broadcast(lanes, hist, histL)
    broadcast(lanes, histb, histbL)
    for i in range(m):
        xL[i * L + 1 + i] += perturb[i]
    for r in range(len(par)):
        for k in range(columns):
            parL[r * L + 1 + m + k] += epsilon * dpar[r, k]
    main = len(hist)
    _perturb(lanes, histL, main, m, columns, epsilon, dhist)
    _perturb(lanes, histbL, len(histb), m, columns, epsilon, dhist[main:])
    lane_lengths(tubes, lanes, mesh, parL, seclenL)
    sweep(tubes, lanes, W, c0, mesh,
          parL, seclenL, xL, histL, histbL, outL, outbL, nodesL, resL)  # fmt: skip
    jacobian = np.empty((m, m))
    for i in range(m):
        for k in range(m):
            jacobian[i, k] = (resL[i * L + 1 + k] - resL[i * L]) / perturb[k]
            if not np.isfinite(jacobian[i, k]):
                return False
    if not invert(jacobian, inverse):
        return False
    for i in range(m):
        for k in range(columns):
            dx[i, k] = 0.0
    for q in range(m):
        for k in range(columns):
            slope = (resL[q * L + 1 + m + k] - resL[q * L]) / epsilon
            if not np.isfinite(slope):
                return False
            for i in range(m):
                dx[i, k] -= inverse[i, q] * slope
    _combine(lanes, outL, main, m, columns, 1.0 / epsilon, perturb, dx, dfields)
    _combine(lanes, outbL, len(histb), m, columns, 1.0 / epsilon, perturb, dx, dfields[main:])
    last = nodesL[len(nodesL) - dnodes.shape[0] * L :]
    _combine(lanes, last, dnodes.shape[0], m, columns, 1.0 / epsilon, perturb, dx, dnodes)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def theta_tangent(
    tubes,
    lanes,
    mesh,
    dt,
    par,
    inputs,
    x,
    after,
    rate,
    dpar,
    epsilon,
    perturb,
    big,
    work,
    dy,
    drate,
    inverse,
    dx,
    dnodes,
):
    """Columns over one step by the one-stage theta method, linearised at the step's end: one sweep instead of one a stage.

    The covariance does not need the model's own time accuracy. ``after``, ``rate`` (fields,): fields and their rates at the end, ``x`` (m,) the
    unknowns there, ``inputs`` (3N + 6,). ``dy``, ``drate`` (fields, r): columns of the fields and of their rates, advanced in place.
    Returns False where the step's end cannot be linearised.
    """
    hist, histb, dhist = work
    main = len(hist)
    c0 = 1.0 / (THETA * dt)
    ratio = (1.0 - THETA) / THETA
    for i in range(main):
        hist[i] = rate[i] - c0 * after[i]
    for i in range(len(histb)):
        histb[i] = rate[main + i] - c0 * after[main + i]
    fields, columns = dy.shape
    for i in range(fields):
        for k in range(columns):
            dhist[i, k] = -c0 * dy[i, k] - ratio * drate[i, k]
    for i in range(len(inputs)):
        par[input_row(tubes, i)] = inputs[i]
    if not linearise(
        tubes,
        lanes,
        mesh,
        c0,
        par,
        dpar,
        x,
        hist,
        histb,
        dhist,
        epsilon,
        perturb,
        big,
        inverse,
        dx,
        dy,
        dnodes,
    ):
        return False
    for i in range(fields):
        for k in range(columns):
            drate[i, k] = c0 * dy[i, k] + dhist[i, k]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def step_tangent(tubes, lanes, mesh, c0, weights, par, inputs, found, before, rates, dpar, dinputs, epsilon, perturb, big, work,
                 dbank, inverse, dx, dnodes):  # fmt: skip
    """Tangent of a whole step.

    ``before`` (slots, fields): stored fields before the step; ``rates`` (stages, fields): the stages' rates; ``found`` (stages, m): their
    unknowns; ``inputs`` as in :func:`ctr_dynamics.model.step.step`, ``dinputs`` (stages, inputs, r) their columns, added to those of the
    parameters ``dpar`` (NP, r). ``dbank`` (3 + stages, fields, r): columns of the stored fields, advanced in place like the fields themselves.
    ``work`` = (hist, histb, dhist (fields, r), bank (3 + stages, fields), dfields (fields, r), dpar of a stage (NP, r)).
    ``dnodes`` (rows, r): columns of the last ``rows`` numbers of the node states. Returns False where a stage cannot be linearised.
    """
    hist, histb, dhist, bank, dfields, dstage = work
    slots, fields, columns = dbank.shape
    stages = len(c0)
    for i in range(fields):
        for slot in range(RATES):
            bank[slot, i] = before[slot, i]
        for stage in range(stages):
            bank[RATES + stage, i] = rates[stage, i]
    for r in range(dpar.shape[0]):
        for k in range(columns):
            dstage[r, k] = dpar[r, k]
    for stage in range(stages):
        history(weights[stage], bank, hist, histb)
        dhist[:] = 0.0
        for slot in range(RATES + stage):
            w = weights[stage, slot]
            if w != 0.0:
                for i in range(fields):
                    for k in range(columns):
                        dhist[i, k] += w * dbank[slot, i, k]
        for i in range(inputs.shape[1]):
            row = input_row(tubes, i)
            par[row] = inputs[stage, i]
            for k in range(columns):
                dstage[row, k] = dpar[row, k] + dinputs[stage, i, k]
        if not linearise(tubes, lanes, mesh, c0[stage], par, dstage, found[stage], hist, histb, dhist, epsilon, perturb, big, inverse,
                         dx, dfields, dnodes):  # fmt: skip
            return False
        for i in range(fields):
            for k in range(columns):
                dbank[RATES + stage, i, k] = c0[stage] * dfields[i, k] + dhist[i, k]
    for i in range(fields):
        for k in range(columns):
            dbank[Y_BEFORE, i, k] = dbank[Y_NOW, i, k]
            dbank[RATE_NOW, i, k] = dbank[RATES + stages - 1, i, k]
            dbank[Y_NOW, i, k] = dfields[i, k]
    return True
