"""Tolerances of the robot file as stated, or all of them too tight by one unknown factor, as a mixture of priors.

In: a linear model at a fit. Out: the evidence of every factor on the tolerances, and the departures that it leads to. A cause competes with
tolerances that are too tight this way: what many small departures explain as well needs no cause.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.diagnosis.inference.gaussian_posterior import posterior_of_information, within_tolerance
from ctr_dynamics.effects import EffectQuantity

Floats = NDArray[np.float64]


class UnderFactor(NamedTuple):
    """One factor on all tolerances: its log weight, prior times evidence, relative to the evidence of one factor; and where the fit goes with
    it, departures (a,) from the file with covariance (a, a)."""

    factor: float
    log_weight: float
    departure: Floats
    covariance: Floats


def under_factors(
    active: Sequence[EffectQuantity],
    causes: set[Key],
    residual: Floats,
    columns: Floats,
    departure: Floats,
    numerics: Floats,
    options: DiagnosisOptions,
    *,
    relative_to: float = 1.0,
) -> list[UnderFactor]:
    """Every factor of the options, the first of them 1.

    Args:
        causes: keys of those of ``active`` that are causes; their plausible sizes do not grow.
        relative_to: the one of the factors whose evidence counts as 0.
        residual: (m,) whitened, at ``departure`` (a,). columns: (m, a) derivatives of the prediction. numerics: (m, d).
    """
    o, count = options.tolerances, len(active)
    J = np.hstack([columns, numerics])
    information, score = J.T @ J, J.T @ (residual + columns @ departure)
    tolerance = np.array([q.tolerance for q in active])
    scale = np.array([q.scale if q.key in causes else 0.0 for q in active])
    ones = np.ones(numerics.shape[1])
    factors = np.geomspace(1.0, o.widest, o.factors)
    # the evidence is tempered later, and a prior is not
    too_tight = o.too_tight**options.evidence.temperature
    priors = np.full(len(factors), too_tight / len(factors))
    priors[0] += 1.0 - too_tight
    found = []
    for factor, prior in zip(factors, priors, strict=True):
        deviation = np.append(np.hypot(factor * tolerance, scale), ones)
        mean, covariance, evidence = posterior_of_information(information, score, deviation)
        mean, covariance = mean[:count], covariance[:count, :count]
        limit = options.calibration.tolerance_limit
        evidence += within_tolerance(active, causes, mean, covariance, limit, factor)
        found.append(UnderFactor(float(factor), evidence + math.log(prior), mean, covariance))
    one = int(np.argmin(np.abs(factors - relative_to)))
    zero = found[one].log_weight - math.log(priors[one])
    return [item._replace(log_weight=item.log_weight - zero) for item in found]


def with_factor(found: Sequence[UnderFactor], factor: float) -> UnderFactor:
    """The one of ``found`` with ``factor``, or the next to it."""
    return min(found, key=lambda one: abs(one.factor - factor))


def credible(found: Sequence[UnderFactor], own: UnderFactor) -> list[UnderFactor]:
    """``found``, or ``own`` alone where the widest factor is the likeliest: what needs more than that is not a matter of tolerances."""
    likeliest = max(found, key=lambda one: one.log_weight)
    return [own] if likeliest is found[-1] else list(found)


def log_gain(found: Sequence[UnderFactor]) -> float:
    """By which the log evidence of the mixture exceeds that of the factor to which the weights are relative."""
    return float(logsumexp([one.log_weight for one in found]))
