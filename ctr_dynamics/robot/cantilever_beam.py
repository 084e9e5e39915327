"""How a load on the tip bends a robot: a straight cantilever of piecewise constant stiffness, linear beam theory."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from ctr_dynamics.robot.schema import Robot


class Cantilever(NamedTuple):
    """Compliances of the tip, and the exposed length, m.

    Attributes:
        deflection: m/N, by a force across the robot. turn: rad/N, by that force. turn_by_moment: rad/(N m).
    """

    deflection: float
    turn: float
    turn_by_moment: float
    length: float


def cantilever(robot: Robot, translations: Sequence[float] | None = None) -> Cantilever:
    """The straight robot with its tubes at ``translations``: (N,) m; None for those at rest. All tubes that are there share the moment."""
    at = robot.rest.beta.value if translations is None else translations
    ends = [max(tube.length + beta, 0.0) for tube, beta in zip(robot.tubes, at, strict=True)]
    stiffness = [tube.bending_stiffness for tube in robot.tubes]
    length = max(ends)
    deflection = turn = turn_by_moment = 0.0
    for start, end in pairwise(sorted({0.0, *ends})):
        bending = sum(k for k, reach in zip(stiffness, ends, strict=True) if reach >= end)
        deflection += ((length - start) ** 3 - (length - end) ** 3) / (3.0 * bending)
        turn += 0.5 * ((length - start) ** 2 - (length - end) ** 2) / bending
        turn_by_moment += (end - start) / bending
    return Cantilever(deflection, turn, turn_by_moment, length)
