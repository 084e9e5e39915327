"""The solver's own error: measured against finer solutions, corrected, and left free to vary."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from .experiment import Experiment
from .fit import Key, Problem

Floats = NDArray[np.float64]
NUMERICS_SIGMA = 0.6  # of the difference to a finer solution, which the prediction includes
SPACE_LIMIT = 3.0  # whitened size of the difference to twice the nodes from which these are used
MOST_NODES = 40


def add_numerics(problem: Problem, point: Mapping[Key, float], workers: int) -> dict[str, float]:
    """Compare with finer solutions at ``point``: correct the residual by the differences, and let them vary.

    Where the data can see the error in space, the problem goes on with twice the nodes.
    Returns rms differences in m: ``time_error_m`` (half the step), ``space_error_m`` (twice the nodes).
    """

    def residual(experiment: Experiment, nodes: int, dt: float) -> Floats | None:
        other = experiment.resolved(nodes, dt)
        prediction = other.predict(point)
        return None if prediction.failure else other.residual(prediction)

    jobs = []
    for e in problem.experiments:
        nodes, dt = e.nodes, e.scheme.dt
        jobs += [delayed(residual)(e, *finer) for finer in ((nodes, dt), (nodes, 0.5 * dt), (2 * nodes, dt))]
    done = Parallel(workers, prefer="threads")(jobs)
    directions: list[list[Floats]] = [[], []]
    squares = np.zeros(2)
    for number, whiten in enumerate(problem.whiteners):
        base, *others = done[3 * number : 3 * number + 3]
        for i, finer in enumerate(others):
            failed = base is None or finer is None
            difference = np.zeros((len(whiten.used), 6)) if failed else base - finer
            directions[i].append(whiten(difference))
            squares[i] += float(np.sum(difference[:, :3] ** 2))
    D = np.stack([np.concatenate(parts) for parts in directions], axis=1)
    nodes = 2 * problem.experiments[0].nodes
    if float(np.linalg.norm(D[:, 1])) > SPACE_LIMIT and nodes <= MOST_NODES:
        problem.experiments = [e.resolved(nodes, e.scheme.dt) for e in problem.experiments]
        return add_numerics(problem, point, workers)
    problem.offset = D.sum(axis=1)
    problem.numerics = NUMERICS_SIGMA * D
    rms = np.sqrt(squares / max(sum(len(w.used) for w in problem.whiteners), 1))
    return {"time_error_m": float(rms[0]), "space_error_m": float(rms[1])}
