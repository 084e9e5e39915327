"""Search on growing parts of the recordings: causes are added where the part that they explain ends.

A cause that changes a frequency puts the model out of phase by turns, and from there no derivative shows the way, not even to causes that
change none. Where the part that is explained ends, the phases still agree. There one more cause is looked for, and all of them are fitted to
growing parts, up to where they do not suffice either.
"""

from __future__ import annotations

from dataclasses import dataclass

from joblib import delayed

from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.diagnosis.inference.candidates import Candidate, causes_of, keys_of
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.fit_quality import MOST_CAUSES, is_acceptable
from ctr_dynamics.diagnosis.inference.growing_fit import explain_growing_parts, part_of
from ctr_dynamics.diagnosis.inference.hypotheses import (
    Addition,
    Hypothesis,
    fit_addition,
    fit_hypothesis,
    with_form,
)
from ctr_dynamics.diagnosis.inference.map_fit import Fit, fit
from ctr_dynamics.diagnosis.inference.screening import one_form_each, screen
from ctr_dynamics.diagnosis.inference.search_moves import SearchState
from ctr_dynamics.diagnosis.inference.sensitivities import sensitivities_at


@dataclass(frozen=True)
class Partial:
    """Causes as far as they explain the recordings.

    Attributes:
        part: of the recordings' durations to which they are fitted.
        fit: to that part. left: of the misfit that the causes but the last one leave there.
        whole: fit to the whole recordings, where they explain these.
    """

    members: tuple[Candidate, ...]
    part: float
    fit: Fit
    left: float = 1.0
    whole: Fit | None = None

    @property
    def names(self) -> str:
        """Effect IDs."""
        return ", ".join(c.effect for c in self.members)

    @property
    def merit(self) -> float:
        """Log evidence for each value, which compares parts of different lengths."""
        return self.fit.log_evidence / len(self.fit.residual)


def search_growing_parts(state: SearchState) -> None:
    """Add hypotheses that are fitted to the whole; none where nuisances explain every part, nor a second time.

    One more cause is added to those that explain most, until something explains the whole or there are as many as there may be. Where nothing
    does, the single causes that explain most are fitted to the whole, so that other searches can begin there.
    """
    if state.grown:
        return
    state.grown = True
    state.context.report("the first part that tolerances do not explain")
    leading = _first_unexplained(state.problem)
    single: list[Partial] = []
    tried: set[frozenset[Key]] = set()
    for number in range(1, MOST_CAUSES + 1):
        more = [new for one in leading for new in _with_one_more(state, one, tried)]
        more.sort(key=lambda one: -one.merit)
        leading = _grown(state, more)
        if number == 1:
            single = leading or more[: state.problem.options.search.beam]
        whole = [Hypothesis(one.members, one.whole) for one in leading if one.whole is not None]
        if whole or state.context.out_of_time:
            state.add(whole)
            return
    limit = state.cost_limit
    state.add(
        state.run_fits(
            [
                delayed(fit_hypothesis)(state.problem, one.members, one.fit.point, limit=limit, polish=False)
                for one in single
            ]
        )
    )


def _first_unexplained(problem: Problem) -> list[Partial]:
    """No cause, at the first part that nuisances do not explain; empty where they explain every part."""
    if problem.explained is None:
        done = explain_growing_parts(problem)
        problem.explained = done.part, done.point
    (explained, point), o = problem.explained, problem.options.calibration
    if explained == 1.0:
        return []
    part = min(explained * o.growth, 1.0) if explained else o.first_part
    begin = fit(part_of(problem, part), (), point, polish=False)
    return [] if begin is None else [Partial((), part, begin)]


def _grown(state: SearchState, begun: list[Partial]) -> list[Partial]:
    """The best of ``begun``, each at the first part that it does not explain.

    Where none explains its own part, that may need two causes from its first moment on: those that explain much of it stay there.
    """
    problem, context, o = state.problem, state.context, state.problem.options.search
    good = [one for one in begun if is_acceptable(part_of(problem, one.part), one.fit)][: o.beam]
    if not good or context.out_of_time:
        return [one for one in begun if one.left <= o.half_left][: o.beam]
    context.report(f"longer parts with {'; '.join(one.names for one in good)}")
    return context.run([delayed(_followed)(problem, one) for one in good])


def _with_one_more(state: SearchState, begun: Partial, tried: set[frozenset[Key]]) -> list[Partial]:
    """``begun`` with each cause that promises most where its part ends; ``tried``: sets that have been fitted, which grows."""
    problem, o = part_of(state.problem, begun.part), state.problem.options.search
    here = sensitivities_at(problem, begun.fit.point, state.pool, state.context)
    if here is None:
        return []
    least = o.further_gain - o.further_slack
    screened = screen(problem, here, begun.fit, begun.members, state.pool)
    promising = one_form_each([item for item in screened if item.gain > least])
    jobs = []
    for item in promising[: o.further if begun.members else problem.options.screening.candidates]:
        keys = keys_of((*begun.members, item.candidate))
        if keys not in tried:
            tried.add(keys)
            jobs.append(delayed(fit_addition)(problem, Addition(begun.members, item, begun.fit, here)))
    misfit = max(begun.fit.chi2 - problem.size, 1.0)
    return [
        Partial(e.members, begun.part, e.fit, (e.fit.chi2 - problem.size) / misfit)
        for e in state.run_fits(jobs)
    ]


def _followed(problem: Problem, begun: Partial) -> Partial:
    """``begun`` fitted to longer and longer parts, and the first one that it does not explain."""
    own, causes = with_form(problem, begun.members), causes_of(begun.members)
    done = explain_growing_parts(own, causes, begun.fit.point, first_part=begun.part)
    if done.fit is not None:
        return Partial(begun.members, 1.0, done.fit, 0.0, done.fit)
    part = min(max(done.part, begun.part) * problem.options.calibration.growth, 1.0)
    found = fit(part_of(own, part), causes, done.point, polish=False)
    return begun if found is None else Partial(begun.members, part, found)
