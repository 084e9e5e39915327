"""Discrepancy: what a model leaves as a correlated process of unknown size, whose evidence competes with that of causes.

In: fits of a problem. Out: for each, the log evidence with a discrepancy, its sizes and its correlation time. The discrepancy is a Gaussian
process on every axis, with Matern's covariance; Kennedy and O'Hagan (2001) argue for such a term. It is rough (smoothness 1/2, an
Ornstein-Uhlenbeck process) or smooth (3/2, with a rate of its own, as the error of a model of a smooth motion has). Positions have one size, and
rotations another.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from joblib import delayed
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp

from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.gaussian_posterior import (
    half_gaussian_gain,
    posterior,
    tail_gain,
    variances,
    within_tolerance,
)
from ctr_dynamics.diagnosis.inference.map_fit import Fit, fit, fit_at
from ctr_dynamics.diagnosis.inference.tolerance_factors import credible, log_gain, under_factors
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.whitening import Whitener
from ctr_dynamics.effects import EffectQuantity

Floats = NDArray[np.float64]
Sizes = tuple[float, float]
"""Of positions in m, and of rotations in rad."""
ROUNDS = 4  # over both sizes
SETTLED = 0.05  # log evidence, which decides nothing
WHOLE, PART = 4000, 500  # poses that a process holds together, and parts of a longer recording: 10 s at 50 Hz
SMOOTH = 2.1461932  # root of (1 + x) exp(-x) = 1 / e


@dataclass(frozen=True)
class Discrepancy:
    """Posterior of a discrepancy beside one fit.

    Attributes:
        log_evidence: with it, averaged over its sizes and correlation time.
        rms_m: 3-D, expected of its positions given the data. correlation_time_s: at which it has fallen to 1/e.
        covariance: (a, a) of the fit's coordinates, with it.
        process, sizes: the likeliest process, and its sizes in m and rad.
        fit: that it stands beside.
    """

    log_evidence: float
    rms_m: float
    correlation_time_s: float
    covariance: Floats
    process: CorrelatedNoise
    sizes: Sizes
    fit: Fit


def correlation(lag: Floats, smooth: bool) -> Floats:
    """Matern's correlation at ``lag``, in units of that at which it is 1/e: of smoothness 3/2 or 1/2."""
    if not smooth:
        return np.asarray(np.exp(-lag))
    x = SMOOTH * lag
    return np.asarray((1.0 + x) * np.exp(-x))


def _parts(whiten: Whitener) -> list[Whitener]:
    """``whiten`` in the parts in which a process is one."""
    count = int(whiten.used.sum())
    if count <= WHOLE:
        return [whiten]
    return [whiten.part(first, first + PART) for first in range(0, count, PART)]


class CorrelatedNoise:
    """Eigenvectors of the whitened covariance of a process of unit size (m, rad) with one correlation time, where it is diagonal.

    Their memory grows with the square of the poses. In a long recording the process is therefore taken for one of its own in each part that is long
    against correlation times.

    Args:
        time: in s, at which the correlation has fallen to 1/e. smooth: whether the process has a rate.
    """

    def __init__(self, problem: Problem, time: float, smooth: bool = False) -> None:
        self.time, self.smooth = time, smooth
        self._axes: list[tuple[Floats, Floats]] = []
        of_position: list[NDArray[np.bool_]] = []
        for forward_model, whiten in zip(problem.forward_models, problem.whiteners, strict=True):
            axes = np.flatnonzero(whiten.mask)
            kinds = dict.fromkeys((axes < 3).tolist())
            turned: dict[bool, list[tuple[Floats, Floats]]] = {kind: [] for kind in kinds}
            for part in _parts(whiten):
                t = forward_model.recording.stamps[part.used]
                process = correlation(np.abs(t[:, None] - t[None]) / time, smooth)
                for kind in kinds:
                    turned[kind].append(np.linalg.eigh(part.covariance(process, position=kind)))
            for axis in axes:
                self._axes += turned[bool(axis < 3)]
                of_position.append(np.full(int(whiten.used.sum()), axis < 3))
        self.variance = np.maximum(np.concatenate([size for size, _ in self._axes]), 0.0)
        self.of_position = np.concatenate(of_position)

    def __call__(self, whitened: Floats) -> Floats:
        """(m, ...) in the axes of the eigenvectors."""
        parts, start = [], 0
        for size, vectors in self._axes:
            parts.append(vectors.T @ whitened[start : start + len(size)])
            start += len(size)
        return np.concatenate(parts)

    def undone(self, turned: Floats) -> Floats:
        """Whitened values (m, ...) of those in the axes of the eigenvectors."""
        parts, start = [], 0
        for size, vectors in self._axes:
            parts.append(vectors @ turned[start : start + len(size)])
            start += len(size)
        return np.concatenate(parts)

    def rms_m(self, problem: Problem, turned: Floats, size: float) -> float:
        """3-D rms that is expected of a process of ``size`` (m), given what is left (m,) in the axes of the eigenvectors."""
        total, start, samples, number = 0.0, 0, 0, 0
        for whiten in problem.whiteners:
            for axis in np.flatnonzero(whiten.mask):
                for part in _parts(whiten):
                    variances, vectors = self._axes[number]
                    left = turned[start : start + len(variances)]
                    start, number = start + len(variances), number + 1
                    if axis >= 3:
                        continue
                    free = size**2 * np.maximum(variances, 0.0)
                    shown = free / (1.0 + free)
                    modes = np.sum(part.positions(vectors) ** 2, axis=0)
                    total += float(np.sum(part.positions(vectors @ (shown * left)) ** 2) + modes @ shown)
            samples += int(whiten.used.sum())
        return math.sqrt(total / samples)

    def scale(self, sizes: Sizes) -> Floats:
        """(m,) factors that whiten values in the axes of the eigenvectors beside a process of these sizes."""
        squares = np.where(self.of_position, sizes[0] ** 2, sizes[1] ** 2)
        return np.asarray(1.0 / np.sqrt(1.0 + squares * self.variance))


