"""findings.json: the outcome of a diagnosis for programs (schema ctr_dynamics/findings/1), and the robot files beside it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import __version__
from ctr_dynamics.diagnosis.diagnosis_result import Diagnosis
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.inference.residual_tests import rms
from ctr_dynamics.diagnosis.inference.tolerance_evidence import WiderTolerance
from ctr_dynamics.diagnosis.learned.dictionary import EFFECT
from ctr_dynamics.diagnosis.output.cause_text import cause_text
from ctr_dynamics.diagnosis.output.robot_export import robot_with_fit
from ctr_dynamics.diagnosis.verdict.separability import Cause
from ctr_dynamics.diagnosis.whitening import noise_floor
from ctr_dynamics.effects import EFFECTS, EffectQuantity
from ctr_dynamics.io.atomic_files import atomic_file
from ctr_dynamics.robot_files import robot_to_yaml
from ctr_dynamics.runtime.replay import plain

Floats = NDArray[np.float64]
SCHEMA = "ctr_dynamics/findings/1"
RECALIBRATED: str = "recalibrated_robot.yaml"
EXTENDED: str = "extended_robot.yaml"
FINDINGS: str = "findings.json"


def interval(q: EffectQuantity, value: float, sigma: float, width: float) -> list[float | None]:
    """Interval of ``width`` sigma in the contract's unit; None where it is unbounded."""
    low, high = max(value - width * sigma, q.low), min(value + width * sigma, q.high)
    ends = sorted((q.parameter.value(low), q.parameter.value(high)))
    return [x if math.isfinite(x) else None for x in ends]


def parameters(fit: Fit, candidate: Candidate) -> dict[str, Any]:
    """Values of one cause's parameters, with intervals of the posterior deviations of ``fit``."""
    out: dict[str, Any] = {}
    for q, value, sigma in zip(fit.active, fit.values, fit.sigma, strict=True):
        if q.key not in candidate.keys:
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
    """The contract's dictionary; numbers that are not known are None.

    Args:
        command: that reproduces the diagnosis.
        experiment: the next one, as the contract has it.
    """
    d = diagnosis
    problem, v = d.problem, d.validation
    residual = {
        "nominal_rms_m": d.nominal_rms,
        "recalibrated_rms_m": _rms(d.residual_recalibrated),
        "extended_rms_m": _rms(d.residual_extended),
        "noise_floor_m": noise_floor(d.robot),
        "whiteness_p": d.whiteness_extended.p if d.whiteness_extended else None,
    }
    limit = d.options.report.numerics_limit * noise_floor(d.robot)
    measured = bool(d.numerics) and all(math.isfinite(x) for x in d.numerics.values())
    within = measured and max(d.numerics.values()) < limit
    return plain(
        {
            "schema": SCHEMA,
            "verdict": d.verdict,
            "causes": [] if d.verdict in ("clean", "not_excited") else [_cause(d, c) for c in d.causes],
            # clean is one hypothesis by contract; "probabilities" has the small causes that are possible
            "cause_set95": [[]] if d.verdict == "clean" else [list(effects) for effects, _ in d.cause_sets],
            "tested": d.tested,
            "not_observable": d.not_observable,
            "numerics": {
                "time_error_m": d.numerics.get("time_error_m"),
                "space_error_m": d.numerics.get("space_error_m"),
                "within_noise": within if measured else None,
            },
            "residual": residual,
            "discrepancy": None
            if d.discrepancy is None
            else {
                "rms_m": d.discrepancy.rms_m,
                "correlation_time_s": d.discrepancy.correlation_time_s,
                "share_of_misfit": d.fraction_of_misfit,
            },
            "validation": None
            if v is None
            else {
                "rms_nominal_m": v.rms_nominal,
                "rms_recalibrated_m": v.rms_recalibrated,
                "rms_extended_m": v.rms_extended,
                "gain": v.gain,
                "ci95": list(v.interval),
                "gain_over_nominal": v.gain_over_nominal,
                "nis_before": v.nis_before,
                "nis_after": v.nis_after,
            },
            "learned": _learned(d),
            "next_experiment": experiment,
            "tolerances": [_tolerance(w) for w in d.tolerances.wider]
            if d.tolerances is not None and d.verdict == "tolerances"
            else [],
            "extended_robot": EXTENDED if d.extended is not None else None,
            "recalibrated_robot": RECALIBRATED if d.recalibrated is not None else None,
            "reproduce": command,
            "seconds": d.seconds,
            "probabilities": [{"effects": list(effects), "probability": p} for effects, p in d.cause_sets],
            "notes": d.notes,
            "version": __version__,
            "robot": {"name": d.robot.name, "source": d.robot.source, "sha256": d.robot.sha256},
            "inputs": [
                {"name": name, "sha256": digest} for r in d.recordings for name, digest in r.sha256.items()
            ],
            "parameters": {
                "nodes": problem.forward_models[0].nodes,
                "dt_s": min(e.shortest_step for e in problem.forward_models),
                "longest_dt_s": max(e.longest_step for e in problem.forward_models),
            }
            if problem
            else {},
        }
    )


