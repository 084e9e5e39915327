"""Many simulations at once against one after another, and a simulation with its sensitivities against one without: ratios within one run."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.benchmarks.machine_info import best_of
from ctr_dynamics.benchmarks.release import DT, Release, release_robot, sampled
from ctr_dynamics.effects import apply_effects
from ctr_dynamics.model.batch import LANES, run_many
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.model.trajectory import run

Floats = NDArray[np.float64]
COLUMNS = 40
SPREAD = 0.01  # deviation of the stiffness and of the angles (rad) from case to case


def ensemble(test: Release, nodes: int, cases: int, duration: float, tolerance: float) -> dict[str, Any]:
    """Releases of robots whose stiffness and angles vary: times of one after another and of all at once, on one core."""
    model, scheme = Model(release_robot(), nodes=nodes), make_scheme("sdirk3", DT)
    rng = np.random.default_rng(0)
    blocks, inputs = [], []
    for _ in range(cases):
        plant = model.plant.copy()
        apply_effects(plant, {"youngs_modulus": {"all.scale": 1.0 + SPREAD * rng.standard_normal()}})
        blocks.append(plant.block)
        inputs.append(sampled(test, DT, duration, SPREAD * rng.standard_normal(2)))
    parameters = np.stack(blocks)
    run_many(model, scheme, parameters[:LANES], inputs[:LANES], 4 * DT, tolerance=tolerance)

    def at_once() -> None:
        run_many(model, scheme, parameters, inputs, duration, tolerance=tolerance)

    def one_by_one() -> None:
        for block, rows in zip(parameters, inputs, strict=True):
            run(model, scheme, block, rows, duration, tolerance=tolerance)

    together, apart = best_of(at_once, 1), best_of(one_by_one, 1)
    return {
        "nodes": nodes,
        "cases": cases,
        "lanes": LANES,
        "apart_s": apart,
        "together_s": together,
        "throughput_ratio": apart / together,
    }


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
