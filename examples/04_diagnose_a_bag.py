"""A robot whose payload is heavier than its file says: the diagnosis of a recording names the cause and its size.

    python examples/04_diagnose_a_bag.py [FOLDER]

The recording is simulated here. With one of your own it is `diagnose(["my.mcap"], "my_robot.yaml", "findings")`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from ctr_dynamics import diagnose, load_robot, load_scenario, simulate
from ctr_dynamics.robot_files import robot_with
from ctr_dynamics.simulation import write_recording

HEAVIER_KG = 0.8e-3  # a tenth of the payload; its tolerance in the robot file is 0.02 g


def main(folder: Path) -> dict[str, Any]:
    """Record with the heavier robot, diagnose with the file's; returns the findings."""
    folder.mkdir(parents=True, exist_ok=True)
    robot = load_robot("till2020_tissue")
    mass = robot.tubes[0].end_body.mass.value
    real = robot_with(robot, {"tubes[0].end_body.mass": mass + HEAVIER_KG})

    scenario = load_scenario("light_release").model_copy(update={"duration_s": 2.0})
    write_recording(folder / "recording.mcap", scenario, real, simulate(scenario, real))

    findings = diagnose([folder / "recording.mcap"], robot, folder / "findings", progress=print)
    print(f"verdict: {findings['verdict']}")
    for cause in findings["causes"]:
        for name, found in cause["parameters"].items():
            low, high = found["ci90"]
            print(
                f"{cause['effect']}: {name} {found['value']:.2g} {found['unit']}, 90 % in {low:.2g} to {high:.2g}"
            )
    print(f"report: {folder / 'findings' / 'report.html'}")
    return findings


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "diagnosis_example"))