def _cause(d: Diagnosis, cause: Cause) -> dict[str, Any]:
    """One cause as the contract has it."""
    values: dict[str, Any] = {}
    if cause.effect == "config_mistake" and d.mistake is not None:
        which = {"value": d.mistake.name, "ci90": None, "ci99": None, "unit": "name", "nominal": "none"}
        values = {"which": which}
    elif cause.candidate is not None and d.extended is not None:
        values = parameters(d.extended, cause.candidate)
    return {
        "effect": cause.effect,
        "parameters": values,
        "probability": cause.probability,
        "separation": cause.separation,
        "not_separable_from": cause.rivals,
        "text": cause_text(d.robot, cause.effect, values),
    }


def _tolerance(wider: WiderTolerance) -> dict[str, Any]:
    """One tolerance that is too tight, in the contract's unit."""
    q = wider.quantity

    def shown(deviation: float) -> float:
        return abs(q.parameter.value(q.off + deviation) - q.parameter.value(q.off))

    return {
        "parameter": f"{q.effect}.{q.name}",
        "unit": q.parameter.unit,
        "stated": shown(wider.stated),
        "suggested": shown(wider.suggested),
        "evidence": wider.evidence,
    }


def _learned(d: Diagnosis) -> dict[str, Any] | None:
    """The learned force as the contract has it; None where there is none that predicts."""
    force = None if d.learning is None else d.learning.force
    if force is None:
        return None
    sigma = {q.key: float(s) for q, s in zip(force.fit.active, force.fit.sigma, strict=True)}
    return {
        "kind": "force on the tip",
        "terms": [
            {
                "parameter": q.name,
                "value": force.fit.point[q.key],
                "ci90": interval(q, force.fit.point[q.key], sigma[q.key], 1.6449),
                "unit": q.parameter.unit,
                "text": q.parameter.text,
            }
            for q in force.terms
        ],
        "extension": EFFECT,
        "gain": force.validation.gain,
        "ci95": list(force.validation.interval),
        "held_out": force.held_out,
    }


def _rms(residuals: list[Floats]) -> float | None:
    return rms(np.concatenate(residuals)[:, :3]) if residuals else None


def write(directory: Path, diagnosis: Diagnosis, content: dict[str, Any]) -> None:
    """findings.json and the robot files into ``directory``."""
    directory.mkdir(parents=True, exist_ok=True)
    robot, name = diagnosis.robot, diagnosis.robot.name
    if diagnosis.recalibrated is not None:
        note = "re-calibrated inside its tolerances"
        recalibrated = robot_with_fit(robot, diagnosis.recalibrated, f"{name}_recalibrated", note)
        _text(directory / RECALIBRATED, robot_to_yaml(recalibrated))
    if diagnosis.extended is not None:
        names = [c.effect for c in diagnosis.causes if c.effect in EFFECTS]
        if diagnosis.learning is not None and diagnosis.learning.force is not None:
            robot, names = diagnosis.learning.force.robot, [*names, "a learned force"]
        effects = ", ".join(names) or "no cause"
        extended = robot_with_fit(robot, diagnosis.extended, f"{name}_extended", f"extended by {effects}")
        _text(directory / EXTENDED, robot_to_yaml(extended))
    _text(directory / FINDINGS, json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def _text(path: Path, text: str) -> None:
    with atomic_file(path) as part:
        part.write_text(text, encoding="utf-8", errors="backslashreplace")
