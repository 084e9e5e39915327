"""Diagnosis on many robots: effects hidden in bags of the fleet, with tolerances as shipped and as a laboratory has them.

    python -m studies.fleet_diagnosis --output fleet.jsonl --cases 12 --robots tissue,three_tube,random1,random2
    python -m studies.fleet_diagnosis --output fleet.jsonl --table

A case is a true robot drawn from the tolerances of its file, without limits, and two bags of the package's own simulator: a weight is cut, then
all tubes turn. One is fitted, the other only predicted. Each robot has its turn with each stratum:

- ``clean``: nothing is hidden.
- ``single``: one effect of the catalogue, of 1 to 3 plausible sizes.
- ``many``: every tolerance is 2.5 times too tight, and no effect is hidden.
- ``pair``: two effects of the catalogue, each of 1 to 3 plausible sizes.
- ``outside``: someone pushes the tip three times, which nothing in the catalogue is.

Each outcome is one line of the output; a run that is stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Container
from pathlib import Path
from typing import Any

import numpy as np

from ctr_dynamics.benchmarks.fleet import TURN_S, record, scenario_for
from ctr_dynamics.benchmarks.fleet_robots import FLEET, Draw, drawn, fleet_robot, seed_of
from ctr_dynamics.diagnosis.inference.candidates import Candidate, candidates
from ctr_dynamics.diagnosis.output.findings import findings
from ctr_dynamics.diagnosis.pipeline import diagnose_recordings
from ctr_dynamics.diagnosis.recording import read_recording
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.robot import Robot, cantilever
from ctr_dynamics.robot_files import robot_from_dict, robot_to_dict
from ctr_dynamics.simulation.scenario import Load, Scenario
from studies.diagnosis_study import (
    fraction,
    hidden_effects,
    in_set,
    interval_hits,
    is_sure,
    likeliest_is_right,
    named_effects,
    true_separations,
)

STRATA = ("clean", "single", "many", "pair", "outside")
HIDDEN = {"single": 1, "pair": 2}  # effects of the catalogue
FIT_S, HELD_OUT_S = 8.0, 5.0  # the bags' lengths
SIZES = (1.0, 3.0)  # of a hidden effect, in plausible departures
TOO_TIGHT = 2.5  # true deviations by those of the file, where many are too tight
CLEAR = 8.0  # separation from the nearest rival, in standard deviations, that shows plainly
PUSHES, PUSH_S = 3, (0.2, 0.6)  # number, and length of each
PUSHED = (0.02, 0.05)  # deflection by the exposed length
NOT_SHOWN = {"contact", "tip_spring", "insertion_velocity"}  # need a place in reach, or translations
KEPT = ("verdict", "causes", "cause_set95", "probabilities", "residual", "numerics", "seconds")


def loosened(robot: Robot, factor: float) -> Robot:
    """``robot`` with every tolerance times ``factor``."""

    def walk(item: Any, name: str = "") -> Any:
        if isinstance(item, dict):
            return {key: walk(value, key) for key, value in item.items()}
        if isinstance(item, list) and "tolerance" not in name:
            return [walk(x) for x in item]
        if "tolerance" in name and item is not None:
            return (factor * np.array(item)).tolist()
        return item

    return robot_from_dict(walk(robot_to_dict(robot)))


def hidden_effect(
    robot: Robot, rng: np.random.Generator, besides: Container[str] = ()
) -> dict[str, dict[str, float]]:
    """One effect of the catalogue with its parameters, of a size that is plausible for ``robot``; none of those ``besides``."""
    pool = [c for c in candidates(effect_quantities(robot), np.zeros((1, 3))) if c.effect not in NOT_SHOWN]
    pool = [c for c in pool if c.effect not in besides]
    effects = sorted({c.effect for c in pool})
    name = effects[int(rng.integers(len(effects)))]
    forms = [c for c in pool if c.effect == name]
    chosen = forms[int(rng.integers(len(forms)))]
    size = SIZES[0] * (SIZES[1] / SIZES[0]) ** rng.uniform()
    return extension(chosen, size * direction(chosen, rng))


def direction(candidate: Candidate, rng: np.random.Generator) -> np.ndarray:
    """A random departure (quantities,) of ``candidate`` by one scale, to the side to which each of its quantities can go."""
    drawn_direction = rng.standard_normal(len(candidate.quantities))
    drawn_direction /= np.linalg.norm(drawn_direction)
    one_sided = [q.one_sided for q in candidate.quantities]
    return np.where(one_sided, np.abs(drawn_direction), drawn_direction)


def extension(candidate: Candidate, departures: np.ndarray) -> dict[str, dict[str, float]]:
    """The effect of ``candidate`` as an extension of a robot file, off its nominal values by ``departures`` (quantities,), in scales."""
    values = {key[1]: value for key, value in candidate.start if key[0] == candidate.effect}
    for q, departure in zip(candidate.quantities, departures.tolist(), strict=True):
        coordinate = float(np.clip(q.off + q.scale * departure, q.low, q.high))
        values[q.name] = q.parameter.value(coordinate)
    return {candidate.effect: {key: float(value) for key, value in values.items() if math.isfinite(value)}}


def pushed(scenario: Scenario, robot: Robot, rng: np.random.Generator) -> Scenario:
    """``scenario`` with pushes at the tip that its bag does not tell of, while the tubes turn."""
    most = robot.exposed_length / cantilever(robot).deflection
    loads = list(scenario.loads)
    for _ in range(PUSHES):
        direction = rng.standard_normal(3)
        size = rng.uniform(*PUSHED) * most / np.linalg.norm(direction)
        begin, length = rng.uniform(TURN_S, scenario.duration_s - 1.0), rng.uniform(*PUSH_S)
        loads.append(
            Load(
                start_s=begin, end_s=begin + length, rise_s=0.1, fall_s=0.1, force_N=(size * direction).tolist(), known=False,
            )
        )  # fmt: skip
    return scenario.model_copy(update={"loads": loads})


def run_case(name: str, lab: bool, stratum: str, number: int) -> dict[str, Any]:
    """Make a case and diagnose it."""
    robot = fleet_robot(name, lab)
    rng = np.random.default_rng([number, seed_of(name), int(lab), STRATA.index(stratum)])
    draw = drawn(loosened(robot, TOO_TIGHT) if stratum == "many" else robot, rng)
    hidden: dict[str, dict[str, float]] = {}
    for _ in range(HIDDEN.get(stratum, 0)):
        hidden |= hidden_effect(robot, rng, hidden)
    true = Draw(robot_from_dict({**robot_to_dict(draw.robot), "extensions": hidden}), draw.offsets)
    with tempfile.TemporaryDirectory() as folder:
        recordings = []
        for duration_s in (FIT_S, HELD_OUT_S):
            scenario = scenario_for(robot, int(rng.integers(2**31)), duration_s)
            if stratum == "outside":
                scenario = pushed(scenario, robot, rng)
            bag = Path(folder) / f"{duration_s:g}.mcap"
            record(robot, true, scenario, bag)
            recordings.append(read_recording(bag, robot))
        begin = time.process_time()
        result = diagnose_recordings(robot, recordings[:1], recordings[1:], context=RunContext(workers=1))
        content = findings(result, "", None)
        cpu_s = time.process_time() - begin
    answer = {
        "hidden": [
            {"effect": effect, "parameters": {key: {"total": value} for key, value in values.items()}}
            for effect, values in hidden.items()
        ]
    }
    return {
        "robot": name,
        "lab": lab,
        "stratum": stratum,
        "number": number,
        **answer,
        "separations": true_separations(result, answer) if result.search is not None else {},
        "cpu_s": cpu_s,
        **{key: content[key] for key in KEPT},
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Outcomes by robot, and over all, as Markdown."""

    def cells(own: list[dict[str, Any]]) -> dict[str, str]:
        by = {stratum: [r for r in own if r["stratum"] == stratum] for stratum in STRATA}
        clear = [r for r in by["single"] if r["separations"] and min(r["separations"].values()) >= CLEAR]
        seconds = sorted(r["cpu_s"] for r in own)
        return {
            "clean: called clean": fraction(r["verdict"] == "clean" for r in by["clean"]),
            "clear singles: likeliest is right": fraction(
                hidden_effects(r) == r["probabilities"][0]["effects"] for r in clear
            ),
            "in the set of 95 %": fraction(in_set(r) for r in clear),
            "all singles in the set": fraction(in_set(r) for r in by["single"]),
            "pairs in the set": fraction(in_set(r) for r in by["pair"]),
            "outside: unknown": fraction(is_unknown(r) for r in by["outside"]),
            "no wrong name above 0.5": fraction(not wrongly_named(r) for r in by["outside"]),
            "many small: tolerances": fraction(r["verdict"] == "tolerances" for r in by["many"]),
            "no wrong name above 0.5 ": fraction(not wrongly_named(r) for r in by["many"]),
            "sure of something hidden (0.95): right": fraction(
                likeliest_is_right(r) for r in by["single"] + by["pair"] if is_sure(r)
            ),
            "90 % intervals that hold the truth": fraction(interval_hits(clear + by["pair"], "ci90")),
            "median, longest diagnosis": f"{seconds[len(seconds) // 2]:.0f} s, {seconds[-1]:.0f} s",
        }

    lines = []
    for robot in (*sorted({r["robot"] for r in rows}), "all"):
        found = cells([r for r in rows if robot in (r["robot"], "all")])
        if not lines:
            lines += ["| robot | " + " | ".join(found) + " |", "|" + "---|" * (len(found) + 1)]
        lines.append(f"| {robot} | " + " | ".join(found.values()) + " |")
    return "\n".join(lines)


