"""How good a fit is: acceptable, poor, or in between."""

from __future__ import annotations

import math

from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis
from ctr_dynamics.diagnosis.inference.map_fit import Fit

MOST_CAUSES = 3  # of a hypothesis


def excess(problem: Problem, fit: Fit) -> float:
    """Deviations by which the residual's squares exceed what noise gives."""
    dof = problem.size
    return (fit.chi2 - dof) / math.sqrt(2.0 * dof)


def leaves_much(problem: Problem, fit: Fit) -> bool:
    """Whether ``fit`` leaves so much more than noise that more hypotheses are worth a trial."""
    return excess(problem, fit) > problem.options.search.much_left


def is_acceptable(problem: Problem, fit: Fit) -> bool:
    """Whether ``fit`` may be right: what leaves more is not, whatever fraction of the misfit that is, but for impacts."""
    return fit.chi2 <= problem.options.search.acceptable * problem.size


def is_wrong(problem: Problem, hypothesis: Hypothesis) -> bool:
    """Whether ``hypothesis`` leaves so much that it is not right, and that is not the model's error in time."""
    return hypothesis.resolved and not is_acceptable(problem, hypothesis.fit)


def is_far_from_noise(problem: Problem, hypothesis: Hypothesis, recalibrated: Fit) -> bool:
    """Whether the likeliest ``hypothesis`` is so far from the noise that nuisances beyond their tolerances would only follow the error of the model:
    it explains little, or has as many causes as there may be."""
    far = hypothesis.fit.chi2 > problem.options.search.far_from_noise * problem.size
    most = len(hypothesis.members) == MOST_CAUSES
    return far and (most or hypothesis.fit.cost > poor_fit_cost(problem, recalibrated))


def poor_fit_cost(problem: Problem, recalibrated: Fit) -> float:
    """Cost that two causes must reach for a third, or for more care, to be worth it."""
    misfit = max(recalibrated.cost - problem.size, problem.size)
    return problem.size + problem.options.search.poor_fit * misfit


def explains(problem: Problem, hypothesis: Hypothesis, recalibrated: Fit) -> bool:
    """Whether ``hypothesis`` leaves no more than noise, a small part of the misfit, or the model's own error in time."""
    best = hypothesis.fit
    if not leaves_much(problem, best) or not hypothesis.resolved:
        return True
    allowed = problem.options.search.left * (recalibrated.chi2 - problem.size)
    return is_acceptable(problem, best) and best.chi2 - problem.size <= allowed
