"""What estimator, diagnosis and simulation ask of a sensor, and the kinds of sensors there are.

A further kind of sensor is one class with the methods of :class:`Measurement`, entered into ``SENSORS``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
At = Callable[[Floats], Floats]  # rows (s, c) at times (s,) in s


class Tip(NamedTuple):
    """Pose and twist of tube 1's end in ``ctr_base`` at one time, with the first variation by the coefficients of the covariance factor.

    Attributes:
        stamp: s from the first step.
        mean: (13,) position, quaternion, velocity and rate in one vector, of which these are parts:
        position (3,) m, quaternion (4,) wxyz, velocity (3,) m/s (insertion included), rate (3,) rad/s (base axes).
        columns: (12, r): position, rotation vector (base axes), velocity, angular velocity by every coefficient.
    """

    stamp: float
    mean: Floats
    columns: Floats

    @property
    def position(self) -> Floats:
        return self.mean[0:3]

    @property
    def quaternion(self) -> Floats:
        return self.mean[3:7]

    @property
    def velocity(self) -> Floats:
        return self.mean[7:10]

    @property
    def rate(self) -> Floats:
        return self.mean[10:13]


class Measurement(Protocol):
    """A kind of sensor: from the robot to measurements (forward), back (inverse), and what a small change of the robot does to them (derivative).

    Stamps are those of the sensor's clock, times those of the robot, both in s. A sensor with states of its own (a registration, a bias) lists
    them in ``STATE_NAMES``, as the estimator carries them.
    """

    @property
    def delay(self) -> float:
        """By how much its measurements are older than their stamps, s."""
        ...

    @classmethod
    def of_robot(cls, robot: Robot) -> Any:
        """The sensor that a robot file describes, without the file's extensions."""
        ...

    def observed_times(self, stamps: Floats) -> Floats:
        """Times (s,) of the robot that measurements of ``stamps`` (s,) show."""
        ...

    def forward(self, stamps: Floats, tip_at: At) -> tuple[Floats, ...]:
        """Measurements of ``stamps`` (s,), without noise, when ``tip_at`` gives the tip (s, 7) at any times."""
        ...

    def derivative(self, stamps: Floats, tip_at: At, columns_at: At) -> Floats:
        """Derivatives (s, k, r) of the k numbers of a measurement by r parameters; ``columns_at`` gives those of the tip, (s, 7 r)."""
        ...

    def innovation(
        self, bias: Floats, tip: Tip, pi: Floats, *measurement: Floats
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Innovation (k,), its derivative H (k, r + states), covariance S (k, k), and the whitened innovation (k,).

        ``pi``: covariance of the columns' coefficients and of the sensor's states ``bias``.
        """
        ...


SENSORS: dict[str, type[Measurement]] = {}
"""Kinds of sensors by the name of their block in a robot file."""
