"""Tangent of a step: how fields, tip and nodes after it depend on fields and parameters before it, for many columns at once.

Every stage is linearised where it was solved (:mod:`ctr_dynamics.kernels.linearise`). Columns are swept a batch at a time, so that their fields
stay in the cache.
"""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.kinds import ONE_BATCH, ONE_LANE, SIMD_WIDTH, unknown_lanes
from ctr_dynamics.kernels.layout import RATE_NOW, RATES, Y_BEFORE, Y_NOW, input_row
from ctr_dynamics.kernels.linearise import (
    boundary_columns,
    columns_of,
    combine,
    linearise,
    perturb,
    split_buffers,
    sweep_base,
)
from ctr_dynamics.kernels.shooting import broadcast, lane_lengths
from ctr_dynamics.kernels.simd import column_view, fma, view
from ctr_dynamics.kernels.structures import Derivatives, Solution, SweepBuffers
from ctr_dynamics.kernels.sweep import sweep
from ctr_dynamics.kernels.time_step import fill_history

THETA = 0.55  # of the one-stage tangent: nearly the trapezoidal rule, with a little damping of what the step does not resolve


@njit(nogil=True, error_model="numpy")
def theta_tangent(kind, lanes, mesh, dt, done, dparameters, differences, buffers, before, result):
    """Columns over one step of ``dt`` (s) by the one-stage theta method, linearised at the step's end: one sweep instead of one a stage.

    The covariance does not need the model's own time accuracy. ``done``: :class:`~ctr_dynamics.kernels.structures.SolvedStep`, of which the end
    alone is read. ``dparameters`` (NP, r), ``differences``, ``lanes``: as for :func:`~ctr_dynamics.kernels.linearise.linearise`; ``buffers``:
    :class:`~ctr_dynamics.kernels.structures.TangentBuffers`. ``before`` (2, fields, r): columns of the fields and of their rates before the step;
    those after it go to the fields of ``result`` (:class:`~ctr_dynamics.kernels.structures.Derivatives`) in the same form, which may be the same
    array. Returns False where the step's end cannot be linearised.
    """
    hist, histb, dhist = buffers.history, buffers.base_history, buffers.dhistory
    main, last = len(hist), len(done.rates) - 1
    after, rate = done.after, done.rates[last]
    c0 = 1.0 / (THETA * dt)
    ratio = (1.0 - THETA) / THETA
    for i in range(main):
        hist[i] = rate[i] - c0 * after[i]
    for i in range(len(histb)):
        histb[i] = rate[main + i] - c0 * after[main + i]
    dy, drate = before[0], before[1]
    fields, columns = dy.shape
    for i in range(fields):
        for k in range(columns):
            dhist[i, k] = -c0 * dy[i, k] - ratio * drate[i, k]
    inputs = done.inputs[len(done.inputs) - 1]
    for i in range(len(inputs)):
        done.parameters[input_row(kind.tubes, i)] = inputs[i]
    dy, drate = result.fields[0], result.fields[1]
    solution = Solution(done.parameters, done.unknowns[len(done.unknowns) - 1], hist, histb)
    found = Derivatives(result.inverse, result.unknowns, dy, result.nodes)
    if not linearise(kind, lanes, c0, mesh, solution, dparameters, dhist, differences, buffers.sweep, found):
        return False
    for i in range(fields):
        for k in range(columns):
            drate[i, k] = c0 * dy[i, k] + dhist[i, k]
    return True


@njit(nogil=True, error_model="numpy")
def _mix(weights, stored, first, base, values, epsilon):
    """History of one batch into ``values`` (rows, 8): ``base`` (rows,) plus epsilon times the sum of ``weights`` times the columns ``stored``
    (slots, fields, 8) from field ``first`` on."""
    fields = stored.shape[1]
    target, source, plain = (
        view(ONE_BATCH, values, 0, SIMD_WIDTH),
        view(ONE_BATCH, stored.reshape(-1), 0, SIMD_WIDTH),
        view(ONE_LANE, base, 0, 1),
    )
    used, factor = np.empty(len(weights), np.int64), np.empty(len(weights))
    count = 0
    for slot in range(len(weights)):
        if weights[slot] != 0.0:
            used[count], factor[count] = slot * fields + first, epsilon * weights[slot]
            count += 1
    share = view(ONE_LANE, factor, 0, 1)
    for i in range(len(plain)):
        total = fma(source[used[0] + i], share[0], plain[i])
        for k in range(1, count):
            total = fma(source[used[k] + i], share[k], total)
        target[i] = total


