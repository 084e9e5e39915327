"""Compile every kernel into the cache, so that the first start of the node or of a command does not wait for it."""

from __future__ import annotations

import os
import time
from typing import Annotated

import typer

from ctr_dynamics.diagnosis.rehearsal import rehearse as rehearse_diagnosis
from ctr_dynamics.nodes.rehearsal import rehearse
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot import load_robot


def warmup(
    robot: Annotated[
        list[str] | None,
        typer.Option(help="Robot name or file; may be repeated. Without it: two and three tubes."),
    ] = None,
) -> None:
    """Compile every kernel into the cache."""
    for name in robot or ["till2020_tissue", "three_tube"]:
        loaded = load_robot(name)
        begin = time.perf_counter()
        for policy in ("predict", "wait"):
            steps = rehearse(loaded, Settings({"robot": name, "output.policy": policy}))
        rehearse_diagnosis(loaded)
        typer.echo(f"{name}: {loaded.n_tubes} tubes, {steps} steps, {time.perf_counter() - begin:.1f} s")
    typer.echo(f"kernels are in {os.environ['NUMBA_CACHE_DIR']}")
