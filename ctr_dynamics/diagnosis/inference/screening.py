"""Screening: linear log evidence of every candidate, and of every pair, from the columns at one point.

In: sensitivities and the fit where they stand. Out: single candidates, or sets of one and two, best first. No simulation is needed: with
nuisances and discretisation error eliminated it is algebra of a few columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.diagnosis.inference.candidates import Candidate, causes_of, keys_of, log_prior, tube_of
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.gaussian_posterior import (
    half_gaussian_gain,
    posterior,
    variances,
    within_tolerance,
)
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities, Trial
from ctr_dynamics.effects import EffectQuantity

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Screened:
    """A candidate and the linear log evidence that it gains; ``trial``: the finite size from which it does, None for the base point."""

    gain: float
    candidate: Candidate
    trial: Trial | None


def screen(
    problem: Problem,
    sensitivities: Sensitivities,
    base: Fit,
    members: Sequence[Candidate],
    pool: Sequence[Candidate],
) -> list[Screened]:
    """Linear log evidence gained by each candidate of ``pool`` beside ``members``, best first.

    One-sided causes of the wrong sign gain nothing. ``base`` is the fit of ``members``, where ``sensitivities`` stand.
    """
    limit = problem.options.calibration.tolerance_limit
    here, fixed = sensitivities, causes_of(members)
    active, variance = variances(problem.nuisances, fixed)
    known = {**base.by_key, **here.columns}
    columns = np.stack([known[q.key] for q in active], axis=1)
    values = np.array([here.point.get(q.key, q.off) - q.off for q in active])
    before, spread, reference = posterior(here.residual, columns, values, variance, problem.numerics)
    reference += within_tolerance(active, {q.key for q in fixed}, before, spread, limit)

    def evidence_at(trial: Trial, c: Candidate) -> float:
        there = np.array([{**here.point, **trial.shift}.get(q.key, q.off) - q.off for q in active])
        departure, spread, evidence = posterior(trial.residual, columns, there, variance, problem.numerics)
        q = c.quantities[0]
        evidence -= 0.5 * ((trial.shift[q.key] - q.off) / q.scale) ** 2
        # the size is free
        evidence -= math.log1p(q.scale * float(np.linalg.norm(here.by_candidate[c][:, 0])))
        return evidence + within_tolerance(active, {x.key for x in fixed}, departure, spread, limit)

    taken = {c.effect + tube_of(c.quantities[0]) for c in members}
    place = {q.key: i for i, q in enumerate(active)}
    screened = []
    for c in pool:
        if c.effect + tube_of(c.quantities[0]) in taken or c not in here.by_candidate:
            continue
        wide, J, start = variance.copy(), columns, values
        where = []
        for i, q in enumerate(c.quantities):
            if q.key in place:
                wide[place[q.key]] += q.scale**2
                where.append(place[q.key])
            else:
                where.append(J.shape[1])
                J = np.hstack([J, here.by_candidate[c][:, [i]]])
                wide, start = np.append(wide, q.scale**2), np.append(start, 0.0)
        departure, spread, evidence = posterior(here.residual, J, start, wide, problem.numerics)
        free = {q.key for q in (*fixed, *c.quantities)}
        evidence += within_tolerance(active, free, departure, spread, limit)
        gain = evidence - reference
        if len(where) == 1 and c.quantities[0].one_sided and departure[where[0]] < 0.0:
            gain = -math.inf
        best = Screened(gain, c, None)
        for trial in here.trials.get(c, ()):
            best = max(
                best, Screened(evidence_at(trial, c) - reference, c, trial), key=lambda item: item.gain
            )
        screened.append(best)
    return sorted(screened, key=lambda item: -item.gain)


def one_form_each(screened: Sequence[Screened]) -> list[Screened]:
    """One preset for each set of parameters: the first."""
    seen: set[frozenset[Key]] = set()
    out = []
    for s in screened:
        if s.candidate.keys not in seen:
            seen.add(s.candidate.keys)
            out.append(s)
    return out


def rank_pairs(
    problem: Problem,
    sensitivities: Sensitivities,
    base: Fit,
    pool: Sequence[Candidate],
    everything: Sequence[Candidate],
) -> list[tuple[float, tuple[Candidate, ...]]]:
    """All sets of one and two of ``pool`` with their linear log posterior, best first, where ``base`` and ``sensitivities`` stand.

    A search that adds one cause at a time takes, of two causes, what imitates both together; from there each of the two by itself is worse.

    Args:
        everything: candidates among whom prior probability is shared.
    Returns:
        Sets without causes of the wrong sign.
    """
    limit = problem.options.calibration.tolerance_limit
    known = {**sensitivities.columns, **base.by_key}
    target = base.residual.copy()
    for q, value in zip(base.active, base.values, strict=True):
        target += known[q.key] * (value - q.off)
    common = np.stack([known[q.key] * q.tolerance for q in problem.nuisances], axis=1)
    common = np.hstack([common, problem.numerics])
    forms = [(c, block) for c in pool if (block := _scaled_columns(c, sensitivities, known)) is not None]
    free = np.hstack([block for _, block in forms])
    ends = np.cumsum([block.shape[1] for _, block in forms])
    place = {c: np.arange(end - block.shape[1], end) for (c, block), end in zip(forms, ends, strict=True)}
    # nuisances and numerics eliminated
    factor = np.linalg.cholesky(np.eye(common.shape[1]) + common.T @ common)
    half = np.linalg.solve(factor, common.T @ np.column_stack([free, target]))
    gram = free.T @ free - half[:, :-1].T @ half[:, :-1]
    right = free.T @ target - half[:, :-1].T @ half[:, -1]
    left = float(target @ target - half[:, -1] @ half[:, -1])
    volume = float(np.log(np.diag(factor)).sum())
    spread = np.sqrt(np.diag(np.linalg.inv(factor @ factor.T)))[: len(problem.nuisances)] + 1e-9
    ranked = []
    for members in (*((c,) for c, _ in forms), *combinations([c for c, _ in forms], 2)):
        if len({c.effect + tube_of(c.quantities[0]) for c in members}) < len(members):
            continue
        where = np.concatenate([place[c] for c in members])
        information = np.eye(len(where)) + gram[np.ix_(where, where)]
        size = np.linalg.solve(information, right[where])
        one_sided = [q.one_sided for c in members for q in (*c.quantities, *_known_shapes(c, known))]
        if any(s and z < 0.0 for s, z in zip(one_sided, size, strict=True)):
            continue
        evidence = -0.5 * (left - float(right[where] @ size)) - volume
        evidence -= 0.5 * float(np.linalg.slogdet(information)[1])
        evidence += half_gaussian_gain(size, np.linalg.inv(information), one_sided)
        nuisances = np.linalg.solve(factor.T, half[:, -1] - half[:, where] @ size)[: len(spread)]
        within = float(np.sum(log_ndtr((limit - np.abs(nuisances)) / spread)))
        evidence += within - len(spread) * float(log_ndtr(limit))
        prior = log_prior(members, everything, problem.options.prior, base.point)
        ranked.append((evidence + prior, members))
    return sorted(ranked, key=lambda item: -item[0])


def _known_shapes(c: Candidate, known: dict[Key, Floats]) -> tuple[EffectQuantity, ...]:
    """Shapes of a candidate whose columns are known: those of one that the fit holds."""
    return tuple(q for q in c.shapes if q.key in known)


def _scaled_columns(c: Candidate, sensitivities: Sensitivities, known: dict[Key, Floats]) -> Floats | None:
    """(m, k) columns of a candidate, for coefficients of unit prior deviation; None where it has none."""
    own = {**sensitivities.columns_of(c), **{key: known[key] for key in keys_of((c,)) if key in known}}
    wanted = (*c.quantities, *_known_shapes(c, known))
    if not all(q.key in own for q in wanted):
        return None
    return np.stack([own[q.key] * q.scale for q in wanted], axis=1)
