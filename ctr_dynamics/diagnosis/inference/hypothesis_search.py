"""Hypothesis search: which sets of at most three causes explain the data.

In: a problem, the candidates and the re-calibrated fit. Out: all hypotheses that were fitted, weighed by evidence. docs/diagnosis.md tells
the search in ten sentences; :mod:`~ctr_dynamics.diagnosis.inference.search_moves` has the moves.
"""

from __future__ import annotations

import math
from dataclasses import replace

from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.contact_plane import time_of_divergence
from ctr_dynamics.diagnosis.inference.discretisation_error import change_solution, correct_discretisation
from ctr_dynamics.diagnosis.inference.evidence import WeighedHypotheses, probabilities, weigh
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.fit_quality import excess, explains, is_acceptable, is_far_from_noise
from ctr_dynamics.diagnosis.inference.growing_search import search_growing_parts
from ctr_dynamics.diagnosis.inference.hypotheses import (
    Hypothesis,
    check_time_error,
    fit_with_likeliest_tolerances,
    with_form,
)
from ctr_dynamics.diagnosis.inference.map_fit import Fit, corrected, fit
from ctr_dynamics.diagnosis.inference.residual_tests import whiteness
from ctr_dynamics.diagnosis.inference.screening import screen
from ctr_dynamics.diagnosis.inference.search_moves import (
    SearchState,
    add_alternatives,
    add_further_cause,
    add_pairs,
    begin_again_without_causes,
    drop_causes,
    fit_single_causes,
    leaders,
    pair_for_a_third,
    refit_contenders,
    try_large_sizes,
    try_other_sizes,
)
from ctr_dynamics.diagnosis.inference.sensitivities import off_nominal, sensitivities_at
from ctr_dynamics.diagnosis.run_context import RunContext


def search_hypotheses(
    problem: Problem, pool: list[Candidate], recalibrated: Fit, context: RunContext
) -> WeighedHypotheses | None:
    """Find the hypotheses that deserve probability, from the re-calibrated fit on; None where the model cannot be simulated there.

    Where nothing explains the data and there seem to be impacts, the first moments after them are searched by themselves. Where that does
    not help, the search runs once more with nuisances that may go as far as they like: on the way to several causes they imitate those that
    are not there yet.
    """
    found = search_once(problem, pool, recalibrated, context)
    if found is not None:
        recalibrated = found.no_cause.fit
    if found is None or explains(problem, found.best, recalibrated) or context.out_of_time:
        return found
    if found.best.has_impacts:
        context.report("impacts: the first moments after them")
        early = search_early(problem, found.pool, context)
        if early:
            every = found.hypotheses + early
            weigh(every, found.pool, problem.options)
            check_time_error(problem, every[0])
            found = _with_hypotheses(found, every, problem, found)
        if explains(problem, found.best, recalibrated) or context.out_of_time:
            return found
    if is_far_from_noise(problem, found.best, recalibrated):
        return found
    context.report("once more, with nuisances beyond their tolerances")
    free = replace(problem, reach=math.inf, explained=None)
    far = fit(free, (), recalibrated.point, polish=False)
    other = (
        None if far is None else search_once(free, found.pool, far, context, plane_sought=found.plane_sought)
    )
    if other is None:
        return found
    change = change_solution(problem, free.forward_models, free.offset, free.numerics, found.best.fit.point)
    if change is None:
        return found
    for e in found.hypotheses:
        e.fit = corrected(problem, e.fit, change)
    both = found.hypotheses + [e for e in other.hypotheses if e.members]
    weigh(both, found.pool, problem.options)
    return _with_hypotheses(found, both, problem, found, other)


