"""Hypotheses: sets of candidates with their fits.

In: candidates and a fit to begin from. Out: a hypothesis, or None where no simulation succeeds. A hypothesis is fitted with one cause more
than another, with one less, with one in place of another, or as a pair.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.diagnosis.inference.candidates import Candidate, causes_of, keys_of
from ctr_dynamics.diagnosis.inference.discrepancy import Discrepancy
from ctr_dynamics.diagnosis.inference.fit_problem import Local, Problem
from ctr_dynamics.diagnosis.inference.gaussian_posterior import posterior, variances
from ctr_dynamics.diagnosis.inference.map_fit import Fit, fit
from ctr_dynamics.diagnosis.inference.screening import Screened
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities, off_nominal
from ctr_dynamics.effects import EFFECTS, EffectQuantity, effect_quantities

Floats = NDArray[np.float64]
FAILED = 1e30  # whitened squares where a simulation fails


@dataclass
class Hypothesis:
    """A set of candidates with its fit.

    Attributes:
        score: log posterior, up to a constant. fitted_score: the same by the fitted bags only.
        predicted: log likelihood of bags that were not fitted, up to a constant, if known.
        exact: whether it was fitted with exact Jacobians.
        resolved: whether the error in time is small against what is left.
        discrepancy: beside its causes, where it was asked for. beside: whether the fit is that beside it.
    """

    members: tuple[Candidate, ...]
    fit: Fit
    score: float = 0.0
    fitted_score: float = 0.0
    predicted: float | None = None
    exact: bool = False
    resolved: bool = True
    discrepancy: Discrepancy | None = None
    beside: bool = False

    @property
    def effects(self) -> tuple[str, ...]:
        """Sorted effect IDs."""
        return tuple(sorted({c.effect for c in self.members}))

    @property
    def keys(self) -> frozenset[Key]:
        """Free parameters of its causes."""
        return keys_of(self.members)

    def gain_over(self, other: Hypothesis) -> float:
        """Log posterior that it adds to ``other``, by all bags or by the fitted ones, whichever is less.

        Bags that were not fitted can speak against a cause, but not for one that the others do not show.
        """
        return min(self.score - other.score, self.fitted_score - other.fitted_score)

    @property
    def has_impacts(self) -> bool:
        """Whether a cause strikes the robot; time steps follow that to a limited degree only."""
        return any(EFFECTS[m.effect].impacts for m in self.members)


def with_form(problem: Problem, members: Sequence[Candidate]) -> Problem:
    """``problem`` as ``members`` need it: with the nuisances of the model's form that are free beside them, and short steps for impacts."""
    if any(EFFECTS[c.effect].impacts for c in members):
        problem = problem.even
    names = {name for c in members for name in EFFECTS[c.effect].form}
    if not names:
        return problem
    form = tuple(q for q in effect_quantities(problem.robot) if q.effect in names)
    return replace(problem, nuisances=problem.nuisances + form)


def fit_hypothesis(
    problem: Problem,
    members: tuple[Candidate, ...],
    start: Mapping[Key, float],
    *,
    renewals: int | None = None,
    limit: float = math.inf,
    polish: bool = True,
) -> Hypothesis | None:
    """Fit of ``members`` from ``start``; the arguments are those of :func:`~ctr_dynamics.diagnosis.inference.map_fit.fit`."""
    own = with_form(problem, members)
    result = fit(own, causes_of(members), start, renewals=renewals, limit=limit, polish=polish)
    return None if result is None else Hypothesis(members, result)


@dataclass(frozen=True)
class Addition:
    """A candidate that is to be fitted beside ``members``, from their fit ``start``, where ``sensitivities`` stand."""

    members: tuple[Candidate, ...]
    new: Screened
    start: Fit
    sensitivities: Sensitivities


