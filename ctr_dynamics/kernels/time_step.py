"""One time step: every implicit stage solved by shooting, then the stored fields moved on."""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import (
    RATE_NOW,
    RATES,
    Y_BEFORE,
    Y_NOW,
    input_row,
    parameter_rows,
    unknown_rows,
)
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.shooting import CONVERGED, solve

RENEW = 2  # sweeps a stage beyond which the next step starts with a new Jacobian, which costs two
EARLIER = 4  # steps whose unknowns are kept to start the next one from


@njit(nogil=True)
def extrapolate(unknowns, earlier, unit, guess):
    """Start of the next step, stage by stage, into ``guess`` (stages, m): the straight line, parabola or cubic through the last steps'
    ``unknowns`` (stages, m) and ``earlier`` (EARLIER, stages, m), whichever would have met the last step best.

    Smooth motion is followed by the cubic; noise in the actuators makes the line the better one. ``unit`` (m,) of each unknown.
    """
    stages, m = unknowns.shape
    missed = np.zeros(3)
    for j in range(stages):
        for i in range(m):
            y0, y1, y2, y3, y4 = (
                unknowns[j, i],
                earlier[0, j, i],
                earlier[1, j, i],
                earlier[2, j, i],
                earlier[3, j, i],
            )
            missed[0] += abs(y0 - 2.0 * y1 + y2) / unit[i]
            missed[1] += abs(y0 - 3.0 * (y1 - y2) - y3) / unit[i]
            missed[2] += abs(y0 - 4.0 * (y1 + y3) + 6.0 * y2 + y4) / unit[i]
    for j in range(stages):
        for i in range(m):
            y0, y1, y2, y3 = unknowns[j, i], earlier[0, j, i], earlier[1, j, i], earlier[2, j, i]
            if missed[0] <= missed[1] and missed[0] <= missed[2]:
                guess[j, i] = 2.0 * y0 - y1
            elif missed[1] <= missed[2]:
                guess[j, i] = 3.0 * (y0 - y1) + y2
            else:
                guess[j, i] = 4.0 * (y0 + y2) - 6.0 * y1 - y3


@njit(nogil=True)
def remember(unknowns, earlier, found):
    """After a step: ``found`` become the ``unknowns``, and those the newest of the ``earlier``."""
    for i in range(EARLIER - 1, 0, -1):
        earlier[i] = earlier[i - 1]
    earlier[0] = unknowns
    unknowns[:] = found


@njit(nogil=True)
def fill_history(weights, bank, history, base_history):
    """h = sum of ``weights`` (slots,) times the stored fields ``bank`` (slots, fields), into the main and the base part."""
    main = len(history)
    history[:] = 0.0
    base_history[:] = 0.0
    for slot in range(len(weights)):
        w = weights[slot]
        if w != 0.0:
            for i in range(main):
                history[i] += w * bank[slot, i]
            for i in range(len(base_history)):
                base_history[i] += w * bank[slot, main + i]


@njit(nogil=True)
def advance_step(kind, mesh, scheme, solver, inputs, guess, found, bank, inverse, fresh):
    """Advance the stored fields ``bank`` by one step.

    ``scheme``: :class:`~ctr_dynamics.kernels.structures.StageCoefficients`. ``inputs`` (stages, inputs): see
    :data:`ctr_dynamics.kernels.layout.INPUTS`, at the stage times; they are written to the parameters in the solver's buffers. ``guess`` and
    ``found`` (stages, 5 + N): unknowns to start from and those found. ``inverse``, ``fresh``: see :func:`~ctr_dynamics.kernels.shooting.solve`.
    On failure ``bank`` is as it was before the step. Returns (outcome, iterations, plain sweeps, Jacobian sweeps).
    """
    n = kind.tubes
    m, beta = unknown_rows(n).size, parameter_rows(n).beta
    c0, weights = scheme
    stages = len(c0)
    b = solver.single
    par, hist, histb, out, outb = b.parameters, b.history, b.base_history, b.fields, b.base_fields
    x = np.empty(m)
    iterations, sweeps, jacobians = 0, 0, 0
    for stage in range(stages):
        fill_history(weights[stage], bank, hist, histb)
        for i in range(inputs.shape[1]):
            par[input_row(n, i)] = inputs[stage, i]
        section_lengths(mesh.bp_tube, mesh.bp_offset, par[beta : beta + n], b.section_lengths)
        for i in range(m):
            # what the guess missed at the stage before, it misses here too
            x[i] = guess[stage, i] + (found[stage - 1, i] - guess[stage - 1, i] if stage else 0.0)
        outcome, its, plain, jacs = solve(kind, c0[stage], mesh, solver, x, inverse, fresh)
        fresh = False
        iterations += its
        sweeps += plain
        jacobians += jacs
        if outcome != CONVERGED:
            return outcome, iterations, sweeps, jacobians
        rate = bank[RATES + stage]
        main = len(hist)
        for i in range(main):
            rate[i] = c0[stage] * out[i] + hist[i]
        for i in range(len(histb)):
            rate[main + i] = c0[stage] * outb[i] + histb[i]
        for i in range(m):
            found[stage, i] = x[i]
    main = len(hist)
    for i in range(main + len(histb)):
        bank[Y_BEFORE, i] = bank[Y_NOW, i]
        bank[RATE_NOW, i] = bank[RATES + stages - 1, i]
    for i in range(main):
        bank[Y_NOW, i] = out[i]
    for i in range(len(histb)):
        bank[Y_NOW, main + i] = outb[i]
    return CONVERGED, iterations, sweeps, jacobians
