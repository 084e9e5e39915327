"""Replay of a bag through the estimator: real-time ratio and the time of every step."""

from __future__ import annotations

import time
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ctr_dynamics.benchmarks.sweeps import sweep_cost
from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages.topics import STEP_NS
from ctr_dynamics.kernels.kinds import ONE_LANE
from ctr_dynamics.model.model import Model
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.garbage_collection import rare_garbage_collection
from ctr_dynamics.runtime.replay import Player
from ctr_dynamics.runtime.warm_up import warm_up

EDGES_MS = tuple(float(x) for x in np.round(np.geomspace(0.1, 30.0, 51), 4))


def fused_replay(
    bag: Path,
    robot_name: str,
    nodes: int | None,
    seconds: float | None,
    rank: int | None = None,
    rounds: int = 1,
) -> dict[str, Any]:
    """Replay `bag` with fusion: ratio, percentiles and histogram of the steps' times in ms, and cost in plain sweeps.

    Args:
        nodes: `model.nodes`; None for its default.
        seconds: how much of the bag; None for all of it.
        rank: `filter.rank`; None for its default.
        rounds: how often; the figures are those of the fastest replay.
    """
    values: dict[str, Any] = {"output.policy": "wait"}
    if nodes is not None:
        values["model.nodes"] = nodes
    if rank is not None:
        values["filter.rank"] = rank
    settings, robot = Settings(values), load_robot(robot_name)
    opened = open_bag(bag)
    warm_up(robot, settings)  # as the node does before its first message
    most = None if seconds is None else round(seconds * 1e9) // STEP_NS
    wall = np.inf
    for _ in range(rounds):
        estimator = Estimator(robot, settings)
        player = Player(estimator)
        with rare_garbage_collection():
            begin = time.perf_counter()
            steps = sum(1 for _ in islice(player.play(opened), most))
            spent = time.perf_counter() - begin
        if spent < wall:
            wall, ticks = spent, 1e3 * np.array(player.times_s())[:steps]
    model = Model(robot, nodes=int(settings["model.nodes"]))
    plain = 1e3 * sweep_cost(model, ONE_LANE, max(3, 4000 // model.nodes))
    counts, _ = np.histogram(np.clip(ticks, EDGES_MS[0], EDGES_MS[-1]), EDGES_MS)
    p50, p99, p999, worst = np.percentile(ticks, (50, 99, 99.9, 100))
    return {
        "bag": bag.name,
        "nodes": model.nodes,
        "rank": int(settings["filter.rank"]),
        "columns": estimator.runs.fused.ekf.factor.rank,  # what the rank becomes when its last SIMD batch is full
        "steps": steps,
        "realtime_ratio": steps * STEP_NS * 1e-9 / wall,
        "tick_ms": {"p50": p50, "p99": p99, "p99.9": p999, "max": worst, "mean": float(ticks.mean())},
        "tick_ratio_to_plain_sweep": {"p50": p50 / plain, "p99": p99 / plain},
        "sweeps_per_step": estimator.summary()["solver"]["sweeps_per_step"],
        "plain_sweep_ms": plain,
        "histogram": {"edges_ms": list(EDGES_MS), "counts": counts.tolist()},
    }
