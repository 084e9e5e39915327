"""Fits of sets of causes: one more cause from the columns of a screening, one less, one in place of another."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ctr_dynamics.diagnosis.inference.candidates import Candidate, causes_of, keys_of
from ctr_dynamics.diagnosis.inference.map_fit import Fit, Key, Local, Problem, fit, posterior, variances
from ctr_dynamics.diagnosis.inference.sensitivities import PROBE_STEP, Linearisation, Scored, strayed
from ctr_dynamics.effects import EFFECTS, Quantity, quantities

Floats = NDArray[np.float64]
LEAVES_LITTLE = 2.0  # times the noise: then no other size is tried
NUMERICAL = 5.0  # times that difference's squares: what is left can be the error itself, which falls slowly with the step
FAILED = 1e30  # whitened squares where a simulation fails
NEIGHBOURHOOD = (0.5, 1.7)  # of a probe's size: where the size that leaves least is looked for


@dataclass
class Explanation:
    """A set of candidates with its fit."""

    members: tuple[Candidate, ...]
    fit: Fit
    score: float = 0.0  # log posterior, up to a constant
    fitted: float = 0.0  # the same by the fitted bags alone
    held_out: float | None = None  # log likelihood of bags that were not fitted, up to a constant, if known
    finished: bool = False  # with exact columns
    resolved: bool = True  # whether the model's error in time is small against what is left

    @property
    def effects(self) -> tuple[str, ...]:
        """Sorted effect IDs."""
        return tuple(sorted({c.effect for c in self.members}))

    @property
    def keys(self) -> frozenset[Key]:
        """Free parameters of its causes."""
        return keys_of(self.members)


def with_nuisances(problem: Problem, members: Sequence[Candidate]) -> Problem:
    """``problem`` with the nuisances of the model's form that come with ``members``."""
    names = {name for c in members for name in EFFECTS[c.effect].form}
    if not names:
        return problem
    form = tuple(q for q in quantities(problem.robot) if q.effect in names)
    return replace(problem, nuisances=problem.nuisances + form)


@dataclass(frozen=True)
class Job:
    """A candidate to be fitted beside ``members``, from their fit ``start``, where ``lin`` stands."""

    members: tuple[Candidate, ...]
    new: Scored
    start: Fit
    lin: Linearisation


def explain(problem: Problem, job: Job, limit: float = math.inf) -> Explanation | None:
    """Fit of a set of candidates; ``limit``: cost beyond which it is given up. None where no simulation succeeds."""
    members = (*job.members, job.new.candidate)
    causes = causes_of(members)
    point = {**dict(job.new.candidate.start), **job.start.point}
    own = with_nuisances(problem, members)
    if job.new.candidate.sizes:
        nominal = {**point, **{q.key: q.off for q in problem.nuisances}}
        first = job.new.candidate.quantities[0].key
        result = None
        for size in job.new.candidate.sizes:
            new = fit(own, causes, {**nominal, first: size}, renewals=2, limit=limit, polish=False)
            if new is not None and (result is None or new.cost < result.cost):
                result = new
            if result is not None and result.cost < LEAVES_LITTLE * problem.size:
                break
    elif job.new.probe is not None:
        # so far from where the columns are known that they are computed anew; nuisances that have strayed lead astray, so nominal ones are tried too
        starts = [{**point, **job.new.probe.shift}]
        if strayed(problem, starts[0]):
            starts.append({**starts[0], **{q.key: q.off for q in problem.nuisances}})
        fits = []
        for start in starts:
            start.update(along(problem, start, job.new.candidate.quantities[0]))
            fits.append(fit(own, causes, start, renewals=2, limit=limit, polish=False))
        result = min((f for f in fits if f is not None), key=lambda f: f.cost, default=None)
    else:
        known = Local(
            job.lin.residual, {**job.lin.own(job.new.candidate), **job.start.by_key, **job.lin.columns}
        )
        result = fit(own, causes, point, known, renewals=1, limit=limit, polish=False)
    return None if result is None else Explanation(members, result)


