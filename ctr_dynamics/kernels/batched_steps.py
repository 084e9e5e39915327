"""Steps of many simulations at once, one case in every lane."""

import numpy as np

from ctr_dynamics.kernels.batched_shooting import solve_lanes
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import RATE_NOW, RATES, Y_BEFORE, Y_NOW
from ctr_dynamics.kernels.shooting import lane_lengths
from ctr_dynamics.kernels.time_step import RENEW, extrapolate, history, remember
from ctr_dynamics.kernels.workspace import input_row, lane_count


@njit(cache=True, nogil=True, error_model="numpy")
def advance_batch(tubes, lanes, few, mesh, c0, weights, inputs, bank, unknowns, earlier, inverse, fresh, alive, big, one, eight, scale, perturb,
             unit, tolerance, limit, tips):  # fmt: skip
    """Steps of all lanes with ``inputs`` (K, stages, rows, L); ``tips`` (K, 13, L). Returns the number of sweeps of all lanes together."""
    par, seclen, hist, histb, out, outb, nodes = big[1], big[2], big[4], big[5], big[6], big[7], big[8]
    n, L, stages, m = len(tubes), lane_count(lanes), len(c0), len(scale)
    main = len(hist)
    S = len(nodes) - (16 + 3 * n) * L
    x = np.empty(m * L)
    guess, found = np.empty_like(unknowns), np.empty_like(unknowns)
    spent = np.zeros(L, np.int64)
    total = 0
    for k in range(len(inputs)):
        extrapolate(unknowns, earlier, unit, guess)
        spent[:] = stages
        for stage in range(stages):
            history(weights[stage], bank, hist, histb)
            for i in range(inputs.shape[2]):
                row = input_row(tubes, i) * L
                for j in range(L):
                    par[row + j] = inputs[k, stage, i, j]
            lane_lengths(tubes, lanes, mesh, par, seclen)
            for i in range(m * L):
                x[i] = guess[stage, i] + (found[stage - 1, i] - guess[stage - 1, i] if stage else 0.0)
            total += solve_lanes(tubes, lanes, few, mesh, c0[stage], big, one, eight, x, inverse, fresh, alive, scale, perturb, tolerance, limit,
                                 spent, 0)[0]  # fmt: skip
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
            fresh[j] = spent[j] > RENEW * stages
        remember(unknowns, earlier, found)
        for i in range(tips.shape[1]):
            for j in range(L):
                tips[k, i, j] = nodes[S + i * L + j]
        if not alive.any():
            break
    return total
