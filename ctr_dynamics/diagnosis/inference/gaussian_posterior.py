"""Bayes' rule for linear models with Gaussian noise and priors; numerics directions are free beside the parameters.

The model is y = J d + N e + noise of unit variance. d are departures from the values of the robot file, with variances as priors; e are
sizes of the discretisation error with unit prior variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.effects import EffectQuantity

Floats = NDArray[np.float64]


def prior_variance(quantity: EffectQuantity, cause: bool, factor: float = 1.0) -> float:
    """Of a coordinate: the square of ``factor`` tolerances, plus scale^2 where it may be a cause."""
    return (factor * quantity.tolerance) ** 2 + (quantity.scale**2 if cause else 0.0)


def variances(
    nuisances: Sequence[EffectQuantity], causes: Sequence[EffectQuantity], factor: float = 1.0
) -> tuple[tuple[EffectQuantity, ...], Floats]:
    """Free quantities and their prior variances: nuisances, then causes that are none; ``factor`` on all tolerances."""
    active = list(nuisances)
    names = {q.key for q in nuisances}
    active += [q for q in causes if q.key not in names]
    wide = {q.key for q in causes}
    return tuple(active), np.array([prior_variance(q, q.key in wide, factor) for q in active])


def tail_gain(causes: Sequence[EffectQuantity], departure: Sequence[float]) -> float:
    """Log density of Cauchy's distribution over the normal one, of the causes whose size nothing bounds.

    Their prior has the same scale, but departures of many times that are rare and not impossible. The steps of a fit take it for a normal one:
    where the data speak of so large a departure, they are much narrower than either.
    """
    total = 0.0
    for q, d in zip(causes, departure, strict=True):
        if q.parameter.unbounded:
            z2 = d**2 / prior_variance(q, True)
            total += 0.5 * math.log(2.0 / math.pi) - math.log1p(z2) + 0.5 * z2
    return total


def half_gaussian_gain(departure: Floats, covariance: Floats, one_sided: Sequence[bool]) -> float:
    """Log evidence of half-Gaussian priors over that of Gaussian ones: twice the density, and only the part of the posterior with departures
    above zero.

    Args:
        departure: (a,) likeliest ones by the Gaussian priors. covariance: (a, a) of their posterior.
        one_sided: (a,) which priors are half.
    """
    total = 0.0
    for i in np.flatnonzero(one_sided):
        deviation = math.sqrt(max(covariance[i, i], 1e-30))
        total += math.log(2.0) + float(log_ndtr(departure[i] / deviation))
    return total


def posterior(
    residual: Floats, columns: Floats, departure: Floats, variance: Floats, numerics: Floats
) -> tuple[Floats, Floats, float]:
    """One linear step: new departures (a,), their covariance (a, a), and the log evidence.

    Args:
        residual: (m,) whitened, at the present ``departure`` (a,).
        columns: (m, a) derivatives of the prediction.
        variance: (a,) of the priors.
        numerics: (m, d).
    """
    count = len(variance)
    J = np.hstack([columns, numerics])
    deviation = np.sqrt(np.concatenate([variance, np.ones(J.shape[1] - count)]))
    target = residual + columns @ departure
    mean, covariance, gain = posterior_of_information(J.T @ J, J.T @ target, deviation)
    return mean[:count], covariance[:count, :count], gain - 0.5 * float(target @ target)


def posterior_of_information(
    information: Floats, score: Floats, deviation: Floats
) -> tuple[Floats, Floats, float]:
    """Departures (a,) from zero, their covariance (a, a), and the log evidence relative to no departure.

    Args:
        information: (a, a) of the data. score: (a,) derivatives of the log likelihood, both at no departure.
        deviation: (a,) of the priors.
    """
    A = np.eye(len(deviation)) + deviation[:, None] * information * deviation
    factor = np.linalg.cholesky(A)
    half = np.linalg.solve(factor, deviation * score)
    evidence = 0.5 * float(half @ half) - float(np.log(np.diag(factor)).sum())
    covariance = deviation[:, None] * np.linalg.inv(A) * deviation
    return deviation * np.linalg.solve(factor.T, half), covariance, evidence


def cost(residual: Floats, departure: Floats, variance: Floats, numerics: Floats) -> float:
    """Twice the negative log posterior, with the numerics directions at their best."""
    rhs = numerics.T @ residual
    free = float(rhs @ np.linalg.solve(np.eye(numerics.shape[1]) + numerics.T @ numerics, rhs))
    return float(residual @ residual) - free + float(np.sum(departure**2 / variance))


def numerics_part(residual: Floats, numerics: Floats) -> Floats:
    """(m,) part of a residual that the numerics directions explain at their best."""
    return numerics @ np.linalg.solve(
        np.eye(numerics.shape[1]) + numerics.T @ numerics, numerics.T @ residual
    )


def within_tolerance(
    active: Sequence[EffectQuantity],
    causes: set[Key],
    departure: Floats,
    covariance: Floats,
    limit: float,
    factor: float = 1.0,
) -> float:
    """Log probability that the nuisances lie within ``limit`` times ``factor`` tolerances, over that before the data.

    A tolerance is the deviation of normal errors; what lies far outside is no error of tolerance, however little it adds to the evidence.
    """
    total, before = 0.0, float(log_ndtr(limit))
    for i, q in enumerate(active):
        if q.key in causes or q.tolerance <= 0.0:
            continue
        tolerance = factor * q.tolerance
        sigma = math.sqrt(max(covariance[i, i], 0.0)) / tolerance + 1e-9
        z = departure[i] / tolerance
        tail = log_ndtr((limit - z) / sigma) if z > 0.0 else log_ndtr((limit + z) / sigma)
        total += float(tail) - before
    return total
