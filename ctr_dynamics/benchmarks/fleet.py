"""Is the published covariance right, on any robot? NEES, NIS and errors over bags of many robots, each drawn from its file's tolerances.

A bag holds a few independent values of the tracker's drift and one of every tolerance. So the NEES of a single bag scatters widely about 1;
the mean over many tells whether the filter is consistent.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ctr_dynamics.benchmarks.fleet_robots import FLEET, Draw, drawn, fleet_robot, seed_of
from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import Robot
from ctr_dynamics.runtime.replay import Player
from ctr_dynamics.sensing import TrackerModel
from ctr_dynamics.simulation.motion_primitives import Hold, Multisine
from ctr_dynamics.simulation.scenario import Load, Scenario, Solver, TubeMotion
from ctr_dynamics.simulation.scenario_run import SimulatedRecording, simulate, write_recording

Floats = NDArray[np.float64]
CUT_S, TURN_S, END_S = 0.6, 2.0, 5.0  # a weight is cut; all tubes turn; end of a bag
DEFLECTION = 0.1  # of the exposed length, by the weight
TURNS_HZ = (0.37, 0.83, 1.7)  # and amplitudes that give each the same speed, 0.9 rad/s


class Consistency(NamedTuple):
    """Of one bag: NEES and NIS per degree of freedom, and the 3-D rms error of the fused tip in m."""

    nees: float
    nis: float
    error: float


def scenario_for(robot: Robot, seed: int, end_s: float = END_S) -> Scenario:
    """A hung weight that is cut, then all tubes in motion until ``end_s``."""
    model, rest = Model(robot), robot.rest
    beta, alpha = np.array(rest.beta.value), np.array(rest.alpha.value)
    gravity = np.array(robot.gravity.value)
    push = 1e-4 * model.scale[0] * gravity / max(float(np.linalg.norm(gravity)), 1e-9)
    statics = Statics(model)
    free, loaded = statics.solve(beta, alpha), statics.solve(beta, alpha, push)
    compliance = np.linalg.norm(loaded.tip_position - free.tip_position) / np.linalg.norm(push)
    rng = np.random.default_rng([seed, 1])
    turns = [
        Multisine(
            kind="multisine", duration_s=end_s - TURN_S, fade_s=0.3, frequencies_hz=list(TURNS_HZ),
            amplitudes=[0.9 / (2 * math.pi * f) for f in TURNS_HZ], phases_rad=rng.uniform(0, 2 * math.pi, 3).tolist(),
        )
        for _ in range(robot.n_tubes)
    ]  # fmt: skip
    return Scenario(
        duration_s=end_s,
        seed=seed,
        tubes=[TubeMotion(rotation=[Hold(kind="hold", duration_s=TURN_S), turn]) for turn in turns],
        loads=[
            Load(
                end_s=CUT_S,
                fall_s=0.01,
                hung_mass_kg=float(
                    DEFLECTION * robot.exposed_length / (compliance * np.linalg.norm(gravity))
                ),
            )
        ],
        solver=Solver(nodes=30),
    )


def record(robot: Robot, draw: Draw, scenario: Scenario, bag: Path) -> tuple[Floats, Floats]:
    """Write the bag of a true robot; returns times (k,) in s from its start and the tip (k, 3) m as the tracker realises it.

    Raises:
        RuntimeError: the simulation failed.
    """
    run = simulate(scenario, draw.robot)
    if run.failure:
        raise RuntimeError(run.failure)

    def read(t: float) -> tuple[Floats, Floats]:
        alpha, beta = run.joints(t)
        return alpha - draw.offsets, beta

    seen: SimulatedRecording = replace(run, joints=read)
    write_recording(bag, scenario, draw.robot, seen)
    position, quaternion = TrackerModel.of_robot(draw.robot).reported(run.t, run.position, run.quaternion)
    nominal = TrackerModel.of_robot(robot)
    realised = [nominal.to_base(p, q)[0] for p, q in zip(position, quaternion, strict=True)]
    return run.t, np.array(realised)


def consistency(
    robot: Robot, bag: Path, t: Floats, realised: Floats, settings: dict[str, Any] | None = None
) -> Consistency:
    """Replay ``bag`` with the file ``robot`` and compare with the truth ``realised`` (k, 3) m at ``t`` (k,) s, from the first output on."""
    estimator = Estimator(robot, Settings({"output.policy": "wait", **(settings or {})}))
    outputs = [out for out in Player(estimator).play(open_bag(bag)) if out.valid]
    start = 1_700_000_000 * 10**9
    times = np.array([out.stamp_ns - start for out in outputs]) * 1e-9
    inside = times <= t[-1]
    error = np.array([out.tip_position for out in outputs]) - CubicSpline(t, realised)(times)
    covariance = np.array([out.tip_covariance[:3, :3] for out in outputs])
    nees = np.einsum("ki,ki->k", error, np.linalg.solve(covariance, error[..., None])[..., 0]) / 3.0
    health = estimator.health
    return Consistency(
        float(nees[inside].mean()),
        health.measurements.nis_sum / max(health.measurements.nis_dof, 1),
        float(np.sqrt((error[inside] ** 2).sum(axis=1).mean())),
    )


def fleet(
    draws: int,
    robots: Sequence[str] = tuple(FLEET),
    lab: Sequence[bool] = (False, True),
    seed: int = 0,
    say: Callable[[str], None] = lambda line: None,
) -> list[dict[str, Any]]:
    """Rows of the table: for each robot and kind of tolerances the bags' NEES, NIS and errors with their means and intervals."""
    rows = []
    for name in robots:
        for kind in lab:
            robot, found = fleet_robot(name, kind), []
            failures: list[str] = []
            for number in range(draws):
                rng = np.random.default_rng([seed, number, seed_of(name), int(kind)])
                draw = drawn(robot, rng)
                scenario = scenario_for(robot, int(rng.integers(2**31)))
                with tempfile.TemporaryDirectory() as folder:
                    bag = Path(folder) / "drawn.mcap"
                    try:
                        t, realised = record(robot, draw, scenario, bag)
                    except RuntimeError as error:
                        failures.append(str(error))
                        continue
                    found.append(consistency(robot, bag, t, realised))
                say(f"{name} {'lab' if kind else 'file'} {number}: NEES {found[-1].nees:.2f}, NIS {found[-1].nis:.2f}, "
                    f"error {1e3 * found[-1].error:.3f} mm")  # fmt: skip
            rows.append(_row(name, kind, found, failures))
    return rows


