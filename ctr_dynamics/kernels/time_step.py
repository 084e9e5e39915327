"""One time step: every implicit stage solved by shooting, then the stored fields moved on."""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import RATE_NOW, RATES, Y_BEFORE, Y_NOW
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.shooting import CONVERGED, solve
from ctr_dynamics.kernels.workspace import input_row

RENEW = 2  # sweeps a stage beyond which the next step starts with a new Jacobian, which costs two


EARLIER = 4  # steps whose unknowns are kept to start the next one from


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def remember(unknowns, earlier, found):
    """After a step: ``found`` become the ``unknowns``, and those the newest of the ``earlier``."""
    for i in range(EARLIER - 1, 0, -1):
        earlier[i] = earlier[i - 1]
    earlier[0] = unknowns
    unknowns[:] = found


@njit(cache=True, nogil=True)
def history(weights, bank, hist, histb):
    """h = sum of weights (slots,) times the stored fields ``bank`` (slots, fields), into the main and the base part."""
    main = len(hist)
    hist[:] = 0.0
    histb[:] = 0.0
    for slot in range(len(weights)):
        w = weights[slot]
        if w != 0.0:
            for i in range(main):
                hist[i] += w * bank[slot, i]
            for i in range(len(histb)):
                histb[i] += w * bank[slot, main + i]


@njit(cache=True, nogil=True)
def step(tubes, lane, lanes, mesh, c0, weights, par, inputs, bank, guess, found, inverse, fresh, small, big, scale, perturb,
         tolerance, limit):  # fmt: skip
    """Advance the stored fields ``bank`` by one step.

    ``inputs`` (stages, 3N + 6): alpha, alpha rate, beta of every tube, tip force and torque, at the stage times. ``guess`` and ``found``
    (stages, 5 + N): unknowns to start from and those found. On failure ``bank`` is as it was before the step.
    Returns (outcome, iterations, plain sweeps, Jacobian sweeps).
    """
    n = len(tubes)
    stages = len(c0)
    W, seclen, hist, histb, out, outb, nodes, res = small
    x = np.empty(5 + n)
    iterations, sweeps, jacobians = 0, 0, 0
    for stage in range(stages):
        history(weights[stage], bank, hist, histb)
        for i in range(inputs.shape[1]):
            par[input_row(tubes, i)] = inputs[stage, i]
        section_lengths(mesh.bp_tube, mesh.bp_offset, par[13 * n : 14 * n], seclen)
        for i in range(5 + n):
            # what the guess missed at the stage before, it misses here too
            x[i] = guess[stage, i] + (found[stage - 1, i] - guess[stage - 1, i] if stage else 0.0)
        outcome, its, plain, jacs = solve(
            tubes, lane, lanes, mesh, c0[stage], par, seclen, x, hist, histb, (W, out, outb, nodes, res), big, scale, perturb,
            inverse, fresh, tolerance, limit,
        )  # fmt: skip
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
        for i in range(5 + n):
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
