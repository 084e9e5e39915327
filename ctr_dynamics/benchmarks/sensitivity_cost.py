"""A simulation with its sensitivities against one without: a ratio within one run."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.benchmarks.machine_info import best_of
from ctr_dynamics.benchmarks.release import DT, Release, release_robot, sampled
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.model.trajectory import run

Floats = NDArray[np.float64]
COLUMNS = 40


def sensitivity_cost(test: Release, nodes: int, duration: float, tolerance: float) -> dict[str, Any]:
    """A simulation with derivatives by ``COLUMNS`` parameters, in simulations without."""
    model, scheme = Model(release_robot(), nodes=nodes), make_scheme("sdirk3", DT)
    rows = sampled(test, DT, duration)
    effect = np.zeros((len(model.parameters), COLUMNS))
    for k in range(COLUMNS):  # which parameters they are does not matter for the cost
        row = k % (11 * model.n)
        effect[row, k] = 1e-3 * abs(model.parameters[row])

    def simulate(columns: Floats | None) -> None:
        run(model, scheme, model.parameters, rows, duration, effect=columns, tolerance=tolerance)

    plain, derived = best_of(partial(simulate, None), 1), best_of(partial(simulate, effect), 1)
    return {"nodes": nodes, "columns": COLUMNS, "simulations": derived / plain}
