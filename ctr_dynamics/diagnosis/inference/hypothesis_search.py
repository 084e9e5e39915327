"""Which causes explain the data: screening along signatures, joint fits, evidence, several causes.

Explanations are sets of at most three candidates. Their probabilities follow from Laplace evidence with priors on causes and sizes, tempered
against overconfidence (docs/diagnosis.md). Fits of candidates begin with the columns of the screening and go on with Broyden's updates; those
that may win are finished with exact columns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.inference.candidates import Candidate, keys_of, log_prior
from ctr_dynamics.diagnosis.inference.contact_plane import wall
from ctr_dynamics.diagnosis.inference.discretisation_error import renew_numerics
from ctr_dynamics.diagnosis.inference.hypotheses import (
    Explanation,
    Job,
    combined,
    finish,
    fit_all,
    look_closer,
    reduced,
    replaced,
)
from ctr_dynamics.diagnosis.inference.map_fit import Fit, Key, Problem, corrected
from ctr_dynamics.diagnosis.inference.pair_ranking import rank_sets
from ctr_dynamics.diagnosis.inference.sensitivities import (
    Linearisation,
    Scored,
    far_probes,
    linearise,
    screen,
    separation,
)
from ctr_dynamics.effects import EFFECTS, quantities

Floats = NDArray[np.float64]
TEMPERATURE = 1.6  # of the log evidence: a judgement against overconfidence, not fitted to cases
SHORTLIST = 8  # candidates that are fitted
BATCH = 2  # first fits, which the others must be able to beat; fixed, so that the outcome does not depend on the number of workers
SECOND = 4  # second causes that are fitted beside a first
HELPFUL = 5  # effects that leave least alone, whose pairs are tried where more than noise is left
LEFT_SHARE = 0.03  # of the misfit beyond noise that an explanation may leave
LEFT_NUMERICAL = 0.15  # the same where the model's error in time is as large
MUCH = 4.0  # deviations of the noise that an explanation may leave before more is tried
HOPELESS = 0.3  # of the misfit: two causes that leave more are not made right by a third
SECOND_EVIDENCE = 5.0  # log evidence that a further cause must add
# deviations of the noise: misfit from which large sizes of causes and a wall are looked at too, unless something else leaves no more than so many
FAR, LARGER = 80.0, 2.0
MIN_SCREEN = 1.0  # log evidence by the linear estimate below which a candidate is not worth a fit
# explanations that are finished with exact columns, and the log evidence to the best within which they may be
CONTENDERS, CONTEND = 3, 6.0
# separation from the best explanation's cause within which another is fitted in its place, and how many
STAND_IN, STAND_INS = 12.0, 3
LIKENESS = 0.12  # of its size: a rival that is nearer is alike in shape, and what a large effect does is not linear enough to tell them apart
ADEQUATE = 1.5  # of the noise: an explanation that leaves more is not right, nor worth stand-ins
# sets that are fitted because they look best by the columns at the best explanation; where that is right, how much less likely they may look,
# and which share of the misfit that it explains they may leave by these columns
SETS, CLOSE, NONLINEAR = 6, 6.0, 0.01
ROUNDS = 3  # of stand-ins and sets, from a new best explanation each, or the next sets where none of the first is better and more than noise is left
CONTENDER = 8.0  # deviations by which the cost may exceed the best one's: beyond, a fit is given up


@dataclass
class Search:
    """Outcome of a search.

    Attributes:
        explanations: all fitted, likeliest first, with ``score``; the clean one is among them.
        probabilities: of each. clean: the recalibrated fit. linearised: at the recalibrated point. screened: linear gains there.
        at_best: signatures at the likeliest explanation; None where there was no need of them.
    """

    explanations: list[Explanation]
    probabilities: Floats
    clean: Explanation
    linearised: Linearisation
    screened: list[Scored]
    pool: list[Candidate]
    at_best: Linearisation | None = None

    @property
    def best(self) -> Explanation:
        """The likeliest."""
        return self.explanations[0]


def explore(
    problem: Problem, pool: list[Candidate], clean: Fit, note: Callable[[str], None], workers: int
) -> Search | None:
    """The explanations that deserve probability, from the recalibrated fit ``clean`` on; None where the model cannot be simulated there."""
    base = Explanation((), clean)
    note("signatures of all candidates")
    lin = linearise(problem, clean.point, pool, workers)
    if lin is None:
        return None
    found = [base]
    screened = screen(problem, lin, clean, (), pool)
    _singles(problem, pool, found, screened, lin, note, workers)
    if leftover(problem, clean) > FAR and leftover(problem, found[0].fit) > LARGER:
        note("large sizes, and a wall")
        pool = [*pool, *_walls(problem, pool, workers)]
        tried = screened
        lin = far_probes(problem, lin, pool, workers)
        screened = screen(problem, lin, clean, (), pool)
        _singles(problem, pool, found, screened, lin, note, workers, tried)
    if found[0].members:
        leaders = _leaders(problem, found, pool, clean, note, workers)
        found += _further(problem, pool, leaders, clean, lin, note, workers)
        weigh(found, pool)
        if leftover(problem, found[0].fit) > MUCH and found[0].fit.cost < hopeless(problem, clean):
            note("pairs of what helps most alone")
            found += _pairs(problem, found, workers)
            weigh(found, pool)
        found += _further(
            problem, pool, _pair_to_go_on(problem, found, leaders, clean), clean, lin, note, workers
        )
        weigh(found, pool)
        found += _fewer(problem, found, note, workers)
        weigh(found, pool)
    _finish_contenders(problem, found, pool, clean)
    at_best, stood = None, None
    for _ in range(ROUNDS):  # a stand-in may take the first place
        _renew(problem, found, pool, clean, note, workers)
        best = found[0]
        close = adequate(problem, best.fit)
        wrong = leftover(problem, best.fit) > MUCH and best.fit.cost < hopeless(problem, clean)
        if not best.members or not (close or wrong):
            break
        note(f"what could stand in for {', '.join(best.effects)}")
        if best is not stood:
            forms = [s.candidate for s in distinct(screened)]
            at_best, stood = linearise(problem, best.fit.point, forms, workers, again=best.fit), best
        if at_best is None:
            break
        sets = _stand_ins(problem, found, at_best) if close else []
        margin = math.inf if wrong else CLOSE + NONLINEAR * max(clean.cost - best.fit.cost, 0.0)
        sets += _other_sets(problem, found, at_best, pool, sets, margin)
        new = _replace(problem, found, sets, at_best, workers)
        if not sets:
            break
        found += new
        weigh(found, pool)
        if found[0] is not best:
            found += _fewer(problem, found, note, workers)
            weigh(found, pool)
        _finish_contenders(problem, found, pool, clean)
        if found[0] is best and not wrong:
            break
    if found[0] is not stood:
        at_best = None
    return Search(found, probabilities(found, problem), base, lin, screened, pool, at_best)


def _singles(
    problem: Problem,
    pool: Sequence[Candidate],
    found: list[Explanation],
    screened: Sequence[Scored],
    lin: Linearisation,
    note: Callable[[str], None],
    workers: int,
    tried: Sequence[Scored] = (),
) -> None:
    """Fits of what the screening likes best to ``found``, which holds the clean one; likeliest first, so that what cannot win against those before
    it is given up. ``tried``: an earlier screening, of which nothing is fitted again."""
    clean = next(e for e in found if not e.members).fit
    first = distinct([s for s in screened if s.gain > MIN_SCREEN][: SHORTLIST + 3])[:SHORTLIST]
    before = {s.candidate: s.probe for s in tried}
    first = [s for s in first if s.candidate not in before or s.probe is not before[s.candidate]]
    note(f"fitting {len(first)} single causes")
    for batch in (first[:BATCH], first[BATCH:]):
        jobs = [Job((), s, clean, lin) for s in batch]
        found += fit_all(problem, jobs, _limit(problem, found), workers)
        weigh(found, pool)


def _walls(problem: Problem, pool: Sequence[Candidate], workers: int) -> list[Candidate]:
    """The wall that the data tell of, if they do and ``pool`` has none yet."""
    if any(c.sizes for c in pool):
        return []
    found = wall(problem, quantities(problem.robot), workers)
    return [found] if found else []


def _finish_contenders(
    problem: Problem, found: list[Explanation], pool: Sequence[Candidate], clean: Fit
) -> None:
    """Exact columns for the explanations that may be the likeliest."""
    for _ in range(CONTENDERS):  # finishing one may put another first
        near = [e for e in found if e.members and not e.finished and e.fit.cost < _limit(problem, found)]
        near = [
            e for e in near if e.score > found[0].score - CONTEND and e.fit.cost < hopeless(problem, clean)
        ]
        if not near:
            break
        finish(problem, near[0])
        weigh(found, pool)


def _stand_ins(
    problem: Problem, found: Sequence[Explanation], lin: Linearisation
) -> list[tuple[Candidate, ...]]:
    """The best explanation with each of its causes, and each two, replaced by one that looks much like them there, where nobody has tried.

    Screening looks from the re-calibrated model; a large effect looks different from there, and its place may have been taken by a likeness or
    by two.
    """
    best = found[0]
    tried = {e.keys for e in found}
    limit_apart = STAND_IN
    if leftover(problem, best.fit) > MUCH:  # it is not right, and what is lies about that far away
        limit_apart += math.sqrt(best.fit.chi2 - problem.size)
    sets: list[tuple[Candidate, ...]] = []
    for gone in (*combinations(best.members, 1), *combinations(best.members, 2)):
        rest = tuple(m for m in best.members if m not in gone)
        kept = {m.effect for m in rest} if len(gone) > 1 else set(best.effects)
        apart = max(limit_apart, LIKENESS * separation(problem, best.fit, gone, None, lin))
        near = sorted(
            (
                (separation(problem, best.fit, gone, rival, lin), i, rival)
                for i, rival in enumerate(lin.signatures)
                if rival.effect not in kept
            ),
            key=lambda item: item[:2],
        )
        wanted = [
            (*rest, rival) for d, _, rival in near if d < apart and keys_of((*rest, rival)) not in tried
        ][:STAND_INS]
        tried.update(keys_of(members) for members in wanted)
        sets += wanted
    return sets


def _other_sets(
    problem: Problem,
    found: Sequence[Explanation],
    lin: Linearisation,
    pool: Sequence[Candidate],
    planned: Sequence[tuple[Candidate, ...]],
    margin: float,
) -> list[tuple[Candidate, ...]]:
    """Sets of one and two that explain most by the columns at the best explanation, whatever it holds, where nobody has tried or will; those
    whose log posterior seems less by more than ``margin`` are left."""
    best = found[0]
    tried = {e.keys for e in found} | {keys_of(members) for members in planned}
    forms = [c for c in lin.signatures if c.keys not in {m.keys for m in best.members}]
    sets: list[tuple[Candidate, ...]] = []
    for score, members in rank_sets(problem, lin, best.fit, (*best.members, *forms), pool):
        if len(sets) == SETS or score < best.score - margin:
            break
        if keys_of(members) not in tried:
            tried.add(keys_of(members))
            sets.append(members)
    return sets


def _replace(
    problem: Problem,
    found: Sequence[Explanation],
    sets: Sequence[tuple[Candidate, ...]],
    lin: Linearisation,
    workers: int,
) -> list[Explanation]:
    """Fits of ``sets`` from the best explanation, where ``lin`` stands."""
    limit = _limit(problem, found)
    fits = Parallel(workers, prefer="threads")(
        delayed(replaced)(problem, found[0], members, lin, limit) for members in sets
    )
    return [e for e in fits if e is not None]


def _leaders(
    problem: Problem,
    found: list[Explanation],
    pool: Sequence[Candidate],
    clean: Fit,
    note: Callable[[str], None],
    workers: int,
) -> list[Explanation]:
    """The likeliest single cause, and the next where it may be as good, beside which others are looked for; none beside impacts that leave no more
    than the model's error in time."""
    much = leftover(problem, found[0].fit) > MUCH
    if much:
        _renew(problem, found, pool, clean, note, workers)
        finish(problem, found[0])
        look_closer(problem, found[0])
        if not found[0].resolved:
            return []
    near = found[0].score - (20.0 if much else 3.0)
    return [e for e in found if e.members and e.score > near][:2]


