"""Decision: the verdict and its causes.

In: weighed hypotheses, the validation, and whether the bags excite the robot. Out: a :class:`Verdict`. docs/diagnosis.md lists the rules.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.inference.discrepancy import CorrelatedProblem, Discrepancy, as_beside
from ctr_dynamics.diagnosis.inference.evidence import (
    WeighedHypotheses,
    WithDiscrepancy,
    likeliest_sets,
    needed_gain,
)
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.fit_quality import is_wrong
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis
from ctr_dynamics.diagnosis.inference.residual_tests import Whiteness
from ctr_dynamics.diagnosis.inference.screening import one_form_each
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities, sensitivities_at
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.verdict.separability import Cause, cause_with_rivals
from ctr_dynamics.diagnosis.verdict.unexplained_force import UnexplainedForce, unexplained_force
from ctr_dynamics.diagnosis.verdict.validation import Validation
from ctr_dynamics.diagnosis.whitening import noise_floor

CauseSets = list[tuple[tuple[str, ...], float | None]]


@dataclass
class Verdict:
    """Outcome of a diagnosis.

    Attributes:
        word: `clean`, `named`, `named_with_remainder`, `ambiguous`, `unknown` or `not_excited`.
        cause_sets: sets of effects with their probabilities, likeliest first.
        sensitivities: at the likeliest hypothesis, where causes are named.
        unexplained_force: description of what no cause explains.
        discrepancy: what remains and is more than noise.
    """

    word: str
    causes: list[Cause] = field(default_factory=list)
    cause_sets: CauseSets = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    sensitivities: Sensitivities | None = None
    unexplained_force: UnexplainedForce | None = None
    discrepancy: Discrepancy | None = None


@dataclass(frozen=True)
class Evidence:
    """What a verdict rests on besides the hypotheses.

    Attributes:
        whiteness: of what the best hypothesis leaves. validation: None without bags for it.
        excited: whether the bags excite the robot.
        weighed: probabilities with a discrepancy; None where the residual is noise.
        numerics: discretisation error in m by name, NaN where it could not be measured.
    """

    whiteness: Whiteness
    validation: Validation | None
    excited: bool
    weighed: WithDiscrepancy | None = None
    numerics: Mapping[str, float] = field(default_factory=dict)


def needed_hypothesis(hypotheses: Sequence[Hypothesis], problem: Problem) -> Hypothesis:
    """The first of ``hypotheses``, likeliest first, without causes that together gain less than they must."""
    best = hypotheses[0]
    fewer = [e for e in hypotheses if e.keys <= best.keys and best.gain_over(e) < needed_gain(problem, e)]
    return min(fewer, key=lambda e: (len(e.members), -e.score))


def hypothesis_for_verdict(found: WeighedHypotheses, problem: Problem) -> Hypothesis:
    """The one that is needed; the likeliest where none with causes is, and yet it is as sure that something is wrong as a name must be."""
    needed = needed_hypothesis(found.hypotheses, problem)
    if needed.members or not found.best.members:
        return needed
    right = sum(float(p) for e, p in zip(found.hypotheses, found.probabilities, strict=True) if not e.members)
    return found.best if 1.0 - right >= problem.options.verdict.named else needed


def is_unexplained(problem: Problem, found: WeighedHypotheses, best: Hypothesis, evidence: Evidence) -> bool:
    """Whether ``best`` leaves what is neither noise, nor small and without effect on the bags that were not fitted."""
    o = problem.options
    is_noise = evidence.whiteness.p >= o.residual_tests.noise_p
    predicted = evidence.validation is not None and evidence.validation.confirms(o.validation)
    too_much = _fraction_left(problem, found, best) > (
        o.search.left if best.resolved else o.search.left_impacts
    )
    return not is_noise and (not best.members or is_wrong(problem, best) or (too_much and not predicted))


def decide(
    problem: Problem, found: WeighedHypotheses, best: Hypothesis, evidence: Evidence, context: RunContext
) -> Verdict:
    """Verdict with ``best`` as the hypothesis that is needed."""
    if is_unexplained(problem, found, best, evidence):
        result = _with_remainder(problem, found, best, evidence, context)
    else:
        result = _without_remainder(problem, found, best, evidence, context)
    unmeasured = [name for name, error in evidence.numerics.items() if not math.isfinite(error)]
    if unmeasured and result.word in ("clean", "named", "named_with_remainder"):
        result.word, result.causes = "unknown", [Cause(None, "unknown", None)]
        result.notes.append(
            f"{' and '.join(unmeasured)} could not be measured: finer simulations fail, and the error of the model may be the cause"
        )
    return result


def _separate(
    result: Verdict, problem: Problem, found: WeighedHypotheses, best: Hypothesis, context: RunContext
) -> None:
    """Causes of ``best`` with their separations and rivals into ``result``."""
    context.report("separability")
    forms = [s.candidate for s in one_form_each(found.screened)]
    known = found.at_best if best is found.best else None
    result.sensitivities = known or sensitivities_at(problem, best.fit.point, forms, context, again=best.fit)
    there = result.sensitivities or found.sensitivities
    result.causes = [cause_with_rivals(problem, found, best, c, there) for c in best.members]


def _without_remainder(
    problem: Problem, found: WeighedHypotheses, best: Hypothesis, evidence: Evidence, context: RunContext
) -> Verdict:
    """What ``best`` leaves is noise, or so small that it changes nothing."""
    o = problem.options
    is_noise = evidence.whiteness.p >= o.residual_tests.noise_p
    predicted = evidence.validation is not None and evidence.validation.confirms(o.validation)
    pooled = found.pooled(problem, best)
    result = Verdict("clean", cause_sets=list(likeliest_sets(pooled, o.evidence)))
    if best.members:
        _separate(result, problem, found, best, context)
    apart = all(cause.is_apart(o.verdict) for cause in result.causes)
    # who names more names these too
    probability = sum(p for effects, p in pooled if set(best.effects) <= set(effects))
    needed = needed_hypothesis(found.hypotheses, problem)
    sure = probability >= o.verdict.named and bool(needed.members or not best.members)
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
            probability = evidence.weighed.discrepancy if evidence.weighed is not None else None
            result.causes.append(Cause(None, "unknown", probability))


def _fraction_left(problem: Problem, found: WeighedHypotheses, best: Hypothesis) -> float:
    """Fraction of the re-calibrated model's misfit beyond noise that ``best`` leaves; 0 where that is within the noise."""
    dof = problem.size
    beyond = found.no_cause.fit.chi2 - dof
    return (best.fit.chi2 - dof) / beyond if beyond > 3.0 * math.sqrt(2.0 * dof) else 0.0


