"""findings.json: the outcome of a diagnosis for programs (schema ctr_dynamics/findings/1)."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import __version__
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.output.robot_export import robot_of
from ctr_dynamics.diagnosis.pipeline import Diagnosis, Member
from ctr_dynamics.diagnosis.verdict.residual_tests import rms
from ctr_dynamics.diagnosis.whitening import noise_floor
from ctr_dynamics.effects import EFFECTS, Quantity
from ctr_dynamics.io.atomic_files import atomic_file
from ctr_dynamics.robot_files import robot_to_yaml
from ctr_dynamics.runtime.replay import plain

Floats = NDArray[np.float64]
SCHEMA = "ctr_dynamics/findings/1"
RECALIBRATED, EXTENDED = "recalibrated_robot.yaml", "extended_robot.yaml"
NUMERICS_LIMIT = 0.2  # of the noise floor


def interval(q: Quantity, value: float, sigma: float, width: float) -> list[float | None]:
    """Interval of ``width`` sigma in the contract's unit; None where it is unbounded."""
    low, high = max(value - width * sigma, q.low), min(value + width * sigma, q.high)
    ends = sorted((q.parameter.value(low), q.parameter.value(high)))
    return [x if math.isfinite(x) else None for x in ends]


def parameters(fit: Fit, member: Member, inflation: float) -> dict[str, Any]:
    """Values of one cause's parameters."""
    out: dict[str, Any] = {}
    assert member.candidate is not None
    for q, value, sigma in zip(fit.active, fit.values, fit.sigma * inflation, strict=True):
        if q.key not in member.candidate.keys:
            continue
        if q.parameter.period:
            value %= q.parameter.period
        shown = q.parameter.value(float(value))
        nominal = q.parameter.value(q.off)
        out[q.name] = {
            "value": shown if math.isfinite(shown) else None,
            "ci90": interval(q, float(value), float(sigma), 1.6449),
            "ci99": interval(q, float(value), float(sigma), 2.5758),
            "unit": q.parameter.unit,
            "nominal": nominal if math.isfinite(nominal) else None,
        }
    return out


def findings(diagnosis: Diagnosis, command: str, experiment: dict[str, Any] | None) -> dict[str, Any]:
    """The contract's dictionary; numbers that are not known are None."""
    d = diagnosis
    problem, best = d.problem, d.best
    inflation = 1.0
    if problem is not None and best is not None:
        inflation = math.sqrt(max(1.0, best.chi2 / problem.size))
    causes = []
    for m in d.members:
        if m.effect == "config_mistake" and d.mistake is not None:
            values: dict[str, Any] = {
                "which": {
                    "value": d.mistake[0],
                    "ci90": None,
                    "ci99": None,
                    "unit": "name",
                    "nominal": "none",
                }
            }
        elif m.candidate is None or best is None:
            values = {}
        else:
            values = parameters(best, m, inflation)
        causes.append(
            {
                "effect": m.effect,
                "parameters": values,
                "probability": m.probability,
                "separation": m.separation,
                "not_separable_from": m.rivals,
            }
        )
    if d.verdict in ("clean", "not_excited"):
        causes = []
    residual = {
        "nominal_rms_m": d.nominal_rms,
        "recalibrated_rms_m": _rms(d.left),
        "extended_rms_m": _rms(d.rest),
        "noise_floor_m": noise_floor(d.robot),
        "whiteness_p": d.white.p if d.white else None,
    }
    v = d.validation
    within = bool(d.numerics) and max(d.numerics.values()) < NUMERICS_LIMIT * noise_floor(d.robot)
    return plain(
        {
            "schema": SCHEMA,
            "verdict": d.verdict,
            "causes": causes,
            # clean is one explanation by contract; what small causes are possible stands in "probabilities"
            "cause_set95": [[]] if d.verdict == "clean" else [list(effects) for effects, _ in d.sets],
            "tested": d.tested,
            "not_observable": d.not_observable,
            "numerics": {
                "time_error_m": d.numerics.get("time_error_m"),
                "space_error_m": d.numerics.get("space_error_m"),
                "within_noise": within if d.numerics else None,
            },
            "residual": residual,
            "validation": None
            if v is None
            else {
                "rms_recalibrated_m": v.rms_recalibrated,
                "rms_extended_m": v.rms_extended,
                "gain": v.gain,
                "ci95": list(v.interval),
                "nis_before": v.nis_before,
                "nis_after": v.nis_after,
            },
            "next_experiment": experiment,
            "extended_robot": EXTENDED if best is not None else None,
            "recalibrated_robot": RECALIBRATED if d.clean is not None else None,
            "reproduce": command,
            "seconds": d.seconds,
            "probabilities": [{"effects": list(effects), "probability": p} for effects, p in d.sets],
            "notes": d.notes,
            "version": __version__,
            "robot": {"name": d.robot.name, "source": d.robot.source, "sha256": d.robot.sha256},
            "inputs": [
                {"name": name, "sha256": digest} for r in d.recordings for name, digest in r.sha256.items()
            ],
            "parameters": {
                "nodes": problem.forward_models[0].nodes,
                "dt_s": problem.forward_models[0].scheme.dt,
            }
            if problem
            else {},
        }
    )


def _rms(residuals: list[Floats]) -> float | None:
    return rms(np.concatenate(residuals)[:, :3]) if residuals else None


def write(directory: Path, diagnosis: Diagnosis, content: dict[str, Any]) -> None:
    """findings.json and the robot files into ``directory``."""
    directory.mkdir(parents=True, exist_ok=True)
    name = diagnosis.robot.name
    if diagnosis.clean is not None:
        recalibrated = robot_of(
            diagnosis.robot, diagnosis.clean, f"{name}_recalibrated", "re-calibrated inside its tolerances"
        )
        _text(directory / RECALIBRATED, robot_to_yaml(recalibrated))
    if diagnosis.best is not None:
        effects = ", ".join(m.effect for m in diagnosis.members if m.effect in EFFECTS) or "no cause"
        extended = robot_of(diagnosis.robot, diagnosis.best, f"{name}_extended", f"extended by {effects}")
        _text(directory / EXTENDED, robot_to_yaml(extended))
    _text(
        directory / "findings.json", json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    )


def _text(path: Path, text: str) -> None:
    with atomic_file(path) as part:
        part.write_text(text, encoding="utf-8", errors="backslashreplace")
