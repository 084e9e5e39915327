"""Maximum a posteriori fits of effects and nuisances to recordings, and their Laplace evidence.

The residual is whitened by the stated noise; tolerances of the robot file are 1-sigma priors of the nuisances, and plausible sizes those of
causes. Gauss-Newton with exact columns at the start and Broyden's rank-one updates between, so that most iterations cost one simulation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from ctr_dynamics.effects import EFFECTS, Quantity
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot

from .experiment import Experiment
from .noise import Whitener
from .recording import Recording

Floats = NDArray[np.float64]
Key = tuple[str, str]
INSIDE = 2.9  # tolerances: an error beyond is not one of tolerance, and needs a cause
NUMERICS_SIGMA = 0.6  # of the difference to a finer solution, which the prediction includes

LOG_INSIDE = float(log_ndtr(INSIDE))


@dataclass
class Fit:
    """One explanation at its best.

    Attributes:
        causes: quantities beyond tolerance. active: all quantities that were free, causes included.
        values: (a,) coordinates. sigma: (a,) posterior deviations. covariance: (a, a).
        chi2: whitened squares of the residual. cost: twice the negative log posterior density, tolerances ended.
        log_evidence: relative to no model at all; only differences count.
        whitened: residuals at the best point. columns: (m, a) their derivatives, in coordinates.
    """

    causes: tuple[Quantity, ...]
    active: tuple[Quantity, ...]
    values: Floats
    covariance: Floats
    chi2: float
    log_evidence: float
    whitened: Floats
    columns: Floats
    cost: float

    @property
    def sigma(self) -> Floats:
        """(a,) posterior deviations of the coordinates."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def point(self) -> dict[Key, float]:
        """Coordinates by quantity."""
        return {q.key: float(v) for q, v in zip(self.active, self.values, strict=True)}


@dataclass
class Problem:
    """Recordings of one robot, prepared for fits.

    Attributes:
        experiments, whiteners: one for each recording.
        nuisances: quantities with a tolerance. numerics: (m, d) whitened directions of the solver's own error.
        offset: (m,) whitened correction of the residual towards the finer solution.
    """

    robot: Robot
    experiments: list[Experiment]
    whiteners: list[Whitener]
    nuisances: tuple[Quantity, ...]
    numerics: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    offset: Floats = field(default_factory=lambda: np.zeros(0))
    weights: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def size(self) -> int:
        """Number of whitened values."""
        return sum(w.size for w in self.whiteners)

    def residual(self, point: Mapping[Key, float]) -> Floats | None:
        """(m,) whitened residual at ``point``; None where a simulation fails."""
        parts = []
        for experiment, whiten in zip(self.experiments, self.whiteners, strict=True):
            try:
                prediction = experiment.predict(point)
            except InputError:  # no equilibrium to start from
                return None
            if prediction.failure:
                return None
            parts.append(whiten(experiment.residual(prediction)))
        return np.concatenate(parts) - self.offset if len(self.offset) else np.concatenate(parts)

    def linearise(
        self, point: Mapping[Key, float], wanted: Sequence[Quantity]
    ) -> tuple[Floats, Floats] | None:
        """Whitened residual (m,) at ``point`` and derivatives (m, len(wanted)) of the prediction, each by its coordinate."""
        residuals, columns = [], []
        for experiment, whiten in zip(self.experiments, self.whiteners, strict=True):
            try:
                prediction, jacobian = experiment.jacobian(point, wanted)
            except InputError:
                return None
            if prediction.failure:
                return None
            residuals.append(whiten(experiment.residual(prediction)))
            columns.append(whiten(jacobian))
        scale = np.array([q.scale for q in wanted])
        residual = np.concatenate(residuals)
        return (residual - self.offset if len(self.offset) else residual), np.concatenate(columns) / scale


def make_problem(
    robot: Robot, recordings: Sequence[Recording], nuisances: Sequence[Quantity], mask: NDArray[np.bool_]
) -> Problem:
    """Problem of ``recordings``; axes that are not finite or not in ``mask`` (6,) are left out."""
    experiments = [Experiment(r, robot) for r in recordings]
    whiteners = []
    for r in recordings:
        used = np.isfinite(r.position).all(axis=1) & (r.stamps >= 0.0)
        whiteners.append(Whitener(robot, r.stamps, mask, used))
    return Problem(robot, experiments, whiteners, tuple(nuisances))