def _with_remainder(
    problem: Problem, found: WeighedHypotheses, best: Hypothesis, evidence: Evidence, context: RunContext
) -> Verdict:
    """More than noise is left: is it small, stands it beside causes that are sure all the same, or is the cause outside the catalogue."""
    o, weighed, validation = problem.options, evidence.weighed, evidence.validation
    remainder = best.discrepancy
    if weighed is None or remainder is None:
        return _unknown(problem, found, weighed)
    if not best.members:
        small = remainder.rms_m < noise_floor(problem.robot)
        if small and validation is not None and validation.nis_before <= o.validation.predicted:
            text = (
                f"{1e3 * remainder.rms_m:.2f} mm rms are left that are not noise: less than the tracker's noise, and the bags that "
                "were not fitted are predicted down to the noise"
            )
            return Verdict("clean", cause_sets=_sets(weighed, o), notes=[text], discrepancy=remainder)
        return _unknown(problem, found, weighed)
    without = found.no_cause.discrepancy
    # of the squares of what is left of positions, whatever the noise
    explained = 0.0 if without is None else 1.0 - (remainder.rms_m / without.rms_m) ** 2
    sure = weighed.of(best.effects) >= o.verdict.named and explained >= o.discrepancy.dominant
    worse = validation is not None and validation.interval[1] < 0.0
    if not sure or worse:
        return _unknown(problem, found, weighed)
    result = Verdict("named_with_remainder", cause_sets=_sets(weighed, o), discrepancy=remainder)
    beside = CorrelatedProblem.of(problem, remainder.process, remainder.sizes)
    _separate(
        result, beside, found, replace(best, fit=as_beside(beside, remainder.fit), beside=True), context
    )
    if result.sensitivities is not None:
        result.sensitivities = result.sensitivities.mapped(beside.undone)
    for cause in result.causes:
        cause.probability = weighed.of((cause.effect,))
        if cause.less_plausible:
            rivals = " or ".join(name.replace("_", " ") for name in cause.less_plausible)
            result.notes.append(
                f"by the data alone {rivals} could stand in the place of {cause.effect.replace('_', ' ')}; "
                "it would have a size that is less plausible"
            )
    if not all(cause.is_apart(o.verdict) for cause in result.causes):
        result.word = "ambiguous"
        result.notes.append(
            f"{1e3 * remainder.rms_m:.1f} mm rms remain, correlated over {remainder.correlation_time_s:.2g} s, whichever cause it is"
        )
    return result


def _sets(weighed: WithDiscrepancy, options: DiagnosisOptions) -> CauseSets:
    """Sets of causes, `unknown` among them where there is a discrepancy, as few as hold the probability of the options."""
    every = [*weighed.alone, *(((*effects, "unknown"), p) for effects, p in weighed.beside)]
    return list(likeliest_sets(every, options.evidence))


def _unknown(problem: Problem, found: WeighedHypotheses, weighed: WithDiscrepancy | None) -> Verdict:
    """No cause of the catalogue explains what is left; it is described as a force at the tip."""
    force = unexplained_force(
        problem.forward_models[0], found.no_cause.fit.point, problem.options.unexplained_force
    )
    return Verdict(
        "unknown",
        [Cause(None, "unknown", None if weighed is None else weighed.discrepancy)],
        [(("unknown",), None)] if weighed is None else _sets(weighed, problem.options),
        [force.text] if force is not None else [],
        unexplained_force=force,
        discrepancy=found.no_cause.discrepancy,
    )
