"""An alignment in words, and as a parameter file."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ctr_dynamics.calibration.alignment import Alignment
from ctr_dynamics.errors import InputError
from ctr_dynamics.parameters import PARAMETERS, Settings, parameter

Floats = NDArray[np.float64]
UNMEASURED_RAD = 1.0  # posterior deviation of an angle of which the tips say nothing
SIGNIFICANT = 3.0  # deviations; a smaller mount is as good as none, and would only add its noise
MOST_LEFT = 0.1  # of the robot's length. Published models of real robots, not calibrated, are within it; another robot is not
IMPORTED_START_S = 1_000_000_000  # `import` adds it to logs on a clock that begins near zero


def lines(found: Alignment) -> list[str]:
    """What was found, with deviations."""
    clock_sigma = math.hypot(found.lag_sigma, found.file_delay_sigma)
    seen = found.mount_sigma > 0.0
    out = [
        f"lag of the poses     {found.lag:8.4f} +- {found.lag_sigma:.4f} s",
        f"  robot file's delay {found.file_delay:8.4f} +- {found.file_delay_sigma:.4f} s",
        f"  beyond it          {found.clock:8.4f} +- {clock_sigma:.4f} s: offset between the clocks, or more latency",
        f"registration         {_vector(found.rotation, found.rotation_sigma, 1.0, 4)} rad",
        f"                     {_vector(found.translation, found.translation_sigma, 1e3, 2)} mm",
    ]
    if seen.any():
        out.append(f"mount of the sensor  {_vector(found.mount, found.mount_sigma, 1.0, 4)} rad")
    return [*out, f"what is left         {found.errors.text()}"]


def mismatch(found: Alignment) -> str:
    """Why the alignment says nothing, in one line; empty where the robot file can be that of the recorded robot."""
    errors = found.errors
    if errors.rms <= MOST_LEFT * errors.length:
        return ""
    return (
        f"nothing is written: the tips stay {1e3 * errors.rms:.1f} mm rms off the static model, limit {1e3 * MOST_LEFT * errors.length:.1f} mm "
        f"({100 * MOST_LEFT:g} % of the robot's length): is it another robot's file, are the joints' zeros, units and order right, is the "
        "registration unknown (--unknown-registration)?"
    )


def _vector(value: Floats, sigma: Floats, factor: float, digits: int) -> str:
    return ", ".join(
        f"{factor * v:.{digits}f} +- {factor * s:.{digits}f}"
        if s < UNMEASURED_RAD
        else f"{factor * v:.{digits}f} (not measured)"
        for v, s in zip(value, sigma, strict=True)
    )


def file_text(found: Alignment, settings: Settings, command: str) -> tuple[str, str]:
    """Text of a parameter file with the alignment beside all of ``settings`` that are not at their defaults, and a warning.

    The warning says what to do about a lag that is too large for the estimator.
    """
    values: dict[str, Any] = {p.name: settings[p.name] for p in PARAMETERS if settings[p.name] != p.default}
    values["tracker.registration_rotation_rad"] = _rounded(found.rotation)
    values["tracker.registration_translation_m"] = _rounded(found.translation)
    if np.any(np.abs(found.mount) > SIGNIFICANT * found.mount_sigma):
        values["tracker.mount_rotation_rad"] = _rounded(found.mount)
    warning = ""
    try:
        parameter("tracker.delay_s").check(round(found.clock, 6))
        values["tracker.delay_s"] = round(found.clock, 6)
    except InputError:
        values.pop("tracker.delay_s", None)
        warning = (
            f"{found.clock:.4f} s is more than tracker.delay_s takes, for poses that come so late are past: shift the stamps of the poses by "
            f"{-found.clock:.4f} s (in CSV logs without a date, start_s: {IMPORTED_START_S - found.clock:.4f} of the tracker's time)"
        )
    head = [f"Written by {command}", *(line.rstrip() for line in lines(found))]
    nested: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        node = nested
        for group in groups:
            node = node.setdefault(group, {})
        node[last] = list(value) if isinstance(value, tuple) else value
    body = yaml.safe_dump(
        {"/ctr/estimator": {"ros__parameters": nested}}, sort_keys=False, default_flow_style=None
    )
    return "".join(f"# {line}\n" for line in head) + body, warning


def _rounded(vector: Floats) -> list[float]:
    return [round(float(v), 8) for v in vector]
