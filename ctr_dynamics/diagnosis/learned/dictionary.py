"""Dictionary of the learned force: the shape of its features for one robot and its recordings, the coefficients, and the features on a known path.

In: a robot and the paths of its tip. Out: a robot whose file says the shape of the features, with all coefficients still zero, and
:class:`Features`, which are those of the effect (:mod:`ctr_dynamics.effects.learned_force`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.effects import EffectQuantity, effect_quantities
from ctr_dynamics.effects.learned_force import AXES
from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import robot_from_dict, robot_to_dict

Floats = NDArray[np.float64]
EFFECT = "learned_force"
DRY_SPEED = 0.05  # of the rms speed: at which dry friction turns, slow against what the bags show


def has_learned(robot: Robot) -> bool:
    """Whether the robot's file has a learned force already."""
    return any(value for name, value in robot.extensions.get(EFFECT, {}).items() if name.endswith("_N"))


def shaped_robot(robot: Robot, positions: Floats, speeds: Floats) -> Robot:
    """``robot`` with features that are at most one at ``positions`` (s, 3) m and of the order of one at ``speeds`` (s,) m/s."""
    origin = positions.mean(axis=0)
    length = max(float(np.linalg.norm(positions - origin, axis=1).max()), 1e-4)
    speed = max(float(np.sqrt(np.mean(speeds**2))), 1e-4)
    shape = {f"origin_{axis}_m": float(x) for axis, x in zip("xyz", origin, strict=True)}
    shape.update(length_m=length, speed_m_per_s=speed, dry_speed_m_per_s=DRY_SPEED * speed)
    data = robot_to_dict(robot)
    data.setdefault("extensions", {})[EFFECT] = shape
    return robot_from_dict(data, robot.name)


def dictionary(robot: Robot, moving: Sequence[bool]) -> list[EffectQuantity]:
    """Coefficients of all features; of the translations of the tubes (N,) only those that are ``moving``.

    Of the damping only the diagonal: its other entries may feed energy in.
    """
    skewed = ("damping_xy_N", "damping_xz_N", "damping_yz_N")
    still = {f"tube{i + 1}.slide" for i, moves in enumerate(moving) if not moves}
    return [
        q
        for q in effect_quantities(robot)
        if q.effect == EFFECT
        and not q.parameter.shape
        and q.name not in skewed
        and not any(q.name.startswith(s) for s in still)
    ]


def memory_time(robot: Robot) -> EffectQuantity:
    """The delay of the remembered position."""
    return next(q for q in effect_quantities(robot) if q.key == (EFFECT, "memory_s"))


@dataclass(frozen=True)
class Features:
    """What the terms multiply, on a path that is known: force by coefficient.

    Attributes:
        names: of the coefficients, as the effect has them; those of the memory with each delay, one after the other.
        shape: parameters of the features by name. at_rest: (N,) m, translations at rest.
    """

    names: tuple[str, ...]
    shape: Mapping[str, float]
    at_rest: Floats

    @classmethod
    def of_robot(cls, robot: Robot, names: Sequence[str]) -> Features:
        """Those of the robot's file."""
        return cls(tuple(names), robot.extensions[EFFECT], np.array(robot.rest.beta.value))

    def __call__(self, p: Floats, v: Floats, z: Sequence[Floats], alpha: Floats, beta: Floats) -> Floats:
        """(k, 3, names) of positions and velocities (k, 3) m and m/s, remembered positions (k, 3) for each delay, and actuators (k, N)."""
        length, speed, dry = (self.shape[name] for name in ("length_m", "speed_m_per_s", "dry_speed_m_per_s"))
        q = (p - np.array([self.shape[f"origin_{axis}_m"] for axis in AXES])) / length
        q = np.clip(q, -1.0, 1.0)
        r = v / speed
        quick = np.linalg.norm(r, axis=1)
        slow = 1.0 / np.sqrt(np.sum(v**2, axis=1) + dry**2)
        out = np.zeros((len(p), 3, len(self.names)))
        seen: dict[str, int] = {}
        for k, name in enumerate(self.names):
            kind, which = name.removesuffix("_N").rsplit("_", 1)
            if kind == "potential":
                powers = np.array([which.count(axis) for axis in AXES])
                for axis in np.flatnonzero(powers):
                    lower = powers - (np.arange(3) == axis)
                    out[:, axis, k] = -powers[axis] * np.prod(q**lower, axis=1)
                continue
            i, j = AXES.index(which[0]), AXES.index(which[-1])
            if kind == "constant":
                out[:, i, k] = 1.0
            elif kind == "damping":
                out[:, i, k], out[:, j, k] = -r[:, j], -r[:, i]
            elif kind == "drag":
                out[:, i, k] = -quick * r[:, i]
            elif kind == "dry":
                out[:, i, k] = -slow * v[:, i]
            elif kind == "memory":
                number = seen[name] = seen.get(name, -1) + 1
                out[:, i, k] = -(p[:, i] - z[number][:, i]) / length
            else:
                tube, what = int(kind[4]) - 1, kind.split(".")[1]
                if what == "slide":
                    out[:, i, k] = (beta[:, tube] - self.at_rest[tube]) / length
                else:
                    out[:, i, k] = (np.sin if what == "sine" else np.cos)(alpha[:, tube])
        return out
