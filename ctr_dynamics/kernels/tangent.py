"""Tangent of a step: how fields, tip and nodes after it depend on fields and parameters before it, for many columns at once.

Every stage is linearised where it was solved (:mod:`ctr_dynamics.kernels.linearise`). Columns are swept a batch at a time, so that their fields
stay in the cache.
"""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.complex_linearise import add_complex
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
from ctr_dynamics.kernels.structures import Solution, SweepBuffers
from ctr_dynamics.kernels.sweep import sweep
from ctr_dynamics.kernels.time_step import fill_history


@njit(nogil=True, error_model="numpy")
def _fields_of_rates(kind, mesh, parameters, unknowns, rates, b, fields):
    """The ``fields`` (fields,) that belong to ``unknowns`` and ``rates`` on these sections.

    Interpolated from other sections they differ a little, and c0 times the difference would be taken for accelerations.
    """
    main = len(b.history)
    b.parameters[:], b.unknowns[:] = parameters, unknowns
    b.history[:], b.base_history[:] = rates[:main], rates[main:]
    lane_lengths(kind, ONE_LANE, mesh, b.parameters, b.section_lengths)
    sweep(kind, ONE_LANE, 0.0, mesh, b)
    fields[:main], fields[main:] = b.fields, b.base_fields


@njit(nogil=True, error_model="numpy")
def rational_tangent(
    kind, lanes, mesh, fraction, dt, done, dparameters, before, differences, buffers, result
):
    """Columns over ``dt`` (s) by a rational function of the linearised dynamics, frozen at the end of a solved step.

    With A the derivative of the rates by the fields there, a column goes from dy to R(dt A) dy, with R the stability function of a collocation
    method. In partial fractions the terms do not wait for each other:

        R(dt A) dy = sum of w v over the poles,  (c0 - A) v = c0 dy + B dp,  c0 = pole / dt.

    ``fraction``: :class:`~ctr_dynamics.kernels.structures.PartialFractions`. ``done``:
    :class:`~ctr_dynamics.kernels.structures.SolvedStep`, of which inputs, unknowns and rates of the last stage are read. ``dparameters`` (NP, r),
    ``differences``, ``lanes``: as for :func:`~ctr_dynamics.kernels.linearise.linearise`. ``before`` (fields, r): columns of the fields before the
    step; those after it go to the ``result`` (:class:`~ctr_dynamics.kernels.structures.Derivatives`), another array. ``buffers``:
    :class:`~ctr_dynamics.kernels.structures.RationalBuffers`. Returns False where the step's end cannot be linearised.
    """
    rates, fields = done.rates[len(done.rates) - 1], np.empty(len(before))
    inputs, unknowns = done.inputs[len(done.inputs) - 1], done.unknowns[len(done.unknowns) - 1]
    for i in range(len(inputs)):
        done.parameters[input_row(kind.tubes, i)] = inputs[i]
    _fields_of_rates(kind, mesh, done.parameters, unknowns, rates, buffers.single, fields)
    share = 0.0
    if fraction.real_pole != 0.0:
        c0, share = fraction.real_pole / dt, fraction.real_weight
        dhistory, main = buffers.dhistory, len(buffers.real.history) // lanes.count
        history = rates - c0 * fields
        for i in range(len(fields)):
            for k in range(before.shape[1]):
                dhistory[i, k] = -c0 * before[i, k]
        solution = Solution(done.parameters, unknowns, history[:main], history[main:])
        if not linearise(
            kind, lanes, c0, mesh, solution, dparameters, dhistory, differences, buffers.real, result
        ):
            return False
    return add_complex(
        kind, mesh, fraction.complex_pole / dt, fraction.complex_weight, share, (done.parameters, unknowns, fields, rates),
        dparameters, before, differences, (buffers.near, buffers.far), result,
    )  # fmt: skip


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