def fit_addition(problem: Problem, addition: Addition, limit: float = math.inf) -> Hypothesis | None:
    """Fit with one more cause; ``limit``: cost beyond which it is given up."""
    new, here = addition.new, addition.sensitivities
    members = (*addition.members, new.candidate)
    causes = causes_of(members)
    point = {**dict(new.candidate.start), **addition.start.point}
    own = with_form(problem, members)
    if new.candidate.sizes:
        nominal = {**point, **problem.nominal}
        first = new.candidate.quantities[0].key
        result = None
        for size in new.candidate.sizes:
            found = fit(own, causes, {**nominal, first: size}, renewals=2, limit=limit, polish=False)
            if found is not None and (result is None or found.cost < result.cost):
                result = found
            if result is not None and result.cost < problem.options.search.enough * problem.size:
                break
    elif new.trial is not None:
        # so far from where the columns are known that they are computed again; nuisances off nominal mislead, so nominal ones are tried too
        starts = [{**point, **new.trial.shift}]
        if off_nominal(problem, starts[0]):
            starts.append({**starts[0], **problem.nominal})
        fits = []
        for start in starts:
            start.update(best_size_nearby(problem, start, new.candidate.quantities[0]))
            fits.append(fit(own, causes, start, renewals=2, limit=limit, polish=False))
        result = min((f for f in fits if f is not None), key=lambda f: f.cost, default=None)
    else:
        known = Local(
            here.residual, {**here.columns_of(new.candidate), **addition.start.by_key, **here.columns}
        )
        result = fit(own, causes, point, known, renewals=1, limit=limit, polish=False)
    return None if result is None else Hypothesis(members, result)


def best_size_nearby(problem: Problem, point: Mapping[Key, float], q: EffectQuantity) -> dict[Key, float]:
    """The size of ``q`` near ``point`` that leaves least, all else as it is.

    Where an effect changes a frequency, the phase error grows in time, and the columns reach a few per cent far only. Nuisances that follow
    them would settle in the wrong place.
    """
    o = problem.options.search
    coarse = problem.with_least_step(problem.options.screening.finite_size_dt_s)
    departure = point[q.key] - q.off

    def left(factor: float) -> float:
        size = float(np.clip(q.off + factor * departure, q.low, q.high))
        residual = coarse.residual({**point, q.key: size})
        return FAILED if residual is None else float(residual @ residual)

    found = minimize_scalar(
        left,
        bounds=o.nearby_sizes,
        method="bounded",
        options={"maxiter": o.nearby_evaluations, "xatol": o.nearby_accuracy},
    )
    factor = float(found.x) if found.fun < left(1.0) else 1.0
    return {q.key: float(np.clip(q.off + factor * departure, q.low, q.high))}


def fit_without(
    problem: Problem, members: tuple[Candidate, ...], start: Fit, limit: float
) -> Hypothesis | None:
    """Fit of ``members`` from that of a larger set; ``limit``: cost beyond which it is given up."""
    own = with_form(problem, members)
    free = {q.key for q in (*own.nuisances, *causes_of(members))}
    point = {key: value for key, value in start.point.items() if key in free}
    return fit_hypothesis(problem, members, point, renewals=1, limit=limit)


def fit_pair(problem: Problem, parts: Sequence[Hypothesis], limit: float) -> Hypothesis | None:
    """Fit of the causes of all ``parts`` from the values that each has by itself.

    Nuisances start at nominal values: those of the parts imitate one another's causes.
    """
    members = tuple(m for e in parts for m in e.members)
    start = {key: value for e in parts for key, value in e.fit.point.items() if key in e.keys}
    return fit_hypothesis(problem, members, start, limit=limit, polish=False)