def _pair_to_go_on(
    problem: Problem, found: Sequence[Explanation], leaders: Sequence[Explanation], clean: Fit
) -> list[Explanation]:
    """The best pair, where two are needed and a third could save it: what leaves more is outside the catalogue."""
    two = next((e for e in found if len(e.members) == 2), None)
    if two is None or not leaders or two.fit.cost > hopeless(problem, clean):
        return []
    enough = max(e.fit.log_evidence for e in leaders) + SECOND_EVIDENCE
    return [two] if two.fit.log_evidence > enough else []


def _further(
    problem: Problem,
    pool: Sequence[Candidate],
    leaders: Sequence[Explanation],
    clean: Fit,
    lin: Linearisation,
    note: Callable[[str], None],
    workers: int,
) -> list[Explanation]:
    """One more cause beside those of each of ``leaders``: what they leave is screened again."""
    new: list[Explanation] = []
    tried: set[frozenset[str]] = set()
    beyond = hopeless(problem, clean)
    for leader in leaders:
        note(f"what {', '.join(leader.effects)} leaves")
        finish(problem, leader)
        here = lin.carried(leader.fit)
        scored = screen(problem, here, leader.fit, leader.members, pool)
        jobs = []
        for s in distinct([s for s in scored if s.gain > SECOND_EVIDENCE - 2.0])[:SECOND]:
            names = frozenset(x.label for x in (*leader.members, s.candidate))
            if names not in tried:
                tried.add(names)
                jobs.append(Job(leader.members, s, leader.fit, here))
        enough = leader.fit.log_evidence + SECOND_EVIDENCE
        new += [e for e in fit_all(problem, jobs, beyond, workers) if e.fit.log_evidence > enough]
    return new


