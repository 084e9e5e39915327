"""The whole set of measurements, in a short and a long form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctr_dynamics.benchmarks.fused import fused_replay
from ctr_dynamics.benchmarks.machine_info import machine
from ctr_dynamics.benchmarks.release import Release
from ctr_dynamics.benchmarks.release_figures import grid, space_error, time_error, work
from ctr_dynamics.benchmarks.sensitivity_cost import sensitivity_cost
from ctr_dynamics.benchmarks.snap_steps import snap_cost
from ctr_dynamics.benchmarks.sweeps import sweeps
from ctr_dynamics.parameters import Settings
from ctr_dynamics.runtime.replay import plain


@dataclass(frozen=True)
class Size:
    """How much is measured; times in s, `cut` when the weight is cut."""

    cut: float
    work_s: float
    work_nodes: tuple[int, ...]
    replay_nodes: tuple[int | None, ...]
    replay_s: float | None
    ranks: tuple[int, ...]
    rank_s: float | None
    time_nodes: int
    time_s: float
    reference: tuple[str, float]
    since: float
    grid_s: float
    grid_dts: tuple[float, ...]
    grid_nodes: tuple[int, ...]
    space_s: float
    space_nodes: tuple[int, ...]
    fine_nodes: int
    derived_s: float
    rounds: int


LONG = Size(
    cut=1.0,
    work_s=2.0,
    work_nodes=(12, 100, 400),
    replay_nodes=(None, 100),
    replay_s=None,
    ranks=(10, 16, 24, 40),
    rank_s=None,
    time_nodes=100,
    time_s=6.0,
    reference=("radau", 0.0015),
    since=1.0,
    grid_s=2.0,
    grid_dts=(0.001, 0.002, 0.003, 0.005, 0.01),
    grid_nodes=(12, 16, 24, 50, 100, 200, 400),
    space_s=3.0,
    space_nodes=(10, 12, 16, 20, 24, 32, 50, 75, 100, 150, 200),
    fine_nodes=400,
    derived_s=2.0,
    rounds=5,
)
QUICK = Size(
    cut=0.06,
    work_s=0.3,
    work_nodes=(12, 100),
    replay_nodes=(None,),
    replay_s=0.6,
    ranks=(),
    rank_s=0.0,
    time_nodes=24,
    time_s=0.3,
    reference=("radau", 0.0015),
    since=0.06,
    grid_s=0.15,
    grid_dts=(0.003, 0.005),
    grid_nodes=(24, 50),
    space_s=0.15,
    space_nodes=(12, 24, 48),
    fine_nodes=100,
    derived_s=0.15,
    rounds=1,
)


def measure(bag: Path, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """All figures, as plain data for JSON; numbers that are not finite become null.

    Args:
        bag: bag for the replay, of a robot `till2020_tissue`.
        quick: few and short measurements.
        say: called with the name of each part before it begins.
    """
    size = QUICK if quick else LONG
    result: dict[str, Any] = {"quick": quick, "machine": machine()}
    say("cost of a sweep")
    result["sweeps"] = sweeps(quick)
    test = Release.make(size.cut)
    say("release test: sweeps a solve, cost of a step")
    tolerance = float(Settings()["model.tolerance"])
    result["simulate"] = work(test, size.work_nodes, size.work_s, tolerance)
    say("sensitivities")
    result["sensitivities"] = [
        sensitivity_cost(test, nodes, size.derived_s, tolerance) for nodes in size.work_nodes[:2]
    ]
    say("replay with fusion")
    result["replay"] = [
        fused_replay(bag, "till2020_tissue", nodes, size.replay_s, rounds=size.rounds)
        for nodes in size.replay_nodes
    ]
    say("replay with fusion over the rank")
    result["rank"] = [
        fused_replay(bag, "till2020_tissue", None, size.rank_s, rank, size.rounds) for rank in size.ranks
    ]
    say("release test: error of the time schemes")
    result["time_error"] = time_error(test, size.time_nodes, size.time_s, size.reference, size.since)
    say("real-time ratio over time step and node spacing")
    result["figure_13"] = grid(test, size.grid_dts, size.grid_nodes, size.grid_s)
    say("error over node spacing")
    result["figure_14"] = space_error(test, size.space_nodes, size.fine_nodes, size.space_s)
    say("snap-through: cost of a step")
    result["snap"] = snap_cost(quick)
    return dict(plain(result))
