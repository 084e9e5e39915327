"""`ctr-dynamics evaluate`: a replay's outputs against the truth."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from ctr_dynamics.reporting.evaluation import evaluate as evaluate_outputs

# Key of the result, label, factor to the unit shown, unit, name of its NEES.
ROWS = (
    ("position_m", "tip position, fused", 1e3, "mm", "position"),
    ("tracker_position_m", "the same, at the tracker's point", 1e3, "mm", "tracker_position"),
    ("predicted_m", "tip position, open loop", 1e3, "mm", ""),
    ("orientation_rad", "orientation, fused", 57.29577951308232, "deg", "orientation"),
    ("velocity_m_s", "tip velocity, fused", 1e3, "mm/s", "velocity"),
)


def evaluate(
    outputs: Annotated[
        Path, typer.Argument(metavar="OUT.mcap", help="A bag that `replay --output` or a node wrote.")
    ],
    truth: Annotated[
        Path, typer.Argument(metavar="TRUTH.npz", help="Its truth, as `simulate --truth` writes it.")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="The figures as one line of JSON.")] = False,
) -> int:
    """Compare outputs with the truth of a simulated robot.

    Shows errors of position, orientation and velocity over all valid steps, and the NEES per degree of freedom:
    1 where the covariances are right, more where they promise too much.
    """
    found = evaluate_outputs(outputs, truth)
    if as_json:
        print(json.dumps(found, allow_nan=False))
        return 0
    print(f"{'':34}{'rms':>9}{'mean':>9}{'max':>9}       {'NEES':>6}{'> 3 sigma':>11}")
    for key, label, factor, unit, nees in ROWS:
        if key in found:
            print(_row(label, found[key], factor, unit, found["nees"].get(nees)))
    print(f"{found['steps']} valid steps compared")
    if found["outside"]:
        print(
            f"ctr-dynamics: note: {found['outside']} valid steps lie outside the time of the truth; is it that of this bag?",
            file=sys.stderr,
        )
    return 0


def _row(label: str, sizes: dict[str, Any], factor: float, unit: str, nees: dict[str, Any] | None) -> str:
    numbers = "".join(
        f"{factor * sizes[k]:9.3f}" if sizes[k] is not None else f"{'-':>9}" for k in ("rms", "mean", "max")
    )
    text = f"{label:34}{numbers} {unit:<5}"
    if nees is None or nees["mean"] is None:
        return text.rstrip()
    return f"{text} {nees['mean']:6.2f}{100.0 * nees['beyond_3_sigma']:9.1f} %"
