"""Sealed cases: two bags, and what is hidden in them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctr_dynamics.robot.schema import Robot
from ctr_dynamics.robot_files import load_robot

from . import nuisances, sensors
from .effects import CATALOGUE, NEAR_TIES, OUTSIDE, UNSEEN_AT_REST, Hide
from .motion import Motion, protocol, still, sweep
from .world import STEP_S, World, carry_out

ROBOT = "till2020_tissue"
STRATA = ("none", "single", "pair", "outside", "not_excited", "near_tie")
VERDICTS = {
    "none": ["clean"],
    "single": ["named"],
    "pair": ["named"],
    "outside": ["unknown"],
    "not_excited": ["not_excited"],
    "near_tie": ["named", "ambiguous"],
}


@dataclass(frozen=True)
class Case:
    """A case on disk.

    Attributes:
        protocol, sweep: bags to fit and to validate on.
        answer: the sealed answer; read it only when the verdict is in.
    """

    seed: int
    stratum: str
    robot: str
    protocol: Path
    sweep: Path
    answer: Path

    def unseal(self) -> dict[str, Any]:
        """The answer."""
        return json.loads(self.answer.read_text())


def streams(seed: int, stratum: str) -> dict[str, np.random.Generator]:
    """Generators of one case, one for each purpose, so that hiding something changes neither motion nor noise."""
    names = ("tolerances", "motion", "choice", "size", "protocol", "sweep")
    key = [seed, STRATA.index(stratum)]
    return {name: np.random.default_rng([*key, k]) for k, name in enumerate(names)}


def _choose(rng: np.random.Generator, stratum: str, effects: Sequence[str] | None) -> tuple[list[str], str]:
    """Names to hide, and the rival of a near tie."""
    if effects is not None:
        unknown = [e for e in effects if e not in CATALOGUE and e not in OUTSIDE]
        if unknown:
            raise ValueError(f"no effect '{unknown[0]}'; known: {', '.join([*CATALOGUE, *OUTSIDE])}")
        return list(effects), ""
    if stratum == "single":
        return [str(rng.choice(list(CATALOGUE)))], ""
    if stratum == "pair":
        return [str(e) for e in rng.choice(list(CATALOGUE), 2, replace=False)], ""
    if stratum == "outside":
        return [str(rng.choice(list(OUTSIDE)))], ""
    if stratum == "near_tie":
        effect, rival = NEAR_TIES[int(rng.integers(len(NEAR_TIES)))]
        return [effect], rival
    if stratum == "not_excited" and rng.uniform() < 0.5:
        return [str(rng.choice(UNSEEN_AT_REST))], ""
    return [], ""


def make_case(
    seed: int,
    stratum: str,
    directory: str | Path,
    *,
    effects: Sequence[str] | None = None,
    robot: Robot | None = None,
    step_s: float = STEP_S,
    duration_s: float | None = None,
) -> Case:
    """Write `protocol.mcap`, `sweep.mcap`, `answer.json` and the noise-free `truth.npz` into `directory`; the same arguments give the same bytes.

    Args:
        stratum: one of STRATA.
        effects: names to hide instead of those that the seed chooses.
        duration_s: shortens both bags, for quick tests.

    Raises:
        ValueError: no such stratum or effect.
    """
    if stratum not in STRATA:
        raise ValueError(f"no stratum '{stratum}'; known: {', '.join(STRATA)}")
    robot = load_robot(ROBOT) if robot is None else robot
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    rng = streams(seed, stratum)
    draws = nuisances.draw(rng["tolerances"], robot)
    names, rival = _choose(rng["choice"], stratum, effects)
    world = World.of(robot)
    nuisances.apply(draws, world)
    hidden: list[dict[str, Any]] = []
    hide = Hide(rng["size"], world, robot, draws, small=stratum == "near_tie")
    # contact and springs are placed where the changed robot rests, so they come last
    for name in sorted(names, key=lambda e: e in ("contact", "tip_spring")):
        if name in OUTSIDE:
            hidden.append({"effect": "unknown", "kind": name, "description": OUTSIDE[name](hide)})
        else:
            hidden.append({"effect": name, "parameters": CATALOGUE[name](hide)})

    motions = _motions(rng["motion"], stratum, np.array(robot.rest.alpha.value), duration_s)
    exact: dict[str, np.ndarray] = {}
    for motion in motions:
        run = carry_out(world, motion, step_s)
        sensors.write(folder / f"{motion.name}.mcap", run, world.sensing, robot, rng[motion.name])
        stamps = sensors.tracker_stamps(motion)
        exact[f"{motion.name}_t"] = stamps
        exact[f"{motion.name}_reading"] = sensors.readings(run, world.sensing, stamps)[0]
        exact[f"{motion.name}_realised"] = sensors.realised(run, world.sensing, stamps)
        exact[f"{motion.name}_tip"] = run.pose(stamps)[0]
    np.savez(folder / "truth.npz", **exact)
    answer = {
        "schema": "ctr_dynamics/truth/1",
        "seed": seed,
        "stratum": stratum,
        "robot": robot.name,
        "verdicts": VERDICTS[stratum],
        "hidden": hidden,
        "rival": rival or None,
        "tolerance_draw": draws,
    }
    path = folder / "answer.json"
    path.write_text(json.dumps(answer, indent=1) + "\n")
    return Case(seed, stratum, robot.name, folder / "protocol.mcap", folder / "sweep.mcap", path)


def _motions(
    rng: np.random.Generator, stratum: str, center: np.ndarray, duration_s: float | None
) -> list[Motion]:
    if stratum == "not_excited":
        motions = [still("protocol", 14.0, center), still("sweep", 10.0, center)]
    else:
        motions = [protocol(rng, center), sweep(rng, center)]
    for motion in motions:
        motion.duration_s = min(motion.duration_s, duration_s or motion.duration_s)
    return motions
