"""Which sets of causes would explain the data, by the columns at one point: all pairs at once, where looking for one cause at a time fails.

A search that adds one cause at a time takes, of two causes, what imitates both together; from there each of the two alone is worse. The linear
evidence of every pair costs no simulation: with nuisances and the solver's own error eliminated, it is algebra of a few columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from ctr_dynamics.diagnosis.inference.candidates import Candidate, keys_of, log_prior, tube_of
from ctr_dynamics.diagnosis.inference.map_fit import INSIDE, LOG_INSIDE, Fit, Key, Problem
from ctr_dynamics.diagnosis.inference.sensitivities import Linearisation
from ctr_dynamics.effects import Quantity

Floats = NDArray[np.float64]


def rank_sets(
    problem: Problem,
    lin: Linearisation,
    base: Fit,
    pool: Sequence[Candidate],
    everything: Sequence[Candidate],
) -> list[tuple[float, tuple[Candidate, ...]]]:
    """Sets of one and two of ``pool``, with their linear log posterior, best first, where ``base`` and ``lin`` stand.

    ``everything``: the candidates among whom prior probability is shared. Causes of the wrong sign do not appear.
    """
    known = {**lin.columns, **base.by_key}
    target = base.residual.copy()
    for q, value in zip(base.active, base.values, strict=True):
        target += known[q.key] * (value - q.off)
    common = np.stack([known[q.key] * q.tolerance for q in problem.nuisances], axis=1)
    common = np.hstack([common, problem.numerics])
    forms = [(c, block) for c in pool if (block := _columns(c, lin, known)) is not None]
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
        one_sided = [q.one_sided for c in members for q in (*c.quantities, *_shapes(c, known))]
        if any(s and z < 0.0 for s, z in zip(one_sided, size, strict=True)):
            continue
        evidence = -0.5 * (left - float(right[where] @ size)) - volume
        evidence -= 0.5 * float(np.linalg.slogdet(information)[1])
        evidence += math.log(2.0) * sum(one_sided)
        astray = np.linalg.solve(factor.T, half[:, -1] - half[:, where] @ size)[: len(spread)]
        evidence += float(np.sum(log_ndtr((INSIDE - np.abs(astray)) / spread))) - len(spread) * LOG_INSIDE
        ranked.append((evidence + log_prior(members, everything), members))
    return sorted(ranked, key=lambda item: -item[0])


def _shapes(c: Candidate, known: dict[Key, Floats]) -> tuple[Quantity, ...]:
    """Shapes of a candidate whose columns are known: those of one that the fit holds."""
    return tuple(q for q in c.shapes if q.key in known)


def _columns(c: Candidate, lin: Linearisation, known: dict[Key, Floats]) -> Floats | None:
    """(m, k) columns of a candidate, for coefficients of unit prior deviation; None where it has none."""
    own = {**lin.own(c), **{key: known[key] for key in keys_of((c,)) if key in known}}
    wanted = (*c.quantities, *_shapes(c, known))
    if not all(q.key in own for q in wanted):
        return None
    return np.stack([own[q.key] * q.scale for q in wanted], axis=1)
