"""Discrepancy: what a model leaves as a correlated process of unknown size, whose evidence competes with that of causes.

In: fits of a problem. Out: for each, the log evidence with a discrepancy over that without, its size and its correlation time. The
discrepancy is an Ornstein-Uhlenbeck process on every axis; Kennedy and O'Hagan (2001) argue for such a term. Positions have one size, and
rotations turn with them as the tip of a cantilever does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_ndtr, logsumexp

from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.gaussian_posterior import posterior, variances, within_tolerance
from ctr_dynamics.diagnosis.inference.map_fit import Fit

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Discrepancy:
    """Posterior of a discrepancy beside one fit.

    Attributes:
        log_bayes: log evidence with it over that without, averaged over its size and correlation time.
        rms_m: 3-D, of its positions. correlation_time_s: at which it has fallen to 1/e.
        covariance: (a, a) of the fit's coordinates, with it.
    """

    log_bayes: float
    rms_m: float
    correlation_time_s: float
    covariance: Floats


class CorrelatedNoise:
    """Eigenvectors of the whitened covariance of a process of unit size (m) with one correlation time, where it is diagonal.

    Args:
        time: correlation time in s.
    """

    def __init__(self, problem: Problem, time: float) -> None:
        # rad at the tip of a cantilever for each m of its deflection
        turn = 1.5 / problem.robot.exposed_length
        self.time = time
        self._axes: list[tuple[Floats, Floats]] = []
        for forward_model, whiten in zip(problem.forward_models, problem.whiteners, strict=True):
            t = forward_model.recording.stamps[whiten.used]
            process = np.exp(-np.abs(t[:, None] - t[None]) / time)
            kinds = {True: whiten.covariance(process, position=True)}
            if whiten.mask[3:].any():
                kinds[False] = turn**2 * whiten.covariance(process, position=False)
            turned = {kind: np.linalg.eigh(matrix) for kind, matrix in kinds.items()}
            self._axes += [turned[bool(axis < 3)] for axis in np.flatnonzero(whiten.mask)]
        self.variance = np.maximum(np.concatenate([size for size, _ in self._axes]), 0.0)

    def __call__(self, whitened: Floats) -> Floats:
        """(m, ...) in the axes of the eigenvectors."""
        parts, start = [], 0
        for size, vectors in self._axes:
            parts.append(vectors.T @ whitened[start : start + len(size)])
            start += len(size)
        return np.concatenate(parts)


def discrepancy_of(problem: Problem, fit: Fit, processes: list[CorrelatedNoise]) -> Discrepancy:
    """Evidence of a discrepancy beside ``fit``, with its size and one of the correlation times of ``processes``."""
    o = problem.options.discrepancy
    noise = max(problem.robot.tracker.noise.position.value, 1e-6)
    low, high = math.log(o.smallest * noise), math.log(o.largest * noise)
    found = []
    plain = None
    for process in processes:
        model = _Linear(problem, fit, process)
        if plain is None:
            plain = model.log_evidence(0.0)[0]

        def worse(log_size: float, model: _Linear = model) -> float:
            return -model.log_evidence(math.exp(log_size))[0]

        best = minimize_scalar(worse, bounds=(low, high), method="bounded", options={"xatol": 0.02})
        at, h = float(best.x), 0.05
        curvature = (worse(at + h) + worse(at - h) - 2.0 * float(best.fun)) / h**2
        width = min(math.sqrt(2.0 * math.pi / max(curvature, 1e-6)), high - low)
        found.append((-float(best.fun) + math.log(width / (high - low)), at, model))
    assert plain is not None
    logs = np.array([log for log, _, _ in found])
    weights = np.exp(logs - logsumexp(logs))
    size = math.exp(float(weights @ [at for _, at, _ in found]))
    time = math.exp(float(weights @ np.log([p.time for p in processes])))
    _, at, model = found[int(np.argmax(logs))]
    covariance = model.log_evidence(math.exp(at))[1]
    average = float(logsumexp(logs)) - math.log(len(processes))
    return Discrepancy(average - plain, math.sqrt(3.0) * size, time, covariance)


class _Linear:
    """A fit as a linear model, in the axes in which the discrepancy is diagonal."""

    def __init__(self, problem: Problem, fit: Fit, process: CorrelatedNoise) -> None:
        self.fit, self.process, self.options = fit, process, problem.options
        self.residual, self.columns = process(fit.residual), process(fit.columns)
        self.numerics = process(problem.numerics)
        keys = {q.key for q in fit.causes}
        others = [q for q in fit.active if q.key not in keys]
        active, variance = variances(others, fit.causes)
        by_key = {q.key: v for q, v in zip(active, variance, strict=True)}
        self.variance = np.array([by_key[q.key] for q in fit.active])
        self.departure = fit.values - np.array([q.off for q in fit.active])

    def log_evidence(self, size: float) -> tuple[float, Floats]:
        """Log evidence up to a constant, and covariance (a, a) of the coordinates, with a discrepancy of ``size`` (m)."""
        scale = 1.0 / np.sqrt(1.0 + size**2 * self.process.variance)
        departure, covariance, evidence = posterior(
            self.residual * scale,
            self.columns * scale[:, None],
            self.departure,
            self.variance,
            self.numerics * scale[:, None],
        )
        evidence += float(np.log(scale).sum())
        wide = {q.key for q in self.fit.causes}
        limit = self.options.calibration.tolerance_limit
        evidence += within_tolerance(self.fit.active, wide, departure, covariance, limit)
        for i, q in enumerate(self.fit.active):
            if q.key in wide and q.one_sided:
                deviation = math.sqrt(max(covariance[i, i], 1e-30))
                evidence += math.log(2.0) + float(log_ndtr(departure[i] / deviation))
        return evidence, covariance
