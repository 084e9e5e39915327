"""Many collocation steps in one compiled loop: the tip after every step, with or without its derivatives.

The derivatives (columns) are those of the step itself. All stages of a column stand side by side with those of another one in the lanes of one
sweep, with the parameters, inputs, fields and unknowns moved a little along the column. What the boundary values must follow is found by Newton's
method with a Jacobian of their own, in a few sweeps, since the problem is linear. The run is the same, bit by bit, without columns.
"""

import math

import numpy as np

from ctr_dynamics.kernels.collocation import (
    ACCOUNT,
    FRESH,
    OUTCOME,
    TWO_RUNS,
    advance_stages,
    newton_step,
    renew,
)
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.coupling import STAGES, fill_coupling, stage_coupling
from ctr_dynamics.kernels.kinds import SIMD_WIDTH
from ctr_dynamics.kernels.layout import Y_NOW, input_row, parameter_rows, state_rows
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.shooting import CONVERGED
from ctr_dynamics.kernels.sweep import sweep

PAIR = SIMD_WIDTH // STAGES  # columns in the lanes of a sweep
NO_TANGENT = -1  # outcome of a step that has been taken and cannot be linearised
ACCURACY = 1e-4  # of a column's unknowns: what the last sweep may have left of them
ROUNDING = 1e-2  # likewise, where further sweeps gain nothing
MOST_SWEEPS = 12  # of two columns in a step
WORN = 0.05  # what a sweep leaves of the error, from which the Jacobian is renewed


@njit(nogil=True, error_model="numpy")
def fill_tables(kind, C, parameters, dparameters, epsilon, tables):
    """Tables of the coupling (r / 2, size) for the columns ``dparameters`` (NP, r) of the ``parameters`` (NP,), in changes of ``epsilon``."""
    for pair in range(len(tables)):
        for g in range(PAIR):
            moved = parameters + epsilon * dparameters[:, PAIR * pair + g]
            fill_coupling(kind, C, moved, tables[pair], SIMD_WIDTH, g * STAGES)


@njit(nogil=True, error_model="numpy")
def _lay_column(kind, mesh, b, g, parameters, inputs, dparameters, dinputs, column, epsilon):
    """Parameters, inputs and section lengths of one column into the lanes of group ``g``."""
    n, L, first = kind.tubes, SIMD_WIDTH, g * STAGES
    beta = parameter_rows(n).beta
    for r in range(len(parameters)):
        moved = parameters[r] + epsilon * dparameters[r, column]
        for q in range(STAGES):
            b.parameters[r * L + first + q] = moved
    translations, lengths = np.empty(n), np.empty(len(mesh.sec_cells))
    for q in range(STAGES):
        for i in range(inputs.shape[1]):
            row = input_row(n, i)
            change = dparameters[row, column] + dinputs[q, i, column]
            b.parameters[row * L + first + q] = inputs[q, i] + epsilon * change
        for i in range(n):
            translations[i] = b.parameters[(beta + i) * L + first + q]
        section_lengths(mesh.bp_tube, mesh.bp_offset, translations, lengths)
        for k in range(len(lengths)):
            b.section_lengths[k * L + first + q] = lengths[k]


