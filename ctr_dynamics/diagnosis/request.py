"""A diagnosis from paths to files: what the command runs here, or on a cluster."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from ctr_dynamics.diagnosis.kernel_warm_up import warm_up
from ctr_dynamics.diagnosis.next_experiment import NextExperiment, next_experiment
from ctr_dynamics.diagnosis.output.findings import EXTENDED, FINDINGS, RECALIBRATED, findings, write
from ctr_dynamics.diagnosis.output.findings_report import write_report
from ctr_dynamics.diagnosis.pipeline import diagnose_recordings
from ctr_dynamics.diagnosis.recording import Recording, read_recording
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.atomic_files import atomic_file, check_folder, replaced_files
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.tracker_parameters import with_tracker_parameters

SCENARIO, REPORT = "next_experiment.yaml", "report.html"
# All that a diagnosis may write; the findings, which name the others, take their place last.
FILES = (RECALIBRATED, EXTENDED, SCENARIO, REPORT, FINDINGS)


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
    settings: Settings = field(default_factory=Settings)
    remap: dict[str, str] = field(default_factory=dict)


def run(request: Request, context: RunContext | None = None) -> dict[str, Any]:
    """Read, diagnose, write; returns the content of findings.json.

    ``context`` is by default a silent one with the workers of ``request``.

    Raises:
        InputError: a bag that cannot be used, or that is given twice; a folder that cannot be written to.
    """
    context = context or RunContext(workers=request.workers)
    directory = check_folder(Path(request.output))
    context.report("reading")
    robot = with_tracker_parameters(request.robot, request.settings)
    recordings, others = (
        [read_recording(path, robot, None, request.settings, request.remap) for path in paths]
        for paths in (request.bags, request.validation)
    )
    _all_different([*recordings, *others])
    context.report("kernels: compiled at the first use")
    warm_up(robot)
    diagnosis = diagnose_recordings(robot, recordings, others, context=context)
    if not others:
        diagnosis.notes.append(
            "without a validation bag the gain is not measured, and a wrong cause that fits is not found out"
        )
    context.report("next experiment")
    proposed = next_experiment(diagnosis, context)
    with replaced_files(directory, FILES) as staged:
        content = findings(diagnosis, request.command, _write_scenario(proposed, staged))
        write(staged, diagnosis, content)
        if request.report:
            context.report("report")
            write_report(staged / REPORT, diagnosis, content)
    return content


def run_on_cluster(request: Request, address: str) -> dict[str, Any]:
    """:func:`run` as one task of the Dask scheduler at ``address``.

    Raises:
        InputError: Dask is not installed, or no scheduler answers.
    """
    try:
        from dask.distributed import Client
    except ImportError:
        raise InputError(
            "--cluster needs dask.distributed", do="pip install 'ctr_dynamics[cluster]'"
        ) from None
    try:
        client = Client(address, timeout="10s")
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"no Dask scheduler answers at '{address}' within 10 s ({error})", do="check the address"
        ) from None
    with client:
        content: dict[str, Any] = client.submit(run, request, pure=False).result()
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


def _write_scenario(proposed: NextExperiment | None, directory: Path) -> dict[str, Any] | None:
    """The scenario of ``proposed`` as a file; its entry in the findings."""
    if proposed is None:
        return None
    content = proposed.scenario.model_dump(exclude_none=True, mode="json")
    with atomic_file(directory / SCENARIO) as part:
        part.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return {
        "description": proposed.description,
        "scenario_file": SCENARIO,
        "separation_before": proposed.before,
        "separation_after": proposed.after,
    }
