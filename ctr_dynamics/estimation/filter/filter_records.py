"""What goes into the filter and what comes out of it: options, the outcome of an update, the fused tip, and the state for a checkpoint."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.adapted_variances import AdaptedState
from ctr_dynamics.estimation.filter.covariance_factor import FactorState
from ctr_dynamics.estimation.filter.factor_schedule import ScheduleState
from ctr_dynamics.estimation.filter.gating import GateOptions
from ctr_dynamics.estimation.filter.tip_window import TipWindowState
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FilterOptions:
    """Tuning of the filter; the parameter table says what each means.

    ``parameter_energy`` is the weight of the parameters in the energy norm, in units of their priors, by the fields' mean. It is small,
    so that a reduction is decided by what moves the robot.
    """

    rank: int = 24
    force_sigma: float = 0.0
    force_sigma_max: float = 0.0
    force_change: float = 20.0
    force_time: float = 0.3
    window: float = 0.2
    gate: GateOptions = field(default_factory=GateOptions)
    parameter_energy: float = 0.1


class ModelErrorSize(NamedTuple):
    """Deviations per axis of ``position`` (m) and ``rotation`` (rad) of the tip from where the model has it, and their correlation ``time`` (s)."""

    position: float
    rotation: float
    time: float

    @classmethod
    def of_robot(cls, robot: Robot) -> ModelErrorSize:
        """What the robot file states, or none."""
        stated = robot.model_error
        if stated is None:
            return cls(0.0, 0.0, 1.0)
        return cls(stated.position.value, stated.rotation.value, stated.time.value)


class Update(NamedTuple):
    """The outcome of one tracker measurement.

    Attributes:
        residual: (6,) measured minus expected, position m in the tracker's axes, rotation rad in the sensor's.
        variance: (6,) its predicted variance. nis, dof: normalised innovation squared and its degrees of freedom.
        accepted: whether it was fused. reason: why not, or how.
        white: (6,) residual by the inverse root of its covariance. NaN on axes that are not measured, here and in the others.
        predictive: logarithm of the density of the measured position by what was known before it, and by the variances that it led to; 0 is that of
            the stated noise at its middle. None where it was not compared.
        half_jitter_gain: logarithm of that density with half the jitter that is counted on, less that with all of it.
    """

    residual: Floats
    variance: Floats
    nis: float
    dof: int
    accepted: bool
    reason: str
    white: Floats
    predictive: tuple[float, float] | None = None
    half_jitter_gain: float = 0.0

    @classmethod
    def impossible(cls, reason: str) -> Update:
        """A measurement that cannot be compared with anything."""
        unknown = np.full(6, np.nan)
        return cls(unknown, unknown, math.nan, 0, False, reason, unknown)


class TipComparison(NamedTuple):
    """A measurement against the tip of its time.

    Attributes:
        nu: (k,) innovation. H: (k, r + 22) its derivative. S: (k, k) its covariance. extra_noise: (k, k), what of that is by jitter and by an
            uncertain response.
        record: of the measurement.
    """

    nu: Floats
    H: Floats
    S: Floats
    extra_noise: Floats
    record: Update


class TipEstimate(NamedTuple):
    """Fused tip: position (3,) m, quaternion (4,) wxyz, twist (6,), covariance (12, 12) of pose and twist (base axes); deviation (3,) of the
    estimated tip force, N; and whether all is finite."""

    position: Floats
    quaternion: Floats
    twist: Floats
    covariance: Floats
    force_sigma: Floats
    finite: bool

    @property
    def position_deviation(self) -> float:
        """m, root of the trace of the position's covariance."""
        covariance = self.covariance
        return math.sqrt(max(covariance[0, 0] + covariance[1, 1] + covariance[2, 2], 0.0))


class FilterState(NamedTuple):
    """What a checkpoint stores of a :class:`RodEkf`, part by part."""

    theta: Floats
    bias: Floats
    pi: Floats
    adapted: AdaptedState
    rejections: int
    schedule: ScheduleState
    factor: FactorState
    tips: TipWindowState
    refuted: bool
