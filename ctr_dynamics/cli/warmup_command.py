"""Compile the kernels of estimator and diagnosis into the cache, so that the first start of the node or of a command does not wait for it."""

from __future__ import annotations

import time
from typing import Annotated

import typer
from joblib import Parallel, delayed

from ctr_dynamics.diagnosis.kernel_warm_up import EXTENDED, PLAIN
from ctr_dynamics.diagnosis.kernel_warm_up import warm_up as warm_up_diagnosis
from ctr_dynamics.kernels.compiler import cache_folder
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.garbage_collection import rare_garbage_collection
from ctr_dynamics.runtime.warm_up import warm_up


def warmup(
    robot: Annotated[
        list[str] | None,
        typer.Option(help="Robot name or file; may be repeated. Without it: two and three tubes."),
    ] = None,
) -> None:
    """Compile the kernels into the cache: estimator and diagnosis of every robot, two at a time."""
    names = robot or ["till2020_tissue", "three_tube"]
    for name in names:
        load_robot(name)
    # two processes for a robot: kernels of one physics call the same ones, which every process lowers once
    tasks = [delayed(task)(name) for name in names for task in (_plain, _extended)]
    for text in Parallel(2, return_as="generator")(tasks):
        typer.echo(text)
    typer.echo(f"kernels are in {cache_folder()}")


def _plain(name: str) -> str:
    begin, steps, robot = time.perf_counter(), 0, load_robot(name)
    for policy in ("predict", "wait"):
        steps = warm_up(robot, Settings({"robot": name, "output.policy": policy}))
    with rare_garbage_collection():
        warm_up_diagnosis(robot, PLAIN)
    return f"{name}: estimator, {steps} steps, and diagnosis, {time.perf_counter() - begin:.1f} s"


def _extended(name: str) -> str:
    begin, robot = time.perf_counter(), load_robot(name)
    with rare_garbage_collection():
        warm_up_diagnosis(robot, EXTENDED)
    return f"{name}: diagnosis with extended physics, {time.perf_counter() - begin:.1f} s"
