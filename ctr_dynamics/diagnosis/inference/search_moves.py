"""Moves of the hypothesis search: each fits more hypotheses and adds them to what was found.

In: a search state, and sensitivities where the move begins. Out: the state with more hypotheses, likeliest first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from joblib import delayed

from ctr_dynamics.diagnosis.inference.candidates import Candidate, keys_of
from ctr_dynamics.diagnosis.inference.contact_plane import find_contact_plane
from ctr_dynamics.diagnosis.inference.discretisation_error import renew_correction
from ctr_dynamics.diagnosis.inference.evidence import weigh
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.fit_quality import excess, is_acceptable, leaves_much, poor_fit_cost
from ctr_dynamics.diagnosis.inference.hypotheses import (
    Addition,
    Hypothesis,
    check_time_error,
    fit_addition,
    fit_alternative,
    fit_exactly,
    fit_hypothesis,
    fit_pair,
    fit_with_likeliest_tolerances,
    fit_without,
)
from ctr_dynamics.diagnosis.inference.map_fit import Fit, corrected
from ctr_dynamics.diagnosis.inference.screening import Screened, one_form_each, rank_pairs, screen
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities, sensitivities_at, with_large_sizes
from ctr_dynamics.diagnosis.inference.separation import separation
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.effects import EFFECTS, effect_quantities


@dataclass
class SearchState:
    """What a hypothesis search has found so far.

    Attributes:
        pool: candidates. recalibrated: the fit without causes, from which the search begins.
        found: hypotheses, likeliest first; the one without causes is among them.
        plane_sought: whether a contact plane has been looked for. Only the data and the nominal model tell of it, whatever the search begins from.
        grown: whether growing parts of the recordings have been searched.
    """

    problem: Problem
    pool: list[Candidate]
    recalibrated: Fit
    context: RunContext
    found: list[Hypothesis]
    plane_sought: bool = False
    grown: bool = False

    @property
    def best(self) -> Hypothesis:
        """The likeliest."""
        return self.found[0]

    @property
    def poor_fit_cost(self) -> float:
        """Cost above which a hypothesis is a poor fit."""
        return poor_fit_cost(self.problem, self.recalibrated)

    @property
    def cost_limit(self) -> float:
        """Cost from which a fit has no chance against what was found."""
        best = min(e.fit.cost for e in self.found)
        return best + self.problem.options.search.give_up**2 * max(1.0, best / self.problem.size)

    @property
    def promising(self) -> bool:
        """Whether the best leaves more than noise and is no poor fit."""
        return leaves_much(self.problem, self.best.fit) and self.best.fit.cost < self.poor_fit_cost

    def add(self, new: Sequence[Hypothesis] = ()) -> None:
        """Take ``new`` in, and sort again by log posterior."""
        self.found += new
        weigh(self.found, self.pool, self.problem.options)

    def run_fits(self, jobs: Sequence[object]) -> list[Hypothesis]:
        """Hypotheses of ``jobs``, without those that cannot be simulated."""
        return [e for e in self.context.run(jobs) if e is not None]


def fit_single_causes(
    state: SearchState, screened: Sequence[Screened], here: Sensitivities, tried: Sequence[Screened] = ()
) -> None:
    """Fit the best of ``screened``, likeliest first, so that what cannot win against those before it is given up.

    ``tried``: an earlier screening, of which nothing is fitted again.
    """
    problem, o, s = state.problem, state.problem.options.search, state.problem.options.screening
    promising = [item for item in screened if item.gain > s.least_gain][: s.candidates + s.spare]
    first = one_form_each(promising)[: s.candidates]
    before = {item.candidate: item.trial for item in tried}
    first = [
        item for item in first if item.candidate not in before or item.trial is not before[item.candidate]
    ]
    state.context.report(f"fitting {len(first)} single causes")
    for batch in (first[: o.batch], first[o.batch :]):
        limit = state.cost_limit
        state.add(
            state.run_fits(
                [
                    delayed(fit_addition)(problem, Addition((), item, state.recalibrated, here), limit)
                    for item in batch
                ]
            )
        )
        settle_tolerances(state)
    keep_promises(state, first)


def keep_promises(state: SearchState, fitted: Sequence[Screened]) -> None:
    """Fit again what screening promised more of than the best hypothesis has gained, and whose fit gained nothing: it went astray.

    The next fits begin at every finite size and preset, with nuisances as the robot file has them, which do not imitate the cause.
    """
    problem, least = state.problem, state.problem.options.search.further_gain
    nothing = max(e.fit.log_evidence for e in state.found if not e.members)
    gained = max(state.best.fit.log_evidence - nothing, least)
    kept = {e.keys for e in state.found if e.members and e.fit.log_evidence > nothing + least}
    jobs = []
    for item in fitted:
        c = item.candidate
        if item.gain > gained and c.keys not in kept:
            q = c.quantities[0]
            for form in (form for form in state.pool if form.keys == c.keys):
                for size in EFFECTS[c.effect].finite_sizes or (0.0,):
                    start = {**problem.nominal, **dict(form.start), q.key: q.off + size * q.scale}
                    jobs.append(delayed(fit_hypothesis)(problem, (form,), start, limit=state.cost_limit))
    if jobs:
        state.context.report("once more what did not keep what screening promised")
        state.add(state.run_fits(jobs))
        settle_tolerances(state)


def settle_tolerances(state: SearchState) -> None:
    """Fits with the likeliest tolerances for what may be the likeliest hypothesis, as long as one wants others than it was fitted with."""
    o = state.problem.options.search
    while not state.context.out_of_time:
        least = state.best.score - o.contender_margin
        near = [e for e in state.found if e.score > least and not e.fit.has_likeliest_tolerances]
        if not near:
            return
        fit_with_likeliest_tolerances(state.problem, near[0])
        state.add()


def begin_again_without_causes(state: SearchState) -> bool:
    """Whether the nuisances of the best hypothesis are a better fit by themselves than that without causes, whose place they take.

    A cause can lead the way to them that the fit without it did not find.
    """
    best, problem = state.best, state.problem
    if not best.members or not is_acceptable(problem, best.fit):
        return False
    other = fit_without(problem, (), best.fit, state.recalibrated.cost)
    if other is None or other.fit.cost > state.recalibrated.cost - problem.options.search.further_gain:
        return False
    state.context.report(f"once more, from the nuisances beside {', '.join(best.effects)}")
    state.recalibrated = other.fit
    return True


def try_large_sizes(
    state: SearchState, screened: list[Screened], here: Sensitivities, *, plane: bool = True
) -> tuple[list[Screened], Sensitivities]:
    """Screen and fit single causes at large sizes; returns screening and sensitivities with them.

    ``plane``: whether a contact plane that the data show is looked for.
    """
    problem = state.problem
    state.context.report("large sizes, and a contact plane" if plane else "large sizes")
    if plane and not (state.plane_sought or any(c.sizes for c in state.pool)):
        found = find_contact_plane(problem.even, effect_quantities(problem.robot), state.context)
        state.plane_sought = True
        state.pool = [*state.pool, *([found] if found else [])]
    here = with_large_sizes(problem, here, state.pool, state.context)
    again = screen(problem, here, state.recalibrated, (), state.pool)
    fit_single_causes(state, again, here, screened)
    return again, here


def leaders(state: SearchState) -> list[Hypothesis]:
    """The likeliest single cause, and the next where it may be as good, beside which others are looked for.

    None beside impacts that leave no more than the model's error in time.
    """
    problem, o = state.problem, state.problem.options.search
    much = leaves_much(problem, state.best.fit)
    if much:
        renew_discretisation(state)
        fit_exactly(problem, state.best)
        check_time_error(problem, state.best)
        if not state.best.resolved:
            return []
    near = state.best.score - (o.leader_margin_poor if much else o.leader_margin)
    return [e for e in state.found if e.members and e.score > near][: o.leaders]


def add_further_cause(state: SearchState, beside: Sequence[Hypothesis], here: Sensitivities) -> None:
    """One more cause beside those of each of ``beside``: what they leave is screened again."""
    problem, o = state.problem, state.problem.options.search
    new: list[Hypothesis] = []
    tried: set[frozenset[str]] = set()
    beyond = state.poor_fit_cost
    for leader in beside:
        state.context.report(f"what {', '.join(leader.effects)} leaves")
        fit_exactly(problem, leader)
        there = here.carried_to(leader.fit)
        if excess(problem, leader.fit) > o.little_left and leader.fit.cost < beyond:
            there = with_large_sizes(problem, there, state.pool, state.context)
        screened = screen(problem, there, leader.fit, leader.members, state.pool)
        jobs = []
        least = o.further_gain - o.further_slack
        for item in one_form_each([item for item in screened if item.gain > least])[: o.further]:
            names = frozenset(c.label for c in (*leader.members, item.candidate))
            if names not in tried:
                tried.add(names)
                addition = Addition(leader.members, item, leader.fit, there)
                jobs.append(delayed(fit_addition)(problem, addition, beyond))
        enough = leader.fit.log_evidence + o.further_gain
        new += [e for e in state.run_fits(jobs) if e.fit.log_evidence > enough]
    state.add(new)


def add_pairs(state: SearchState) -> None:
    """All pairs of the effects that leave least by themselves, where nobody has tried.

    Beside one of two causes that imitates both, the other looks like nothing.
    """
    state.context.report("pairs of what helps most by itself")
    single: dict[str, Hypothesis] = {}
    for e in sorted((e for e in state.found if len(e.members) == 1), key=lambda e: e.fit.cost):
        single.setdefault(e.effects[0], e)
    tried = {e.keys for e in state.found}
    helpful = list(single.values())[: state.problem.options.search.pair_effects]
    pairs = [p for p in combinations(helpful, 2) if p[0].keys | p[1].keys not in tried]
    limit = state.cost_limit
    state.add(state.run_fits([delayed(fit_pair)(state.problem, pair, limit) for pair in pairs]))


def pair_for_a_third(state: SearchState, beside: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best pair, where two causes are needed and a third could complete it; what leaves more is outside the catalogue."""
    two = next((e for e in state.found if len(e.members) == 2), None)
    if two is None or not beside or two.fit.cost > state.poor_fit_cost:
        return []
    enough = max(e.fit.log_evidence for e in beside) + state.problem.options.search.further_gain
    return [two] if two.fit.log_evidence > enough else []


