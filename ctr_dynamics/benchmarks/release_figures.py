"""Costs of the release test, and its errors in time and space: tables of the bench and the paper's Figures 13 and 14."""

from __future__ import annotations

from typing import Any

from ctr_dynamics.benchmarks.euler import euler_tips
from ctr_dynamics.benchmarks.release import (
    DT,
    ROUNDS,
    Release,
    compiled,
    divided,
    release_robot,
    rms,
    rms_difference,
    run,
    tip_length,
)
from ctr_dynamics.benchmarks.sweeps import sweep_cost
from ctr_dynamics.kernels.kinds import ONE_LANE
from ctr_dynamics.model.model import Model

SCHEMES = ("backward_euler", "bdf2", "bdf_alpha", "trapezoid", "sdirk2", "sdirk3", "radau")


def work(
    test: Release, nodes_list: tuple[int, ...], duration: float, tolerance: float
) -> list[dict[str, Any]]:
    """Sweeps a solve and a step, and the cost of a step in plain sweeps of the same nodes, at the default scheme."""
    rows = []
    for nodes in nodes_list:
        run(test, "sdirk3", DT, nodes, 0.03, tolerance)
        path = min(
            (run(test, "sdirk3", DT, nodes, duration, tolerance) for _ in range(ROUNDS)), key=lambda p: p.wall
        )
        plain = sweep_cost(Model(release_robot(), nodes=nodes), ONE_LANE, max(3, 4000 // nodes))
        step = path.wall / path.steps
        compiled_ratio, _ = compiled(test, nodes, duration, tolerance)
        rows.append(
            {
                "nodes": nodes,
                "tolerance": tolerance,
                "steps": path.steps,
                "sweeps_per_solve": path.sweeps / path.solves,
                "sweeps_per_step": path.sweeps / path.steps,
                "jacobians_per_step": path.jacobians / path.steps,
                "step_us": 1e6 * step,
                "plain_sweep_us": 1e6 * plain,
                "step_ratio_to_plain_sweep": step / plain,
                "realtime_ratio": path.realtime,
                "compiled_realtime_ratio": compiled_ratio,
                "failure": path.failure,
            }
        )
    return rows


def time_error(
    test: Release, nodes: int, duration: float, reference: tuple[str, float], since: float
) -> dict[str, Any]:
    """Error of every scheme at 3 ms against the scheme and step (s) `reference` on the same nodes; and of the default scheme over the step, with
    steps across the cut as they fall and divided there."""
    scheme, fine_dt = reference
    fine = run(test, scheme, fine_dt, nodes, duration)
    steps = []
    for count in (1, 2, 3):
        dt = DT / count
        steps.append(
            {
                "dt_s": dt,
                "error_m": rms_difference(run(test, "sdirk3", dt, nodes, duration), fine, since),
                "divided_error_m": rms_difference(divided(test, dt, nodes, duration), fine, since),
            }
        )
    rows = []
    for name in SCHEMES:
        path = run(test, name, DT, nodes, duration)
        rows.append(
            {
                "scheme": name,
                "error_m": rms_difference(path, fine, since),
                "realtime_ratio": path.realtime,
                "failure": path.failure or fine.failure,
            }
        )
    return {"nodes": nodes, "reference": {"scheme": scheme, "dt_s": fine_dt}, "schemes": rows, "steps": steps}


def grid(
    test: Release, dts: tuple[float, ...], nodes_list: tuple[int, ...], duration: float
) -> list[dict[str, Any]]:
    """The paper's Figure 13: real-time ratio over time step and node spacing, at the default scheme and tolerance of the estimator."""
    reach = tip_length()
    rows = []
    for nodes in nodes_list:
        for dt in dts:
            path = run(test, "sdirk3", dt, nodes, duration, 1e-4)
            rows.append(
                {
                    "nodes": nodes,
                    "spacing_m": reach / (nodes - 1),
                    "dt_s": dt,
                    "realtime_ratio": path.realtime,
                    "failure": path.failure,
                }
            )
    return rows


def space_error(test: Release, nodes_list: tuple[int, ...], fine: int, duration: float) -> dict[str, Any]:
    """The paper's Figure 14: error over node spacing at 3 ms of fourth-order Runge-Kutta and of Euler's method, against `fine` nodes of the former.

    The paper's own reference is a spacing of 0.02 mm; that of `fine` nodes lies as close to it as rounding allows.
    """
    reach = tip_length()
    reference = run(test, "sdirk3", DT, fine, duration)
    rows = []
    for nodes in nodes_list:
        path = run(test, "sdirk3", DT, nodes, duration)
        euler = euler_tips(test, nodes, duration)
        rows.append(
            {
                "nodes": nodes,
                "spacing_m": reach / (nodes - 1),
                "error_m": rms_difference(path, reference, 0.0),
                "euler_error_m": None if euler is None else rms(euler - reference.tips[: len(euler)]),
                "realtime_ratio": path.realtime,
                "failure": path.failure or reference.failure,
            }
        )
    return {"reference_nodes": fine, "reference_spacing_m": reach / (fine - 1), "rows": rows}
