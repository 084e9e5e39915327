"""Compile the kernels of estimator and diagnosis into the cache, so that the first start of the node or of a command does not wait for it."""

from __future__ import annotations

import time
from typing import Annotated

import typer
from joblib import Parallel, delayed

from ctr_dynamics.diagnosis.kernel_warm_up import MODELS
from ctr_dynamics.diagnosis.kernel_warm_up import warm_up as warm_up_diagnosis
from ctr_dynamics.kernels.compiler import cache_folder
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
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
    # the longest first; each compiles in a process of its own
    tasks = [delayed(_diagnosis)(name, model) for name in names for model in reversed(MODELS)]
    tasks += [delayed(_estimator)(name) for name in names]
    for text in Parallel(2, return_as="generator")(tasks):
        typer.echo(text)
    typer.echo(f"kernels are in {cache_folder()}")


def _estimator(name: str) -> str:
    begin, steps = time.perf_counter(), 0
    for policy in ("predict", "wait"):
        steps = warm_up(load_robot(name), Settings({"robot": name, "output.policy": policy}))
    return f"{name}: estimator, {steps} steps, {time.perf_counter() - begin:.1f} s"


def _diagnosis(name: str, model: str) -> str:
    begin, robot = time.perf_counter(), load_robot(name)
    warm_up_diagnosis(robot, (model,))
    return f"{name}: diagnosis with the {model} model, {robot.n_tubes} tubes, {time.perf_counter() - begin:.1f} s"