def drop_causes(state: SearchState) -> None:
    """The best hypothesis without each of its causes: what was found on the way to others may not be needed beside them."""
    best, out = state.best, []
    while len(best.members) > 1:
        state.context.report(f"whether each of {', '.join(best.effects)} is needed")
        sets = [tuple(m for m in best.members if m is not c) for c in best.members]
        limit = state.cost_limit
        smaller = state.run_fits(
            [delayed(fit_without)(state.problem, rest, best.fit, limit) for rest in sets]
        )
        out += smaller
        better = max(smaller, key=lambda e: e.fit.log_evidence, default=None)
        least = best.fit.log_evidence - state.problem.options.search.further_gain
        if better is None or better.fit.log_evidence < least:
            break
        best = better
    state.add(out)


def refit_contenders(state: SearchState) -> None:
    """Exact Jacobians for the hypotheses that may be the likeliest."""
    o = state.problem.options.search
    for _ in range(o.contenders):  # an exact fit of one may put another first
        near = [e for e in state.found if e.members and not e.exact and e.fit.cost < state.cost_limit]
        least = state.best.score - o.contender_margin
        near = [e for e in near if e.score > least and e.fit.cost < state.poor_fit_cost]
        if not near:
            break
        fit_exactly(state.problem, near[0])
        state.add()
    settle_tolerances(state)


