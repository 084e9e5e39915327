"""`ctr-dynamics diagnose`: what the simulation gets wrong, the cause, the extended robot, and what it gains."""

from __future__ import annotations

import json
import shlex
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from ctr_dynamics.cli.recording_options import RecordingChoice, settings_from, with_recording_options
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.inputs.input_mapping import parse_remap
from ctr_dynamics.robot_files import load_robot

EXIT = 0


@with_recording_options
def diagnose(
    bags: Annotated[
        list[Path], typer.Argument(metavar="BAG [BAG ...]", help="Bags to fit: .mcap files or folders.")
    ],
    robot: Annotated[
        str, typer.Option("--robot", metavar="NAME_OR_FILE", help="A shipped robot or a robot file.")
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", metavar="DIR", help="Folder for findings.json, report.html and robot files."
        ),
    ],
    validate: Annotated[
        list[Path] | None,
        typer.Option(
            "--validate",
            metavar="BAG [BAG ...]",
            help="Bags that are predicted only: what the extension is worth.",
        ),
    ] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, max=64, help="Fits at once.")] = 2,
    cluster: Annotated[
        str,
        typer.Option(
            "--cluster", metavar="ADDRESS", help="Dask scheduler that takes the work, one bag set a task."
        ),
    ] = "",
    as_json: Annotated[
        bool, typer.Option("--json", help="One line of JSON on stdout instead of the summary.")
    ] = False,
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")] = True,
    *,
    choice: RecordingChoice,
) -> int:
    """Find what the simulation gets wrong about the recorded robot, name the cause, extend the model and measure the gain."""
    from ctr_dynamics.diagnosis.request import Request, run, run_on_cluster
    from ctr_dynamics.diagnosis.run_context import RunContext

    loaded = load_robot(robot)
    for path in (*bags, *(validate or [])):
        if not path.exists():
            raise InputError("no such file or folder", where=str(path), do="check the path")
    command = "ctr-dynamics diagnose " + " ".join(shlex.quote(str(b)) for b in bags)
    if validate:
        command += " --validate " + " ".join(shlex.quote(str(b)) for b in validate)
    command += "".join(f" {shlex.quote(word)}" for word in choice.words())
    command += f" --robot {shlex.quote(robot)} --output {shlex.quote(str(output))}"
    request = Request(
        loaded,
        [str(b) for b in bags],
        [str(b) for b in validate or []],
        str(output),
        command,
        workers,
        report,
        settings_from(choice.params, choice.assignments),
        parse_remap(choice.remap),
    )
    begin = time.perf_counter()

    def note(text: str) -> None:
        if not as_json:
            print(f"[{time.perf_counter() - begin:6.1f} s] {text}", file=sys.stderr, flush=True)

    if cluster:
        content = run_on_cluster(request, cluster)
    else:
        content = run(request, RunContext(note, workers))
    if as_json:
        print(json.dumps(content, allow_nan=False, ensure_ascii=False))
    else:
        for text in content["notes"]:
            print(f"ctr-dynamics: note: {text}", file=sys.stderr)
        from ctr_dynamics.diagnosis.output.summary_text import summary

        print("\n".join(summary(content)))
        print(f"findings: {output / 'findings.json'}")
    return EXIT
