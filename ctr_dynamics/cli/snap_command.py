"""`ctr-dynamics snap`: snap-through by the finite-difference solver."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from ctr_dynamics import __version__
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.atomic_files import check_folder, output_folder
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot

if TYPE_CHECKING:
    from ctr_dynamics.snap.experiment import Plan, Trajectory
    from ctr_dynamics.snap.features import Extremum
    from ctr_dynamics.snap.scurve import SCurve


def assignments(texts: list[str]) -> dict[str, float]:
    """Numbers of `NAME=VALUE` texts.

    Raises:
        InputError: no "=", not a number, or a name given twice.
    """
    values: dict[str, float] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not name:
            raise InputError(
                f"'{text}' is not NAME=VALUE", do="write for example tube_coulomb=0", where="--set"
            )
        if name in values:
            raise InputError(f"'{name}' is given twice", do="give it once", where="--set")
        try:
            values[name] = float(value)
        except ValueError:
            raise InputError(
                f"{name}: '{value}' is not a number", do="give a number in SI units", where="--set"
            ) from None
    return values


def _cells(text: str) -> tuple[int, ...] | None:
    if not text:
        return None
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise InputError(
            f"--cells '{text}' is not a list of counts", do="write for example 14,29,9,14,9,3"
        ) from None


def _start(robot: Robot, asked: float | None, moved: bool, curve: SCurve) -> float:
    """theta_b at t = 0: as asked, else the robot file's rest, else a little before the predicted snap."""
    from ctr_dynamics.snap.experiment import MARGIN

    if asked is not None:
        return asked
    rest = robot.rest.alpha.value[1] - robot.rest.alpha.value[0]
    if rest and not moved:
        return float(rest)
    if curve.snap is None:
        raise InputError("the S-curve has no fold: nothing snaps", do="give --start to run all the same")
    return curve.snap[0] - MARGIN


def _progress() -> Callable[[float], None] | None:
    if not sys.stderr.isatty():
        return None
    return lambda share: print(f"\rsnap: {100 * share:3.0f} %", end="\r", file=sys.stderr, flush=True)


def _figures(
    plan: Plan, run: Trajectory, curve: SCurve, found: list[Extremum], crossed: float | None
) -> dict[str, Any]:
    """What summary.json says of the run itself."""
    from ctr_dynamics.snap.experiment import overshoot
    from ctr_dynamics.snap.features import LEVEL, frequencies

    tones = frequencies(run.t, run.theta_f, crossed) if crossed is not None else []
    return {
        "theta_b_start": plan.start,
        "theta_f_start": run.theta_f_rest,
        "snap_predicted": None
        if curve.snap is None
        else {"theta_b": curve.snap[0], "theta_f": curve.snap[1]},
        "folds": [
            {"theta_b": b, "theta_f": f, "kind": "snap" if opens else "snap back"}
            for b, f, opens in curve.folds()
        ],
        "crossing": {"level": LEVEL, "t_s": crossed},
        "first_peak": None if not found else {"t_s": found[0].t_s, "theta_f": found[0].theta_f},
        "overshoot": overshoot(run, curve, found),
        "frequencies": [{"hz": hz, "relative_height": height} for hz, height in tones],
        "steps": len(run.t),
        "unknowns": run.unknowns,
        "cells": list(run.cells),
        "iterations_per_step": float(run.iterations.mean()) if len(run.t) else None,
        "jacobians_per_step": float(run.jacobians.mean()) if len(run.t) else None,
        "wall_s": run.wall_s,
        "ms_per_step": 1e3 * run.wall_s / len(run.t) if len(run.t) else None,
        "cpu_ms_per_step": 1e3 * run.cpu_s / len(run.t) if len(run.t) else None,
        "failure": run.failure,
    }


@dataclass(frozen=True)
class SnapOptions:
    """Options of the command."""

    robot: Annotated[
        str, typer.Option("--robot", metavar="NAME_OR_FILE", help="A shipped robot or a robot file.")
    ]
    output: Annotated[
        Path, typer.Option("--output", metavar="DIR", help="Folder for tables, plots and the bag.")
    ]
    dt: Annotated[float, typer.Option("--dt", metavar="S", help="Time step.")] = 1e-5
    duration: Annotated[float, typer.Option("--duration", metavar="S", help="Length of the motion.")] = 12e-3
    refine: Annotated[
        int, typer.Option("--refine", metavar="N", help="Multiply the cells of every section.")
    ] = 1
    values: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="tube_coulomb, tube_viscous, epsilon, beta1, or a number of the robot file such as tubes[0].youngs_modulus; may be repeated.",
        ),
    ] = None
    start: Annotated[
        float | None,
        typer.Option(
            "--start",
            metavar="RAD",
            help="theta_b at t = 0; default: the robot's rest, or just before the snap.",
        ),
    ] = None
    rate: Annotated[float, typer.Option("--rate", metavar="RAD/S", help="Rate of theta_b.")] = 10.0
    scheme: Annotated[str, typer.Option("--scheme", help="bdf2, bdf_alpha, trapezoid or backward_euler.")] = (
        "bdf2"
    )
    alpha: Annotated[float, typer.Option("--alpha", help="Alpha of bdf_alpha.")] = -0.45
    cells: Annotated[
        str,
        typer.Option(
            "--cells", metavar="N,N,..", help="Cells behind the plate and of each section, base to tip."
        ),
    ] = ""
    adaptive: Annotated[
        float | None,
        typer.Option(
            "--adaptive",
            metavar="S",
            help="Longest step: steps grow to it from --dt where the motion is slow.",
        ),
    ] = None
    equations: Annotated[
        str,
        typer.Option(
            "--equations", help="derived, or printed: (12) and (20) as in the paper, without a term in gamma."
        ),
    ] = "derived"
    points: Annotated[int, typer.Option("--points", metavar="N", help="Points of the S-curve.")] = 1000
    slower: Annotated[float, typer.Option("--slower", metavar="FACTOR", help="Slow motion of the bag.")] = (
        1000.0
    )


