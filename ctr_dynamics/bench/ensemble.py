"""Many simulations at once against one after another, and a simulation with its sensitivities against one without: ratios within one run."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.bench.release import DT, Release, release_robot
from ctr_dynamics.effects import apply_effects, make_setup
from ctr_dynamics.model.batch import LANES, run_many
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.scheme import make_scheme
from ctr_dynamics.model.trajectory import CHUNK, InputRows, run

Floats = NDArray[np.float64]
COLUMNS = 40
SPREAD = 0.01  # deviation of the stiffness and of the angles (rad) from case to case


def ensemble(test: Release, nodes: int, cases: int, duration: float, tolerance: float) -> dict[str, Any]:
    """Releases of robots whose stiffness and angles vary: times of one after another and of all at once, on one core."""
    model, scheme = Model(release_robot(), nodes=nodes), make_scheme("sdirk3", DT)
    rng = np.random.default_rng(0)
    count = int(
        np.floor(duration / DT + 1e-9)
    )  # as many as a run takes, or it would sample the last ones anew
    blocks, inputs = [], []
    for _ in range(cases):
        setup = make_setup(model)
        apply_effects(setup, {"youngs_modulus": {"all.scale": 1.0 + SPREAD * rng.standard_normal()}})
        blocks.append(setup.block)
        inputs.append(_rows(test, SPREAD * rng.standard_normal(2)))
        for k in range(0, count, CHUNK):  # sampled before the clock starts, as those of a bag are
            steps = np.arange(k, min(k + CHUNK, count))
            inputs[-1](((steps[:, None] + scheme.times) * DT).ravel())
    parameters = np.stack(blocks)
    run_many(model, scheme, parameters[:LANES], inputs[:LANES], 4 * DT, tolerance=tolerance)
    begin = time.perf_counter()
    run_many(model, scheme, parameters, inputs, duration, tolerance=tolerance)
    together = time.perf_counter() - begin
    begin = time.perf_counter()
    for block, rows in zip(parameters, inputs, strict=True):
        run(model, scheme, block, rows, duration, tolerance=tolerance)
    apart = time.perf_counter() - begin
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
    rows = _rows(test, np.zeros(2))
    effect = np.zeros((len(model.parameters), COLUMNS))
    for k in range(COLUMNS):  # which parameters they are does not matter for the cost
        row = k % (11 * model.n)
        effect[row, k] = 1e-3 * abs(model.parameters[row])
    times = []
    for columns in (None, effect):
        run(model, scheme, model.parameters, rows, 4 * DT, effect=columns, tolerance=tolerance)
        begin = time.perf_counter()
        run(model, scheme, model.parameters, rows, duration, effect=columns, tolerance=tolerance)
        times.append(time.perf_counter() - begin)
    return {"nodes": nodes, "columns": COLUMNS, "simulations": times[1] / times[0]}


def _rows(test: Release, turn: Floats) -> InputRows:
    """Inputs of the release with both tubes turned by ``turn`` (2,) rad, sampled once."""
    known: dict[tuple[float, int], Floats] = {}

    def rows(times: Floats) -> Floats:
        key = float(times[0]), len(times)
        if key not in known:
            found = [test.at(float(t)) for t in times]
            known[key] = np.array(
                [np.r_[x.alpha + turn, x.alpha_rate, x.beta, x.force, x.torque] for x in found]
            )
        return known[key]

    return rows