def try_other_sizes(state: SearchState) -> None:
    """The best hypothesis from sizes around its own and from every preset, for causes that are tried at finite sizes.

    What such a cause leaves has several minima, in its size and in its form together.
    """
    problem, best = state.problem, state.best
    if best.fit.cost > state.poor_fit_cost or state.context.out_of_time:
        return
    growth = problem.options.screening.size_growth
    jobs = []
    for m in best.members:
        if m.sizes or not EFFECTS[m.effect].finite_sizes:  # of which the data tell, or a derivative does
            continue
        q = m.quantities[0]
        departure = best.fit.point[q.key] - q.off
        for form in (c for c in state.pool if c.keys == m.keys):
            for factor in (growth, 1.0 / growth):
                size = min(q.off + factor * departure, q.high)
                start = {**best.fit.point, **problem.nominal, **dict(form.start), q.key: size}
                jobs.append(delayed(fit_hypothesis)(problem, best.members, start, limit=state.cost_limit))
    if jobs:
        state.context.report(f"other sizes of {', '.join(best.effects)}")
        state.add(state.run_fits(jobs))
        refit_contenders(state)


def renew_discretisation(state: SearchState) -> None:
    """The discretisation error where the best hypothesis stands, if that is about right; what was found so far is weighed with it."""
    best = state.best
    if not best.members or best.has_impacts or best.fit.cost > state.poor_fit_cost:
        return
    state.context.report(f"discretisation error with {', '.join(best.effects)}")
    change = renew_correction(state.problem, best.fit.point, state.context)
    if change is None:
        return
    for e in state.found:
        e.fit, e.exact = corrected(state.problem, e.fit, change), False
    state.add()
    refit_contenders(state)


