"""`ctr-dynamics replay`: a recorded bag through the estimator, without a ROS graph."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from ctr_dynamics.cli.recording_options import (
    BAG_HELP,
    Assignments,
    Params,
    Remap,
    open_with,
    settings_from,
)
from ctr_dynamics.io.atomic_files import check_targets
from ctr_dynamics.parameters import Settings
from ctr_dynamics.runtime.replay import Progress, ReplayResult
from ctr_dynamics.runtime.replay import replay as run_replay


def settings_for_replay(params: Path | None, assignments: list[str], fusion: bool) -> Settings:
    """Parameters of a replay: policy `wait` unless asked otherwise, then the file, then single values.

    Raises:
        InputError: unreadable file, unknown name, wrong type or out of range.
    """
    defaults = {"output.policy": "wait"}
    settings = settings_from(params, assignments, defaults)
    return settings if fusion else settings.replace({"filter.enabled": False})


@contextmanager
def _progress(label: str) -> Iterator[Progress | None]:
    """A progress bar on a terminal, nothing elsewhere."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(f"{label}: start", total=1.0)

        def update(fraction: float, steps: int) -> None:
            bar.update(task, completed=fraction, description=f"{label}: {steps} steps")

        yield update


def _number(value: Any, form: str, unit: str = "", scale: float = 1.0) -> str:
    if value is None:
        return "-"
    return f"{value * scale:{form}}{' ' + unit if unit else ''}"


def _table(result: ReplayResult) -> list[tuple[str, str]]:
    """The short table shown at the end. Lengths in millimetres, and said so."""
    summary = result.summary
    residual, nis, step = summary["residual_rms_m"], summary["nis"], summary["step_ms"]
    measurements = summary["measurements"]
    apart_m = measurements["not_used_residual_rms_m"]["predicted"]
    apart = (
        f" (those not used lie {1e3 * apart_m:.1f} mm rms off the open loop)" if apart_m is not None else ""
    )
    rows = [
        ("steps", f"{summary['steps']} of 3 ms, {summary['duration_s']:.2f} s"),
        ("run time", f"{summary['wall_s']:.2f} s, {summary['realtime_ratio']:.1f} times real time"),
        ("time per step", f"p50 {step['p50']:.2f} ms, p99 {step['p99']:.2f} ms, max {step['max']:.2f} ms"),
        ("residual rms, open loop", _number(residual.get("predicted"), ".3f", "mm", 1e3)),
        ("residual rms, fused", _number(residual.get("fused"), ".3f", "mm", 1e3)),
        (
            "NIS per degree of freedom",
            f"{_number(nis.get('mean'), '.3f')} (95 % band of the mean {_number(nis.get('lower95'), '.3f')} "
            f"to {_number(nis.get('upper95'), '.3f')})",
        ),
        (
            "tracker measurements",
            f"used {measurements['used']}, rejected {_count(summary['rejected'])}, late {_count(summary['late'])}, "
            f"dropped {_count(summary['dropped'])}{apart}",
        ),
    ]
    if summary["invalid"]["steps"]:
        first = summary["invalid"]["stretches"][0]
        rows.append(
            (
                "invalid steps",
                f"{summary['invalid']['steps']}, first at {first['from_s']:.3f} s: {first['reason']}",
            )
        )
    if result.failures:
        reasons = summary["solver"].get("reasons") or {}
        listed = (
            ", ".join(f"{reason} ({count})" for reason, count in reasons.items())
            if isinstance(reasons, dict)
            else ", ".join(map(str, reasons))
        )
        rows.append(("failed steps", f"{result.failures}: {listed or 'no reason given'}"))
    return rows


def _count(value: Any) -> Any:
    """A number that may be split by reason."""
    return sum(value.values()) if isinstance(value, dict) else value


def replay(
    bag: Annotated[Path, typer.Argument(metavar="BAG", help=BAG_HELP)],
    robot: Annotated[
        str, typer.Option("--robot", metavar="NAME_OR_FILE", help="A shipped robot or a robot file.")
    ] = "",
    output: Annotated[
        Path | None, typer.Option("--output", metavar="OUT.mcap", help="Bag to write every output topic to.")
    ] = None,
    summary: Annotated[
        Path | None, typer.Option("--summary", metavar="OUT.json", help="Summary to write.")
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option("--report", metavar="OUT.html", help="Report to write: one file, opens offline."),
    ] = None,
    remap: Remap = None,
    params: Params = None,
    assignments: Assignments = None,
    no_fusion: Annotated[
        bool, typer.Option("--no-fusion", help="Open loop: the model without the tracker.")
    ] = False,
) -> int:
    """Run a recorded bag through the estimator, without a ROS graph.

    Messages are taken in the order of their log time. Twice the same bag, robot and parameters give the same
    output, byte for byte. Exit code 1 when some steps failed, or when next to nothing was estimated: less than
    a tenth of the time is valid, or less than a tenth of the poses was fused.
    """
    check_targets({"output": output, "summary": summary, "report": report}, {"parameter file": params})
    settings = settings_for_replay(params, assignments or [], not no_fusion)
    with _progress(bag.name or str(bag)) as progress:
        result = run_replay(
            open_with(bag, settings, remap),
            robot or str(settings["robot"]),
            settings,
            output,
            summary,
            progress,
            report=report,
        )
    for note in result.notes:
        print(f"ctr-dynamics: note: {note}", file=sys.stderr)
    rows = _table(result)
    width = max(len(label) for label, _ in rows)
    for label, text in rows:
        print(f"{label:<{width}}  {text}")
    for label, path in (("output", output), ("summary", summary), ("report", report)):
        if path is not None:
            print(f"{label:<{width}}  {path}")
    if result.shortfall:
        print(f"ctr-dynamics: {result.shortfall}", file=sys.stderr)
    return 1 if result.failures or result.shortfall else 0