def snap(options: SnapOptions) -> int:
    """Snap-through by the finite-difference solver.

    Tube 1 turns against the others, which are held, through the fold of the S-curve. Writes trajectory.csv,
    scurve.csv, peaks.csv, summary.json, theta_f.png, scurve.png and backbone.mcap. Exit code 1 when a step
    failed; the tables then end there.
    """
    # imported late: --help must not wait for the compiled model
    from ctr_dynamics.snap import output as files
    from ctr_dynamics.snap.experiment import Plan, refined_cells, robot_for_snap, run
    from ctr_dynamics.snap.features import after_snap, crossing, extrema
    from ctr_dynamics.snap.scurve import s_curve

    given = assignments(options.values or [])
    of = robot_for_snap(load_robot(options.robot), given)
    if not 50 <= options.points <= 100_000:
        raise InputError(
            f"--points {options.points} is outside 50 to 100000", do="1000 resolve the fold to 1e-7 rad"
        )
    slower, output, adaptive = options.slower, options.output, options.adaptive
    if not 1.0 <= slower <= 1e6:
        raise InputError(f"--slower {slower:g} is outside 1 to 1e6")
    numerics = {
        "dt": options.dt,
        "duration": options.duration,
        "rate": options.rate,
        "cells": refined_cells(of, options.refine, _cells(options.cells)),
        "scheme": options.scheme,
        "alpha": options.alpha,
        "equations": options.equations,
    }
    Plan(options.start or 0.0, adaptive=adaptive, **numerics).check()  # type: ignore[arg-type]
    check_folder(output)
    curve = s_curve(of, np.array(of.rest.beta.value), of.rest.alpha.value[1], options.points)
    start = _start(of, options.start, "beta1" in given, curve)
    plan = Plan(start, adaptive=adaptive, **numerics)  # type: ignore[arg-type]
    trajectory = run(of, plan, _progress())
    crossed = crossing(trajectory.t, trajectory.theta_f)
    found = after_snap(extrema(trajectory.t, trajectory.theta_f), crossed)
    metadata = {
        "version": __version__,
        "robot": of.source or of.name,
        "robot_sha256": of.sha256,
        "parameters": str({**numerics, "start": plan.start, "adaptive": adaptive, "set": given}),
    }
    summary = _figures(plan, trajectory, curve, found, crossed)
    output_folder(output)
    files.write_trajectory(output / "trajectory.csv", trajectory)
    files.write_scurve(output / "scurve.csv", curve)
    files.write_peaks(output / "peaks.csv", found)
    files.write_json(output / "summary.json", {**metadata, **summary})
    files.write_plots(
        output, trajectory, curve, found, f"{of.name}, beta1 = {1e3 * of.rest.beta.value[0]:.1f} mm"
    )
    files.write_backbones(output / "backbone.mcap", trajectory, slower, {**metadata, "slower": f"{slower:g}"})
    _show(summary, found)
    print(f"output             {output}")
    if trajectory.failure:
        print(f"ctr-dynamics: {trajectory.failure}", file=sys.stderr)
        return 1
    return 0


def _show(summary: dict[str, Any], found: list[Extremum]) -> None:
    """The short table shown at the end."""
    predicted, crossed = summary["snap_predicted"], summary["crossing"]["t_s"]
    rows = [
        ("snap predicted at", f"theta_b = {predicted['theta_b']:.5f} rad" if predicted else "no fold"),
        (
            "start",
            f"theta_b = {summary['theta_b_start']:.5f} rad, theta_f = {summary['theta_f_start']:.5f} rad",
        ),
        ("theta_f = 4 rad at", f"{1e3 * crossed:.5f} ms" if crossed is not None else "not reached"),
        *((e.kind, f"{e.theta_f:.4f} rad at {1e3 * e.t_s:.4f} ms") for e in found[:4]),
        ("overshoot", f"{summary['overshoot']:.4f} rad" if summary["overshoot"] is not None else "-"),
        (
            "frequencies",
            ", ".join(
                f"{1e-3 * f['hz']:.3f} kHz ({f['relative_height']:.2f})" for f in summary["frequencies"]
            )
            or "-",
        ),
        ("steps", f"{summary['steps']} with {summary['unknowns']} unknowns"),
    ]
    if summary["steps"]:
        rows.append(
            ("cost", f"{summary['ms_per_step']:.2f} ms ({summary['cpu_ms_per_step']:.2f} ms of processor time), "
             f"{summary['iterations_per_step']:.2f} iterations, {summary['jacobians_per_step']:.2f} Jacobians a step")
        )  # fmt: skip
    for name, value in rows:
        print(f"{name:18s} {value}")