def fit_alternative(
    problem: Problem,
    best: Hypothesis,
    members: tuple[Candidate, ...],
    sensitivities: Sensitivities,
    limit: float,
) -> Hypothesis | None:
    """Fit of ``members`` in place of those of ``best``, where ``sensitivities`` stand.

    It begins where the columns say that the new members do the work of those that are gone.
    """
    gone = best.keys - keys_of(members)
    new = [c for c in members if c not in best.members]
    own = with_form(problem, members)
    active, variance = variances(own.nuisances, causes_of(members))
    known = dict(sensitivities.columns)
    start: dict[Key, float] = {}
    for c in new:
        known.update(sensitivities.columns_of(c))
        start.update(dict(c.start))
    known.update(best.fit.by_key)
    point = {key: value for key, value in best.fit.point.items() if key not in gone}
    departure = np.array([point.get(q.key, q.off) - q.off for q in active])
    without = sum(
        best.fit.columns[:, i] * (best.fit.values[i] - q.off)
        for i, q in enumerate(best.fit.active)
        if q.key in gone
    )
    nothing = np.zeros(len(best.fit.residual))
    columns = np.stack([known.get(q.key, nothing) for q in active], axis=1)
    wanted, _, _ = posterior(best.fit.residual + without, columns, departure, variance, problem.numerics)
    start.update(
        {
            q.key: float(np.clip(q.off + d, q.low, q.high))
            for q, d in zip(active, wanted, strict=True)
            if q.key not in start
        }
    )
    found = fit_hypothesis(problem, members, start, limit=limit)
    if found is None or found.fit.cost <= limit or not off_nominal(problem, found.fit.point):
        return found
    # given up: nuisances that have followed other causes so far may be stuck, so nominal ones are tried too
    sizes = {key: value for key, value in found.fit.point.items() if key in found.keys}
    again = fit_hypothesis(problem, members, {**found.fit.point, **problem.nominal, **sizes}, limit=limit)
    return again if again is not None and again.fit.cost < found.fit.cost else found


def fit_exactly(problem: Problem, hypothesis: Hypothesis) -> None:
    """Fit again, with exact Jacobians."""
    own = replace(with_form(problem, hypothesis.members), tolerance_factor=hypothesis.fit.tolerance_factor)
    better = fit(own, hypothesis.fit.causes, hypothesis.fit.point)
    if better is not None and better.cost <= hypothesis.fit.cost + 1e-6:
        hypothesis.fit = better
    hypothesis.exact = True


def fit_with_likeliest_tolerances(problem: Problem, hypothesis: Hypothesis) -> None:
    """Fit again with the factor on all tolerances that is the likeliest where ``hypothesis`` stands, until it is the one of the fit.

    Far from where the columns are known, other factors promise more evidence than there is: where a fit does not find it, it does not count.
    """
    own = with_form(problem, hypothesis.members)
    for _ in range(problem.options.tolerances.refits):
        before = hypothesis.fit
        if before.has_likeliest_tolerances:
            return
        found = fit(replace(own, tolerance_factor=before.likeliest_factor), before.causes, before.point)
        if found is None or found.log_evidence < before.own_evidence:
            break
        hypothesis.fit = found
    last = hypothesis.fit
    if not last.has_likeliest_tolerances:
        hypothesis.fit = replace(last, likeliest_factor=last.tolerance_factor, log_evidence=last.own_evidence)


def check_time_error(problem: Problem, hypothesis: Hypothesis) -> None:
    """Whether what ``hypothesis`` leaves beyond noise is more than the error in time at its best point, where there are impacts.

    Impacts excite what steps of this length do not follow, and a further cause would only imitate that.
    """
    if not hypothesis.has_impacts:
        return
    # beside the steps of the fit, which are short throughout, and not those that were chosen without impacts
    finer = with_form(problem, hypothesis.members).finer.residual(hypothesis.fit.point)
    if finer is not None and len(finer) == len(hypothesis.fit.residual):
        error = finer - hypothesis.fit.residual
        left = hypothesis.fit.chi2 - problem.size
        # what is left can be the error itself, which falls slowly with the step
        hypothesis.resolved = left > problem.options.search.time_error * float(error @ error)
