"""The robots of the fleet, and true robots drawn from the tolerances of their files."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict

Floats = NDArray[np.float64]
Data = dict[str, Any]


def _light(data: Data) -> None:
    """Without a payload: the slowest modes have 60 and 90 Hz."""
    del data["tubes"][0]["end_body"]


def _heavy(data: Data) -> None:
    """With 2.5 times the payload."""
    body = data["tubes"][0]["end_body"]
    body["mass"]["value"] *= 2.5
    body["mass"]["tolerance"] *= 2.5
    body["inertia"]["value"] = [2.5 * x for x in body["inertia"]["value"]]


def _long(data: Data) -> None:
    """1.8 times as long, behind and in front of the plate."""
    for tube in data["tubes"]:
        for segment in tube["precurvature"]:
            segment["length"]["value"] *= 1.8
    data["rest"]["beta"]["value"] = [1.8 * x for x in data["rest"]["beta"]["value"]]


def _four_tubes(data: Data) -> None:
    """A fourth tube around the outer one, as thick in the wall as that."""
    outer = data["tubes"][-1]
    gap = outer["outer_radius"]["value"] - outer["inner_radius"]["value"]
    added = robot_to_dict(robot_from_dict(data))["tubes"][-1]
    added["name"] = "outermost"
    added["inner_radius"]["value"] = outer["outer_radius"]["value"] + 5e-5
    added["outer_radius"]["value"] = added["inner_radius"]["value"] + gap
    beta = data["rest"]["beta"]["value"]
    exposed = sum(segment["length"]["value"] for segment in outer["precurvature"]) + beta[-1]
    added["precurvature"][0]["length"]["value"] = max(
        0.02, 0.5 * exposed + 0.02 - added["precurvature"][-1]["length"]["value"]
    )
    data["tubes"].append(added)
    data["rest"]["beta"]["value"] = [*beta, -0.01]
    data["rest"]["alpha"]["value"] = [*data["rest"]["alpha"]["value"], 0.3]


FLEET: dict[str, tuple[str, Callable[[Data], None] | None]] = {
    "tissue": ("till2020_tissue", None),
    "light": ("till2020_tissue", _light),
    "heavy": ("till2020_tissue", _heavy),
    "long": ("till2020_tissue", _long),
    "three_tube": ("three_tube", None),
    "four_tubes": ("three_tube", _four_tubes),
}
"""Robots by name: the shipped file that each comes from, and how it differs."""

RANDOM = "random"
"""With a number behind it: one of endlessly many robots like that of the paper, which nobody has looked at when a method was chosen."""

LAB_STIFFNESS, LAB_PRECURVATURE = (
    0.03,
    0.02,
)  # of a robot that was built and measured in a laboratory: E 2 to 5 %, precurvature 1 to 3 %


def seed_of(name: str) -> int:
    """A number of its own for each robot.

    Raises:
        KeyError: no such robot.
    """
    if name.startswith(RANDOM):
        return len(FLEET) + _random_number(name) - 1
    if name not in FLEET:
        raise KeyError(name)
    return list(FLEET).index(name)


def _random_number(name: str) -> int:
    number = name.removeprefix(RANDOM)
    if not number.isdecimal() or int(number) < 1:
        raise KeyError(name)
    return int(number)


def _at_random(data: Data, number: int) -> None:
    """Other radii, lengths, stiffnesses, precurvatures and payload."""
    rng = np.random.default_rng([77, number])
    width, length = rng.uniform(0.85, 1.25), rng.uniform(0.75, 1.35)
    for tube in data["tubes"]:
        for radius in ("inner_radius", "outer_radius"):
            tube[radius]["value"] *= width
        stiffness, curvature = rng.uniform(0.8, 1.2), rng.uniform(0.6, 1.3)
        tube["youngs_modulus"]["value"] *= stiffness
        for segment in tube["precurvature"]:
            segment["length"]["value"] *= length
            if "curvature" in segment:
                segment["curvature"]["value"] = [
                    curvature / length * x for x in segment["curvature"]["value"]
                ]
        if "end_body" in tube:
            payload, body = rng.uniform(0.1, 1.5), tube["end_body"]
            body["mass"]["value"] *= payload
            body["mass"]["tolerance"] *= payload
            body["inertia"]["value"] = [payload * x for x in body["inertia"]["value"]]
    data["rest"]["beta"]["value"] = [length * x for x in data["rest"]["beta"]["value"]]


def fleet_robot(name: str, lab: bool = False) -> Robot:
    """A robot of the fleet, or one at random as ``random7``, as its file describes it; ``lab``: with the tolerances of a laboratory.

    Raises:
        KeyError: no such robot.
    """
    if name.startswith(RANDOM):
        data = robot_to_dict(load_robot("till2020_tissue"))
        _at_random(data, _random_number(name))
    else:
        source, change = FLEET[name]
        data = robot_to_dict(load_robot(source))
        if change is not None:
            change(data)
    data["name"] = name
    for tube in data["tubes"] if lab else ():
        _tolerate(tube["youngs_modulus"], LAB_STIFFNESS)
        for segment in tube["precurvature"]:
            if "curvature" in segment:
                _tolerate(segment["curvature"], LAB_PRECURVATURE)
    return robot_from_dict(data)


def _tolerate(quantity: Data, relative: float) -> None:
    value = quantity["value"]
    quantity["tolerance"] = (
        [relative * abs(x) for x in value] if isinstance(value, list) else relative * value
    )


class Draw(NamedTuple):
    """A true robot, and what of it no robot file can say: ``offsets`` (N,) rad, true angle of each tube minus its encoder's reading."""

    robot: Robot
    offsets: Floats