def _pairs(problem: Problem, found: Sequence[Explanation], workers: int) -> list[Explanation]:
    """All pairs of the effects that leave least alone, where nobody has tried: beside one of two causes that stands in for both, the other looks like
    nothing."""
    alone: dict[str, Explanation] = {}
    for e in sorted((e for e in found if len(e.members) == 1), key=lambda e: e.fit.cost):
        alone.setdefault(e.effects[0], e)
    tried = {e.keys for e in found}
    pairs = [p for p in combinations(list(alone.values())[:HELPFUL], 2) if p[0].keys | p[1].keys not in tried]
    limit = _limit(problem, found)
    fits = Parallel(workers, prefer="threads")(delayed(combined)(problem, pair, limit) for pair in pairs)
    return [e for e in fits if e is not None]


def _limit(problem: Problem, found: Sequence[Explanation]) -> float:
    """Cost from which a fit has no chance against what was found."""
    best = min(e.fit.cost for e in found)
    return best + CONTENDER**2 * max(1.0, best / problem.size)


def _renew(
    problem: Problem,
    found: list[Explanation],
    pool: Sequence[Candidate],
    clean: Fit,
    note: Callable[[str], None],
    workers: int,
) -> bool:
    """The solver's own error where the best explanation stands, if that is about right; what was found so far is weighed with it."""
    best = found[0]
    if not best.members or any(EFFECTS[m.effect].impacts for m in best.members):
        return False
    if best.fit.cost > hopeless(problem, clean):
        return False
    note(f"numerics with {', '.join(best.effects)}")
    change = renew_numerics(problem, best.fit.point, workers)
    if change is None:
        return False
    for e in found:
        e.fit, e.finished = corrected(problem, e.fit, change), False
    weigh(found, pool)
    _finish_contenders(problem, found, pool, clean)
    return True


