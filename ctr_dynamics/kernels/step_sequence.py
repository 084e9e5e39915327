"""Many time steps in one compiled loop: the tip after every step, with or without its derivatives."""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import RATES
from ctr_dynamics.kernels.shooting import CONVERGED
from ctr_dynamics.kernels.structures import SolvedStep
from ctr_dynamics.kernels.tangent import step_tangent
from ctr_dynamics.kernels.time_step import RENEW, advance_step, extrapolate, remember

NO_TANGENT = -1  # outcome of a step that has been taken and cannot be linearised


@njit(nogil=True)
def advance(kind, mesh, scheme, solver, inputs, run, fresh, tips):
    """Steps with ``inputs`` (K, stages, inputs) until one fails; returns (steps taken, plain sweeps, outcome of the last).

    ``run``: :class:`~ctr_dynamics.kernels.structures.RunArrays`; ``tips`` (K, rows) takes the first rows of the state at the tip.
    """
    nodes = solver.single.nodes
    S = len(nodes) - tips.shape[1]
    guess, found = np.empty_like(run.unknowns), np.empty_like(run.unknowns)
    total = 0
    for k in range(len(inputs)):
        extrapolate(run.unknowns, run.earlier, solver.options.perturbation, guess)
        outcome, _, sweeps, _ = advance_step(
            kind, mesh, scheme, solver, inputs[k], guess, found, run.bank, run.inverse, fresh
        )
        total += sweeps
        if outcome != CONVERGED:
            return k, total, outcome
        fresh = sweeps > RENEW * len(scheme.c0)
        remember(run.unknowns, run.earlier, found)
        for i in range(tips.shape[1]):
            tips[k, i] = nodes[S + i]
    return len(inputs), total, CONVERGED


@njit(nogil=True)
def advance_tangent(kind, lanes, mesh, scheme, solver, inputs, run, fresh, tips, tangent):
    """The same with the columns of the stored fields; ``tangent``: :class:`~ctr_dynamics.kernels.structures.RunTangent`, of ``lanes`` lanes."""
    nodes = solver.single.nodes
    S = len(nodes) - tips.shape[1]
    guess, found = np.empty_like(run.unknowns), np.empty_like(run.unknowns)
    stages = len(scheme.c0)
    before, dtips = tangent.before, tangent.tips
    total = 0
    for k in range(len(inputs)):
        extrapolate(run.unknowns, run.earlier, solver.options.perturbation, guess)
        before[:] = run.bank[:RATES]
        outcome, _, sweeps, _ = advance_step(
            kind, mesh, scheme, solver, inputs[k], guess, found, run.bank, run.inverse, fresh
        )
        total += sweeps
        if outcome != CONVERGED:
            return k, total, outcome
        fresh = sweeps > RENEW * stages
        remember(run.unknowns, run.earlier, found)
        for i in range(tips.shape[1]):
            tips[k, i] = nodes[S + i]
        done = SolvedStep(
            solver.single.parameters, inputs[k], found, before, run.bank[RATES : RATES + stages], run.bank[0]
        )
        if not step_tangent(
            kind, lanes, mesh, scheme, done, tangent.dparameters, tangent.dinputs[k], tangent.differences, tangent.buffers,
            tangent.bank, tangent.result,
        ):  # fmt: skip
            return k, total, NO_TANGENT
        for i in range(dtips.shape[1]):
            for c in range(dtips.shape[2]):
                dtips[k, i, c] = tangent.result.nodes[i, c]
    return len(inputs), total, CONVERGED