def drawn(robot: Robot, rng: np.random.Generator) -> Draw:
    """A true robot inside the tolerances of the file ``robot``: independent normal deviations, none cut off.

    As the filter's prior has it, densities vary together, and so do the segments of a tube's precurvature (docs/robot_file.md).
    """
    data = robot_to_dict(robot)

    def vary(quantity: Data, least: float = 0.0) -> None:
        """A scalar or a vector, by its own tolerance."""
        value = np.array(quantity["value"], float)
        changed = value + np.array(quantity.get("tolerance", 0.0)) * rng.standard_normal(value.shape)
        quantity["value"] = np.maximum(changed, least).tolist() if least else changed.tolist()

    density = 1.0 + max(tube.density.relative for tube in robot.tubes) * rng.standard_normal()
    for tube, file in zip(data["tubes"], robot.tubes, strict=True):
        vary(tube["youngs_modulus"])
        tube["density"]["value"] *= density
        precurvature = 1.0 + file.precurvature_tolerance * rng.standard_normal()
        for segment in tube["precurvature"]:
            for key in ("curvature", "curvature_polynomial"):
                if key in segment:
                    segment[key]["value"] = (precurvature * np.array(segment[key]["value"])).tolist()
        if "end_body" in tube:
            vary(tube["end_body"]["mass"], 1e-9)
    for pair in ("base", "tubes"):
        for kind in ("coulomb", "viscous"):
            vary(data["friction"][pair][kind], 1e-12)
    vary(data["friction"]["epsilon"], 1e-3)
    gravity = np.array(data["gravity"]["value"])
    if gravity.any():
        turn = data["gravity"].get("direction_tolerance", 0.0) * rng.standard_normal(3)
        turned = gravity + np.cross(turn, gravity)
        data["gravity"]["value"] = (turned * np.linalg.norm(gravity) / np.linalg.norm(turned)).tolist()
    for name in ("registration_rotation", "registration_translation", "lever_arm", "delay"):
        vary(data["tracker"][name])
    offsets = robot.encoders.offset.tolerance * rng.standard_normal(robot.n_tubes)
    return Draw(robot_from_dict(data), offsets)
