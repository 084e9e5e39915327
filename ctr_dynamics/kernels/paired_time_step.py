"""One time step of two runs in the same sweeps."""

import math

import numpy as np

from ctr_dynamics.kernels.batched_shooting import solve_cases
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.kinds import Lanes
from ctr_dynamics.kernels.layout import (
    RATE_NOW,
    RATES,
    Y_BEFORE,
    Y_NOW,
    input_row,
    input_rows,
    unknown_rows,
)
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.structures import Cases
from ctr_dynamics.kernels.time_step import extrapolate, fill_history, remember

PAIR_LANES = Lanes(4, 4)  # both runs, and a perturbed unknown of each


@njit(nogil=True, error_model="numpy")
def _spread(first, second, target):
    """The numbers (rows,) of both runs to their lanes of ``target`` (rows, 4), flat."""
    for i in range(len(first)):
        target[4 * i] = target[4 * i + 2] = first[i]
        target[4 * i + 1] = target[4 * i + 3] = second[i]


@njit(nogil=True, error_model="numpy")
def _gather(values, first, second):
    """The opposite of :func:`_spread`."""
    for i in range(len(first)):
        first[i], second[i] = values[4 * i], values[4 * i + 1]


@njit(nogil=True, error_model="numpy")
def _rates(c0, fields, j, history, rate):
    """``rate`` (rows,) of the fields of run ``j`` after a stage, c0 y + h, from its lane of ``fields`` (rows, 4), flat."""
    for i in range(len(rate)):
        rate[i] = c0 * fields[4 * i + j] + history[i]


@njit(nogil=True, error_model="numpy")
def _compatible(kind, first, second):
    """Whether all inputs (stages, inputs) of both runs are finite, and their translations the same."""
    beta = input_rows(kind.tubes).beta
    total = 0.0
    for stage in range(len(first)):
        for i in range(first.shape[1]):
            total += abs(first[stage, i]) + abs(second[stage, i])
        for i in range(beta, beta + kind.tubes):
            if first[stage, i] != second[stage, i]:
                return False
    return math.isfinite(total)


@njit(nogil=True, error_model="numpy")
def advance_both(kind, mesh, scheme, buffers, runs, inputs, found, usable, column, alive):
    """A step of both runs, as :func:`ctr_dynamics.kernels.time_step.advance_step` for one; returns sweeps, 0 where they cannot go together, and new
    Jacobians.

    ``buffers``: :class:`~ctr_dynamics.kernels.structures.PairBuffers`; ``runs``: two :class:`~ctr_dynamics.kernels.structures.RunArrays`;
    ``inputs``: two arrays (stages, inputs); ``found`` (2, stages, 5 + N): unknowns at the stages; ``usable``: whether each inverse Jacobian is.
    ``column``: the unknown to perturb first. ``alive`` (2,): set; False where a run does not converge, and then nothing else has changed.
    """
    alive[:] = True
    first, second = inputs
    if not _compatible(kind, first, second):
        return 0, 0
    c0, weights = scheme
    batch, solver, h = buffers.batch, buffers.solver, buffers.histories
    n, stages, m, main = kind.tubes, len(c0), unknown_rows(kind.tubes).size, len(batch.history) // 4
    beta = input_rows(n).beta
    sweeps, jacobians = 0, 0
    guess = np.empty((2, stages, m))
    lengths = np.empty(len(mesh.sec_cells))
    cases = Cases(np.empty(2 * m), np.empty((2, m, m)), np.empty(2, np.bool_), alive, np.zeros(2, np.int64))
    x = cases.unknowns
    par = batch.parameters
    _spread(runs[0].parameters, runs[1].parameters, par)
    for j in range(2):
        cases.inverse[j], cases.fresh[j] = runs[j].inverse, not usable[j]
        extrapolate(runs[j].unknowns, runs[j].earlier, solver.options.perturbation, guess[j])
    for stage in range(stages):
        for j in range(2):
            fill_history(weights[stage], runs[j].bank, h[j, :main], h[j, main:])
        _spread(h[0, :main], h[1, :main], batch.history)
        _spread(h[0, main:], h[1, main:], batch.base_history)
        for i in range(first.shape[1]):
            row = 4 * input_row(n, i)
            par[row] = par[row + 2] = first[stage, i]
            par[row + 1] = par[row + 3] = second[stage, i]
        section_lengths(mesh.bp_tube, mesh.bp_offset, first[stage, beta : beta + n], lengths)
        _spread(lengths, lengths, batch.section_lengths)
        for j in range(2):
            for i in range(m):
                # what the guess missed at the stage before, it misses here too
                x[2 * i + j] = guess[j, stage, i] + (
                    found[j, stage - 1, i] - guess[j, stage - 1, i] if stage else 0.0
                )
        plain, renewed, column = solve_cases(kind, PAIR_LANES, c0[stage], mesh, batch, solver, cases, column)
        sweeps += plain
        jacobians += renewed
        if not (alive[0] and alive[1]):
            return sweeps, jacobians
        for j in range(2):
            _rates(c0[stage], batch.fields, j, h[j, :main], runs[j].bank[RATES + stage, :main])
            _rates(c0[stage], batch.base_fields, j, h[j, main:], runs[j].bank[RATES + stage, main:])
            for i in range(m):
                found[j, stage, i] = x[2 * i + j]
    for j in range(2):
        runs[j].inverse[:] = cases.inverse[j]
        for i in range(inputs[j].shape[1]):
            runs[j].parameters[input_row(n, i)] = inputs[j][stages - 1, i]
        runs[j].bank[Y_BEFORE] = runs[j].bank[Y_NOW]
        remember(runs[j].unknowns, runs[j].earlier, found[j])
    _gather(batch.fields, runs[0].bank[Y_NOW, :main], runs[1].bank[Y_NOW, :main])
    _gather(batch.base_fields, runs[0].bank[Y_NOW, main:], runs[1].bank[Y_NOW, main:])
    for j in range(2):
        runs[j].bank[RATE_NOW] = runs[j].bank[RATES + stages - 1]
    _gather(batch.nodes, runs[0].nodes.reshape(-1), runs[1].nodes.reshape(-1))
    return sweeps, jacobians