def add_alternatives(state: SearchState, screened: Sequence[Screened]) -> Sensitivities | None:
    """Alternatives to the best hypothesis and pairs ranked where it stands, until none takes the first place.

    Returns:
        Sensitivities at the likeliest hypothesis; None where there was no need of them.
    """
    problem, o = state.problem, state.problem.options.search
    at_best: Sensitivities | None = None
    stood: Hypothesis | None = None
    for _ in range(o.rounds):  # an alternative may take the first place
        renew_discretisation(state)
        best = state.best
        close, wrong = is_acceptable(problem, best.fit), state.promising
        if not best.members or not (close or wrong) or state.context.out_of_time:
            break
        state.context.report(f"alternatives to {', '.join(best.effects)}")
        if best is not stood:
            forms = [item.candidate for item in one_form_each(screened)]
            at_best = sensitivities_at(problem, best.fit.point, forms, state.context, again=best.fit)
            stood = best
        if at_best is None:
            break
        sets = alternatives(problem, state.found, at_best) if close else []
        margin = o.pair_margin + o.pair_nonlinear * max(state.recalibrated.cost - best.fit.cost, 0.0)
        sets += ranked_pairs(state, at_best, sets, math.inf if wrong else margin)
        if not sets:
            break
        state.add(fit_alternatives(state, sets, at_best))
        if state.best is not best:
            drop_causes(state)
        refit_contenders(state)
        if state.best is best and not wrong:
            break
    return at_best if state.best is stood else None


def alternatives(
    problem: Problem, found: Sequence[Hypothesis], at_best: Sensitivities
) -> list[tuple[Candidate, ...]]:
    """The best hypothesis with each of its causes, and each two, replaced by one that looks much like them there, where nobody has tried.

    Screening looks from the re-calibrated model. A large effect looks different from there, and one like it, or two, may have taken its place.
    """
    o, best = problem.options.search, found[0]
    tried = {e.keys for e in found}
    distance = o.alternative_distance
    if leaves_much(problem, best.fit):  # it is not right, and what is lies about that far away
        distance += math.sqrt(best.fit.chi2 - problem.size)
    sets: list[tuple[Candidate, ...]] = []
    for gone in (*combinations(best.members, 1), *combinations(best.members, 2)):
        rest = tuple(m for m in best.members if m not in gone)
        kept = {m.effect for m in rest} if len(gone) > 1 else set(best.effects)
        size = separation(problem, best.fit, gone)
        apart = max(distance, o.alternative_likeness * size)
        near = sorted(
            (
                (separation(problem, best.fit, gone, rival, at_best), i, rival)
                for i, rival in enumerate(at_best.by_candidate)
                if rival.effect not in kept
            ),
            key=lambda item: item[:2],
        )
        wanted = [
            (*rest, rival) for d, _, rival in near if d < apart and keys_of((*rest, rival)) not in tried
        ][: o.alternatives]
        tried.update(keys_of(members) for members in wanted)
        sets += wanted
    return sets


def ranked_pairs(
    state: SearchState, at_best: Sensitivities, planned: Sequence[tuple[Candidate, ...]], margin: float
) -> list[tuple[Candidate, ...]]:
    """Sets of one and two that gain most by the columns at the best hypothesis, where nobody has tried or will.

    Those whose log posterior seems less by more than ``margin`` are left out.
    """
    best = state.best
    tried = {e.keys for e in state.found} | {keys_of(members) for members in planned}
    forms = [c for c in at_best.by_candidate if c.keys not in {m.keys for m in best.members}]
    sets: list[tuple[Candidate, ...]] = []
    for score, members in rank_pairs(state.problem, at_best, best.fit, (*best.members, *forms), state.pool):
        if len(sets) == state.problem.options.search.pair_rankings or score < best.score - margin:
            break
        if keys_of(members) not in tried:
            tried.add(keys_of(members))
            sets.append(members)
    return sets


def fit_alternatives(
    state: SearchState, sets: Sequence[tuple[Candidate, ...]], at_best: Sensitivities
) -> list[Hypothesis]:
    """Fits of ``sets`` from the best hypothesis, where ``at_best`` stands."""
    limit = state.cost_limit
    return state.run_fits(
        [delayed(fit_alternative)(state.problem, state.best, members, at_best, limit) for members in sets]
    )
