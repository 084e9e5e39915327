"""`ctr-dynamics simulate`: a bag of driver messages from a scenario file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from ctr_dynamics.io.atomic_files import check_targets
from ctr_dynamics.io.truth_files import write_truth
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.simulation import load_scenario, scenario_names, write_recording
from ctr_dynamics.simulation import simulate as run_scenario
from ctr_dynamics.simulation.scenario_run import truth_of


def _progress(fraction: float) -> None:
    if sys.stderr.isatty():
        print(
            f"\rsimulate: {100 * fraction:3.0f} %",
            end="\r" if fraction < 1 else "\n",
            file=sys.stderr,
            flush=True,
        )


def simulate(
    scenario: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO.yaml", help=f"A scenario file, or a shipped one: {', '.join(scenario_names())}."
        ),
    ],
    robot: Annotated[
        str, typer.Option("--robot", metavar="NAME_OR_FILE", help="A shipped robot or a robot file.")
    ],
    output: Annotated[Path, typer.Option("--output", metavar="OUT.mcap", help="Bag to write.")],
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth", metavar="TRUTH.npz", help="Where the tip really was, for `ctr-dynamics evaluate`."
        ),
    ] = None,
) -> int:
    """Write a bag of a simulated scenario.

    The bag has the input topics /ctr/joint_states, /ctr/tracker/tip and, with known loads, /ctr/tip_load.
    Exit code 1 when the solver could not follow the scenario to its end; the bag then ends there.
    """
    check_targets({"output": output, "truth": truth}, {"scenario": scenario, "robot file": robot})
    loaded, of = load_scenario(scenario), load_robot(robot)
    recording = run_scenario(loaded, of, _progress)
    count = write_recording(output, loaded, of, recording)
    if truth is not None:
        write_truth(truth, truth_of(loaded, of, recording))
    print(f"messages  {count}")
    print(f"duration  {recording.t[-1]:.3f} s of {loaded.duration_s:g} s")
    print(f"output    {output}")
    if truth is not None:
        print(f"truth     {truth}")
    if recording.failure:
        print(f"ctr-dynamics: {recording.failure}", file=sys.stderr)
        return 1
    return 0
