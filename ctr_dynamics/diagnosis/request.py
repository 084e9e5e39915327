"""A diagnosis from paths to files: what the command runs here, or on a cluster."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from ctr_dynamics.diagnosis.kernel_warm_up import rehearse
from ctr_dynamics.diagnosis.output.findings import findings, write
from ctr_dynamics.diagnosis.output.findings_report import write_report
from ctr_dynamics.diagnosis.pipeline import diagnose
from ctr_dynamics.diagnosis.recording import Recording, read_recording
from ctr_dynamics.diagnosis.verdict.next_experiment import Plan, plan
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.atomic_files import atomic_file, output_folder
from ctr_dynamics.robot import Robot
from ctr_dynamics.simulation.scenario import Scenario

SCENARIO = "next_experiment.yaml"


@dataclass(frozen=True)
class Request:
    """Everything a diagnosis needs, ready to be sent elsewhere; paths as text."""

    robot: Robot
    bags: list[str]
    validation: list[str]
    output: str
    command: str
    workers: int = 2
    report: bool = True


def _quiet(text: str) -> None:
    pass


def run(request: Request, note: Callable[[str], None] = _quiet) -> dict[str, Any]:
    """Read, diagnose, write; returns the content of findings.json.

    Raises:
        InputError: a bag that cannot be used, or that is given twice; a folder that cannot be written to.
    """
    directory = output_folder(Path(request.output))
    note("reading")
    recordings = [read_recording(path, request.robot) for path in request.bags]
    others = [read_recording(path, request.robot) for path in request.validation]
    _all_different([*recordings, *others])
    note("kernels: compiled at the first use")
    rehearse(request.robot)
    diagnosis = diagnose(request.robot, recordings, others, note=note, workers=request.workers)
    if not others:
        diagnosis.notes.append(
            "without a validation bag the gain is not measured, and a wrong cause that fits is not found out"
        )
    note("next experiment")
    planned = plan(diagnosis)
    content = findings(diagnosis, request.command, _experiment(planned, directory))
    write(directory, diagnosis, content)
    if request.report:
        note("report")
        write_report(directory / "report.html", diagnosis, content)
    return content


def _all_different(recordings: list[Recording]) -> None:
    """A bag that is fitted predicts itself, and one that is fitted twice counts twice.

    Raises:
        InputError: two of them have the same content.
    """
    seen: dict[frozenset[str], str] = {}
    for recording in recordings:
        content = frozenset(recording.sha256.values())
        if content in seen:
            raise InputError(
                f"is the same bag as {seen[content]}",
                where=recording.path,
                do="give each bag once, and validate with others than are fitted",
            )
        seen[content] = recording.path


def _experiment(planned: Plan | None, directory: Path) -> dict[str, Any] | None:
    if planned is None:
        return None
    with atomic_file(directory / SCENARIO) as part:
        part.write_text(_yaml(planned.scenario), encoding="utf-8")
    return {
        "description": planned.description,
        "scenario_file": SCENARIO,
        "separation_before": planned.before,
        "separation_after": planned.after,
    }


def _yaml(scenario: Scenario) -> str:
    return yaml.safe_dump(scenario.model_dump(exclude_none=True, mode="json"), sort_keys=False)
