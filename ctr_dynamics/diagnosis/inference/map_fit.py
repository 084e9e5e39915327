"""Maximum a posteriori fits of effects and nuisances to recordings, and their Laplace evidence.

The residual is whitened by the stated noise; tolerances of the robot file are 1-sigma priors of the nuisances, and plausible sizes those of
causes. Gauss-Newton with exact columns at the start and Broyden's rank-one updates between, so that most iterations cost one simulation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.special import log_ndtr

from ctr_dynamics.diagnosis.forward_model import NODES, ForwardModel
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.whitening import Whitener
from ctr_dynamics.effects import Quantity
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
Key = tuple[str, str]
INSIDE = 2.9  # tolerances: an error beyond is not one of tolerance, and needs a cause
REACH = 4.0  # tolerances: no fit takes a nuisance farther at first. The misfit of a large cause would carry them all away, and hide it
WIDENING = 1.5  # of posterior deviations: errors of tuning cases were larger than stated by that much
DIFFERENCE = 0.02  # of the scale, for columns by differences
# how many times over a fit may gain what its columns promise, at its first steps and later: beyond, it cannot reach its limit
SURPRISE = (12.0, 6.0, 4.0)
DAMPING = (1e2, 1e3, 1e4, 1e5)  # in units of the priors' precision
SETTLED = 0.05  # of the cost: what is not worth a simulation

LOG_INSIDE = float(log_ndtr(INSIDE))


@dataclass
class Fit:
    """One explanation at its best.

    Attributes:
        causes: quantities beyond tolerance. active: all quantities that were free, causes included.
        values: (a,) coordinates. sigma: (a,) posterior deviations. covariance: (a, a).
        chi2: whitened squares of the residual. cost: twice the negative log posterior density, tolerances ended.
        log_evidence: relative to no model at all; only differences count.
        residual, whitened: (m,) residuals at the best point, with the solver's own error and without.
        columns: (m, a) their derivatives, in coordinates.
    """

    causes: tuple[Quantity, ...]
    active: tuple[Quantity, ...]
    values: Floats
    covariance: Floats
    chi2: float
    log_evidence: float
    residual: Floats
    whitened: Floats
    columns: Floats
    cost: float

    @property
    def sigma(self) -> Floats:
        """(a,) posterior deviations of the coordinates, widened for what no model has (docs/diagnosis.md) and by what is left beyond noise."""
        left = max(1.0, self.chi2 / max(len(self.whitened), 1))
        return WIDENING * np.sqrt(left * np.maximum(np.diag(self.covariance), 0.0))

    @property
    def point(self) -> dict[Key, float]:
        """Coordinates by quantity."""
        return {q.key: float(v) for q, v in zip(self.active, self.values, strict=True)}

    @property
    def by_key(self) -> dict[Key, Floats]:
        """Columns by quantity."""
        return {q.key: self.columns[:, i] for i, q in enumerate(self.active)}


@dataclass(frozen=True)
class Local:
    """The model around one point: whitened residual (m,), and derivatives (m,) of the prediction by coordinates."""

    residual: Floats
    columns: Mapping[Key, Floats]


@dataclass
class Problem:
    """Recordings of one robot, prepared for fits.

    Attributes:
        forward_models, whiteners: one for each recording.
        nuisances: quantities with a tolerance. numerics: (m, d) whitened directions of the solver's own error.
        offset: (m,) whitened correction of the residual towards the finer solution.
        reach: tolerances that fits take a nuisance at most.
    """

    robot: Robot
    forward_models: list[ForwardModel]
    whiteners: list[Whitener]
    nuisances: tuple[Quantity, ...]
    numerics: Floats
    offset: Floats
    reach: float = REACH

    @property
    def size(self) -> int:
        """Number of whitened values."""
        return sum(w.size for w in self.whiteners)

    def with_step(self, dt: float) -> Problem:
        """The same with another time step (s)."""
        return replace(self, forward_models=[e.resolved(e.nodes, dt) for e in self.forward_models])

    @property
    def finer(self) -> Problem:
        """The same with half the time step."""
        return self.with_step(0.5 * self.forward_models[0].scheme.dt)

    def residual(self, point: Mapping[Key, float]) -> Floats | None:
        """(m,) whitened residual at ``point``; None where a simulation fails."""
        parts = []
        for forward_model, whiten in zip(self.forward_models, self.whiteners, strict=True):
            left = forward_model.residual_at(point)
            if left is None:
                return None
            parts.append(whiten(left))
        return np.concatenate(parts) - self.offset

    def linearise(
        self, point: Mapping[Key, float], wanted: Sequence[Quantity]
    ) -> tuple[Floats, Floats] | None:
        """Whitened residual (m,) at ``point`` and derivatives (m, len(wanted)) of the prediction, each by its coordinate."""
        residuals, columns = [], []
        for forward_model, whiten in zip(self.forward_models, self.whiteners, strict=True):
            try:
                prediction, jacobian = forward_model.jacobian(point, wanted)
            except InputError:
                return None
            if prediction.failure:
                return None
            residuals.append(whiten(forward_model.residual(prediction)))
            columns.append(whiten(jacobian))
        scale = np.array([q.scale for q in wanted])
        return np.concatenate(residuals) - self.offset, np.concatenate(columns) / scale


def make_problem(
    robot: Robot,
    recordings: Sequence[Recording],
    nuisances: Sequence[Quantity],
    mask: NDArray[np.bool_],
    nodes: int = NODES,
) -> Problem:
    """Problem of ``recordings``; axes that are not finite or not in ``mask`` (6,) are left out."""
    forward_models = [ForwardModel(r, robot, nodes) for r in recordings]
    whiteners = []
    for r in recordings:
        used = np.isfinite(r.position).all(axis=1) & (r.stamps >= 0.0)
        whiteners.append(Whitener(robot, r.stamps, mask, used))
    size = sum(w.size for w in whiteners)
    return Problem(robot, forward_models, whiteners, tuple(nuisances), np.zeros((size, 0)), np.zeros(size))


def prior_variance(quantity: Quantity, cause: bool) -> float:
    """Of a coordinate: tolerance^2, plus scale^2 where it may be a cause."""
    return quantity.tolerance**2 + (quantity.scale**2 if cause else 0.0)


def variances(
    nuisances: Sequence[Quantity], causes: Sequence[Quantity]
) -> tuple[tuple[Quantity, ...], Floats]:
    """Free quantities and their prior variances: tolerance^2 for nuisances, plus scale^2 for causes."""
    active = list(nuisances)
    names = {q.key for q in nuisances}
    active += [q for q in causes if q.key not in names]
    wide = {q.key for q in causes}
    return tuple(active), np.array([prior_variance(q, q.key in wide) for q in active])


def posterior(
    residual: Floats, columns: Floats, departure: Floats, variance: Floats, numerics: Floats
) -> tuple[Floats, Floats, float]:
    """One linear step: (new departures from off, covariance, log evidence) of y = J d + N e + noise with Gaussian priors.

    ``residual`` (m,) at the present ``departure`` (a,); ``columns`` (m, a); ``numerics`` (m, d) with prior deviations of one.
    """
    count = len(variance)
    J = np.hstack([columns, numerics])
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
    rhs = numerics.T @ residual
    free = float(rhs @ np.linalg.solve(np.eye(numerics.shape[1]) + numerics.T @ numerics, rhs))
    return float(residual @ residual) - free + float(np.sum(departure**2 / variance))


def fit(
    problem: Problem,
    causes: Sequence[Quantity],
    start: Mapping[Key, float],
    known: Local | None = None,
    *,
    iterations: int = 10,
    renewals: int = 2,
    limit: float = math.inf,
    polish: bool = True,
) -> Fit | None:
    """Best values of nuisances and ``causes`` from ``start``.

    Args:
        known: the model at ``start``, where it has been computed already; columns that it lacks are zero until the fit has moved.
        renewals: how often columns may be computed exactly on the way.
        limit: cost beyond which the fit is given up early.
        polish: whether to end on exact columns after a way on which they have changed.
    Returns:
        None where no simulation succeeds.
    """
    descent = _Descent(problem, causes, start)
    if not descent.begin(known):
        return None
    stale = False  # columns have missed the last step
    for number in range(iterations):
        step = descent.step()
        promise = descent.promise(step)
        if descent.cost - SURPRISE[min(number, len(SURPRISE) - 1)] * promise > limit:
            return descent.result()
        if stale:
            if not descent.renew():
                return None
            renewals -= 1
            step = descent.step()
            promise = descent.promise(step)
        if promise < SETTLED and not descent.unseen:
            break
        size = float(np.linalg.norm(descent.columns @ step))
        moved = descent.move(step, parts=2 if promise > 1.0 else 1)
        if moved is None and promise > 1.0:
            moved = descent.creep()
        if moved is None:  # not even a small part of the step is good: the columns are not
            stale = not descent.exact and renewals > 0
            if not stale:
                break
            continue
        error, gain, factor = moved
        blind = descent.see()
        stale = error > 0.3 * size * factor and descent.travelled > 3.0 and renewals > 0 and not blind
        if gain < SETTLED and factor == 1.0 and not (stale or blind):
            break
    if polish and renewals and descent.travelled > 3.0 and descent.renew():
        step = descent.step()
        if descent.promise(step) > SETTLED:
            descent.move(step, parts=1, learn=False)
    return descent.result()


class _Descent:
    """Gauss-Newton with Broyden's updates on one set of quantities; the arrays are those of :class:`Fit`.

    Attributes:
        exact: whether the columns were computed where the fit stands. travelled: whitened error of predictions since they were.
        unseen: causes without a column, as shapes of an effect that is off.
    """

    def __init__(self, problem: Problem, causes: Sequence[Quantity], start: Mapping[Key, float]) -> None:
        self.problem, self.causes = problem, tuple(causes)
        self.active, self.variance = variances(problem.nuisances, causes)
        self.off = np.array([q.off for q in self.active])
        free = {q.key for q in causes}
        reach = np.array([math.inf if q.key in free else problem.reach * q.tolerance for q in self.active])
        self.low = np.maximum([q.low for q in self.active], self.off - reach)
        self.high = np.minimum([q.high for q in self.active], self.off + reach)
        self.values = np.clip([start.get(q.key, q.off) for q in self.active], self.low, self.high)
        self.residual, self.columns = np.zeros(0), np.zeros((0, 0))
        self.cost, self.travelled, self.exact = math.inf, 0.0, False
        self.unseen: list[int] = []

    def point(self, values: Floats) -> dict[Key, float]:
        return {q.key: float(v) for q, v in zip(self.active, values, strict=True)}

    def begin(self, known: Local | None) -> bool:
        if known is None:
            return self.renew()
        nothing = np.zeros(len(known.residual))
        self.residual = known.residual
        self.columns = np.stack([known.columns.get(q.key, nothing) for q in self.active], axis=1)
        self.unseen = [i for i, q in enumerate(self.active) if q.key not in known.columns]
        self.exact = not self.unseen
        self.cost = self.cost_at(self.residual, self.values)
        return True

    def cost_at(self, residual: Floats, values: Floats) -> float:
        return cost(residual, values - self.off, self.variance, self.problem.numerics)

    def renew(self) -> bool:
        """Exact columns where the fit stands."""
        found = self.problem.linearise(self.point(self.values), self.active)
        if found is None:
            return False
        self.residual, self.columns = found
        self.cost, self.travelled, self.exact = self.cost_at(self.residual, self.values), 0.0, True
        return True

    def see(self) -> bool:
        """Columns of the unseen by differences; whether there were any."""
        for i in self.unseen:
            q, trial = self.active[i], self.values.copy()
            trial[i] += DIFFERENCE * q.scale * (1.0 if trial[i] + DIFFERENCE * q.scale <= q.high else -1.0)
            new = self.problem.residual(self.point(trial))
            if new is not None:
                self.columns[:, i] = (self.residual - new) / (trial[i] - self.values[i])
        seen, self.unseen = bool(self.unseen), []
        return seen

    def step(self, damping: float = 0.0) -> Floats:
        """Gauss-Newton step inside the bounds; the unseen stay. ``damping``: precision, in units of the prior's, with which the fit is held where
        it stands (Levenberg-Marquardt)."""
        seen = np.ones(len(self.values), bool)
        seen[self.unseen] = False
        sigma, departure = np.sqrt(self.variance[seen]), (self.values - self.off)[seen]
        count = len(sigma)
        J = np.hstack([self.columns[:, seen] * sigma, self.problem.numerics])
        information = J.T @ J + np.eye(J.shape[1])
        gradient = J.T @ self.residual
        information[:count, :count] += damping * np.eye(count)
        gradient[:count] -= departure / sigma
        step = np.linalg.solve(information, gradient)[:count] * sigma
        low, high = (self.low - self.values)[seen], (self.high - self.values)[seen]
        if np.any(step < low) or np.any(step > high):
            # bounds of the numerics directions: none
            root = np.linalg.cholesky(information).T
            wide = np.full(J.shape[1] - count, np.inf)
            tiny = 1e-12  # the solver wants some room where a value stands at its bound
            step = lsq_linear(
                root,
                np.linalg.solve(root.T, gradient),
                (np.append(low / sigma - tiny, -wide), np.append(high / sigma + tiny, wide)),
                method="bvls",
            ).x[:count] * sigma  # fmt: skip
        full = np.zeros(len(self.values))
        full[seen] = np.clip(step, low, high)
        return full

    def creep(self) -> tuple[float, float, float] | None:
        """:meth:`move` by the least damped step that lowers the cost: where the misfit is large, a phase in time is beyond what columns say."""
        for damping in DAMPING:
            moved = self.move(self.step(damping), parts=1)
            if moved is not None:
                error, gain, _ = moved
                return error, gain, 0.0
        return None

    def promise(self, step: Floats) -> float:
        """What ``step`` takes off the cost if the columns are right."""
        return self.cost - self.cost_at(self.residual - self.columns @ step, self.values + step)

    def move(self, step: Floats, parts: int = 4, learn: bool = True) -> tuple[float, float, float] | None:
        """Go by ``step`` or a part of it that lowers the cost: (error of the prediction, gain, part); None where none does."""
        factor = 1.0
        for _ in range(parts):
            trial = self.values + factor * step
            new = self.problem.residual(self.point(trial))
            if new is not None and (there := self.cost_at(new, trial)) < self.cost + 1e-9:
                break
            factor *= 0.35
        else:
            return None
        change = trial - self.values
        missed = self.residual - self.columns @ change - new
        error, gain = float(np.linalg.norm(missed)), self.cost - there
        if learn:  # Broyden, in coordinates scaled by the prior
            weight = change / self.variance
            self.columns = self.columns + np.outer(missed, weight) / float(change @ weight)
            self.travelled += error
            self.exact = False
        self.values, self.residual, self.cost = trial, new, there
        return error, gain, factor

    def result(self) -> Fit:
        """What was reached."""
        return summary(self.problem, self.causes, self.active, self.values, self.residual, self.columns)


def summary(
    problem: Problem,
    causes: tuple[Quantity, ...],
    active: tuple[Quantity, ...],
    values: Floats,
    residual: Floats,
    columns: Floats,
) -> Fit:
    """The fit that stands at ``values`` (a,), with its posterior and evidence."""
    wide = {q.key for q in causes}
    variance = np.array([prior_variance(q, q.key in wide) for q in active])
    departure, numerics = values - np.array([q.off for q in active]), problem.numerics
    _, covariance, _ = posterior(residual, columns, departure, variance, numerics)
    J = np.hstack([columns * np.sqrt(variance), numerics])
    total = cost(residual, departure, variance, numerics)
    evidence = -0.5 * total - 0.5 * float(np.linalg.slogdet(np.eye(J.shape[1]) + J.T @ J)[1])
    evidence += math.log(2.0) * sum(q.one_sided for q in causes)
    within = inside(active, wide, departure, covariance)
    left = residual - _numerics_part(residual, numerics)
    return Fit(
        causes,
        active,
        values,
        covariance,
        float(left @ left),
        evidence + within,
        residual,
        left,
        columns,
        total - 2.0 * within,
    )


def corrected(problem: Problem, result: Fit, change: Floats) -> Fit:
    """``result`` after ``problem.offset`` has changed by ``change`` (m,), where it stood."""
    return summary(
        problem, result.causes, result.active, result.values, result.residual - change, result.columns
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


def _numerics_part(residual: Floats, numerics: Floats) -> Floats:
    return numerics @ np.linalg.solve(
        np.eye(numerics.shape[1]) + numerics.T @ numerics, numerics.T @ residual
    )