@njit(nogil=True, error_model="numpy")
def _lay_histories(scheme, b, before, dfields, epsilon):
    """Histories of the two columns ``dfields`` (fields, 2) about the fields ``before`` (fields,) into all lanes."""
    L, main = SIMD_WIDTH, len(b.history) // SIMD_WIDTH
    shares = np.zeros(STAGES)
    for q in range(STAGES):
        for j in range(STAGES):
            shares[q] -= scheme.C[q, j]
    for history, start in ((b.history, 0), (b.base_history, main)):
        for r in range(len(history) // L):
            for g in range(PAIR):
                moved = before[start + r] + epsilon * dfields[start + r, g]
                for q in range(STAGES):
                    history[r * L + g * STAGES + q] = shares[q] * moved


@njit(nogil=True, error_model="numpy")
def extrapolations(c):
    """(degrees, stages, stages) weights by which polynomials through the last stages of a step, at the fractions ``c`` (stages,), give the stages of
    the next one of the same length."""
    weights = np.zeros((STAGES, STAGES, STAGES))
    for degree in range(STAGES):
        first = STAGES - 1 - degree
        for q in range(STAGES):
            for i in range(first, STAGES):
                weight = 1.0
                for j in range(first, STAGES):
                    if i != j:
                        weight *= (1.0 + c[q] - c[j]) / (c[i] - c[j])
                weights[degree, q, i] = weight
    return weights


@njit(nogil=True, error_model="numpy")
def _extrapolated(weights, last, guess):
    """``guess`` (stages, mt) from the ``last`` stages (stages, mt) by ``weights`` (stages, stages)."""
    guess[:] = 0.0
    for q in range(STAGES):
        for j in range(STAGES):
            w = weights[q, j]
            if w != 0.0:
                for i in range(guess.shape[1]):
                    guess[q, i] += w * last[j, i]


@njit(nogil=True, error_model="numpy")
def _guess(weights, last, found, guess):
    """Start ``guess`` (stages, mt) of the next step from the stages ``found`` in this one, by the degree that would have given these from the
    ``last`` ones best; ``last`` becomes ``found``."""
    least, best = math.inf, 0
    for degree in range(STAGES):
        _extrapolated(weights[degree], last, guess)
        missed = 0.0
        for q in range(STAGES):
            for i in range(guess.shape[1]):
                missed += abs(guess[q, i] - found[q, i])
        if missed < least:
            least, best = missed, degree
    last[:] = found
    _extrapolated(weights[best], last, guess)


@njit(nogil=True, error_model="numpy")
def _residual_column(b, base, g, scale, epsilon, F):
    """Derivative of the residuals, in units, by the column in group ``g`` into ``F`` (stages, mt); False where one is not finite."""
    L, total = SIMD_WIDTH, 0.0
    for i in range(F.shape[1]):
        for q in range(STAGES):
            change = b.residual[i * L + g * STAGES + q] - base.residual[i * STAGES + q]
            F[q, i] = change / (epsilon * scale[i])
            total += F[q, i]
    return math.isfinite(total)


@njit(nogil=True, error_model="numpy")
def stage_columns(kind, damping, mesh, scheme, solver, done, dparameters, dinputs, tangent):
    """Columns over one solved step, whose solution is in the buffers of the ``solver``.

    ``done``: parameters (NP,), inputs (stages, inputs), fields before (fields,), unknowns (stages, mt). ``dparameters`` (NP, r), ``dinputs`` (stages,
    inputs, r). ``tangent``: :class:`~ctr_dynamics.kernels.structures.CollocationTangent`, of which fields and unknowns move on. Returns the number of
    sweeps of two columns, or -1 where the step cannot be linearised.
    """
    parameters, inputs, before, x = done
    base, units, scale = solver.stages, solver.point.units, solver.point.residual_units
    b, epsilon, dfields, factors = tangent.lanes, tangent.epsilon, tangent.fields, tangent.factors
    L, mt, main = SIMD_WIDTH, x.shape[1], len(tangent.lanes.history) // SIMD_WIDTH
    dx, z, F = np.empty((PAIR, STAGES, mt)), np.empty((PAIR, STAGES, mt)), np.empty((STAGES, mt))
    work = np.empty((2, 2, mt))
    tip = len(b.nodes) // L - state_rows(kind.tubes).size
    total, fresh = 0, not tangent.ready[0]
    if fresh and not renew(kind, mesh, scheme, base, STAGES, 0, solver, factors):
        return -1
    tangent.ready[0] = True
    for pair in range(len(dfields)):
        coupling = stage_coupling(TWO_RUNS, damping, tangent.tables[pair])
        for g in range(PAIR):
            column = PAIR * pair + g
            _lay_column(kind, mesh, b, g, parameters, inputs, dparameters, dinputs, column, epsilon)
            dx[g] = tangent.guess[column]
        _lay_histories(scheme, b, before, dfields[pair], epsilon)
        left_before = math.inf
        for _ in range(MOST_SWEEPS):
            for g in range(PAIR):
                for i in range(mt):
                    for q in range(STAGES):
                        b.unknowns[i * L + g * STAGES + q] = x[q, i] + epsilon * dx[g, q, i] * units[i]
            sweep(kind, TWO_RUNS, coupling, mesh, b)
            total += 1
            for attempt in range(2):
                left = 0.0  # largest part of a column's unknowns by which the next step would change them
                for g in range(PAIR):
                    if not _residual_column(b, base, g, scale, epsilon, F):
                        return -1
                    newton_step(scheme, mesh.owner, factors, F, z[g], work)
                    size, change = 1e-300, 0.0
                    for q in range(STAGES):
                        for i in range(mt):
                            size, change = max(size, abs(dx[g, q, i])), max(change, abs(z[g, q, i]))
                    left = max(left, change / size)
                if attempt or fresh or left < max(ACCURACY, WORN * left_before):
                    break
                # the Jacobian is of another place
                if not renew(kind, mesh, scheme, base, STAGES, 0, solver, factors):
                    tangent.ready[0] = False
                    return -1
                fresh, left_before = True, math.inf
            if left < ACCURACY or (left < ROUNDING and left > 0.5 * left_before):
                break
            left_before = left
            dx += z
        for g in range(PAIR):
            last, last0 = g * STAGES + STAGES - 1, STAGES - 1
            for r in range(main):
                dfields[pair, r, g] = (b.fields[r * L + last] - base.fields[r * STAGES + last0]) / epsilon
            for r in range(dfields.shape[1] - main):
                change = b.base_fields[r * L + last] - base.base_fields[r * STAGES + last0]
                dfields[pair, main + r, g] = change / epsilon
            for r in range(len(tangent.tip)):
                change = b.nodes[(tip + r) * L + last] - base.nodes[(tip + r) * STAGES + last0]
                tangent.tip[r, PAIR * pair + g] = change / epsilon
            column = PAIR * pair + g
            _guess(tangent.weights, tangent.unknowns[column], dx[g], tangent.guess[column])
    return total


@njit(nogil=True, error_model="numpy")
def advance_stages_often(kind, damping, mesh, scheme, solver, run, known, at, inputs, fresh, tips):
    """Steps with ``inputs`` (K, stages, inputs) at the times ``at`` (K, stages) s until one fails; returns (steps taken, sweeps, outcome of the
    last, known stages).

    ``run``: :class:`~ctr_dynamics.kernels.structures.CollocationRun`; ``known``: of its last stages, those that tell what comes next. ``tips`` (K,
    rows) takes the first rows of the state at the tip.
    """
    account = np.zeros((1, ACCOUNT), np.int64)
    account[0, FRESH] = fresh
    first, total = len(run.nodes) - state_rows(kind.tubes).size, 0
    for k in range(len(inputs)):
        sweeps, _ = advance_stages(kind, damping, mesh, scheme, solver, run, known, inputs[k], at[k], account)
        total += sweeps
        if account[0, OUTCOME] != CONVERGED:
            return k, total, account[0, OUTCOME], known
        account[0, FRESH] = 0
        known = min(known + STAGES, len(run.times))
        for i in range(tips.shape[1]):
            tips[k, i] = run.nodes[first + i]
    return len(inputs), total, CONVERGED, known


@njit(nogil=True, error_model="numpy")
def advance_columns_often(
    kind,
    damping,
    mesh,
    scheme,
    solver,
    run,
    known,
    at,
    inputs,
    fresh,
    tips,
    dparameters,
    dinputs,
    tangent,
    dtips,
):
    """The same with columns: ``dparameters`` (NP, r), ``dinputs`` (K, stages, inputs, r), ``tangent``:
    :class:`~ctr_dynamics.kernels.structures.CollocationTangent`; ``dtips`` (K, rows, r) takes those of the tip."""
    before, newest = np.empty(run.bank.shape[1]), len(run.times) - STAGES
    total = 0
    for k in range(len(inputs)):
        before[:] = run.bank[Y_NOW]
        taken, sweeps, outcome, known = advance_stages_often(
            kind,
            damping,
            mesh,
            scheme,
            solver,
            run,
            known,
            at[k : k + 1],
            inputs[k : k + 1],
            fresh,
            tips[k : k + 1],
        )
        total += sweeps
        if taken == 0:
            return k, total, outcome, known
        fresh = False
        done = (run.parameters, inputs[k], before, run.unknowns[newest:])
        spent = stage_columns(kind, damping, mesh, scheme, solver, done, dparameters, dinputs[k], tangent)
        if spent < 0:
            return k, total, NO_TANGENT, known
        total += spent
        for i in range(dtips.shape[1]):
            for c in range(dtips.shape[2]):
                dtips[k, i, c] = tangent.tip[i, c]
    return len(inputs), total, CONVERGED, known
