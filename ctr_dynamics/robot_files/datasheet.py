"""A robot file from what data sheets say: diameters, lengths, bend radius, moduli, each with its deviation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ctr_dynamics.errors import InputError
from ctr_dynamics.robot.schema import Robot
from ctr_dynamics.robot_files.loader import robot_from_dict, robot_to_yaml
from ctr_dynamics.units import measure

# Friction of a robot that nobody has measured: Till et al. 2020, Table III, with wide deviations.
FRICTION: dict[str, Any] = {
    "base": {
        "coulomb": {"value": 1.09, "unit": "1", "tolerance_percent": 50},
        "viscous": {"value": 73.9e-7, "unit": "N m s/rad", "tolerance_percent": 50},
    },
    "tubes": {
        "coulomb": {"value": 0.00323, "unit": "1", "tolerance_percent": 50},
        "viscous": {"value": 1.16e-7, "unit": "N m s/rad", "tolerance_percent": 50},
    },
    "epsilon": {"value": 15.0, "unit": "rad/s"},
}
GRAVITY = 9.81
AXES = {"x": 0, "y": 1, "z": 2}
# Key of a data sheet -> SI unit, whether it is needed, and what it is.
TUBE_KEYS: dict[str, tuple[str, bool, str]] = {
    "od": ("m", True, "outer diameter"),
    "id": ("m", True, "inner diameter, 0 mm for a wire"),
    "straight": ("m", True, "length of the straight part, from the tube's base"),
    "curved": ("m", False, "length of the precurved part behind it"),
    "radius": ("m", False, "bend radius of the centre line in the precurved part"),
    "E": ("Pa", True, "Young's modulus"),
    "density": ("kg/m^3", True, "density"),
    "G": ("Pa", False, "shear modulus; E / 2.6 without it"),
    "damping": ("N m^2 s", False, "bending damping; 0 without it"),
}
# Keys that may stand for one of these, as robots are published: SI unit, the key, and what it is.
INSTEAD: dict[str, tuple[str, str, str]] = {
    "EI": ("N m^2", "E", "bending stiffness"),
    "GJ": ("N m^2", "G", "torsional stiffness"),
    "curvature": ("1/m", "radius", "curvature of the precurved part"),
}


@dataclass(frozen=True)
class Measured:
    """A value in SI units with its standard deviation."""

    value: float
    sigma: float = 0.0

    @property
    def relative(self) -> float:
        return self.sigma / abs(self.value) if self.value else 0.0

    def quantity(self, unit: str) -> dict[str, Any]:
        """As a robot file holds it."""
        found: dict[str, Any] = {"value": _short(self.value), "unit": unit}
        if self.sigma:
            found["tolerance"] = _short(self.sigma)
        return found


def _short(value: float) -> float:
    """Twelve digits: 1.244 mm is 0.001244 m, not 0.0012440000000000001 m."""
    return float(f"{value:.12g}")


def measured(text: str, si: str, where: str) -> Measured:
    """A value such as "1.244 mm", "52 GPa +- 2 %" or "0 ms +- 1 ms"; the deviation is one standard deviation.

    Raises:
        InputError: no number, no fitting unit, or a negative deviation.
    """
    head, mark, tail = text.replace("±", "+-").partition("+-")
    value = measure(head, si, where)
    if not mark:
        return Measured(value)
    if tail.strip().endswith("%"):
        sigma = abs(value) * measure(tail.strip()[:-1], "1", where) / 100
    else:
        sigma = measure(tail, si, where)
    if not 0 <= sigma < math.inf:
        raise InputError(f"deviation '{tail.strip()}' is not 0 or more", do="give one sigma", where=where)
    return Measured(value, sigma)


def measures(text: str, si: str, where: str) -> tuple[Measured, ...]:
    """Several values separated by commas."""
    return tuple(measured(part, si, where) for part in text.split(","))


@dataclass(frozen=True)
class Sheet:
    """What is known of a robot; a tuple holds one entry for each tube, innermost first.

    Attributes:
        tubes: for each tube its name and its data by the keys of `TUBE_KEYS`.
        gravity: direction of the weight in `ctr_base`: -y, +x, ...
        tip_mass, tip_diameter: body at the tip, a sphere; kg and m.
        beta, alpha: rest position of the actuators, m and rad; empty: bases 10 mm apart, angles zero.
        position_noise, rotation_noise: tracker, one sigma per axis, m and rad.
        delay: of the tracker, s. lever_arm: (3,) sensor in the tip frame, m.
        registration_sigma: of the tracker's frame, m and rad per axis.
        registration: rows of [R t; 0 0 0 1] of `ctr_base` in the tracker's frame, t in m; empty: the two are one.
        mount: rotation vector of the sensor in the tip frame, rad; empty: its axes are those of the tip. axes: measured ones; empty: all.
        encoder_sigma: offset of a rotary encoder, rad.
    """

    name: str
    tubes: tuple[tuple[str, Mapping[str, Measured]], ...]
    gravity: str = "-y"
    tip_mass: Measured = Measured(0.0)
    tip_diameter: Measured = Measured(0.0)
    beta: tuple[Measured, ...] = ()
    alpha: tuple[Measured, ...] = ()
    position_noise: Measured = Measured(0.35e-3)
    rotation_noise: Measured = Measured(math.radians(0.3))
    delay: Measured = Measured(0.0, 0.002)
    lever_arm: tuple[Measured, ...] = field(default_factory=lambda: (Measured(0.0, 0.0005),) * 3)
    registration_sigma: tuple[float, float] = (0.0005, math.radians(0.3))
    registration: tuple[tuple[float, ...], ...] = tuple(tuple(row) for row in np.eye(4).tolist())
    mount: tuple[Measured, ...] = ()
    axes: str = ""
    encoder_sigma: Measured = Measured(math.radians(0.1))


def tube_from_text(text: str, number: int) -> tuple[str, dict[str, Measured]]:
    """A tube such as "name=inner, od=1.244mm, id=1.028mm, straight=301mm, E=52GPa+-2%, density=6.5g/cm^3".

    Raises:
        InputError: not KEY=VALUE, an unknown key, or a value that cannot be read.
    """
    where, name, given = f"tube {number}", f"tube{number}", set[str]()
    found: dict[str, Measured] = {}
    for part in text.split(","):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals:
            raise InputError(
                f"'{part.strip()}' is not KEY=VALUE", do="write for example od=1.2mm", where=where
            )
        if key in given:
            raise InputError(f"{key} is given twice", do="leave one of them out", where=where)
        given.add(key)
        if key == "name":
            name = value
        elif key in TUBE_KEYS or key in INSTEAD:
            unit = TUBE_KEYS[key][0] if key in TUBE_KEYS else INSTEAD[key][0]
            found[key] = measured(value, unit, f"{where}: {key}")
        else:
            known = ", ".join([*TUBE_KEYS, *INSTEAD])
            raise InputError(f"unknown key '{key}'", do=f"known: name, {known}", where=where)
    for key, (_, other, _) in INSTEAD.items():
        if key in found and other in found:
            raise InputError(f"both {key} and {other} are given", do="leave one of them out", where=where)
    stood_for = {INSTEAD[key][1] for key in found if key in INSTEAD}
    missing = [
        key
        for key, (_, needed, _) in TUBE_KEYS.items()
        if needed and key not in found and key not in stood_for
    ]
    if missing:
        raise InputError(
            f"{', '.join(missing)} is missing" if len(missing) == 1 else f"{', '.join(missing)} are missing",
            do=f"{missing[0]} is the {TUBE_KEYS[missing[0]][2]}",
            where=where,
        )
    return name, found


def robot_from_sheet(sheet: Sheet) -> Robot:
    """The robot of a sheet, validated.

    Radii are exact in a robot file; what a deviation of a diameter does to stiffness and mass is therefore added to the
    deviations of Young's modulus and density (first order: sigma_I / I = 4 sqrt(sum r^6 sigma_r^2) / (ro^4 - ri^4)).

    Raises:
        InputError: data that no robot can have; the key, the value and the limit are named.
    """
    tubes = [_tube(name, data, number) for number, (name, data) in enumerate(sheet.tubes, 1)]
    if sheet.tip_diameter.value and not sheet.tip_mass.value:
        raise InputError(
            "a diameter is given and no mass", do="give the mass, or leave both out", where="body at the tip"
        )
    if sheet.tip_mass.value:
        r = sheet.tip_diameter.value / 2
        inertia = _short(0.4 * sheet.tip_mass.value * r * r)
        tubes[0]["end_body"] = {
            "mass": sheet.tip_mass.quantity("kg"),
            "inertia": {"value": [inertia] * 3, "unit": "kg m^2"},
        }
    count = len(tubes)
    sign, axis = sheet.gravity[:1], sheet.gravity[1:]
    if sign not in ("+", "-") or axis not in AXES:
        raise InputError(
            f"direction of gravity '{sheet.gravity}'", do="write +x, -x, +y, -y, +z or -z", where="gravity"
        )
    weight = [0.0, 0.0, 0.0]
    weight[AXES[axis]] = math.copysign(GRAVITY, -1.0 if sign == "-" else 1.0)
    beta = [_short(b.value) for b in sheet.beta] or [_short(-0.01 * (count - 1 - i)) for i in range(count)]
    alpha = [_short(a.value) for a in sheet.alpha] or [0.0] * count
    if len(sheet.lever_arm) != 3:
        raise InputError(f"{len(sheet.lever_arm)} numbers", do="give x, y, z", where="lever arm")
    position, rotation = sheet.registration_sigma
    data = {
        "name": sheet.name,
        "gravity": {"value": weight, "unit": "m/s^2", "direction_tolerance": _short(math.radians(0.2))},
        "tubes": tubes,
        "friction": FRICTION,
        "encoders": {
            "offset": {"value": 0.0, "unit": "rad", "tolerance": _short(sheet.encoder_sigma.value)},
            "noise": {"value": _short(math.radians(0.012)), "unit": "rad"},
        },
        "tracker": {
            "registration": {
                "value": sheet.registration,
                "unit": "m",
                "tolerance": _short(position),
                "rotation_tolerance": _short(rotation),
            },
            "lever_arm": {
                "value": [_short(part.value) for part in sheet.lever_arm],
                "unit": "m",
                "tolerance": [_short(part.sigma) for part in sheet.lever_arm],
            },
            "delay": sheet.delay.quantity("s"),
            "noise": {
                "position": Measured(sheet.position_noise.value).quantity("m"),
                "rotation": Measured(sheet.rotation_noise.value).quantity("rad"),
                "drift": {"value": _short(sheet.position_noise.value / 4), "unit": "m"},
                "drift_time": {"value": 2.0, "unit": "s"},
            },
        },
        "rest": {"beta": {"value": beta, "unit": "m"}, "alpha": {"value": alpha, "unit": "rad"}},
        "extensions": {},
    }
    tracker: dict[str, Any] = data["tracker"]  # type: ignore[assignment]
    if sheet.mount:
        tracker["mount_rotation"] = {"value": [_short(part.value) for part in sheet.mount], "unit": "rad"}
    if sheet.axes:
        tracker["axes"] = sheet.axes
    return robot_from_dict(data, f"robot '{sheet.name}'")


def matrix_from_text(text: str, where: str) -> tuple[tuple[float, ...], ...]:
    """Four rows of the 16 numbers in ``text``, which blanks, commas or semicolons separate.

    Raises:
        InputError: not so many numbers.
    """
    words = text.replace(",", " ").replace(";", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise InputError(f"{error}", do="write 16 numbers, row by row", where=where) from None
    if len(numbers) != 16:
        raise InputError(
            f"{len(numbers)} numbers, expected 16", do="write [R t; 0 0 0 1] row by row", where=where
        )
    return tuple(tuple(numbers[i : i + 4]) for i in range(0, 16, 4))


def _tube(name: str, data: Mapping[str, Measured], number: int) -> dict[str, Any]:
    where = f"tube {number}"
    outer, inner = data["od"], data["id"]
    ro, ri, so, si = outer.value / 2, inner.value / 2, outer.sigma / 2, inner.sigma / 2
    if not 0 <= ri < ro:
        raise InputError(
            f"id {1e3 * inner.value:g} mm is not below od {1e3 * outer.value:g} mm",
            do="check both",
            where=where,
        )
    bending = 4 * math.hypot(ro**3 * so, ri**3 * si) / (ro**4 - ri**4)
    area = 2 * math.hypot(ro * so, ri * si) / (ro**2 - ri**2)
    second_moment = math.pi / 4 * (ro**4 - ri**4)
    modulus = _modulus(data, "E", "EI", second_moment, bending)
    density = Measured(
        data["density"].value, data["density"].value * math.hypot(data["density"].relative, area)
    )
    segments = []
    if data["straight"].value:
        segments.append(
            {
                "length": data["straight"].quantity("m"),
                "curvature": {"value": [0.0, 0.0, 0.0], "unit": "1/m"},
            }
        )
    curved = data.get("curved", Measured(0.0))
    if curved.value:
        size = _curvature(data, where)
        curvature = {"value": [_short(size.value), 0.0, 0.0], "unit": "1/m"}
        if size.sigma:
            curvature["tolerance"] = [_short(size.sigma), 0.0, 0.0]
        segments.append({"length": curved.quantity("m"), "curvature": curvature})
    damping = data.get("damping", Measured(0.0)).quantity("N m^2 s")
    tube: dict[str, Any] = {
        "name": name,
        "inner_radius": Measured(ri).quantity("m"),
        "outer_radius": Measured(ro).quantity("m"),
        "youngs_modulus": modulus.quantity("Pa"),
        "density": density.quantity("kg/m^3"),
        "bending_damping": damping,
        "torsion_damping": damping,
        "precurvature": segments,
    }
    if "G" in data or "GJ" in data:
        tube["shear_modulus"] = _modulus(data, "G", "GJ", 2 * second_moment, bending).quantity("Pa")
    return tube


def _modulus(
    data: Mapping[str, Measured], key: str, stiffness: str, second_moment: float, bending: float
) -> Measured:
    """Young's or shear modulus in Pa: as given, with what the diameters add to the stiffness, or from a ``stiffness`` that was measured itself."""
    if stiffness in data:
        given = data[stiffness]
        return Measured(given.value / second_moment, given.sigma / second_moment)
    return Measured(data[key].value, data[key].value * math.hypot(data[key].relative, bending))


