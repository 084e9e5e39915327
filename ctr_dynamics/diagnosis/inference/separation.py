"""Separation: how much of a sensitivity is left after everything that could do the same has been projected out.

In: a fit and sensitivities there. Out: sizes in whitened units, in which noise has a deviation of one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.inference.candidates import Candidate, keys_of
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.gaussian_posterior import prior_variance
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities

Floats = NDArray[np.float64]


def separation(
    problem: Problem,
    fit: Fit,
    members: Sequence[Candidate],
    rival: Candidate | None = None,
    sensitivities: Sensitivities | None = None,
) -> float:
    """d_sep of a cause, or of several together: the whitened size of what they do beside nuisances, other causes and the rival.

    ``sensitivities``: at the fit, with those of the rival.
    """
    against = np.zeros((len(fit.columns), 0))
    if sensitivities is not None and rival in sensitivities.by_candidate:
        against = sensitivities.by_candidate[rival] * [q.scale for q in rival.quantities]
    return separation_in(fit, fit.columns, members, against, problem.numerics)


def separation_in(
    fit: Fit, columns: Floats, members: Sequence[Candidate], against: Floats, numerics: Floats
) -> float:
    """:func:`separation` of ``members`` of ``fit`` where its values have other sensitivities, such as with one more bag.

    Args:
        columns: (m, a) whitened, of the active values.
        against: (m, k) of a rival, by its scales. numerics: (m, j) of the error of the solver.
    """
    scales, departure = prior_scales(fit, members), departures(fit, members)
    J = np.hstack([columns * scales, against, numerics])
    return float(left_over(J, (columns @ departure)[:, None])[0])


def departures(fit: Fit, members: Sequence[Candidate]) -> Floats:
    """(a,) how far the active values of ``members`` are off their nominal ones; 0 of all others."""
    own = {q.key for c in members for q in c.quantities}
    return np.array([v - q.off if q.key in own else 0.0 for q, v in zip(fit.active, fit.values, strict=True)])


def prior_scales(fit: Fit, members: Sequence[Candidate], rival: Candidate | None = None) -> Floats:
    """(a,) prior deviations of the active values; 0 of those that are gone with ``members``, as of a cause for those of a ``rival``."""
    gone, wide = keys_of(members), {q.key for q in (*fit.causes, *(rival.quantities if rival else ()))}
    return np.array(
        [
            0.0 if q.key in gone else math.sqrt(prior_variance(q, q.key in wide, fit.tolerance_factor))
            for q in fit.active
        ]
    )


def observable_sizes(problem: Problem, sensitivities: Sensitivities) -> dict[str, float]:
    """Whitened size of every effect's strongest sensitivity at its prior scale, nuisances projected out."""
    J = np.hstack(
        [
            np.stack([sensitivities.columns[q.key] * q.tolerance for q in problem.nuisances], axis=1),
            problem.numerics,
        ]
    )
    sizes: dict[str, float] = {}
    for c, sensitivity in sensitivities.by_candidate.items():
        size = left_over(J, sensitivity * [q.scale for q in c.quantities])[0]
        sizes[c.effect] = max(float(size), sizes.get(c.effect, 0.0))
    return sizes


def left_over(J: Floats, sensitivity: Floats) -> Floats:
    """Sizes, largest first, of what columns ``J`` (m, a) with coefficients of unit prior deviation leave of ``sensitivity`` (m, k)."""
    return left_over_products(J.T @ J, J.T @ sensitivity, sensitivity.T @ sensitivity)


def left_over_products(JJ: Floats, JS: Floats, SS: Floats) -> Floats:
    """The same by the products of the columns: J^T J (a, a), J^T S (a, k) and S^T S (k, k)."""
    half = np.linalg.solve(np.linalg.cholesky(np.eye(len(JJ)) + JJ), JS)
    squares = np.linalg.eigvalsh(SS - half.T @ half)[::-1]
    return np.sqrt(np.maximum(squares, 0.0))
