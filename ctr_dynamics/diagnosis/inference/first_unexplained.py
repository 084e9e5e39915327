"""Search of the first part of the recordings that nuisances do not explain.

A cause that changes a frequency puts the model out of phase by turns, and from there no derivative shows the way, not even to causes that
change none. In the first moments that are not explained the phases still agree. What is found there is fitted to growing parts.
"""

from __future__ import annotations

from joblib import delayed

from ctr_dynamics.diagnosis.inference.candidates import Candidate, causes_of
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.fit_quality import is_acceptable
from ctr_dynamics.diagnosis.inference.growing_fit import explain_growing_parts, fit_growing, part_of
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis, with_form
from ctr_dynamics.diagnosis.inference.map_fit import Fit, fit
from ctr_dynamics.diagnosis.inference.screening import screen
from ctr_dynamics.diagnosis.inference.search_moves import SearchState, fit_single_causes
from ctr_dynamics.diagnosis.inference.sensitivities import sensitivities_at


def search_first_unexplained(state: SearchState) -> list[Hypothesis]:
    """Hypotheses of one cause from the first part that nuisances do not explain, fitted to the whole; none where they explain all."""
    problem, context = state.problem, state.context
    context.report("the first part that tolerances do not explain")
    if problem.explained is None:
        done = explain_growing_parts(problem)
        problem.explained = done.part, done.point
    explained, point = problem.explained
    if explained == 1.0:
        return []
    o = problem.options.calibration
    part = min(explained * o.growth, 1.0) if explained else o.first_part
    short = part_of(problem, part)
    start = fit(short, (), point, polish=False)
    here = None if start is None else sensitivities_at(short, start.point, state.pool, context)
    if start is None or here is None:
        return []
    there = SearchState(short, state.pool, start, context.within("first part"), [Hypothesis((), start)])
    fit_single_causes(there, screen(short, here, start, (), state.pool), here)
    s = problem.options.search
    leading = [e for e in there.found if e.members][: s.first_part_causes]
    found: list[Hypothesis] = []
    # what explains everything leaves the rest to the search for its rivals
    for batch in (leading[: s.batch], leading[s.batch :]):
        if batch and not any(is_acceptable(problem, e.fit) for e in found):
            context.report(f"longer parts with {', '.join(effect for e in batch for effect in e.effects)}")
            limit = state.cost_limit
            found += state.run_fits([delayed(_grow)(problem, e.members, e.fit, part, limit) for e in batch])
    return found


def _grow(
    problem: Problem, members: tuple[Candidate, ...], begun: Fit, part: float, limit: float
) -> Hypothesis | None:
    """``members`` fitted to the whole recordings, from their fit to a first part of them; ``limit``: cost beyond which that is given up."""
    own = with_form(problem, members)
    found = fit_growing(own, causes_of(members), begun.point, first_part=part, limit=limit)
    return None if found is None else Hypothesis(members, found)