def _curvature(data: Mapping[str, Measured], where: str) -> Measured:
    """Curvature of the precurved part in 1/m, from itself or from the bend radius."""
    if "curvature" in data:
        return data["curvature"]
    if "radius" not in data:
        raise InputError("curved is given and radius is not", do="give the bend radius", where=where)
    radius = data["radius"]
    if not radius.value:
        raise InputError(
            "radius 0 mm is none",
            do="give that of the centre line; leave curved out for a straight tube",
            where=where,
        )
    return Measured(1 / radius.value, abs(radius.relative / radius.value))


def rest_assumed(sheet: Sheet) -> list[str]:
    """What of the rest position is assumed, as the ``sheet`` does not say it."""
    said = {"Rest position: bases 10 mm apart": sheet.beta, "Rest angles: zero": sheet.alpha}
    return [f"{text}, as none was given." for text, given in said.items() if not given]


def robot_file_text(robot: Robot, said: Sequence[str]) -> str:
    """Text of the robot file, with `said` (what was assumed) as comments at its head."""
    head = [
        "SI units and radians; tolerances are standard deviations. Tubes innermost first; arc lengths from a tube's own base,",
        "curvatures in its own frame. Where shear_modulus is not given, G = E / (2 (1 + 0.3)).",
        *said,
    ]
    return "".join(f"# {line}\n" for line in head) + robot_to_yaml(robot)


ASSUMED = (
    "Assumed, not measured: friction (Till et al. 2020, Table III, 50 %), drift of the tracker (a quarter of its noise over 2 s),",
    "direction of gravity within 0.2 deg. Deviations of the diameters are contained in those of the moduli and of density.",
)