def variances(
    nuisances: Sequence[Quantity], causes: Sequence[Quantity]
) -> tuple[tuple[Quantity, ...], Floats]:
    """Free quantities and their prior variances: tolerance^2 for nuisances, plus scale^2 for causes."""
    active = list(nuisances)
    names = {q.key for q in nuisances}
    active += [q for q in causes if q.key not in names]
    wide = {q.key for q in causes}
    return tuple(active), np.array([q.tolerance**2 + (q.scale**2 if q.key in wide else 0.0) for q in active])


def posterior(
    residual: Floats, columns: Floats, departure: Floats, variance: Floats, numerics: Floats
) -> tuple[Floats, Floats, float]:
    """One linear step: (new departures from off, covariance, log evidence) of y = J d + N e + noise with Gaussian priors.

    ``residual`` (m,) at the present ``departure`` (a,); ``columns`` (m, a); ``numerics`` (m, d) with prior deviations of one.
    """
    count = len(variance)
    J = np.hstack([columns, numerics]) if numerics.size else columns
    prior = np.concatenate([variance, np.ones(J.shape[1] - count)])
    target = residual + columns @ departure
    root = np.sqrt(prior)
    A = J * root
    information = np.eye(J.shape[1]) + A.T @ A
    factor = np.linalg.cholesky(information)
    rhs = A.T @ target
    z = np.linalg.solve(factor.T, np.linalg.solve(factor, rhs))
    log_evidence = -0.5 * float(target @ target - rhs @ z) - float(np.log(np.diag(factor)).sum())
    inverse = np.linalg.inv(information)
    covariance = (root[:, None] * inverse * root)[:count, :count]
    return (root * z)[:count], covariance, log_evidence


def cost(residual: Floats, departure: Floats, variance: Floats, numerics: Floats) -> float:
    """Twice the negative log posterior, with the numerics directions at their best."""
    value = float(residual @ residual)
    if numerics.size:
        rhs = numerics.T @ residual
        value -= float(rhs @ np.linalg.solve(np.eye(numerics.shape[1]) + numerics.T @ numerics, rhs))
    return value + float(np.sum(departure**2 / variance))


def fit(
    problem: Problem,
    causes: Sequence[Quantity],
    start: Mapping[Key, float],
    known: tuple[Floats, Floats, Sequence[Quantity]] | None = None,
    *,
    iterations: int = 6,
    exact: bool = True,
) -> Fit | None:
    """Best values of nuisances and ``causes`` from ``start``.

    Args:
        known: residual, columns and their quantities at ``start``, where they have been computed already.
        exact: compute the columns anew at the end when the way there was long.
    Returns:
        None where no simulation succeeds.
    """
    active, variance = variances(problem.nuisances, causes)
    off = np.array([q.off for q in active])
    low = np.array([q.low for q in active])
    high = np.array([q.high for q in active])
    values = np.array([start.get(q.key, q.off) for q in active])
    if known is not None and {q.key for q in active} <= {q.key for q in known[2]}:
        residual = known[0]
        where = {q.key: i for i, q in enumerate(known[2])}
        columns = known[1][:, [where[q.key] for q in active]]
    else:
        found = problem.linearise({q.key: float(v) for q, v in zip(active, values, strict=True)}, active)
        if found is None:
            return None
        residual, columns = found
    numerics = problem.numerics
    here = cost(residual, values - off, variance, numerics)
    travelled, fresh = 0.0, True
    for _ in range(iterations):
        wanted, covariance, _ = posterior(residual, columns, values - off, variance, numerics)
        step = np.clip(off + wanted, low, high) - values
        bound = (off + wanted < low) | (off + wanted > high)
        if bound.any():  # move the others with the bounded ones held
            free = ~bound
            moved = residual - columns[:, bound] @ step[bound]
            wanted_free, _, _ = posterior(
                moved, columns[:, free], (values - off)[free], variance[free], numerics
            )
            step[free] = np.clip((off[free] + wanted_free), low[free], high[free]) - values[free]
        size = float(np.linalg.norm(columns @ step))
        if size < 0.05:
            break
        factor, accepted = 1.0, False
        for _halving in range(4):
            trial = values + factor * step
            new = problem.residual({q.key: float(v) for q, v in zip(active, trial, strict=True)})
            if new is not None:
                there = cost(new, trial - off, variance, numerics)
                if there < here + 1e-9:
                    accepted = True
                    break
            factor *= 0.35
        if not accepted or new is None:
            if fresh:
                break
            found = problem.linearise({q.key: float(v) for q, v in zip(active, values, strict=True)}, active)
            if found is None:
                return None
            residual, columns = found
            fresh, travelled = True, 0.0
            continue
        change = trial - values
        predicted = residual - columns @ change
        error = float(np.linalg.norm(new - predicted))
        travelled += error
        # Broyden, in coordinates scaled by the prior
        weight = change / variance
        columns = columns + np.outer(predicted - new, weight) / float(change @ weight)
        gain = here - there
        values, residual, here, fresh = trial, new, there, False
        if error > 0.3 * max(size, 1e-9) * factor and travelled > 3.0:
            found = problem.linearise({q.key: float(v) for q, v in zip(active, values, strict=True)}, active)
            if found is None:
                return None
            residual, columns = found
            fresh, travelled = True, 0.0
        elif gain < 0.02 and factor == 1.0:
            break
    if exact and travelled > 3.0:
        found = problem.linearise({q.key: float(v) for q, v in zip(active, values, strict=True)}, active)
        if found is not None:
            residual, columns = found
            wanted, _, _ = posterior(residual, columns, values - off, variance, numerics)
            trial = np.clip(off + wanted, low, high)
            new = problem.residual({q.key: float(v) for q, v in zip(active, trial, strict=True)})
            if new is not None and cost(new, trial - off, variance, numerics) < here:
                values, residual = trial, new
                here = cost(residual, values - off, variance, numerics)
    _, covariance, _ = posterior(residual, columns, values - off, variance, numerics)
    evidence = _laplace(here, columns, variance, numerics)
    one_sided = {q.key for q in causes if (math.isfinite(q.low) and q.low == q.off)}
    evidence += math.log(2.0) * len(one_sided)
    within = inside(active, {q.key for q in causes}, values - off, covariance)
    evidence += within
    left = residual - _numerics_part(residual, numerics)
    return Fit(
        tuple(causes),
        active,
        values,
        covariance,
        float(left @ left),
        evidence,
        left,
        columns,
        here - 2.0 * within,
    )


