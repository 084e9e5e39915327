"""Robot export: the robot file with what a fit has found.

In: a robot and a fit. Out: a robot with the fit's values and posterior deviations, in the file's own fields where it has them, and under
`extensions` else.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.effects import EFFECTS
from ctr_dynamics.kernels.rotations import from_vector, matrix, multiply, to_vector
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import robot_from_dict, robot_to_dict

_PLAIN = {
    ("base_coulomb", "mu_base"): ("friction", "base", "coulomb"),
    ("base_viscous", "nu_base"): ("friction", "base", "viscous"),
    ("tube_coulomb", "mu"): ("friction", "tubes", "coulomb"),
    ("tube_viscous", "nu"): ("friction", "tubes", "viscous"),
}
_VECTORS = {
    "registration_rotation": ("registration_rotation", ("rx_rad", "ry_rad", "rz_rad")),
    "registration_translation": ("registration_translation", ("tx_m", "ty_m", "tz_m")),
    "tracker_lever_arm": ("lever_arm", ("x_m", "y_m", "z_m")),
}


def robot_with(robot: Robot, fit: Fit, name: str, note: str) -> Robot:
    """``robot`` with the values and posterior deviations of ``fit``; ``note`` goes into its description."""
    data = robot_to_dict(robot)
    values = {q.key: float(v) for q, v in zip(fit.active, fit.values, strict=True)}
    sigma = {q.key: float(s) for q, s in zip(fit.active, fit.sigma, strict=True)}
    causes = {q.effect for q in fit.causes}
    data["name"], data["description"] = name, f"{robot.description} ({note})".strip()
    for key in list(values):
        if EFFECTS[key[0]].nuisance or not _into_field(data, key, values[key], sigma[key]):
            continue
        values.pop(key)
    _vectors(data, values, sigma)
    extensions: dict[str, dict[str, float]] = data.setdefault("extensions", {})
    for (effect, parameter), coordinate in values.items():
        if EFFECTS[effect].nuisance or effect in ("gravity_direction",):
            continue
        if effect == "encoder_offset" or effect in causes:
            value = EFFECTS[effect].find(parameter).value(coordinate)
            if math.isfinite(value):
                extensions.setdefault(effect, {})[parameter] = value
    if any(key[0] == "encoder_offset" for key in values):
        found = [sigma[key] for key in values if key[0] == "encoder_offset"]
        data["encoders"]["offset"]["tolerance"] = max(found)
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
    elif effect == "youngs_modulus":
        for tube in tubes if number is None else [tubes[number]]:
            own = tube["youngs_modulus"]
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
    elif effect == "density":
        for tube in tubes if number is None else [tubes[number]]:
            own = tube["density"]
            own["value"] *= value
            own["tolerance"] = sigma * own["value"]
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
    """Registration, lever arm and gravity: three coordinates each; taken out of ``values``."""
    tracker = data["tracker"]
    for effect, (field, names) in _VECTORS.items():
        keys = [(effect, n) for n in names]
        if not all(k in values for k in keys):
            continue
        change = np.array([values.pop(k) for k in keys])
        own = tracker[field]
        if effect == "registration_rotation":
            turned = multiply(from_vector(change), from_vector(np.array(own["value"])))
            own["value"] = to_vector(turned).tolist()
            shift = tracker["registration_translation"]
            shift["value"] = (matrix(from_vector(change)) @ np.array(shift["value"])).tolist()
        else:
            own["value"] = (np.array(own["value"]) + change).tolist()
        own["tolerance"] = [sigma[k] for k in keys]
    keys = [("gravity_direction", f"r{a}_rad") for a in "xyz"]
    if all(k in values for k in keys):
        change = np.array([values.pop(k) for k in keys])
        gravity = data["gravity"]
        gravity["value"] = (matrix(from_vector(change)) @ np.array(gravity["value"])).tolist()
        spread = np.sort([sigma[k] for k in keys])
        gravity["direction_tolerance"] = float(np.mean(spread[:2]))
