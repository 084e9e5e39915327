"""One time step of two simulations in the same sweeps."""

import math

import numpy as np

from ctr_dynamics.kernels.batched_shooting import solve_lanes
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import RATE_NOW, RATES, Y_BEFORE, Y_NOW
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.time_step import extrapolate, history, remember
from ctr_dynamics.kernels.workspace import input_row

PAIR_LANES = (False,) * 4  # lane tuple of a pair: both cases, and a probe of each


@njit(cache=True, nogil=True, error_model="numpy")
def _spread(first, second, target):
    """The numbers (rows,) of both cases to their lanes of ``target`` (rows, 4), flat."""
    for i in range(len(first)):
        target[4 * i] = target[4 * i + 2] = first[i]
        target[4 * i + 1] = target[4 * i + 3] = second[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(values, first, second):
    """The opposite of :func:`_spread`."""
    for i in range(len(first)):
        first[i], second[i] = values[4 * i], values[4 * i + 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _rates(c0, out, j, hist, rate):
    """``rate`` (rows,) of the fields of case ``j`` after a stage, c0 out + hist, from its lane of ``out`` (rows, 4), flat."""
    for i in range(len(rate)):
        rate[i] = c0 * out[4 * i + j] + hist[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _together(first, second, n):
    """Whether all inputs (stages, inputs) of both cases are finite, and their translations the same."""
    total = 0.0
    for stage in range(len(first)):
        for i in range(first.shape[1]):
            total += abs(first[stage, i]) + abs(second[stage, i])
        for i in range(2 * n, 3 * n):
            if first[stage, i] != second[stage, i]:
                return False
    return math.isfinite(total)


@njit(cache=True, nogil=True, error_model="numpy")
def step_both(tubes, few, mesh, c0, weights, pars, inputs, banks, unknowns, earlier, founds, inverses, usable, work, scale, perturb, tolerance, limit,
          column, nodes, alive):  # fmt: skip
    """A step of both cases, as :func:`ctr_dynamics.kernels.time_step.step` for one; returns sweeps, 0 where they cannot go together, and new
    Jacobians.

    ``work``: buffers of the four lanes, of one for a Jacobian, of the Jacobian's lanes, and (2, fields) for histories. ``column``: the unknown to
    probe first. ``nodes``: states at the nodes (nodes, S) of both. ``alive`` (2,): set; False where a case does not converge, and then
    nothing else has changed."""
    alive[:] = True
    first, second = inputs
    if not _together(first, second, len(tubes)):
        return 0, 0
    big, one, eight, h = work
    par, seclen, hist, histb, out, outb = big[1], big[2], big[4], big[5], big[6], big[7]
    n, stages, m, main = len(tubes), len(c0), len(scale), len(big[4]) // 4
    x, sweeps, jacobians, spent = np.empty(2 * m), 0, 0, np.zeros(2, np.int64)
    guess, inverse = np.empty((2, stages, m)), np.empty((2, m, m))
    lengths = np.empty(len(mesh.sec_cells))
    fresh = np.empty(2, np.bool_)
    _spread(pars[0], pars[1], par)
    for j in range(2):
        inverse[j], fresh[j] = inverses[j], not usable[j]
        extrapolate(unknowns[j], earlier[j], perturb, guess[j])
    for stage in range(stages):
        for j in range(2):
            history(weights[stage], banks[j], h[j, :main], h[j, main:])
        _spread(h[0, :main], h[1, :main], hist)
        _spread(h[0, main:], h[1, main:], histb)
        for i in range(first.shape[1]):
            row = 4 * input_row(tubes, i)
            par[row] = par[row + 2] = first[stage, i]
            par[row + 1] = par[row + 3] = second[stage, i]
        section_lengths(mesh.bp_tube, mesh.bp_offset, first[stage, 2 * n : 3 * n], lengths)
        _spread(lengths, lengths, seclen)
        for j in range(2):
            for i in range(m):
                # what the guess missed at the stage before, it misses here too
                x[2 * i + j] = guess[j, stage, i] + (
                    founds[j, stage - 1, i] - guess[j, stage - 1, i] if stage else 0.0
                )
        plain, renewed, column = solve_lanes(tubes, PAIR_LANES, few, mesh, c0[stage], big, one, eight, x, inverse, fresh, alive, scale, perturb,
                                             tolerance, limit, spent, column)  # fmt: skip
        sweeps += plain
        jacobians += renewed
        if not (alive[0] and alive[1]):
            return sweeps, jacobians
        for j in range(2):
            _rates(c0[stage], out, j, h[j, :main], banks[j][RATES + stage, :main])
            _rates(c0[stage], outb, j, h[j, main:], banks[j][RATES + stage, main:])
            for i in range(m):
                founds[j, stage, i] = x[2 * i + j]
    for j in range(2):
        inverses[j][:] = inverse[j]
        for i in range(inputs[j].shape[1]):
            pars[j][input_row(tubes, i)] = inputs[j][stages - 1, i]
        banks[j][Y_BEFORE] = banks[j][Y_NOW]
        remember(unknowns[j], earlier[j], founds[j])
    _gather(out, banks[0][Y_NOW, :main], banks[1][Y_NOW, :main])
    _gather(outb, banks[0][Y_NOW, main:], banks[1][Y_NOW, main:])
    for j in range(2):
        banks[j][RATE_NOW] = banks[j][RATES + stages - 1]
    _gather(big[8], nodes[0].reshape(-1), nodes[1].reshape(-1))
    return sweeps, jacobians