def inside(active: Sequence[Quantity], causes: set[Key], departure: Floats, covariance: Floats) -> float:
    """Log probability that the nuisances lie within ``INSIDE`` tolerances, over that before the data.

    A tolerance is the deviation of normal errors; what lies far outside is no error of tolerance, however small its share of the evidence.
    """
    total = 0.0
    for i, q in enumerate(active):
        if q.key in causes or q.tolerance <= 0.0:
            continue
        sigma = math.sqrt(max(covariance[i, i], 0.0)) / q.tolerance + 1e-9
        z = departure[i] / q.tolerance
        tail = log_ndtr((INSIDE - z) / sigma) if z > 0.0 else log_ndtr((INSIDE + z) / sigma)
        total += float(tail) - LOG_INSIDE
    return total


def _laplace(here: float, columns: Floats, variance: Floats, numerics: Floats) -> float:
    J = np.hstack([columns * np.sqrt(variance), numerics]) if numerics.size else columns * np.sqrt(variance)
    _, log_det = np.linalg.slogdet(np.eye(J.shape[1]) + J.T @ J)
    return -0.5 * here - 0.5 * float(log_det)


def _numerics_part(residual: Floats, numerics: Floats) -> Floats:
    if not numerics.size:
        return np.zeros_like(residual)
    return numerics @ np.linalg.solve(
        np.eye(numerics.shape[1]) + numerics.T @ numerics, numerics.T @ residual
    )


def add_numerics(problem: Problem, point: Mapping[Key, float]) -> dict[str, float]:
    """Compare with a finer solution at ``point``: correct the residual by the difference, and let it vary.

    Returns rms differences in m: ``time_error_m`` (half the step), ``space_error_m`` (twice the nodes).
    """
    directions: list[list[Floats]] = [[], []]
    squares = np.zeros(2)
    count = 0
    for experiment, whiten in zip(problem.experiments, problem.whiteners, strict=True):
        base = experiment.predict(point)
        for i, (nodes, dt) in enumerate(
            ((experiment.nodes, 0.5 * experiment.scheme.dt), (2 * experiment.nodes, experiment.scheme.dt))
        ):
            finer = Experiment(experiment.recording, experiment.robot, nodes, dt).predict(point)
            if finer.failure or base.failure:
                difference = np.zeros((len(base.position), 6))
            else:
                difference = experiment.residual(base) - experiment.residual(finer)
            directions[i].append(whiten(difference))
            squares[i] += float(np.sum(difference[:, :3] ** 2))
        count += len(base.position)
    D = np.stack([np.concatenate(parts) for parts in directions], axis=1)
    problem.offset = D.sum(axis=1)
    problem.numerics = NUMERICS_SIGMA * D
    rms = np.sqrt(squares / max(count, 1))
    return {"time_error_m": float(rms[0]), "space_error_m": float(rms[1])}


def is_nuisance(quantity: Quantity) -> bool:
    """Whether the quantity belongs to an effect that is no cause by itself."""
    return EFFECTS[quantity.effect].nuisance
