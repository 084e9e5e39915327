"""Many time steps in one compiled loop: the tip after every step, with or without its derivatives."""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import RATES
from ctr_dynamics.kernels.shooting import CONVERGED
from ctr_dynamics.kernels.tangent import step_tangent
from ctr_dynamics.kernels.time_step import RENEW, extrapolate, remember, step


@njit(cache=True, nogil=True)
def advance(tubes, lane, lanes, mesh, c0, weights, par, inputs, bank, unknowns, earlier, inverse, fresh, small, big, scale, perturb,
             tolerance, limit, tips):  # fmt: skip
    """Steps with ``inputs`` (K, stages, inputs) until one fails; returns (steps taken, plain sweeps, outcome of the last)."""
    nodes = small[6]
    S = len(nodes) - tips.shape[1]
    guess, found = np.empty_like(unknowns), np.empty_like(unknowns)
    total = 0
    for k in range(len(inputs)):
        extrapolate(unknowns, earlier, perturb, guess)
        outcome, _, sweeps, _ = step(tubes, lane, lanes, mesh, c0, weights, par, inputs[k], bank, guess, found, inverse, fresh, small, big,
                                     scale, perturb, tolerance, limit)  # fmt: skip
        total += sweeps
        if outcome != CONVERGED:
            return k, total, outcome
        fresh = sweeps > RENEW * len(c0)
        remember(unknowns, earlier, found)
        for i in range(tips.shape[1]):
            tips[k, i] = nodes[S + i]
    return len(inputs), total, CONVERGED


@njit(cache=True, nogil=True)
def advance_tangent(tubes, lane, lanes, wide, mesh, c0, weights, par, inputs, bank, unknowns, earlier, inverse, fresh, small, big, scale,
                     perturb, fine, tolerance, limit, tips, dpar, dinputs, epsilon, many, work, dbank, before, matrix, dx, dnodes,
                     dtips):  # fmt: skip
    """The same with the columns ``dbank`` of the stored fields; ``dtips`` (K, 13, r) takes those of the tip."""
    nodes = small[6]
    S = len(nodes) - tips.shape[1]
    guess, found = np.empty_like(unknowns), np.empty_like(unknowns)
    stages = len(c0)
    total = 0
    for k in range(len(inputs)):
        extrapolate(unknowns, earlier, perturb, guess)
        before[:] = bank[:RATES]
        outcome, _, sweeps, _ = step(tubes, lane, lanes, mesh, c0, weights, par, inputs[k], bank, guess, found, inverse, fresh, small, big,
                                     scale, perturb, tolerance, limit)  # fmt: skip
        total += sweeps
        if outcome != CONVERGED:
            return k, total, outcome
        fresh = sweeps > RENEW * len(c0)
        remember(unknowns, earlier, found)
        for i in range(tips.shape[1]):
            tips[k, i] = nodes[S + i]
        if not step_tangent(tubes, wide, mesh, c0, weights, par, inputs[k], found, before, bank[RATES : RATES + stages], dpar, dinputs[k],
                            epsilon, fine, many, work, dbank, matrix, dx, dnodes):  # fmt: skip
            return k, total, -1
        for i in range(dtips.shape[1]):
            for c in range(dtips.shape[2]):
                dtips[k, i, c] = dnodes[i, c]
    return len(inputs), total, CONVERGED