def search_once(
    problem: Problem,
    pool: list[Candidate],
    recalibrated: Fit,
    context: RunContext,
    *,
    plane_sought: bool = False,
) -> WeighedHypotheses | None:
    """One search from a fit without causes; None where the model cannot be simulated there.

    ``plane_sought``: whether an earlier search of these recordings has looked for a contact plane.
    """
    o = problem.options.search
    no_cause = Hypothesis((), recalibrated)
    fit_with_likeliest_tolerances(problem, no_cause)
    state = SearchState(problem, pool, recalibrated, context, [no_cause], plane_sought)
    context.report("sensitivities of all candidates")
    near = recalibrated.travelled <= problem.options.calibration.travelled
    known = recalibrated.by_key if near else {}
    here = sensitivities_at(problem, recalibrated.point, pool, context, known=known)
    if here is None:
        return None
    screened = screen(problem, here, recalibrated, (), pool)
    out_of_phase = recalibrated.chi2 > o.far_from_noise * problem.size  # and derivatives mislead
    if out_of_phase:
        search_growing_parts(state)
    if not (out_of_phase and is_acceptable(problem, state.best.fit)):
        fit_single_causes(state, screened, here)
    if begin_again_without_causes(state):
        return search_once(problem, state.pool, state.recalibrated, context, plane_sought=plane_sought)
    large_misfit = excess(problem, recalibrated) > o.large_misfit
    if large_misfit and excess(problem, state.best.fit) > o.little_left and not context.out_of_time:
        search_growing_parts(state)
        if excess(problem, state.best.fit) > o.little_left:
            screened, here = try_large_sizes(state, screened, here)
    imitated = off_nominal(problem, recalibrated.point) and off_nominal(problem, state.best.fit.point)
    suspicious = imitated or whiteness(problem, state.best.fit).p < o.suspicious_p
    if suspicious and not large_misfit and not context.out_of_time:
        screened, here = try_large_sizes(state, screened, here, plane=False)
    if state.best.members and not context.out_of_time:
        beside = leaders(state)
        add_further_cause(state, beside, here)
        if state.promising:
            add_pairs(state)
        add_further_cause(state, pair_for_a_third(state, beside), here)
        drop_causes(state)
    refit_contenders(state)
    try_other_sizes(state)
    at_best = add_alternatives(state, screened)
    best = state.best
    unexplained = whiteness(problem, best.fit).p < o.suspicious_p and not best.has_impacts
    if unexplained and not context.out_of_time:
        search_growing_parts(state)
    if state.best is not best:
        drop_causes(state)
        refit_contenders(state)
        at_best = add_alternatives(state, screened)
    return WeighedHypotheses(
        state.found,
        probabilities(state.found, problem),
        no_cause,
        here,
        screened,
        state.pool,
        at_best,
        state.plane_sought,
    )


def search_early(problem: Problem, pool: list[Candidate], context: RunContext) -> list[Hypothesis]:
    """Hypotheses with impacts of the first moments after model and measurement diverge, fitted to spans that grow to whole recordings.

    Over a whole recording a plane a little off is out of phase for good, and so is one beside a further cause that is not there yet.
    """
    o = problem.options.search
    times = [time_of_divergence(e, problem.options.contact_plane) for e in problem.forward_models]
    begins = [begin for begin in times if begin is not None]
    if len(begins) < len(times):
        return []
    short = problem.even.until([begin + o.early_s for begin in begins])
    start = fit(short, (), {}, polish=False)
    if start is None:
        return []
    correct_discretisation(short, start.point, context)
    start = fit(short, (), start.point) or start
    found = search_once(short, pool, start, context.within("early"))
    out = []
    for e in (found.hypotheses if found else [])[: o.early_leaders]:
        if not e.has_impacts:
            continue
        context.report(f"longer spans with {', '.join(e.effects)}")
        result: Fit | None = e.fit
        longer = [problem.even.until([begin + span for begin in begins]) for span in o.early_spans_s]
        for whole in (*longer, problem):
            if result is not None:
                result = fit(with_form(whole, e.members), e.fit.causes, result.point)
        if result is not None:
            out.append(Hypothesis(e.members, result, exact=True))
    return out


def _with_hypotheses(
    found: WeighedHypotheses, every: list[Hypothesis], problem: Problem, *searches: WeighedHypotheses
) -> WeighedHypotheses:
    """``found`` with all of ``every``, likeliest first, and the sensitivities of the search whose best hypothesis is the best of all."""
    at_best = next((s.at_best for s in searches if s.best is every[0]), None)
    return replace(found, hypotheses=every, probabilities=probabilities(every, problem), at_best=at_best)