def is_unknown(row: dict[str, Any]) -> bool:
    """Whether it is said that something outside the catalogue is there."""
    return row["verdict"] == "unknown" or "unknown" in named_effects(row)


def wrongly_named(row: dict[str, Any]) -> bool:
    """Whether an effect of the catalogue got more than half of the probability where there is none."""
    return any(c["effect"] != "unknown" and (c["probability"] or 0.0) > 0.5 for c in row["causes"])


def main() -> None:
    """Run what is missing, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=4, help="of each stratum, robot and kind of tolerances")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--robots", default=",".join(FLEET))
    parser.add_argument("--strata", default=",".join(STRATA))
    parser.add_argument("--table", action="store_true", help="print the table, and run nothing")
    options = parser.parse_args()
    rows = (
        [json.loads(line) for line in options.output.read_text().splitlines()]
        if options.output.exists()
        else []
    )
    done = {(r["robot"], r["lab"], r["stratum"], r["number"]) for r in rows}
    for number in range(options.first, options.first + (0 if options.table else options.cases)):
        for lab in (True, False):
            for stratum in options.strata.split(","):
                for robot in options.robots.split(","):
                    if (robot, lab, stratum, number) in done:
                        continue
                    try:
                        row = run_case(robot, lab, stratum, number)
                    except Exception as error:  # a case that cannot be made is said, not lost
                        print(f"{robot} {stratum} {number}: {type(error).__name__}: {error}", flush=True)
                        continue
                    rows.append(row)
                    with options.output.open("a") as stream:
                        stream.write(json.dumps(row) + "\n")
                    print(f"{robot} {'lab' if lab else 'file'} {stratum} {number}: {hidden_effects(row)} -> {row['verdict']} "
                          f"{named_effects(row)}, {row['cpu_s']:.0f} s", flush=True)  # fmt: skip
    if rows:
        print(table(rows))


if __name__ == "__main__":
    main()