def along(problem: Problem, point: Mapping[Key, float], q: Quantity) -> dict[Key, float]:
    """The size of ``q`` near ``point`` that leaves least, all else as it is. Where an effect changes a frequency, a phase runs away in time, and the
    columns reach a few per cent far only; nuisances that follow them would settle in the wrong place."""
    coarse = problem.with_step(PROBE_STEP)
    departure = point[q.key] - q.off

    def left(share: float) -> float:
        size = float(np.clip(q.off + share * departure, q.low, q.high))
        residual = coarse.residual({**point, q.key: size})
        return FAILED if residual is None else float(residual @ residual)

    found = minimize_scalar(
        left, bounds=NEIGHBOURHOOD, method="bounded", options={"maxiter": 12, "xatol": 0.01}
    )
    share = float(found.x) if found.fun < left(1.0) else 1.0
    return {q.key: float(np.clip(q.off + share * departure, q.low, q.high))}


def fit_all(problem: Problem, jobs: Sequence[Job], limit: float, workers: int) -> list[Explanation]:
    results = Parallel(workers, prefer="threads")(delayed(explain)(problem, job, limit) for job in jobs)
    return [e for e in results if e is not None]


def reduced(problem: Problem, members: tuple[Candidate, ...], start: Fit, limit: float) -> Explanation | None:
    """Fit of ``members`` from that of a larger set; ``limit``: cost beyond which it is given up."""
    causes = causes_of(members)
    own = with_nuisances(problem, members)
    free = {q.key for q in (*own.nuisances, *causes)}
    point = {key: value for key, value in start.point.items() if key in free}
    result = fit(own, causes, point, renewals=1, limit=limit)
    return None if result is None else Explanation(members, result)


def combined(problem: Problem, parts: Sequence[Explanation], limit: float) -> Explanation | None:
    """Fit of the causes of all ``parts`` from the values that each has alone, beside nominal nuisances: theirs stand in for one another's causes."""
    members = tuple(m for e in parts for m in e.members)
    start = {key: value for e in parts for key, value in e.fit.point.items() if key in e.keys}
    result = fit(with_nuisances(problem, members), causes_of(members), start, limit=limit, polish=False)
    return None if result is None else Explanation(members, result)


def replaced(
    problem: Problem, best: Explanation, members: tuple[Candidate, ...], lin: Linearisation, limit: float
) -> Explanation | None:
    """Fit of ``members`` from where the columns of ``lin``, at ``best``, say that those of them that are new do the work of those that are gone."""
    left = best.keys - keys_of(members)
    new = [c for c in members if c not in best.members]
    own, causes = with_nuisances(problem, members), causes_of(members)
    active, variance = variances(own.nuisances, causes)
    known = dict(lin.columns)
    start: dict[Key, float] = {}
    for c in new:
        known.update(lin.own(c))
        start.update(dict(c.start))
    known.update(best.fit.by_key)
    point = {key: value for key, value in best.fit.point.items() if key not in left}
    departure = np.array([point.get(q.key, q.off) - q.off for q in active])
    without = sum(
        best.fit.columns[:, i] * (best.fit.values[i] - q.off)
        for i, q in enumerate(best.fit.active)
        if q.key in left
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
    result = fit(own, causes, start, limit=limit)
    return None if result is None else Explanation(members, result)


def look_closer(problem: Problem, found: Explanation) -> None:
    """Whether what ``found`` leaves beyond noise is more than the model's own error in time at its best point, where there are impacts: they
    excite what steps of this length do not follow, and a further cause would only imitate that."""
    if not any(EFFECTS[m.effect].impacts for m in found.members):
        return
    finer = problem.finer.residual(found.fit.point)
    if finer is not None and len(finer) == len(found.fit.residual):
        error = finer - found.fit.residual
        found.resolved = found.fit.chi2 - problem.size > NUMERICAL * float(error @ error)


def finish(problem: Problem, found: Explanation) -> None:
    """Fit again with exact columns."""
    better = fit(with_nuisances(problem, found.members), found.fit.causes, found.fit.point)
    if better is not None and better.cost <= found.fit.cost + 1e-6:
        found.fit = better
    found.finished = True
