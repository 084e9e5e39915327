"""How well positions are predicted: logarithms of densities, by that of the tracker's stated noise at zero."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ctr_dynamics import chi_square


def log_density(square: Any, variance: Any, noise: float) -> Any:
    """Logarithm of a normal density of three axes, of ``variance`` (m^2) each, at a squared distance ``square`` (m^2), by that of ``noise`` at 0."""
    return -0.5 * (square / variance + 3.0 * np.log(variance / noise))


def log_changed(elapsed_s: float, every_s: float) -> float:
    """Logarithm of the probability that what changes every ``every_s`` seconds in the mean has changed in ``elapsed_s``."""
    return math.log(-math.expm1(-elapsed_s / every_s))


def student_peak(freedom: float) -> float:
    """Logarithm of Student's density of ``freedom`` degrees in three dimensions at zero, by that of a normal one of the same scale."""
    half = 0.5 * freedom
    return math.lgamma(half + 1.5) - math.lgamma(half) - 1.5 * math.log(half)


def density_of_filter(predictive: tuple[float, float], changes: float) -> float:
    """Logarithm of the density that a filter gave to a measured position; ``predictive``: the one with the force that it had, and with another.

    The unknown force may have met a change since the measurement before: ``changes`` are expected in that time.
    """
    known, changed = predictive
    likely = -math.expm1(-changes)
    return float(np.logaddexp(known + math.log1p(-likely), changed + math.log(likely)))


def allowance(probability: float) -> float:
    """By how much the variance grows for each squared deviation of another estimate that is right with that ``probability``.

    The other estimate must not lie farther out than a normal error of that probability, in three dimensions.
    """
    return 1.0 / chi_square.quantile(1.0 - max(probability, 1e-9), 3) if probability < 0.5 else 1.0
