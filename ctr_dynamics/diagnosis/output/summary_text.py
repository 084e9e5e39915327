"""Summary text: findings in sentences that a roboticist can act on."""

from __future__ import annotations

from typing import Any

from ctr_dynamics.diagnosis.output.cause_text import shown
from ctr_dynamics.effects import EFFECTS

VERDICTS = {
    "clean": "The simulation agrees with the data within the tolerances of the robot file.",
    "named": "The simulation is wrong, and the cause is named.",
    "named_with_remainder": "The simulation is wrong. The cause is named; beside it something smaller is left that is not noise.",
    "ambiguous": "The simulation is wrong; several causes explain it about as well.",
    "unknown": "The simulation is wrong in a way that no cause of the catalogue explains.",
    "not_excited": "These bags hardly move the robot: they cannot show what is wrong.",
    "tolerances": "No cause is needed, but values of the robot scatter more than the tolerances of the robot file say.",
}


def cause(entry: dict[str, Any]) -> str:
    """One cause: what, how much, how sure, and what else it may be."""
    effect = entry["effect"]
    if effect == "unknown":
        return "Cause: outside the catalogue."
    sentence = f"Cause: {entry['text']}"
    sentence += f"; probability {entry['probability']:.2f}." if entry["probability"] is not None else "."
    if entry["not_separable_from"]:
        sentence += (
            f" Not separable from: {', '.join(x.replace('_', ' ') for x in entry['not_separable_from'])}."
        )
    if effect in EFFECTS:
        sentence += f" {EFFECTS[effect].text}"
    return sentence


def summary(content: dict[str, Any]) -> list[str]:
    """The first screen: verdict, causes, gain, what to do next. Lengths in millimetres, and said so."""
    lines = [f"verdict: {content['verdict']}. {VERDICTS[content['verdict']]}"]
    lines += [cause(entry) for entry in content["causes"]]
    r = content["residual"]
    if r["recalibrated_rms_m"] is not None:
        lines.append(
            f"Residual rms against the tracker: nominal {_mm(r['nominal_rms_m'])}, re-calibrated {_mm(r['recalibrated_rms_m'])}, "
            f"extended {_mm(r['extended_rms_m'])}, noise floor {_mm(r['noise_floor_m'])}."
        )
    left = content["discrepancy"]
    if left is not None:
        fraction = (
            ""
            if left["share_of_misfit"] is None
            else f", {100 * left['share_of_misfit']:.0f} % of the squared misfit"
        )
        lines.append(
            f"What remains is not noise: {_mm(left['rms_m'])} rms, correlated over {left['correlation_time_s']:.2g} s{fraction}."
        )
    v = content["validation"]
    if v is not None:
        lines.append(
            f"On bags that were not fitted: nominal {_mm(v['rms_nominal_m'])}, re-calibrated {_mm(v['rms_recalibrated_m'])}, "
            f"extended {_mm(v['rms_extended_m'])}; gain over re-calibrated {v['gain']:.3f} (95 % interval {v['ci95'][0]:.3f} to "
            f"{v['ci95'][1]:.3f}){_over_nominal(v)}."
        )
    force = content["learned"]
    if force is not None:
        terms = "; ".join(
            f"{t['text']} {shown(t['value'], t['unit'])} [{shown(t['ci90'][0], t['unit'])}, {shown(t['ci90'][1], t['unit'])}]"
            for t in force["terms"]
        )
        low, high = (100 * x for x in force["ci95"])
        lines.append(
            f"Learned from what is left, a {force['kind']} of {len(force['terms'])} terms: {terms}. On {force['held_out']} it removes "
            f"{100 * force['gain']:.0f} % of the squared error (95 % interval {low:.0f} to {high:.0f} %); extension {force['extension']}."
        )
    for w in content["tolerances"]:
        stated, suggested = shown(w["stated"], w["unit"]), shown(w["suggested"], w["unit"])
        lines.append(f"Tolerance of {w['parameter']}: {suggested} instead of {stated}.")
    e = content["next_experiment"]
    if e is not None:
        worth = ""
        if e["separation_after"] is not None:
            worth = f" (separation {e['separation_before']:.1f} -> {e['separation_after']:.1f})"
        lines.append(f"Next experiment: {e['description']}{worth}; scenario in {e['scenario_file']}.")
    return lines


def _over_nominal(validation: dict[str, Any]) -> str:
    gain = validation["gain_over_nominal"]
    return "" if gain is None else f", over nominal {gain:.3f}"


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value * 1e3:.3f} mm"