@dataclass
class CorrelatedProblem(Problem):
    """A problem whose noise has a correlated process beside it: residuals and derivatives are white with both."""

    process: CorrelatedNoise | None = None
    scale: Floats | None = None

    @classmethod
    def of(cls, problem: Problem, process: CorrelatedNoise, sizes: Sizes) -> CorrelatedProblem:
        """``problem`` beside a process of ``sizes``."""
        given = {f.name: getattr(problem, f.name) for f in fields(Problem)}
        other = cls(**given, process=process, scale=process.scale(sizes))
        other.numerics = other.whitened(problem.numerics)
        return other

    def whitened(self, values: Floats) -> Floats:
        """(m, ...) of values (m, ...) that are white without the process."""
        assert self.process is not None
        assert self.scale is not None
        return (self.scale * self.process(values).T).T

    def undone(self, values: Floats) -> Floats:
        """The inverse of :meth:`whitened`."""
        assert self.process is not None
        assert self.scale is not None
        return self.process.undone((values.T / self.scale).T)

    def residual(self, point: Mapping[Key, float]) -> Floats | None:
        """As that of a problem."""
        found = super().residual(point)
        return None if found is None else self.whitened(found)

    def linearise(
        self, point: Mapping[Key, float], wanted: Sequence[EffectQuantity]
    ) -> tuple[Floats, Floats] | None:
        """As that of a problem."""
        found = super().linearise(point, wanted)
        return None if found is None else (self.whitened(found[0]), self.whitened(found[1]))


def as_beside(problem: CorrelatedProblem, found: Fit) -> Fit:
    """``found``, a fit of the problem without the process, as one of ``problem``."""
    return fit_at(
        problem,
        found.causes,
        found.active,
        found.values,
        problem.whitened(found.residual),
        problem.whitened(found.columns),
    )


def fit_beside(problem: Problem, fit_before: Fit, discrepancy: Discrepancy) -> Fit | None:
    """``fit_before`` again, with ``discrepancy`` as a part of the noise; as a fit of ``problem``. None where it cannot be simulated.

    White noise makes a fit follow what varies slowly, where a correlated discrepancy leaves that open and trusts what varies fast.
    """
    keys = {q.key for q in fit_before.causes}
    beside = CorrelatedProblem.of(problem, discrepancy.process, discrepancy.sizes)
    beside.nuisances = tuple(q for q in fit_before.active if q.key not in keys or q.tolerance > 0.0)
    found = fit(beside, fit_before.causes, fit_before.point, polish=False)
    local = None if found is None else problem.linearise(found.point, found.active)
    if found is None or local is None:
        return None
    return fit_at(problem, found.causes, found.active, found.values, *local)


def every_process(problem: Problem, context: RunContext) -> list[CorrelatedNoise]:
    """Rough and smooth processes with every correlation time of the options."""
    times = problem.options.discrepancy.times_s
    return context.run(
        delayed(CorrelatedNoise)(problem, time, smooth) for smooth in (False, True) for time in times
    )


