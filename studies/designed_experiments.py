"""Designed experiments on near ties: what the next experiment is worth against the shipped motions, and what the diagnosis says after it.

    python -m studies.designed_experiments --output designed.jsonl --ties 10 --robots tissue,random1,random2
    python -m studies.designed_experiments --output designed.jsonl --table

A case is a true robot drawn from the tolerances of its file, and a short bag that shows little: either all tubes turn, or a small weight is cut and
nothing else moves. Derivatives at the file's values tell which effects of the catalogue, of up to 3 plausible sizes, such a bag would show and
not tell from another. One of them is drawn, and the bag is recorded with it. Where the diagnosis of that bag is `ambiguous`, it is a tie. Then the
proposed experiment is recorded too, and both bags are diagnosed. The shipped motions are compared by the separation that each would give in
addition. Those that a robot cannot make without a snap are left out.

Each outcome is one line of the output; a run that is stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from ctr_dynamics.benchmarks.fleet import record, scenario_for
from ctr_dynamics.benchmarks.fleet_robots import Draw, drawn, fleet_robot, seed_of
from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.diagnosis_result import Diagnosis
from ctr_dynamics.diagnosis.inference.candidates import Candidate, candidates
from ctr_dynamics.diagnosis.inference.discretisation_error import choose_nodes
from ctr_dynamics.diagnosis.inference.fit_problem import choose_steps, make_problem
from ctr_dynamics.diagnosis.inference.recalibration import nuisances_of
from ctr_dynamics.diagnosis.inference.sensitivities import sensitivities_at
from ctr_dynamics.diagnosis.inference.separation import left_over
from ctr_dynamics.diagnosis.next_experiment import Contrast, contrast_of, next_experiment
from ctr_dynamics.diagnosis.pipeline import diagnose_recordings
from ctr_dynamics.diagnosis.recording import Recording, measured_axes, read_recording
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import robot_from_dict, robot_to_dict
from ctr_dynamics.simulation.motion_primitives import Sine
from ctr_dynamics.simulation.scenario import Scenario, Solver, TubeMotion, load_scenario
from studies.fleet_diagnosis import NOT_SHOWN, SIZES, direction, extension

LIBRARY = ("release", "light_release", "sweep", "reversals")  # `turns` takes robots through a snap
FIRST_S = 4.0  # length of the first bag
TURN_HZ, TURN_RAD = (0.5, 1.0), 0.8  # of the first bag
SHOWN = 8.0  # deviations of the noise, by which a bag at least shows an effect
TIED = 2.0  # the same, by which it at most tells the effect from its nearest rival


def first_scenario(robot: Robot, seed: int) -> Scenario:
    """A short motion that shows little: the tubes turn for even seeds, a weight is cut and nothing else moves for others."""
    if seed % 2:
        released = scenario_for(robot, seed, FIRST_S)
        return released.model_copy(update={"tubes": [TubeMotion() for _ in range(robot.n_tubes)]})
    rng = np.random.default_rng([seed, 2])
    turns = [
        Sine(
            kind="sine",
            duration_s=FIRST_S,
            amplitude=TURN_RAD,
            frequency_hz=rng.uniform(*TURN_HZ),
            fade_s=0.5,
        )
        for _ in range(robot.n_tubes)
    ]
    tubes = [TubeMotion(rotation=[turn]) for turn in turns]
    return Scenario(duration_s=FIRST_S, seed=seed, tubes=tubes, solver=Solver(nodes=30))


def ties(robot: Robot, recording: Recording, rng: np.random.Generator) -> list[tuple[Candidate, np.ndarray]]:
    """Effects that ``recording``, of a robot without one, would show and not tell from another: with departures by their scales (quantities,)."""
    context, pool = RunContext(workers=1), candidates(effect_quantities(robot), recording.position)
    mask = measured_axes([recording], [])
    problem = make_problem(robot, [recording], nuisances_of(robot), mask, DiagnosisOptions())
    choose_nodes(problem, {}, context)
    choose_steps(problem, {}, context)
    here = sensitivities_at(problem, {}, pool, context)
    if here is None:
        return []
    columns = [here.columns[q.key] * q.tolerance for q in problem.nuisances]
    nuisances = np.hstack([np.stack(columns, axis=1), problem.numerics])
    scaled = {c: S * [q.scale for q in c.quantities] for c, S in here.by_candidate.items()}
    found = []
    for c, own in scaled.items():
        departures = direction(c, rng)
        effect = (own @ departures)[:, None]
        shown = left_over(nuisances, effect)[0]
        size = max(SIZES[0], SHOWN / shown) if shown else math.inf
        if c.effect in NOT_SHOWN or c in here.trials or size > SIZES[1] or not _can_be(c, size * departures):
            continue
        against = [np.hstack([nuisances, S]) for k, S in scaled.items() if k.effect != c.effect]
        if size * min(left_over(J, effect)[0] for J in against) < TIED:
            found.append((c, size * departures))
    return found


def _can_be(candidate: Candidate, departures: np.ndarray) -> bool:
    """Whether values that are off by ``departures`` (quantities,), in scales, lie within their limits."""
    each = zip(candidate.quantities, departures.tolist(), strict=True)
    return all(q.low <= q.off + q.scale * departure <= q.high for q, departure in each)


def best_shipped(contrast: Contrast, robot: Robot) -> tuple[str, float]:
    """The shipped motion that tells most in addition to the bags at hand, and the separation with it; that of the bags alone where none helps."""
    best = "none", contrast.smallest(contrast.nothing)
    for name in LIBRARY:
        scenario = load_scenario(name)
        if len(scenario.tubes) != robot.n_tubes:
            continue
        told = contrast.told(scenario, exact=True)
        if told is not None and contrast.smallest(told) > best[1]:
            best = name, contrast.smallest(told)
    return best


def outcome(diagnosis: Diagnosis) -> dict[str, Any]:
    """Verdict and the likeliest set of causes with its probability."""
    first = diagnosis.cause_sets[0] if diagnosis.cause_sets else None
    return {
        "verdict": diagnosis.verdict,
        "causes": [c.effect for c in diagnosis.causes],
        "likeliest": [sorted(first[0]), first[1]] if first else None,
    }


def run_case(name: str, number: int) -> dict[str, Any]:
    """Make a case and diagnose it; where it is a tie, also with the designed experiment."""
    robot = fleet_robot(name, True)
    rng = np.random.default_rng([number, seed_of(name), 77])
    draw = drawn(robot, rng)
    row: dict[str, Any] = {"robot": name, "number": number}
    context, begin = RunContext(workers=1), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        bag, scenario = Path(folder) / "first.mcap", first_scenario(robot, number)
        record(robot, draw, scenario, bag)
        tied = ties(robot, read_recording(bag, robot), rng)
        effects = sorted({c.effect for c, _ in tied})
        if not effects:
            return {**row, "hidden": [], "cpu_s": time.process_time() - begin}
        effect = effects[int(rng.integers(len(effects)))]  # every kind as often, whatever its number of forms
        forms = [form for form in tied if form[0].effect == effect]
        hidden = extension(*forms[int(rng.integers(len(forms)))])
        row["hidden"], row["values"] = [effect], hidden[effect]
        true = Draw(robot_from_dict({**robot_to_dict(draw.robot), "extensions": hidden}), draw.offsets)
        record(robot, true, scenario, bag)
        first = read_recording(bag, robot)
        diagnosis = diagnose_recordings(robot, [first], [], context=context)
        row["before"] = outcome(diagnosis)
        contrast = contrast_of(diagnosis) if diagnosis.verdict == "ambiguous" else None
        proposed = next_experiment(diagnosis, context) if contrast is not None else None
        if contrast is not None and proposed is not None:
            row["shipped"] = best_shipped(contrast, robot)
            row["separation"] = [proposed.before, proposed.after]
            bag = Path(folder) / "second.mcap"
            record(
                robot,
                true,
                proposed.scenario.model_copy(update={"seed": number + 1, "solver": Solver(nodes=30)}),
                bag,
            )
            both = [first, read_recording(bag, robot)]
            row["after"] = outcome(diagnose_recordings(robot, both, [], context=context))
    return {**row, "cpu_s": time.process_time() - begin}


def table(rows: list[dict[str, Any]]) -> str:
    """The ties as Markdown."""
    lines = [
        "| robot | hidden | before | separation before, shipped, designed | ratio | after | CPU s |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        if "after" not in r:
            continue
        (name, shipped), (before, after) = r["shipped"], r["separation"]
        said = [f"{r[when]['verdict']}: {', '.join(r[when]['causes'])}" for when in ("before", "after")]
        lines.append(
            f"| {r['robot']} {r['number']} | {', '.join(r['hidden'])} | {said[0]} | {before:.2g}, {shipped:.3g} (`{name}`), {after:.3g} "
            f"| {after / shipped:.1f} | {said[1]} | {r['cpu_s']:.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument(
        "--ties", type=int, default=10, help="cases that are ties, after which the study ends"
    )
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--robots", default="tissue,random1,random2,random3,random4")
    parser.add_argument("--table", action="store_true", help="print the table, and run nothing")
    options = parser.parse_args()
    path: Path = options.output
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    if options.table:
        print(table(rows))
        return
    done, robots = {(r["robot"], r["number"]) for r in rows}, options.robots.split(",")
    for number in itertools.count(options.first):
        if sum("after" in r for r in rows) >= options.ties:
            break
        name = robots[number % len(robots)]
        if (name, number) in done:
            continue
        try:
            row = run_case(name, number)
        except RuntimeError as error:  # a case that cannot be made is said, not lost
            print(f"{name} {number}: {error}", flush=True)
            continue
        rows.append(row)
        with path.open("a") as stream:
            stream.write(json.dumps(row) + "\n")
        print(row, flush=True)


if __name__ == "__main__":
    main()
