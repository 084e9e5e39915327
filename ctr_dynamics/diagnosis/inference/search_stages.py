"""The search for explanations as a whole: over the recordings, after first impacts apart, with nuisances set free, and what held-out bags say."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from joblib import Parallel, delayed

from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.contact_plane import parting
from ctr_dynamics.diagnosis.inference.discretisation_error import add_numerics
from ctr_dynamics.diagnosis.inference.hypotheses import Explanation, finish, look_closer, with_nuisances
from ctr_dynamics.diagnosis.inference.hypothesis_search import (
    CONTENDERS,
    LEFT_SHARE,
    MUCH,
    Search,
    adequate,
    explore,
    leftover,
    probabilities,
    weigh,
)
from ctr_dynamics.diagnosis.inference.map_fit import Fit, Problem, corrected, fit, make_problem, posterior
from ctr_dynamics.effects import EFFECTS

EARLY = 1.0  # s after model and measurement part, to which causes are first fitted where there are impacts
SPANS = (2.0, 4.0)  # s after it, before the whole recording
LEADERS = 2  # explanations of the first moments that are fitted to longer spans
OPINIONS = 8  # likeliest explanations that are asked to predict bags that were not fitted
OUTVOTED = 100.0  # log evidence of the fitted bags that no prediction as good as the noise makes good
IMPOSSIBLE = -1e9  # log likelihood of bags that an explanation cannot simulate


def search(
    problem: Problem, pool: list[Candidate], clean: Fit, note: Callable[[str], None], workers: int = 2
) -> Search | None:
    """Find the explanations that deserve probability, from the recalibrated fit ``clean`` on.

    Where nothing explains the data and there seem to be impacts, the first moments after them are looked at apart. Where that does not help, all is
    tried again with nuisances that may go as far as they like: on the way to several causes they stand in for those that are not there yet.
    """
    found = explore(problem, pool, clean, note, workers)
    if found is None or _explained(problem, found, clean):
        return found
    pool = found.pool  # with the wall that was found
    if any(EFFECTS[m.effect].impacts for m in found.best.members):
        note("impacts: the first moments after them")
        early = _from_early(problem, pool, note, workers)
        if early:
            every = found.explanations + early
            weigh(every, pool)
            look_closer(problem, every[0])
            at_best = found.at_best if every[0] is found.best else None
            chances = probabilities(every, problem)
            found = replace(found, explanations=every, probabilities=chances, at_best=at_best)
        if _explained(problem, found, clean):
            return found
    note("once more, with nuisances beyond their tolerances")
    free = replace(problem, reach=math.inf)
    far = fit(free, (), clean.point, polish=False)
    other = None if far is None else explore(free, pool, far, note, workers)
    if other is None:
        return found
    change = free.offset - problem.offset
    problem.offset, problem.numerics = free.offset, free.numerics
    for e in found.explanations:
        e.fit = corrected(problem, e.fit, change)
    both = found.explanations + [e for e in other.explanations if e.members]
    weigh(both, pool)
    at_best = next((s.at_best for s in (found, other) if s.best is both[0]), None)
    return replace(found, explanations=both, probabilities=probabilities(both, problem), at_best=at_best)


def _explained(problem: Problem, found: Search, clean: Fit) -> bool:
    """Whether the best explanation leaves no more than noise, a small part of the misfit, or the model's own error in time."""
    if leftover(problem, found.best.fit) <= MUCH or not found.best.resolved:
        return True
    best = found.best.fit
    return adequate(problem, best) and best.chi2 - problem.size <= LEFT_SHARE * (clean.chi2 - problem.size)


def _from_early(
    problem: Problem, pool: list[Candidate], note: Callable[[str], None], workers: int
) -> list[Explanation]:
    """Explanations with impacts of the first moments after model and measurement part, fitted to spans that grow to whole recordings.

    Over a whole recording a wall a little off is out of step for good, and so is one beside a further cause that is not there yet.
    """
    partings = [parting(e) for e in problem.forward_models]
    begins = [begin for begin in partings if begin is not None]
    if len(begins) < len(partings):
        return []
    short = _until(problem, begins, EARLY)
    start = fit(short, (), {}, polish=False)
    if start is None:
        return []
    add_numerics(short, start.point, workers)
    start = fit(short, (), start.point) or start
    found = explore(short, pool, start, lambda text: note(f"early: {text}"), workers)
    out = []
    for e in (found.explanations if found else [])[:LEADERS]:
        if not any(EFFECTS[m.effect].impacts for m in e.members):
            continue
        note(f"longer spans with {', '.join(e.effects)}")
        result: Fit | None = e.fit
        for whole in (*(_until(problem, begins, span) for span in SPANS), problem):
            if result is not None:
                result = fit(with_nuisances(whole, e.members), e.fit.causes, result.point)
        if result is not None:
            out.append(Explanation(e.members, result, finished=True))
    return out


def _until(problem: Problem, begins: Sequence[float], span: float) -> Problem:
    """``problem`` up to ``span`` (s) after the time ``begins`` of each recording."""
    recordings = [
        e.recording.until(begin + span) for e, begin in zip(problem.forward_models, begins, strict=True)
    ]
    nodes = problem.forward_models[0].nodes
    return make_problem(problem.robot, recordings, problem.nuisances, problem.whiteners[0].mask, nodes)


def second_opinion(found: Search, problem: Problem, held_out: Problem, workers: int) -> None:
    """Let the likeliest explanations predict ``held_out``, recordings that were not fitted, and weigh them by both: what imitates a cause in one
    motion does not in another. Those have no say that are farther behind than a prediction down to the noise would make good."""
    every, first = found.explanations, found.best

    def ask(those: Sequence[Explanation]) -> None:
        new = [e for e in those if e.held_out is None]
        for e, opinion in zip(
            new,
            Parallel(workers, prefer="threads")(delayed(predicted)(held_out, e.fit) for e in new),
            strict=True,
        ):
            e.held_out = opinion

    for turn in range(CONTENDERS + 1):  # finishing one may put another first
        best = every[0]
        ask([best, found.clean])
        assert best.held_out is not None
        room = OUTVOTED + max(0.0, -0.5 * held_out.size - best.held_out)
        ask([e for e in every[:OPINIONS] if e.members and e.fitted > best.fitted - room])
        weigh(every, found.pool)
        if not every[0].members or every[0].finished or turn == CONTENDERS:
            break
        finish(problem, every[0])
        every[0].held_out = None
    if every[0] is not first:
        found.at_best = None
    found.probabilities = probabilities(every, problem)


def predicted(held_out: Problem, result: Fit) -> float:
    """Log likelihood of ``held_out``, up to a constant, with the posterior of ``result``: what the fitted bags leave open is no wrong prediction.

    By half the step where that can be simulated: fits are corrected for their error in time as well.
    """
    found = held_out.finer.linearise(result.point, result.active)
    found = found or held_out.linearise(result.point, result.active)
    if found is None:
        return IMPOSSIBLE
    residual, columns = found
    size, axes = np.linalg.eigh(result.covariance)
    free = columns @ (axes * np.sqrt(np.maximum(size, 0.0)))  # by coefficients of unit deviation
    _, _, evidence = posterior(residual, free, np.zeros(len(size)), np.ones(len(size)), held_out.numerics)
    return evidence