@njit(nogil=True, error_model="numpy")
def _keep(kind, stored, slot, first, c0, weights, slopes, found, epsilon, dx, column):
    """After a stage, from its swept fields ``found`` (rows, 8): their columns into the ``slot`` of ``stored`` (slots, fields, 8) from field
    ``first`` on. What a one-step scheme never reads is not written: the columns of many nodes exceed the cache."""
    size = len(slopes) // unknown_lanes(kind).count
    now, before, rate = (
        column_view(stored[Y_NOW, first:], 0),
        column_view(stored[Y_BEFORE, first:], 0),
        column_view(stored[RATE_NOW, first:], 0),
    )
    multistep = weights[Y_BEFORE] != 0.0 or weights[RATE_NOW] != 0.0
    if multistep:
        for i in range(size):
            past = now[i] * weights[Y_NOW] + before[i] * weights[Y_BEFORE]
            rate[i] = past + rate[i] * weights[RATE_NOW]
            before[i] = now[i]
    swept, target = view(ONE_BATCH, found, 0, SIMD_WIDTH), column_view(stored[slot, first:], 0)
    columns_of(kind, slopes, swept, column_view(dx, column), 1.0 / epsilon, target, size)
    if multistep:
        for i in range(size):
            rate[i] = rate[i] + now[i] * c0


@njit(nogil=True, error_model="numpy")
def by_fields(c0, weights):
    """``weights`` (stages, 3 + stages) of the stored fields in the histories, for the fields at earlier stages instead of their rates, which are
    y_t = c0 y + h."""
    result = weights.copy()
    for stage in range(len(c0)):
        for earlier in range(stage):
            share = weights[stage, RATES + earlier]
            result[stage, RATES + earlier] = share * c0[earlier]
        for earlier in range(stage):
            result[stage] += weights[stage, RATES + earlier] * result[earlier]
    return result


@njit(nogil=True)
def _without_nodes(b):
    """The buffers of a sweep that does not keep the states at the nodes."""
    return SweepBuffers(
        b.workspace, b.parameters, b.section_lengths, b.unknowns, b.history, b.base_history, b.fields, b.base_fields, b.nodes[:0], b.residual,
    )  # fmt: skip


@njit(nogil=True, error_model="numpy")
def step_tangent(kind, lanes, mesh, scheme, done, dparameters, dinputs, differences, buffers, dbank, result):
    """Tangent of a whole step.

    ``scheme``, ``done``, ``buffers``, ``result``: :mod:`ctr_dynamics.kernels.structures`; of the result the fields are not written. ``dinputs``
    (stages, inputs, r): columns of the inputs, added to those of the parameters ``dparameters`` (NP, r); r is a multiple of 8. ``dbank`` (r / 8,
    3 + stages, fields, 8): columns of the stored fields, advanced in place like the fields themselves, but with the stages' fields in place of their
    rates. ``differences``, ``lanes``: as for :func:`~ctr_dynamics.kernels.linearise.linearise`. Returns False where a stage cannot be linearised.
    """
    c0, weights = scheme
    hist, histb, bank, dstage = buffers.history, buffers.base_history, buffers.bank, buffers.dparameters
    par, inputs, epsilon, dx = done.parameters, done.inputs, differences.column, result.unknowns
    fields, stages, main = dbank.shape[2], len(c0), len(hist)
    whole = split_buffers(kind, lanes, buffers.sweep)
    bare = _without_nodes(whole[0]), _without_nodes(whole[1])
    shares = by_fields(c0, weights)
    for i in range(fields):
        for slot in range(RATES):
            bank[slot, i] = done.before[slot, i]
        for stage in range(stages):
            bank[RATES + stage, i] = done.rates[stage, i]
    dstage[:] = dparameters
    for stage in range(stages):
        fill_history(weights[stage], bank, hist, histb)
        for i in range(inputs.shape[1]):
            row = input_row(kind.tubes, i)
            par[row] = inputs[stage, i]
            for k in range(dparameters.shape[1]):
                dstage[row, k] = dparameters[row, k] + dinputs[stage, i, k]
        used, last = shares[stage, : RATES + stage], stage == stages - 1
        solution = Solution(par, done.unknowns[stage], hist, histb)
        near, far = whole if last else bare
        if not sweep_base(
            kind, c0[stage], mesh, solution, dstage, dbank[0, 0], 0, differences, near, result.inverse
        ):
            return False
        broadcast(ONE_BATCH, solution.unknowns, far.unknowns)
        for block in range(len(dbank)):
            column, stored = block * SIMD_WIDTH, dbank[block]
            perturb(far.parameters, par, dstage, column, 0, SIMD_WIDTH, epsilon)
            lane_lengths(kind, ONE_BATCH, mesh, far.parameters, far.section_lengths)
            _mix(used, stored, 0, hist, far.history, epsilon)
            _mix(used, stored, main, histb, far.base_history, epsilon)
            sweep(kind, ONE_BATCH, c0[stage], mesh, far)
            if not boundary_columns(
                near.residual, far.residual, 0, column, SIMD_WIDTH, epsilon, result.inverse, dx
            ):
                return False
            slot = Y_NOW if last else RATES + stage
            _keep(kind, stored, slot, 0, c0[stage], used, near.fields, far.fields, epsilon, dx, column)
            _keep(
                kind,
                stored,
                slot,
                main,
                c0[stage],
                used,
                near.base_fields,
                far.base_fields,
                epsilon,
                dx,
                column,
            )
            if last:
                combine(kind, near.nodes, far.nodes, 0, SIMD_WIDTH, epsilon, dx, column, result.nodes)
    return True