def discrepancy_of(
    problem: Problem, found_fit: Fit, processes: Sequence[CorrelatedNoise], among: int | None = None
) -> Discrepancy:
    """Evidence of a discrepancy beside ``found_fit``, with its sizes and as one of the ``processes``.

    ``among``: number of all that are as likely before the data, where the others are known to contribute nothing; None stands for no others.
    """
    noise = problem.robot.tracker.noise
    o = problem.options.discrepancy
    floors = np.array([max(noise.position.value, 1e-6), max(noise.rotation.value, 1e-6)])
    found = []
    for process in processes:
        model = _Linear(problem, found_fit, process)
        found.append((*_best_sizes(model, np.log(o.smallest * floors), np.log(o.largest * floors)), model))
    logs = np.array([log for log, _, _ in found])
    weights = np.exp(logs - logsumexp(logs))
    time = math.exp(float(weights @ np.log([p.time for p in processes])))
    _, at, model = found[int(np.argmax(logs))]
    sizes = math.exp(at[0]), math.exp(at[1])
    average = float(logsumexp(logs)) - math.log(among or len(processes)) + model.wider_tolerances(sizes)
    return Discrepancy(
        average,
        model.process.rms_m(problem, model.left(sizes), sizes[0]),
        time,
        model.log_evidence(sizes)[1],
        model.process,
        sizes,
        found_fit,
    )


def refitted(problem: Problem, before: Discrepancy, among: int) -> Discrepancy:
    """``before`` beside a fit with it as a part of the noise, if that is likelier; ``among`` as for :func:`discrepancy_of`."""
    found = fit_beside(problem, before.fit, before)
    after = None if found is None else discrepancy_of(problem, found, [before.process], among)
    return before if after is None or after.log_evidence < before.log_evidence else after


def _best_sizes(model: _Linear, low: Floats, high: Floats) -> tuple[float, Floats]:
    """Log evidence averaged over the sizes between exp ``low`` (2,) and exp ``high`` (2,), and the logarithms of the likeliest.

    One after the other, until they stand: noise of positions and noise of rotations are apart but for the causes that move both.
    """
    kinds = [
        kind
        for kind, there in ((0, model.process.of_position.any()), (1, not model.process.of_position.all()))
        if there
    ]
    at, h, best = low.copy(), 0.05, -math.inf

    def worse(log_size: float, kind: int) -> float:
        trial = at.copy()
        trial[kind] = log_size
        return -model.log_evidence((math.exp(trial[0]), math.exp(trial[1])))[0]

    for _ in range(ROUNDS):
        before = best
        for kind in kinds:
            found = minimize_scalar(
                worse, args=(kind,), bounds=(low[kind], high[kind]), method="bounded", options={"xatol": 0.02}
            )
            at[kind], best = float(found.x), -float(found.fun)
        if len(kinds) == 1 or best - before < SETTLED:
            break
    average = best
    for kind in kinds:
        here = float(at[kind])
        curvature = (worse(here + h, kind) + worse(here - h, kind) + 2.0 * best) / h**2
        span = float(high[kind] - low[kind])
        average += math.log(min(math.sqrt(2.0 * math.pi / max(curvature, 1e-6)), span) / span)
    return average, at


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

    def _posterior(self, scale: Floats) -> tuple[Floats, Floats, float]:
        """Likeliest departures (a,), their covariance (a, a) and log evidence, where the factors ``scale`` (m,) whiten."""
        return posterior(
            self.residual * scale,
            self.columns * scale[:, None],
            self.departure,
            self.variance,
            self.numerics * scale[:, None],
        )

    def left(self, sizes: Sizes) -> Floats:
        """(m,) what is left of the residual at the likeliest departures, in the axes in which the discrepancy is diagonal."""
        best, _, _ = self._posterior(self.process.scale(sizes))
        return np.asarray(self.residual - self.columns @ (best - self.departure))

    def wider_tolerances(self, sizes: Sizes) -> float:
        """Gain in log evidence because tolerances may be too tight."""
        scale = self.process.scale(sizes)
        columns, numerics = self.columns * scale[:, None], self.numerics * scale[:, None]
        causes = {q.key for q in self.fit.causes}
        factors = under_factors(
            self.fit.active, causes, self.residual * scale, columns, self.departure, numerics, self.options
        )
        return log_gain(credible(factors, factors[0]))

    def log_evidence(self, sizes: Sizes) -> tuple[float, Floats]:
        """Log evidence up to a constant, and covariance (a, a) of the coordinates, with a discrepancy of ``sizes`` (m, rad)."""
        scale = self.process.scale(sizes)
        departure, covariance, evidence = self._posterior(scale)
        evidence += float(np.log(scale).sum())
        wide = {q.key for q in self.fit.causes}
        limit = self.options.calibration.tolerance_limit
        evidence += within_tolerance(self.fit.active, wide, departure, covariance, limit)
        by_key = {q.key: d for q, d in zip(self.fit.active, departure, strict=True)}
        evidence += tail_gain(self.fit.causes, [by_key[q.key] for q in self.fit.causes])
        one_sided = [q.key in wide and q.one_sided for q in self.fit.active]
        return evidence + half_gaussian_gain(departure, covariance, one_sided), covariance
