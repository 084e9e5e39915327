"""Steps of many simulations at once, one case in every lane."""

import numpy as np

from ctr_dynamics.kernels.batched_shooting import solve_cases
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import RATE_NOW, RATES, Y_BEFORE, Y_NOW, input_row, state_rows, unknown_rows
from ctr_dynamics.kernels.shooting import lane_lengths
from ctr_dynamics.kernels.time_step import RENEW, extrapolate, fill_history, remember


@njit(nogil=True, error_model="numpy")
def advance_batch(kind, lanes, mesh, scheme, batch, solver, inputs, run, unit, cases, tips):
    """Steps of all lanes with ``inputs`` (K, stages, rows, L); returns the number of sweeps of all lanes together.

    ``tips`` (K, rows, L) takes the first rows of the states at the tips.

    ``run``: :class:`~ctr_dynamics.kernels.structures.RunArrays` with the lane as last index of each row; ``unit`` (m * L,) of each unknown.
    """
    c0, weights = scheme
    par, hist, histb, out, outb = (
        batch.parameters,
        batch.history,
        batch.base_history,
        batch.fields,
        batch.base_fields,
    )
    bank, unknowns, earlier = run.bank, run.unknowns, run.earlier
    n, L, stages, m = kind.tubes, lanes.count, len(c0), unknown_rows(kind.tubes).size
    main = len(hist)
    S = len(batch.nodes) - state_rows(n).size * L
    x, spent = cases.unknowns, cases.sweeps
    guess, found = np.empty_like(unknowns), np.empty_like(unknowns)
    total = 0
    for k in range(len(inputs)):
        extrapolate(unknowns, earlier, unit, guess)
        spent[:] = stages
        for stage in range(stages):
            fill_history(weights[stage], bank, hist, histb)
            for i in range(inputs.shape[2]):
                row = input_row(n, i) * L
                for j in range(L):
                    par[row + j] = inputs[k, stage, i, j]
            lane_lengths(kind, lanes, mesh, par, batch.section_lengths)
            for i in range(m * L):
                x[i] = guess[stage, i] + (found[stage - 1, i] - guess[stage - 1, i] if stage else 0.0)
            total += solve_cases(kind, lanes, c0[stage], mesh, batch, solver, cases, 0)[0]
            found[stage] = x
            rate = bank[RATES + stage]
            for i in range(main):
                rate[i] = c0[stage] * out[i] + hist[i]
            for i in range(len(histb)):
                rate[main + i] = c0[stage] * outb[i] + histb[i]
        bank[Y_BEFORE] = bank[Y_NOW]
        bank[RATE_NOW] = bank[RATES + stages - 1]
        bank[Y_NOW, :main] = out
        bank[Y_NOW, main:] = outb
        for j in range(L):
            cases.fresh[j] = spent[j] > RENEW * stages
        remember(unknowns, earlier, found)
        for i in range(tips.shape[1]):
            for j in range(L):
                tips[k, i, j] = batch.nodes[S + i * L + j]
        if not cases.alive.any():
            break
    return total
