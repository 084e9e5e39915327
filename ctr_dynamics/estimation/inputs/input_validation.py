"""Messages on their way in: numbers that the estimator can use, or why it cannot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.effects import Plant
from ctr_dynamics.io.messages.topics import accepts_frame
from ctr_dynamics.io.messages.unit_quaternions import is_unit, norm
from ctr_dynamics.sensing.checks import Kind, rejection_texts
from ctr_dynamics.sensing.interpolation import finite, joint_order

Floats = NDArray[np.float64]


class Unusable(Exception):
    """A message that is left out: ``kind`` as the diagnostics count it, ``text`` with value, limit and what to do."""

    def __init__(self, kind: Kind | str, text: str) -> None:
        super().__init__(text)
        self.kind = kind.value if isinstance(kind, Kind) else kind
        self.text = text


def joint_values(plant: Plant, stamp_ns: int, names: Sequence[str], positions: Sequence[float]) -> Floats:
    """(2 N,) drive positions, rad and m, from a joint state's lists.

    Raises:
        Unusable: joints are missing or double, numbers are missing or not finite, or the robot cannot be there.
    """
    n = plant.n
    order = joint_order(tuple(names), n)
    if isinstance(order, str):
        raise Unusable("names", order)
    if len(positions) < len(names):
        raise Unusable(
            "positions", f"joint state has {len(positions)} positions for {len(names)} names; give one each"
        )
    value = np.array([positions[i] for i in order], dtype=float)
    if not finite(value.tolist()):
        raise Unusable(Kind.NOT_FINITE, rejection_texts.not_finite("joint state", stamp_ns))
    value = plant.actuators.forward(value)
    numbers = value.tolist()
    reason = plant.robot.actuator_problem(numbers[n:], numbers[:n])
    if reason:
        raise Unusable(Kind.OUT_OF_RANGE, f"{reason}; the joint state was left out")
    return value


def pose_values(
    stamp_ns: int, position: Sequence[float], quaternion_xyzw: Sequence[float], frame_id: str, frame: str
) -> tuple[Floats, Floats, float]:
    """Position (3,) m, unit quaternion (4,) wxyz, and the norm that it had; ``frame``: the one that is expected.

    Raises:
        Unusable: another frame, numbers that are not finite, or no unit quaternion.
    """
    if not accepts_frame(frame_id, frame):
        raise Unusable(Kind.OTHER_FRAME, rejection_texts.pose_in_other_frame(frame_id, frame))
    if not (finite(position) and finite(quaternion_xyzw)):
        raise Unusable(Kind.NOT_FINITE, rejection_texts.not_finite("pose", stamp_ns))
    x, y, z, w = quaternion_xyzw
    size = norm(quaternion_xyzw)
    if not is_unit(size):
        raise Unusable(Kind.QUATERNION, rejection_texts.no_quaternion(size))
    return np.array(position, dtype=float), np.array([w, x, y, z]) / size, size


def wrench_values(
    stamp_ns: int, force: Sequence[float], torque: Sequence[float], frame_id: str, frame: str
) -> Floats:
    """(6,) force in N and torque in N m; ``frame``: the one that is expected.

    Raises:
        Unusable: another frame, or numbers that are not finite.
    """
    if not accepts_frame(frame_id, frame):
        raise Unusable(Kind.OTHER_FRAME, rejection_texts.load_in_other_frame(frame_id, frame))
    if not (finite(force) and finite(torque)):
        raise Unusable(Kind.NOT_FINITE, rejection_texts.not_finite("load", stamp_ns))
    return np.array([*force, *torque], dtype=float)
