"""Maximum a posteriori fits of causes and nuisances to recordings, with their Laplace evidence.

In: a problem, the causes that are free, and where to start. Out: a :class:`Fit`. The residual is whitened by the stated noise; tolerances of
the robot file are 1-sigma priors of the nuisances, and plausible sizes those of causes. Gauss-Newton steps with an exact Jacobian at the
start and Broyden's rank-one updates after it, so that most iterations cost one simulation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.diagnosis.inference.fit_problem import Local, Problem
from ctr_dynamics.diagnosis.inference.gaussian_posterior import (
    cost,
    half_gaussian_gain,
    numerics_part,
    posterior,
    prior_variance,
    tail_gain,
    variances,
    within_tolerance,
)
from ctr_dynamics.diagnosis.inference.tolerance_factors import credible, log_gain, under_factors, with_factor
from ctr_dynamics.effects import EffectQuantity

Floats = NDArray[np.float64]


@dataclass
class Fit:
    """A set of causes at its best.

    Attributes:
        causes: quantities that may leave their tolerance. active: all quantities that were free, causes included.
        values: (a,) coordinates. covariance: (a, a) of the Laplace posterior.
        chi2: sum of the squares of ``whitened``.
        log_evidence: relative to no model at all; only differences count. The tolerances may be too tight by a factor.
        residual, whitened: (m,) residuals at the best point, with the discretisation error and without.
        columns: (m, a) derivatives of the prediction by the coordinates.
        cost: twice the negative log posterior density, tolerances limited. With larger tolerances it holds what their evidence is less for it.
        inflation: of the posterior deviations, for what no model has (docs/diagnosis.md).
        tolerance_factor: on all tolerances, with which it was fitted. own_evidence: log evidence with that factor alone.
        likeliest_factor: the likeliest one where it stands, by the linear model, if it has substantially more evidence.
        travelled: sum of the whitened errors of predictions since ``columns`` were computed exactly.
    """

    causes: tuple[EffectQuantity, ...]
    active: tuple[EffectQuantity, ...]
    values: Floats
    covariance: Floats
    chi2: float
    log_evidence: float
    residual: Floats
    whitened: Floats
    columns: Floats
    cost: float
    inflation: float
    tolerance_factor: float = 1.0
    likeliest_factor: float = 1.0
    own_evidence: float = -math.inf
    travelled: float = 0.0

    @property
    def has_likeliest_tolerances(self) -> bool:
        """Whether it was fitted with the factor on tolerances that is the likeliest where it stands."""
        return self.likeliest_factor == self.tolerance_factor

    @property
    def sigma(self) -> Floats:
        """(a,) posterior deviations of the coordinates, inflated also by what is left beyond noise."""
        left = max(1.0, self.chi2 / max(len(self.whitened), 1))
        return self.inflation * np.sqrt(left * np.maximum(np.diag(self.covariance), 0.0))

    @property
    def effective_parameters(self) -> float:
        """Number of parameters that the data determine instead of the priors: trace of the matrix from data to fitted values."""
        return float(np.sum((self.columns @ self.covariance) * self.columns))

    @property
    def point(self) -> dict[Key, float]:
        """Coordinates by quantity."""
        return {q.key: float(v) for q, v in zip(self.active, self.values, strict=True)}

    @property
    def by_key(self) -> dict[Key, Floats]:
        """Columns by quantity."""
        return {q.key: self.columns[:, i] for i, q in enumerate(self.active)}


def fit(
    problem: Problem,
    causes: Sequence[EffectQuantity],
    start: Mapping[Key, float],
    known: Local | None = None,
    *,
    iterations: int | None = None,
    renewals: int | None = None,
    limit: float = math.inf,
    polish: bool = True,
) -> Fit | None:
    """Best values of nuisances and ``causes`` from ``start``.

    Args:
        known: the model at ``start``, where it has been computed already; columns that it lacks are zero until the fit has moved.
        iterations: steps at most, where not those of the options.
        renewals: how often the Jacobian may be computed exactly on the way, where not that of the options.
        limit: cost beyond which the fit is given up early.
        polish: whether to end on an exact Jacobian after a way on which it has changed.
    Returns:
        None where no simulation succeeds.
    """
    o = problem.options.calibration
    renewals = o.renewals if renewals is None else renewals
    descent = GaussNewton(problem, causes, start)
    if not descent.begin(known):
        return None
    stale = False  # the columns have missed the last step
    for number in range(o.iterations if iterations is None else iterations):
        step = descent.step()
        promise = descent.promise(step)
        if descent.cost - o.surprise[min(number, len(o.surprise) - 1)] * promise > limit:
            return descent.result()
        if stale:
            if not descent.renew():
                return None
            renewals -= 1
            step = descent.step()
            promise = descent.promise(step)
        if promise < o.settled and not descent.unseen:
            break
        size = float(np.linalg.norm(descent.columns @ step))
        moved = descent.move(step, parts=o.parts if promise > 1.0 else 1)
        if moved is None and promise > 1.0:
            moved = descent.move_damped()
        if moved is None:  # not even a small part of the step is good: the columns are not
            stale = not descent.exact and renewals > 0
            if not stale:
                break
            continue
        error, gain, factor = moved
        new_columns = descent.difference_unseen()
        missed = error > o.stale * size * factor and descent.travelled > o.travelled
        stale = missed and renewals > 0 and not new_columns
        if gain < o.settled and factor == 1.0 and not (stale or new_columns):
            break
    if polish and renewals and descent.travelled > o.travelled and descent.renew():
        step = descent.step()
        if descent.promise(step) > o.settled:
            descent.move(step, parts=1, learn=False)
    return descent.result()


class GaussNewton:
    """Gauss-Newton steps with Broyden's updates on one set of quantities; the arrays are those of :class:`Fit`.

    Attributes:
        exact: whether the columns were computed where the fit stands.
        travelled: sum of the whitened errors of predictions since they were.
        unseen: causes without a column yet, as shapes of an effect that is off.
    """

    def __init__(
        self, problem: Problem, causes: Sequence[EffectQuantity], start: Mapping[Key, float]
    ) -> None:
        self.problem, self.causes = problem, tuple(causes)
        self.active, self.variance = variances(problem.nuisances, causes, problem.tolerance_factor)
        self.off = np.array([q.off for q in self.active])
        place = {q.key: i for i, q in enumerate(self.active)}
        self.of_causes = [place[q.key] for q in causes]
        free = {q.key for q in causes}
        reach = problem.reach * problem.tolerance_factor
        most = np.array([math.inf if q.key in free else reach * q.tolerance for q in self.active])
        self.low = np.maximum([q.low for q in self.active], self.off - most)
        self.high = np.minimum([q.high for q in self.active], self.off + most)
        self.values = np.clip([start.get(q.key, q.off) for q in self.active], self.low, self.high)
        self.residual, self.columns = np.zeros(0), np.zeros((0, 0))
        self.cost, self.travelled, self.exact = math.inf, 0.0, False
        self.unseen: list[int] = []

    def point(self, values: Floats) -> dict[Key, float]:
        """``values`` (a,) by quantity."""
        return {q.key: float(v) for q, v in zip(self.active, values, strict=True)}

    def begin(self, known: Local | None) -> bool:
        """Take the model at the start, or compute it; False where it cannot be simulated."""
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
        """Cost of ``residual`` (m,) at ``values`` (a,)."""
        departure = values - self.off
        tails = tail_gain(self.causes, departure[self.of_causes])
        return cost(residual, departure, self.variance, self.problem.numerics) - 2.0 * tails

    def renew(self) -> bool:
        """Exact columns where the fit stands; False where it cannot be simulated."""
        found = self.problem.linearise(self.point(self.values), self.active)
        if found is None:
            return False
        self.residual, self.columns = found
        self.cost, self.travelled, self.exact = self.cost_at(self.residual, self.values), 0.0, True
        return True

    def difference_unseen(self) -> bool:
        """Columns of the unseen by finite differences; whether there were any."""
        fraction = self.problem.options.calibration.difference
        for i in self.unseen:
            q, trial = self.active[i], self.values.copy()
            trial[i] += fraction * q.scale * (1.0 if trial[i] + fraction * q.scale <= q.high else -1.0)
            new = self.problem.residual(self.point(trial))
            if new is not None:
                self.columns[:, i] = (self.residual - new) / (trial[i] - self.values[i])
        seen, self.unseen = bool(self.unseen), []
        return seen

    def step(self, damping: float = 0.0) -> Floats:
        """Gauss-Newton step (a,) inside the bounds; the unseen stay.

        ``damping``: precision, in units of the prior's, with which the fit is held where it stands (Levenberg-Marquardt).
        """
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

    def move_damped(self) -> tuple[float, float, float] | None:
        """:meth:`move` by the least damped step that lowers the cost: a large misfit moves a phase beyond what columns say."""
        for damping in self.problem.options.calibration.damping:
            moved = self.move(self.step(damping), parts=1)
            if moved is not None:
                error, gain, _ = moved
                return error, gain, 0.0
        return None

    def promise(self, step: Floats) -> float:
        """What ``step`` takes off the cost if the columns are right."""
        return self.cost - self.cost_at(self.residual - self.columns @ step, self.values + step)

    def move(self, step: Floats, parts: int, learn: bool = True) -> tuple[float, float, float] | None:
        """Go by ``step`` or a part of it that lowers the cost.

        Args:
            parts: how many lengths are tried.
            learn: whether the columns take Broyden's update.
        Returns:
            Whitened error of the prediction, gain in cost, and part of the step; None where no length lowers the cost.
        """
        factor = 1.0
        for _ in range(parts):
            trial = self.values + factor * step
            new = self.problem.residual(self.point(trial))
            if new is not None and (there := self.cost_at(new, trial)) < self.cost + 1e-9:
                break
            factor *= self.problem.options.calibration.backtracking
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
        """The fit that was reached."""
        found = fit_at(self.problem, self.causes, self.active, self.values, self.residual, self.columns)
        return replace(found, travelled=self.travelled)


def fit_at(
    problem: Problem,
    causes: tuple[EffectQuantity, ...],
    active: tuple[EffectQuantity, ...],
    values: Floats,
    residual: Floats,
    columns: Floats,
) -> Fit:
    """The fit that stands at ``values`` (a,), with its posterior and evidence."""
    o, numerics = problem.options.calibration, problem.numerics
    wide = {q.key for q in causes}
    factor = problem.tolerance_factor
    variance, stated = (
        np.array([prior_variance(q, q.key in wide, f) for q in active]) for f in (factor, 1.0)
    )
    departure = values - np.array([q.off for q in active])
    _, covariance, _ = posterior(residual, columns, departure, variance, numerics)
    occam, occam_stated = (
        float(np.linalg.slogdet(np.eye(J.shape[1]) + J.T @ J)[1])
        for J in (np.hstack([columns * np.sqrt(v), numerics]) for v in (variance, stated))
    )
    place = {q.key: i for i, q in enumerate(active)}
    tails = tail_gain(causes, [departure[place[q.key]] for q in causes])
    total = cost(residual, departure, variance, numerics) - 2.0 * tails
    evidence = -0.5 * total - 0.5 * occam
    evidence += half_gaussian_gain(departure, covariance, [q.key in wide and q.one_sided for q in active])
    within = within_tolerance(active, wide, departure, covariance, o.tolerance_limit, factor)
    factors = under_factors(
        active, wide, residual, columns, departure, numerics, problem.options, relative_to=factor
    )
    own = with_factor(factors, factor)
    factors = credible(factors, own)
    wider = log_gain(factors)
    likeliest = max(factors, key=lambda one: one.log_weight).factor
    if wider - own.log_weight < problem.options.tolerances.substantial:
        likeliest = factor
    total -= 2.0 * within
    if factor != 1.0:
        total += occam - occam_stated - 2.0 * wider
    left = residual - numerics_part(residual, numerics)
    evidence += within
    return Fit(
        causes=causes,
        active=active,
        values=values,
        covariance=covariance,
        chi2=float(left @ left),
        log_evidence=evidence + wider,
        own_evidence=evidence + own.log_weight,
        residual=residual,
        whitened=left,
        columns=columns,
        cost=total,
        inflation=o.inflation,
        tolerance_factor=factor,
        likeliest_factor=likeliest,
    )


def corrected(problem: Problem, result: Fit, change: Floats) -> Fit:
    """``result`` after ``problem.offset`` has changed by ``change`` (m,), where it stood."""
    own = replace(problem, tolerance_factor=result.tolerance_factor)
    found = fit_at(own, result.causes, result.active, result.values, result.residual - change, result.columns)
    return replace(found, travelled=result.travelled)
