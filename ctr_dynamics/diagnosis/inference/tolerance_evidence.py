"""Evidence that the tolerances of a robot file are too tight: its values scatter more than they say.

In: a problem and its fit without causes. Out: evidence for wider tolerances, all together and each alone. The model is linear at the fit; a
tolerance times s is the prior deviation, and ln s is uniform up to ``widest``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_options import ToleranceOptions
from ctr_dynamics.diagnosis.inference.gaussian_posterior import posterior_of_information
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.effects import EffectQuantity

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class WiderTolerance:
    """One tolerance, in the coordinate of its quantity.

    Attributes:
        suggested: root of the posterior mean of the squared prior deviation, the other tolerances as stated.
        evidence: natural logarithm of the Bayes factor for a wider tolerance.
    """

    quantity: EffectQuantity
    stated: float
    suggested: float
    evidence: float


@dataclass(frozen=True)
class ToleranceEvidence:
    """Evidence that tolerances are too tight.

    Attributes:
        evidence: natural logarithm of the Bayes factor for one factor on all tolerances. Where the robot file is right, it exceeds
            1.15 with a probability of about 1 %.
        wider: tolerances with substantial evidence of being wider, the most certain first; the first of all where none has.
    """

    evidence: float
    wider: tuple[WiderTolerance, ...]


def tolerance_evidence(fit: Fit, numerics: Floats, options: ToleranceOptions) -> ToleranceEvidence:
    """Weigh wider tolerances against those of the robot file, with the noise that ``fit`` leaves.

    Args:
        fit: without causes. numerics: (m, d) whitened directions of the discretisation error with unit prior variance.
    """
    used = [i for i, q in enumerate(fit.active) if q.tolerance > 0.0]
    quantities = [fit.active[i] for i in used]
    if not used:
        return ToleranceEvidence(-math.inf, ())
    J = fit.columns[:, used]
    departure = fit.values[used] - np.array([q.off for q in quantities])
    noise = fit.inflation**2 * max(1.0, fit.chi2 / max(len(fit.whitened), 1))
    target = fit.residual + J @ departure
    inner = np.linalg.inv(np.eye(numerics.shape[1]) + numerics.T @ numerics)
    projected = J - numerics @ (inner @ (numerics.T @ J))
    information, score = J.T @ projected / noise, projected.T @ target / noise
    stated = np.array([q.tolerance for q in quantities])
    before = posterior_of_information(information, score, stated)[2]
    factors = np.geomspace(1.0, options.widest, options.factors)

    def of(which: NDArray[np.bool_]) -> Floats:
        return (
            np.array(
                [
                    posterior_of_information(information, score, np.where(which, s * stated, stated))[2]
                    for s in factors
                ]
            )
            - before
        )

    every = np.ones(len(used), dtype=np.bool_)
    together = _log_mean(of(every))
    wider = []
    for i, q in enumerate(quantities):
        each = of(np.arange(len(used)) == i)
        evidence = _log_mean(each)
        if evidence > 0.0:
            weights = np.exp(each - each.max())
            square = float(weights @ factors**2 / weights.sum())
            wider.append(WiderTolerance(q, float(stated[i]), math.sqrt(square) * float(stated[i]), evidence))
    wider.sort(key=lambda w: -w.evidence)
    return ToleranceEvidence(
        together, tuple(w for w in wider if w is wider[0] or w.evidence > options.substantial)
    )


def _log_mean(logs: Floats) -> float:
    top = float(logs.max())
    return top + math.log(float(np.exp(logs - top).mean()))
