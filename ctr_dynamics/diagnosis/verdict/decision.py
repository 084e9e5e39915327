"""Decision: the verdict and its causes.

In: weighed hypotheses, the validation, and whether the bags excite the robot. Out: a :class:`Verdict`. docs/diagnosis.md lists the rules.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from ctr_dynamics.diagnosis.inference.evidence import WeighedHypotheses
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.fit_quality import is_wrong
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis
from ctr_dynamics.diagnosis.inference.screening import one_form_each
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities, sensitivities_at
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.verdict.residual_tests import Whiteness
from ctr_dynamics.diagnosis.verdict.separability import Cause, cause_with_rivals
from ctr_dynamics.diagnosis.verdict.unexplained_force import UnexplainedForce, unexplained_force
from ctr_dynamics.diagnosis.verdict.validation import Validation

CauseSets = list[tuple[tuple[str, ...], float]]


@dataclass
class Verdict:
    """Outcome of a diagnosis.

    Attributes:
        word: `clean`, `named`, `ambiguous`, `unknown` or `not_excited`.
        cause_sets: sets of effects with their probabilities, likeliest first.
        sensitivities: at the likeliest hypothesis, where causes are named.
        unexplained_force: description of what no cause explains.
    """

    word: str
    causes: list[Cause] = field(default_factory=list)
    cause_sets: CauseSets = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    sensitivities: Sensitivities | None = None
    unexplained_force: UnexplainedForce | None = None


@dataclass(frozen=True)
class Evidence:
    """What a verdict rests on besides the hypotheses.

    Attributes:
        whiteness: of what the best hypothesis leaves. validation: None without bags for it.
        excited: whether the bags excite the robot.
    """

    whiteness: Whiteness
    validation: Validation | None
    excited: bool


def needed_hypothesis(hypotheses: Sequence[Hypothesis], needed_gain: float) -> Hypothesis:
    """The first of ``hypotheses``, likeliest first, without causes that gain less than ``needed_gain`` together.

    By all bags or by the fitted ones: bags that were not fitted can speak against a cause, but not for one that the others do not show.
    """
    best = hypotheses[0]
    fewer = [
        e
        for e in hypotheses
        if e.keys <= best.keys and min(best.score - e.score, best.fitted_score - e.fitted_score) < needed_gain
    ]
    return min(fewer, key=lambda e: (len(e.members), -e.score))


def decide(
    problem: Problem, found: WeighedHypotheses, best: Hypothesis, evidence: Evidence, context: RunContext
) -> Verdict:
    """Verdict with ``best`` as the hypothesis that is needed."""
    o = problem.options
    is_noise = evidence.whiteness.p >= o.residual_tests.noise_p
    predicted = evidence.validation is not None and evidence.validation.confirms(o.validation)
    too_much = _fraction_left(problem, found, best) > (
        o.search.left if best.resolved else o.search.left_impacts
    )
    if not is_noise and (not best.members or is_wrong(problem, best) or (too_much and not predicted)):
        return _unknown(problem, found, best)
    result = Verdict("clean", cause_sets=found.cause_sets(o))
    if best.members:
        context.report("separability")
        forms = [s.candidate for s in one_form_each(found.screened)]
        known = found.at_best if best is found.best else None
        result.sensitivities = known or sensitivities_at(
            problem, best.fit.point, forms, context, again=best.fit
        )
        there = result.sensitivities or found.sensitivities
        result.causes = [cause_with_rivals(problem, found, best, c, there) for c in best.members]
    apart = all(cause.is_apart(o.verdict) for cause in result.causes)
    # who names more names these too
    probability = sum(p for effects, p in result.cause_sets if set(best.effects) <= set(effects))
    sure = probability >= o.verdict.named
    if not evidence.excited and not (best.members and apart and sure):
        result.word, result.causes = "not_excited", []
    elif not best.members:
        if not sure:
            result.notes.append("small causes cannot be excluded; see the list of hypotheses")
    else:
        _name(result, problem, best, evidence, apart and sure, is_noise or predicted)
    return result


def _name(
    result: Verdict, problem: Problem, best: Hypothesis, evidence: Evidence, sure: bool, complete: bool
) -> None:
    """`named` or `ambiguous`, with a cause outside the catalogue beside those of ``best`` where they are not ``complete``."""
    o = problem.options
    worse = evidence.validation is not None and evidence.validation.interval[1] < 0.0
    result.word = "named" if sure and not worse else "ambiguous"
    if worse:
        result.notes.append("the causes make the prediction of the validation bags worse: they are not named")
    if evidence.whiteness.p < o.residual_tests.noise_p:
        result.notes.append(
            "something small is left that is not noise"
            if best.resolved
            else "what is left is of the size of the model's own error in time"
        )
        if not complete and best.resolved:
            result.causes.append(Cause(None, "unknown", o.verdict.unknown_beside))


def _fraction_left(problem: Problem, found: WeighedHypotheses, best: Hypothesis) -> float:
    """Fraction of the re-calibrated model's misfit beyond noise that ``best`` leaves; 0 where that is within the noise."""
    dof = problem.size
    beyond = found.no_cause.fit.chi2 - dof
    return (best.fit.chi2 - dof) / beyond if beyond > 3.0 * math.sqrt(2.0 * dof) else 0.0


def _unknown(problem: Problem, found: WeighedHypotheses, best: Hypothesis) -> Verdict:
    """No cause of the catalogue explains what is left; it is described as a force at the tip."""
    o = problem.options.verdict
    force = unexplained_force(
        problem.forward_models[0], found.no_cause.fit.point, problem.options.unexplained_force
    )
    sets = found.cause_sets(problem.options)
    rest = [(s, o.beside_unknown * p) for s, p in sets[:2] if s] if best.members else []
    return Verdict(
        "unknown",
        [Cause(None, "unknown", o.unknown)],
        [(("unknown",), o.unknown), *rest],
        [force.text] if force is not None else [],
        unexplained_force=force,
    )