def _fewer(
    problem: Problem, found: Sequence[Explanation], note: Callable[[str], None], workers: int
) -> list[Explanation]:
    """The best explanation without each of its causes: what was found on the way to others may not be needed beside them."""
    best, out = found[0], []
    while len(best.members) > 1:
        note(f"whether each of {', '.join(best.effects)} is needed")
        sets = [tuple(m for m in best.members if m is not c) for c in best.members]
        limit = _limit(problem, found)
        fits = Parallel(workers, prefer="threads")(
            delayed(reduced)(problem, rest, best.fit, limit) for rest in sets
        )
        smaller = [e for e in fits if e is not None]
        out += smaller
        better = max(smaller, key=lambda e: e.fit.log_evidence, default=None)
        if better is None or better.fit.log_evidence < best.fit.log_evidence - SECOND_EVIDENCE:
            break
        best = better
    return out


def hopeless(problem: Problem, clean: Fit) -> float:
    """Cost that two causes must reach for a third, or for more care, to be worth it."""
    return problem.size + HOPELESS * max(clean.cost - problem.size, problem.size)


def leftover(problem: Problem, result: Fit) -> float:
    """Deviations by which the residual's squares exceed what noise gives."""
    dof = problem.size
    return (result.chi2 - dof) / math.sqrt(2.0 * dof)


def adequate(problem: Problem, result: Fit) -> bool:
    """Whether ``result`` may be right: what leaves more is not, whatever share of the misfit that is, but for impacts."""
    return result.chi2 <= ADEQUATE * problem.size


def distinct(found: Sequence[Scored]) -> list[Scored]:
    """One preset for each set of parameters: the first."""
    seen: set[frozenset[Key]] = set()
    out = []
    for s in found:
        if s.candidate.keys not in seen:
            seen.add(s.candidate.keys)
            out.append(s)
    return out


def weigh(found: list[Explanation], pool: Sequence[Candidate]) -> None:
    """Sort by log posterior; the better of two fits of the same set stays."""
    best: dict[frozenset[Key], Explanation] = {}
    for e, evidence in zip(found, _evidence(found), strict=True):
        prior = log_prior(e.members, pool)
        e.score, e.fitted = evidence + prior, e.fit.log_evidence + prior
        if e.keys not in best or best[e.keys].score < e.score:
            best[e.keys] = e
    found[:] = sorted(best.values(), key=lambda e: -e.score)


def _evidence(found: Sequence[Explanation]) -> list[float]:
    """Log evidence of each, with what it predicts of bags that were not fitted; who was not asked predicts no better than the worst."""
    worst = min((e.held_out for e in found if e.held_out is not None), default=0.0)
    return [e.fit.log_evidence + (worst if e.held_out is None else e.held_out) for e in found]


def probabilities(found: Sequence[Explanation], problem: Problem) -> Floats:
    """Of each explanation: softmax of the tempered score, with the noise that the best one leaves."""
    inflation = max(1.0, found[0].fit.chi2 / problem.size)
    evidence = np.array(_evidence(found))
    prior = np.array([e.score for e in found]) - evidence
    scores = evidence / (TEMPERATURE * inflation) + prior
    weights = np.exp(scores - scores.max())
    return weights / weights.sum()
