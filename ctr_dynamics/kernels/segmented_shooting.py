"""Multiple shooting of single implicit stages: Newton's method on all unknowns together, with Broyden's updates between Jacobians.

Single shooting ends where the equations grow too much from the base to the tip: the rate c0 of a short step lets a perturbation at the base grow
by e^G at the tip (:func:`ctr_dynamics.model.segments.growth`). Between cuts it grows by a fraction of G.
"""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.kinds import ONE_LANE
from ctr_dynamics.kernels.layout import RATES, Y_NOW, input_row, parameter_rows
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.segmented_jacobian import real_jacobian
from ctr_dynamics.kernels.shooting import CONVERGED, NOT_FINITE, STALLED, broyden, invert, scaled_norm
from ctr_dynamics.kernels.sweep import sweep
from ctr_dynamics.kernels.time_step import fill_history


@njit(nogil=True)
def solve_segmented(kind, c0, mesh, solver, x, inverse, fresh):
    """Find the unknowns ``x`` (mt,) at which all residuals vanish; ``x`` and ``inverse`` (mt, mt), in units, are updated in place.

    ``solver``: :class:`~ctr_dynamics.kernels.structures.SegmentedSolver` with parameters, lengths and histories in its buffers of one lane, where the
    fields and nodes of the solution are left. Returns (outcome, iterations, sweeps, Jacobians).
    """
    single, wide, units, scale, step, tolerance, limit = solver
    mt = len(x)
    trial, res = single.unknowns, single.residual
    dx, before, moved = np.empty(mt), np.empty(mt), np.empty(mt)
    work, matrix = np.empty((2, mt)), np.empty((mt, mt))
    trial[:] = x
    sweep(kind, ONE_LANE, c0, mesh, single)
    sweeps, jacobians = 1, 0
    norm = scaled_norm(res, scale)
    newest = False
    for iteration in range(limit):
        if norm <= tolerance:
            return CONVERGED, iteration, sweeps, jacobians
        if not np.isfinite(norm):
            return NOT_FINITE, iteration, sweeps, jacobians
        if fresh:
            jacobians += 1
            if not (
                real_jacobian(kind, c0, mesh, single, x, wide, units, scale, step, matrix) and invert(matrix, inverse)
            ):  # fmt: skip
                return NOT_FINITE, iteration, sweeps, jacobians
            newest, fresh = True, False
        for i in range(mt):
            before[i] = res[i] / scale[i]
        for i in range(mt):
            dx[i] = 0.0
            for k in range(mt):
                dx[i] -= inverse[i, k] * before[k]
        factor = 1.0
        while True:
            for i in range(mt):
                trial[i] = x[i] + factor * dx[i] * units[i]
            sweep(kind, ONE_LANE, c0, mesh, single)
            sweeps += 1
            best = scaled_norm(res, scale)
            if best < (1.0 - 0.1 * factor) * norm or not newest or factor < 1e-3:
                break
            factor *= 0.5
        if best >= norm and newest:
            return STALLED, iteration, sweeps, jacobians
        slow = True
        if best < norm:
            for i in range(mt):
                moved[i] = res[i] / scale[i] - before[i]
                dx[i] *= factor
                x[i] = trial[i]
            broyden(inverse, dx, moved, work)
            slow = best > 0.6 * norm
            norm = best
            newest = False
        else:  # the trial was rejected: the residual belongs to it, so evaluate at x again
            trial[:] = x
            sweep(kind, ONE_LANE, c0, mesh, single)
            sweeps += 1
            norm = scaled_norm(res, scale)
        fresh = slow
    return STALLED, limit, sweeps, jacobians


@njit(nogil=True)
def advance_segmented(kind, mesh, scheme, solver, inputs, x, found, bank, inverse):
    """One step of a singly diagonally implicit scheme, each stage from the unknowns ``x`` (mt,) of the one before, and a new Jacobian at first.

    As :func:`ctr_dynamics.kernels.time_step.advance_step`; ``found`` (stages, mt). Only y_n of the ``bank`` is read.
    """
    n = kind.tubes
    beta = parameter_rows(n).beta
    c0, weights = scheme
    b = solver.single
    par, hist, histb, out, outb = b.parameters, b.history, b.base_history, b.fields, b.base_fields
    main = len(hist)
    iterations, sweeps, jacobians = 0, 0, 0
    for stage in range(len(c0)):
        fill_history(weights[stage], bank, hist, histb)
        for i in range(inputs.shape[1]):
            par[input_row(n, i)] = inputs[stage, i]
        section_lengths(mesh.bp_tube, mesh.bp_offset, par[beta : beta + n], b.section_lengths)
        outcome, its, plain, jacs = solve_segmented(kind, c0[stage], mesh, solver, x, inverse, stage == 0)
        iterations += its
        sweeps += plain
        jacobians += jacs
        if outcome != CONVERGED:
            return outcome, iterations, sweeps, jacobians
        rate = bank[RATES + stage]
        for i in range(main):
            rate[i] = c0[stage] * out[i] + hist[i]
        for i in range(len(histb)):
            rate[main + i] = c0[stage] * outb[i] + histb[i]
        found[stage] = x
    bank[Y_NOW, :main] = out
    bank[Y_NOW, main:] = outb
    return CONVERGED, iterations, sweeps, jacobians
