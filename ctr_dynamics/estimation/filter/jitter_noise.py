"""What stamps that scatter do to a measurement.

A stamp that is off by tau shows -v tau + a tau^2 / 2, with the measurement's velocity v and acceleration a.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.variance_likelihood import position_density

Floats = NDArray[np.float64]


class Jittered(NamedTuple):
    """An innovation (k,) and its covariance ``S`` (k, k) with jitter, which makes ``extra_noise`` (k, k) of it; ``half_jitter_gain`` as in
    :class:`~ctr_dynamics.estimation.filter.filter_records.Update`."""

    nu: Floats
    S: Floats
    extra_noise: Floats
    half_jitter_gain: float


def with_jitter(
    nu: Floats, S: Floats, R: Floats, deviation: float, velocity: Floats, earlier: Floats, dt: float
) -> Jittered:
    """An innovation ``nu`` (k,) of covariance ``S`` and stated noise ``R`` (k, k), where stamps scatter by ``deviation`` (s).

    ``velocity`` (k,): of the measurement in time; ``earlier``: ``dt`` (s) before.
    """
    acceleration = (velocity - earlier) / dt
    half, part = jitter_noise(0.5 * deviation, velocity, acceleration)
    mean, extra_noise = jitter_noise(deviation, velocity, acceleration)
    late, total = nu - mean, S + extra_noise
    half_jitter_gain = position_density(nu - half, S + part, R) - position_density(late, total, R)
    return Jittered(late, total, extra_noise, half_jitter_gain)


def jitter_noise(deviation: float, velocity: Floats, acceleration: Floats) -> tuple[Floats, Floats]:
    """Mean (k,) and covariance (k, k) of what stamps that scatter by ``deviation`` (s) do to a measurement of these derivatives (k,) in time."""
    variance = deviation**2
    covariance: Floats = variance * np.multiply.outer(velocity, velocity)
    covariance += 0.5 * variance**2 * np.multiply.outer(acceleration, acceleration)
    return 0.5 * variance * acceleration, covariance
