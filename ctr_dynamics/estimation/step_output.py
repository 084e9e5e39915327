"""What the estimator gives out: plain numbers, no ROS types."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

OK, WARN, ERROR = 0, 1, 2
FUSION_OFF = "fusion is off"
UNKNOWN_DELAY = "the tracker is late by a time that is not known yet"
DOUBTED_LOAD = "the robot does not seem to bear the known load"
MOVING_FRAME = "the frame of the tracker moves"
NOT_FUSED = FUSION_OFF, UNKNOWN_DELAY, MOVING_FRAME, DOUBTED_LOAD  # reasons that are no outliers


class Modes(NamedTuple):
    """Slowest vibration modes.

    Attributes:
        frequency_hz, damping: (m,) Hz and damping ratio.
        amplitude: (m,) m, of the tip's motion along the direction, from the equilibrium at the present actuators and load.
        rate: (m,) m/s, time derivative of the amplitude.
        direction: (m, 3) unit, of the tip's motion, ``ctr_base``; continuous in sign while the robot moves.
    """

    frequency_hz: Floats
    damping: Floats
    amplitude: Floats
    rate: Floats
    direction: Floats

    @classmethod
    def none(cls) -> Modes:
        """No modes known."""
        empty = np.zeros(0)
        return cls(empty, empty, empty, empty, np.zeros((0, 3)))


class MotionPoint(NamedTuple):
    """The open-loop run at a measurement's own time, ``ctr_base``, SI units.

    Attributes:
        residual: (3,) m, measured minus open-loop position.
        position, velocity, acceleration: (3,) m, m/s, m/s^2; quaternion: (4,) wxyz, of the tip.
        alpha, alpha_rate, beta_rate: (n,) rad, rad/s, m/s.
    """

    residual: Floats
    position: Floats
    quaternion: Floats
    velocity: Floats
    acceleration: Floats
    alpha: Floats
    alpha_rate: Floats
    beta_rate: Floats


class Innovation(NamedTuple):
    """A processed tracker measurement.

    Attributes:
        stamp_ns: of its header.
        residual, variance: (6,) measured minus expected and its predicted variance: position m in the tracker's axes, rotation rad in the sensor's.
        nis, dof: normalised innovation squared and its degrees of freedom; 0 where it could not be compared.
        accepted: whether it was fused; reason: why not, or how.
        delay_s: how late it came.
        white: (6,) whitened residual.
        motion: the open-loop run at its time; fused_residual: (3,) m, measured minus the fused tip that was published for its time. Both are None
            where no tip of that time is stored.
    """

    stamp_ns: int
    residual: Floats
    variance: Floats
    nis: float
    dof: int
    accepted: bool
    delay_s: float
    reason: str = ""
    white: Floats | None = None
    motion: MotionPoint | None = None
    fused_residual: Floats | None = None


class SolverStats(NamedTuple):
    """Work of one step."""

    iterations: int
    sweeps: int
    outcome: str


NO_WORK = SolverStats(0, 0, "")
NO_JACOBIAN = np.zeros((6, 0))


class StepOutput(NamedTuple):
    """Everything that is published for one stamp; ``ctr_base``, SI units.

    Attributes:
        tip_position (3,), tip_quaternion_wxyz (4,), tip_covariance (6, 6): x, y, z, rx, ry, rz about the base axes.
        tip_velocity (6,): d/dt of the tip point (insertion included) and angular velocity, with its covariance (6, 6).
        predicted_position, predicted_quaternion_wxyz: the open-loop run, never corrected.
        backbone: float32 (P, 15): s, x, y, z, qx, qy, qz, qw, vx, vy, vz, ux, uy, uz, sd.
        disturbance_force, disturbance_sigma (3,): N, base axes.
        beta: (n,) m, translations of the tubes; empty where they are not known.
        jacobian: (6, 2N + 6) of the tip, position then rotation, by alpha, beta, force and torque at rest; (6, 0) before it is known.
    """

    stamp_ns: int
    k: int
    valid: bool
    reason: str
    tip_position: Floats
    tip_quaternion_wxyz: Floats
    tip_covariance: Floats
    tip_velocity: Floats
    tip_velocity_covariance: Floats
    predicted_position: Floats
    predicted_quaternion_wxyz: Floats
    backbone: NDArray[np.float32]
    modes: Modes
    disturbance_force: Floats
    disturbance_sigma: Floats
    innovations: Sequence[Innovation] = ()
    solver: SolverStats = NO_WORK
    beta: Sequence[float] = ()
    jacobian: Floats = NO_JACOBIAN

    @classmethod
    def invalid(cls, stamp_ns: int, k: int, reason: str, innovations: list[Innovation]) -> StepOutput:
        """A stamp without an estimate: every number is NaN, the backbone empty."""
        nan3, nan4, nan6 = np.full(3, np.nan), np.full(4, np.nan), np.full(6, np.nan)
        return cls(
            stamp_ns, k, False, reason, nan3, nan4, np.full((6, 6), np.nan), nan6, np.full((6, 6), np.nan), nan3, nan4,
            np.zeros((0, 15), np.float32), Modes.none(), nan3, nan3, innovations, SolverStats(0, 0, reason),
        )  # fmt: skip


@dataclass(frozen=True)
class Status:
    """One line of health: level 0 ok, 1 warning, 2 error."""

    name: str
    level: int
    message: str
    values: dict[str, str]
