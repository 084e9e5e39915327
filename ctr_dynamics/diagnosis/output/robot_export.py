"""Robot export: the robot file with what a fit has found.

In: a robot and a fit. Out: a robot with the fit's values and posterior deviations, in the file's own fields where it has them, and under
`extensions` else. What the file had under `extensions` before is part of the new values.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ctr_dynamics.diagnosis.forward_model import Key, values_at
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.effects import EFFECTS, combined
from ctr_dynamics.kernels.rotations import from_vector, matrix, multiply, to_vector
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import robot_from_dict, robot_to_dict

_PLAIN = {
    ("base_coulomb", "mu_base"): ("friction", "base", "coulomb"),
    ("base_viscous", "nu_base"): ("friction", "base", "viscous"),
    ("tube_coulomb", "mu"): ("friction", "tubes", "coulomb"),
    ("tube_viscous", "nu"): ("friction", "tubes", "viscous"),
}
_GRAVITY = "gravity_direction"
_REGISTRATION = ("registration_rotation", "registration_translation")
_VECTORS = {
    "registration_rotation": ("registration_rotation", ("rx_rad", "ry_rad", "rz_rad")),
    "registration_translation": ("registration_translation", ("tx_m", "ty_m", "tz_m")),
    "tracker_lever_arm": ("lever_arm", ("x_m", "y_m", "z_m")),
}


def robot_with_fit(robot: Robot, fit: Fit, name: str, note: str) -> Robot:
    """``robot`` with the values and posterior deviations of ``fit``; ``note`` goes into its description.

    What belongs to a recording rather than the robot, such as the time of its loads, is left out.
    """
    data = robot_to_dict(robot)
    data["name"], data["description"] = name, f"{robot.description} ({note})".strip()
    forms = {form for q in fit.causes for form in EFFECTS[q.effect].form}
    kept = {key: value for key, value in fit.point.items() if not EFFECTS[key[0]].nuisance or key[0] in forms}
    sigma = {q.key: float(s) for q, s in zip(fit.active, fit.sigma, strict=True)}
    extensions = data["extensions"] = combined(robot, values_at(kept))
    moved = {effect for effect, _ in kept if effect in (*_VECTORS, _GRAVITY)}
    if moved.intersection(_REGISTRATION):  # one moves the other
        moved.update(_REGISTRATION)
    further = [(effect, name) for effect in sorted(moved) for name in extensions.get(effect, ())]
    taken = list(dict.fromkeys([*kept, *further]))
    own = {(effect, parameter): float(extensions[effect][parameter]) for effect, parameter in taken}
    offsets = [sigma[key] for key in kept if key[0] == "encoder_offset"]
    if offsets:
        data["encoders"]["offset"]["tolerance"] = max(offsets)
    _vectors(data, own, sigma)
    for key, value in list(own.items()):
        if _into_field(data, key, value, sigma[key]) or not math.isfinite(value):
            own.pop(key)
    for effect, parameter in taken:
        if (effect, parameter) not in own:
            extensions[effect].pop(parameter, None)
            if not extensions[effect]:
                extensions.pop(effect)
    return robot_from_dict(data, name)


def _into_field(data: dict[str, Any], key: Key, value: float, sigma: float) -> bool:
    """Write one coordinate into the robot file's field for it; False where there is none."""
    effect, name = key
    if key in _PLAIN:
        node: Any = data
        for part in _PLAIN[key]:
            node = node[part]
        node["value"], node["tolerance"] = max(value, 0.0), sigma
        return True
    tubes = data["tubes"]
    number = int(name[4]) - 1 if name.startswith("tube") else None
    if effect in ("bending_damping", "torsion_damping") and number is not None:
        tubes[number][effect].update(value=max(value, 0.0), tolerance=sigma)
    elif effect in ("youngs_modulus", "shear_modulus", "density"):
        chosen = tubes if number is None else [tubes[number]]
        if any(tube.get(effect) is None for tube in chosen):  # a shear modulus that follows Young's
            return False
        for tube in chosen:
            own = tube[effect]
            own["value"] *= value
            own["tolerance"] = sigma * own["value"]
    elif effect == "precurvature" and number is not None:
        for segment in tubes[number]["precurvature"]:
            if "curvature" in segment:
                own = segment["curvature"]
                own["value"] = [v * value for v in own["value"]]
                own["tolerance"] = [abs(v) * sigma for v in own["value"]]
            else:
                own = segment["curvature_polynomial"]
                own["value"] = [[v * value for v in row] for row in own["value"]]
                own["tolerance_percent"] = 100.0 * sigma
    elif effect == "payload_mass" and tubes[0].get("end_body"):
        tubes[0]["end_body"]["mass"]["value"] += value
        tubes[0]["end_body"]["mass"]["tolerance"] = sigma
    elif effect == "tracker_latency":
        data["tracker"]["delay"]["value"] += value
        data["tracker"]["delay"]["tolerance"] = sigma
    else:
        return False
    return True


def _vectors(data: dict[str, Any], values: dict[Key, float], sigma: Mapping[Key, float]) -> None:
    """Registration, lever arm and gravity: three coordinates each; taken out of ``values``. A tolerance stays where there is no ``sigma``."""
    tracker, gravity = data["tracker"], data["gravity"]
    for effect, (field, names) in _VECTORS.items():
        keys = [(effect, n) for n in names]
        if not any(k in values for k in keys):
            continue
        change = np.array([values.pop(k, 0.0) for k in keys])
        own = tracker[field]
        if effect == "registration_rotation":
            turned = multiply(from_vector(change), from_vector(np.array(own["value"])))
            own["value"] = to_vector(turned).tolist()
            shift = tracker["registration_translation"]
            shift["value"] = (matrix(from_vector(change)) @ np.array(shift["value"])).tolist()
        else:
            own["value"] = (np.array(own["value"]) + change).tolist()
        own["tolerance"] = _deviations(sigma, keys, own["tolerance"])
    keys = [(_GRAVITY, f"r{a}_rad") for a in "xyz"]
    if any(k in values for k in keys):
        change = np.array([values.pop(k, 0.0) for k in keys])
        gravity["value"] = (matrix(from_vector(change)) @ np.array(gravity["value"])).tolist()
        spread = np.sort([sigma.get(k, 0.0) for k in keys])
        gravity["direction_tolerance"] = float(np.mean(spread[:2]))


def _deviations(sigma: Mapping[Key, float], keys: Sequence[Key], before: Sequence[float]) -> list[float]:
    """Deviations of three coordinates, those ``before`` where there are none."""
    return [sigma.get(k, b) for k, b in zip(keys, before, strict=True)]
