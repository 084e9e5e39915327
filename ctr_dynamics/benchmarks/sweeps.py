"""Cost of one sweep from base to tip: against nodes, tubes and lanes."""

from __future__ import annotations

from typing import Any

import numpy as np

from ctr_dynamics.benchmarks.machine_info import best_of
from ctr_dynamics.kernels.collocation import ONE_RUN
from ctr_dynamics.kernels.kinds import ONE_LANE, Lanes, lanes_for
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.shooting import broadcast
from ctr_dynamics.kernels.sweep import sweep
from ctr_dynamics.model.mesh import node_count
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict

# one lane; the stages of a step; batches of eight
LANES = (ONE_LANE, ONE_RUN, lanes_for(8), lanes_for(16), lanes_for(32))


def sweep_cost(model: Model, lanes: Lanes, repeats: int) -> float:
    """Time of one sweep in s with the history of a robot at rest, all lanes together."""
    robot = model.robot
    beta, alpha = np.array(robot.rest.beta.value), np.array(robot.rest.alpha.value)
    equilibrium = Statics(model, 1e-8).solve(beta, alpha, np.zeros(3), np.zeros(3))
    mesh = equilibrium.mesh
    b = model.sweep_buffers(mesh, lanes.count)
    c0 = float(make_scheme("sdirk3", 0.003).c0[-1])
    block = model.parameters.copy()
    block[model.layout["alpha"]], block[model.layout["beta"]] = alpha, beta
    lengths = np.zeros(len(mesh.sec_cells))
    section_lengths(mesh.bp_tube, mesh.bp_offset, beta, lengths)
    main = len(b.history) // lanes.count
    for source, target in (
        (block, b.parameters),
        (lengths, b.section_lengths),
        (equilibrium.x, b.unknowns),
        (-c0 * equilibrium.fields[:main], b.history),
        (-c0 * equilibrium.fields[main:], b.base_history),
    ):
        broadcast(lanes, np.ascontiguousarray(source), target)

    def once() -> None:
        sweep(model.kind, lanes, c0, mesh, b)

    return best_of(once, repeats)


def _robot_of(tubes: int) -> Robot:
    """A robot of that many tubes: the shipped ones of two and three, or the two-tube one without its outer tube."""
    if tubes == 3:
        return load_robot("three_tube")
    robot = load_robot("till2020_tissue")
    if tubes == 2:
        return robot
    data = robot_to_dict(robot)
    data["tubes"] = data["tubes"][:tubes]
    for name in ("alpha", "beta"):
        data["rest"][name]["value"] = data["rest"][name]["value"][:tubes]
    return robot_from_dict(data)


def sweeps(quick: bool) -> list[dict[str, Any]]:
    """Rows: tubes, nodes (as asked), mesh_nodes, lanes, sweep_us, lane_us, and ratios to the plain sweep of as many tubes and nodes."""
    rows = []
    for tubes in (2,) if quick else (1, 2, 3):
        robot = _robot_of(tubes)
        for nodes in (12, 100) if quick else (12, 16, 24, 50, 100, 200, 400):
            model = Model(robot, nodes=nodes)
            repeats = max(3, (2000 if quick else 20000) // nodes)
            plain = sweep_cost(model, ONE_LANE, repeats)
            for lanes in LANES[:3] if quick else LANES:
                cost = (
                    sweep_cost(model, lanes, max(3, repeats // lanes.count))
                    if lanes is not ONE_LANE
                    else plain
                )
                rows.append(
                    {
                        "tubes": tubes,
                        "nodes": nodes,
                        "mesh_nodes": node_count(model.mesh(np.array(robot.rest.beta.value))[1]),
                        "lanes": lanes.count,
                        "sweep_us": 1e6 * cost,
                        "lane_us": 1e6 * cost / lanes.count,
                        "ratio_to_plain_sweep": cost / plain,
                        "lane_ratio_to_plain_sweep": cost / lanes.count / plain,
                    }
                )
    return rows
