"""Discretisation error: the solver's own error, measured against finer solutions, corrected, and left free to vary.

In: a problem and a point. Out: its residual corrected by the differences, and these as directions of the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from joblib import delayed
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_options import DiscretisationOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel, Key
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.run_context import RunContext

Floats = NDArray[np.float64]


def correct_discretisation(
    problem: Problem, point: Mapping[Key, float], context: RunContext
) -> dict[str, float]:
    """Compare with finer solutions at ``point``: correct the residual by the differences, and let them vary.

    Where the data can see the error in space, the problem goes on with twice the nodes.

    Returns:
        rms differences in m: ``time_error_m`` (half the step), ``space_error_m`` (twice the nodes).
    """
    o = problem.options.discretisation
    D, squares = differences(problem, point, context)
    nodes = 2 * problem.forward_models[0].nodes
    if float(np.linalg.norm(D[:, 1])) > o.space_limit and nodes <= o.most_nodes:
        problem.forward_models = [e.resolved(nodes, e.scheme.dt) for e in problem.forward_models]
        return correct_discretisation(problem, point, context)
    _apply(problem, D)
    rms = np.sqrt(squares / max(sum(len(w.used) for w in problem.whiteners), 1))
    return {"time_error_m": float(rms[0]), "space_error_m": float(rms[1])}


def renew_correction(problem: Problem, point: Mapping[Key, float], context: RunContext) -> Floats | None:
    """The same at a ``point`` that fits the data: a strong cause, as friction, can make an error that the nominal model does not have.

    Returns:
        Change (m,) of the whitened correction; None where it is too small to count, and all is left as it was.
    """
    D, _ = differences(problem, point, context)
    change = D.sum(axis=1) - problem.offset
    if not np.any(D[:, 0]) or float(np.linalg.norm(change)) < problem.options.discretisation.renewed:
        return None
    _apply(problem, D)
    return change


def differences(problem: Problem, point: Mapping[Key, float], context: RunContext) -> tuple[Floats, Floats]:
    """Whitened differences (m, 2) to shorter steps and to twice the nodes at ``point``, and sums (2,) m^2 of their squares in position.

    They are zero for a recording that cannot be simulated so.
    """
    o = problem.options.discretisation
    jobs = [
        job
        for e in problem.forward_models
        for job in (
            delayed(ForwardModel.residual_at)(e, point),
            delayed(with_shorter_step)(e, point, o),
            delayed(with_more_nodes)(e, point),
        )
    ]
    done = context.run(jobs)
    parts: list[list[Floats]] = [[], []]
    squares = np.zeros(2)
    for number, whiten in enumerate(problem.whiteners):
        base, *others = done[3 * number : 3 * number + 3]
        for i, (finer, factor) in enumerate(others):
            failed = base is None or finer is None
            difference = np.zeros((len(whiten.used), 6)) if failed else factor * (base - finer)
            parts[i].append(whiten(difference))
            squares[i] += float(np.sum(difference[:, :3] ** 2))
    return np.stack([np.concatenate(p) for p in parts], axis=1), squares


def _apply(problem: Problem, D: Floats) -> None:
    problem.offset = D.sum(axis=1)
    problem.numerics = problem.options.discretisation.deviation * D


def with_shorter_step(
    forward_model: ForwardModel, point: Mapping[Key, float], options: DiscretisationOptions
) -> tuple[Floats | None, float]:
    """Residual (s, 6) by the shortest step that succeeds, and the factor from its difference to that of half a step."""
    for part, factor in options.shorter:
        found = forward_model.resolved(forward_model.nodes, part * forward_model.scheme.dt).residual_at(point)
        if found is not None:
            return found, factor
    return None, 0.0


def with_more_nodes(forward_model: ForwardModel, point: Mapping[Key, float]) -> tuple[Floats | None, float]:
    """Residual (s, 6) with twice the nodes, and the factor 1."""
    return forward_model.resolved(2 * forward_model.nodes, forward_model.scheme.dt).residual_at(point), 1.0
