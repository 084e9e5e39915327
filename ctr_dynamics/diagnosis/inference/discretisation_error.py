"""The solver's own error: measured against finer solutions, corrected, and left free to vary."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference.map_fit import Key, Problem

Floats = NDArray[np.float64]
NUMERICS_SIGMA = 0.6  # of the difference to a finer solution, which the prediction includes
SPACE_LIMIT = 3.0  # whitened size of the difference to twice the nodes from which these are used
MOST_NODES = 40
RENEWED = 3.0  # whitened change of the differences from which those of another point count
# shorter steps, of the step, of which the first that succeeds tells the error in time, and what makes its difference that to half the step
SHORTER = ((0.5, 1.0), (2.0 / 3.0, 1.4), (0.8, 2.2))


def add_numerics(problem: Problem, point: Mapping[Key, float], workers: int) -> dict[str, float]:
    """Compare with finer solutions at ``point``: correct the residual by the differences, and let them vary.

    Where the data can see the error in space, the problem goes on with twice the nodes.
    Returns rms differences in m: ``time_error_m`` (half the step), ``space_error_m`` (twice the nodes).
    """
    D, squares = differences(problem, point, workers)
    nodes = 2 * problem.forward_models[0].nodes
    if float(np.linalg.norm(D[:, 1])) > SPACE_LIMIT and nodes <= MOST_NODES:
        problem.forward_models = [e.resolved(nodes, e.scheme.dt) for e in problem.forward_models]
        return add_numerics(problem, point, workers)
    _put(problem, D)
    rms = np.sqrt(squares / max(sum(len(w.used) for w in problem.whiteners), 1))
    return {"time_error_m": float(rms[0]), "space_error_m": float(rms[1])}


def renew_numerics(problem: Problem, point: Mapping[Key, float], workers: int) -> Floats | None:
    """The same at a ``point`` that explains the data: a strong cause, as friction, can make a solver's error that the nominal model does not have.

    Returns the change (m,) of the whitened correction; None where it is too small to count, and all is left as it was.
    """
    D, _ = differences(problem, point, workers)
    change = D.sum(axis=1) - problem.offset
    if not np.any(D[:, 0]) or float(np.linalg.norm(change)) < RENEWED:
        return None
    _put(problem, D)
    return change


def differences(problem: Problem, point: Mapping[Key, float], workers: int) -> tuple[Floats, Floats]:
    """Whitened differences (m, 2) to shorter steps and to twice the nodes at ``point``, and the sums (2,) m^2 of their squares in position; zero
    where a recording cannot be simulated so."""
    jobs = [
        delayed(residual)(e, point)
        for e in problem.forward_models
        for residual in (ForwardModel.residual_at, _shorter, _denser)
    ]
    done = Parallel(workers, prefer="threads")(jobs)
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


def _put(problem: Problem, D: Floats) -> None:
    problem.offset = D.sum(axis=1)
    problem.numerics = NUMERICS_SIGMA * D


def _shorter(forward_model: ForwardModel, point: Mapping[Key, float]) -> tuple[Floats | None, float]:
    for share, factor in SHORTER:
        found = forward_model.resolved(forward_model.nodes, share * forward_model.scheme.dt).residual_at(
            point
        )
        if found is not None:
            return found, factor
    return None, 0.0


def _denser(forward_model: ForwardModel, point: Mapping[Key, float]) -> tuple[Floats | None, float]:
    return forward_model.resolved(2 * forward_model.nodes, forward_model.scheme.dt).residual_at(point), 1.0