def _row(name: str, lab: bool, found: Sequence[Consistency], failures: Sequence[str]) -> dict[str, Any]:
    nees, nis, error = np.array(found).reshape(-1, 3).T
    mean, half = interval(nees)
    return {
        "robot": name,
        "tolerances": "lab" if lab else "file",
        "bags": len(found),
        "failures": list(failures),
        "nees": {
            "mean": mean,
            "half_width": half,
            "below_2.5": float((nees < 2.5).mean()) if len(nees) else math.nan,
            "largest": float(nees.max(initial=-math.inf)),
        },
        "nis": dict(zip(("mean", "half_width"), interval(nis), strict=True)),
        "error_m": {
            "rms": float(np.sqrt((error**2).mean())) if len(error) else math.nan,
            "largest": float(error.max(initial=-math.inf)),
        },
    }


def interval(values: Floats) -> tuple[float, float]:
    """Mean and half the width of its 95 % interval; NaN where there are too few values."""
    if len(values) < 2:
        return (float(values.mean()) if len(values) else math.nan), math.nan
    return float(values.mean()), float(1.96 * values.std(ddof=1) / math.sqrt(len(values)))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a Markdown table."""
    head = "| robot | tolerances | bags | NEES / dof | bags below 2.5 | largest | NIS / dof | fused tip, mm rms | largest |"
    lines = [head, "|" + "---|" * 9]
    for row in rows:
        nees, nis, error = row["nees"], row["nis"], row["error_m"]
        lines.append(
            f"| {row['robot']} | {row['tolerances']} | {row['bags']} | {nees['mean']:.2f} +- {nees['half_width']:.2f} "
            f"| {100 * nees['below_2.5']:.0f} % | {nees['largest']:.2f} | {nis['mean']:.3f} +- {nis['half_width']:.3f} "
            f"| {1e3 * error['rms']:.3f} | {1e3 * error['largest']:.3f} |"
        )
        lines += [f"  {len(row['failures'])} failed: {row['failures'][0]}"] if row["failures"] else []
    return "\n".join(lines)
