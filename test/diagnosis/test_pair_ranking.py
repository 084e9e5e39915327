"""Pairs of causes on problems that are linear: what a search one by one misses, and what bags that were not fitted say."""

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions, SearchOptions
from ctr_dynamics.diagnosis.inference.candidates import Candidate, causes_of
from ctr_dynamics.diagnosis.inference.evidence import (
    WeighedHypotheses,
    probabilities,
    weigh,
    weigh_by_prediction,
)
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis
from ctr_dynamics.diagnosis.inference.map_fit import fit
from ctr_dynamics.diagnosis.inference.screening import rank_pairs
from ctr_dynamics.diagnosis.inference.search_moves import SearchState, add_pairs, try_other_sizes
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities
from ctr_dynamics.diagnosis.inference.separation import separation
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.verdict.decision import hypothesis_for_verdict, needed_hypothesis
from ctr_dynamics.effects import EFFECTS, EffectParameter, EffectQuantity

OPTIONS = DiagnosisOptions()
SILENT = RunContext(workers=1)
# any effects of the catalogue
EFFECT = {"one": "density", "two": "payload_mass", "both": "youngs_modulus", "other": "tip_force"}


def quantity(effect, *, tolerance=0.0, low=-math.inf):
    """A coordinate of unit prior size."""
    return EffectQuantity(
        effect, "size", 0.0, tolerance, 1.0, low, math.inf, EffectParameter("size", "1", 0.0, 1.0)
    )


@dataclass
class Linear:
    """A problem with one column for every quantity; ``data`` (m,) whitened."""

    columns: dict
    data: np.ndarray
    nuisances: tuple
    numerics: np.ndarray
    reach: float = OPTIONS.calibration.reach
    options: DiagnosisOptions = OPTIONS
    tolerance_factor: float = 1.0

    @property
    def size(self):
        return len(self.data)

    @property
    def nominal(self):
        return {q.key: q.off for q in self.nuisances}

    def residual(self, point):
        return self.data - sum(self.columns[key] * value for key, value in point.items())

    @property
    def finer(self):
        return self

    def linearise(self, point, wanted):
        return self.residual(point), np.stack([self.columns[q.key] for q in wanted], axis=1)


@pytest.fixture
def made():
    """(problem, candidates by name, held-out problem): ``both`` looks nearly like ``one`` and ``two`` together, in the fitted data alone."""
    rng = np.random.default_rng(5)
    causes = {n: quantity(e, low=0.0 if n == "other" else -math.inf) for n, e in EFFECT.items()}
    nuisance = quantity("nuisance", tolerance=0.5)
    problems = []
    for held_out in (False, True):
        columns = {q.key: 20.0 * rng.normal(size=300) for q in (*causes.values(), nuisance)}
        one, two = columns[causes["one"].key], columns[causes["two"].key]
        if not held_out:
            columns[causes["both"].key] = one - two + 4.0 * rng.normal(size=300)
        columns[causes["other"].key] -= 3.0 * one  # of the wrong sign
        data = one - two + 0.2 * columns[nuisance.key] + rng.normal(size=300)
        problems.append(Linear(columns, data, (nuisance,), rng.normal(size=(300, 1))))
    return problems[0], {n: Candidate(q.effect, (q,)) for n, q in causes.items()}, problems[1]


def sensitivities(problem, pool, result):
    by_candidate = {c: problem.columns[c.quantities[0].key][:, None] for c in pool}
    return Sensitivities(result.point, result.residual, dict(problem.columns), by_candidate)


def fitted(problem, *members):
    return Hypothesis(members, fit(problem, causes_of(members), {}), exact=True)


def ranked_at(problem, result, pool):
    return rank_pairs(problem, sensitivities(problem, pool, result), result, pool, pool)


def test_the_pair_is_first_where_its_likeness_stands(made):
    """Looking for one cause at a time ends at the likeness: beside it, and instead of it, each of the two alone is worse."""
    problem, pool, _ = made
    clean = fit(problem, (), {})
    everything = list(pool.values())
    first = ranked_at(problem, clean, everything)
    singles = [members for _, members in first if len(members) == 1]
    assert singles[0] == (pool["both"],)
    assert (pool["other"],) not in singles
    best = fitted(problem, pool["both"])
    ranked = ranked_at(problem, best.fit, everything)
    assert set(ranked[0][1]) == {pool["one"], pool["two"]}


def test_the_evidence_of_sets_is_that_of_their_fits(made):
    """Where the model is linear and nuisances stay inside."""
    problem, pool, _ = made
    everything = list(pool.values())
    start = fitted(problem, pool["both"]).fit
    ranked = ranked_at(problem, start, everything)
    found = [fitted(problem, *members) for _, members in ranked]
    weigh(found, everything, OPTIONS)
    exact = {e.keys: e.score for e in found}
    linear = {frozenset().union(*(c.keys for c in members)): score for score, members in ranked}
    assert len(linear) > 4
    for keys, score in linear.items():
        assert score == pytest.approx(exact[keys], rel=1e-3, abs=0.5)


def test_pairs_of_what_helps_most_by_itself(made):
    """Each of a few effects with each other, once."""
    problem, pool, _ = made
    problem.options = replace(OPTIONS, search=SearchOptions(pair_effects=3))
    found = [fitted(problem, c) for c in pool.values()]
    single = sorted(found, key=lambda e: e.fit.cost)
    state = SearchState(problem, list(pool.values()), found[0].fit, SILENT, list(found))
    add_pairs(state)
    pairs = [e for e in state.found if len(e.members) == 2]
    assert {e.keys for e in pairs} == {a.keys | b.keys for a, b in combinations(single[:3], 2)}
    best = min(pairs, key=lambda e: e.fit.cost)
    assert set(best.members) == {pool["one"], pool["two"]}
    assert best.fit.chi2 == pytest.approx(fitted(problem, pool["one"], pool["two"]).fit.chi2, abs=0.1)
    before = list(state.found)
    add_pairs(state)
    assert state.found == before


@dataclass
class Wavy(Linear):
    """What the cause leaves has minima half a unit of its size apart; the least is at 1.5."""

    def residual(self, point):
        x = point.get(self.nuisances[0].key, 0.0)
        (size,) = [value for key, value in point.items() if key != self.nuisances[0].key] or [0.0]
        wave, slope = self.columns["wave"], self.columns["slope"]
        return self.data + wave * np.sin(2.0 * np.pi * (size - 1.5)) + slope * (size - 1.5 + x)

    def linearise(self, point, wanted):
        def change(q):
            step = 1e-6
            return (
                self.residual({**point, q.key: point.get(q.key, 0.0) + step}) - self.residual(point)
            ) / -step

        return self.residual(point), np.stack([change(q) for q in wanted], axis=1)


@pytest.mark.parametrize(("data_tell", "size"), [(False, 1.5), (True, 1.0)])
def test_the_best_hypothesis_is_tried_from_sizes_around_its_own(data_tell, size):
    """A fit that stands in a minimum beside the least one finds it; not where the data have told the size already."""
    rng = np.random.default_rng(3)
    cause, nuisance = quantity("backlash", low=0.0), quantity("nuisance", tolerance=0.01)
    columns = {name: rng.normal(size=300) for name in ("wave", "slope")}
    columns = {"wave": 3.0 * columns["wave"], "slope": 2.0 * columns["slope"]}
    problem = Wavy(columns, rng.normal(size=300), (nuisance,), np.zeros((300, 0)))
    candidate = Candidate("backlash", (cause,), sizes=(1.0,) if data_tell else ())
    start = Hypothesis((candidate,), fit(problem, (cause,), {cause.key: 1.0}), exact=True)
    none = Hypothesis((), fit(problem, (), {}))
    state = SearchState(problem, [candidate], none.fit, SILENT, [start, none])
    state.add()
    assert state.best.fit.point[cause.key] == pytest.approx(1.0, abs=0.1)
    try_other_sizes(state)
    assert state.best.fit.point[cause.key] == pytest.approx(size, abs=0.1)


def test_bags_that_were_not_fitted_have_a_say(made):
    """A likeness that fits about as well as the truth does not predict."""
    problem, pool, held_out = made
    problem.data = problem.data + 0.9 * (
        problem.columns[pool["both"].quantities[0].key]
        - problem.columns[pool["one"].quantities[0].key]
        + problem.columns[pool["two"].quantities[0].key]
    )
    everything = list(pool.values())
    no_cause = Hypothesis((), fit(problem, (), {}))
    right, wrong = fitted(problem, pool["one"], pool["two"]), fitted(problem, pool["both"])
    found = [no_cause, right, wrong]
    weigh(found, everything, OPTIONS)
    assert found[0] is wrong
    result = WeighedHypotheses(found, probabilities(found, problem), no_cause, None, [], everything)
    weigh_by_prediction(result, problem, held_out, SILENT)
    assert result.best is right
    assert result.probabilities[0] > 0.99
    # who cannot simulate them loses, whoever it is; where nobody can, nothing changes
    for e in found:
        e.predicted = None
    simulate = held_out.linearise
    held_out.linearise = lambda point, wanted: (
        None if len(point) == len(right.fit.point) else simulate(point, wanted)
    )
    weigh_by_prediction(result, problem, held_out, SILENT)
    assert result.best is wrong
    for e in found:
        e.predicted = None
    held_out.linearise = lambda point, wanted: None
    weigh_by_prediction(result, problem, held_out, SILENT)
    assert result.best is wrong
    assert np.isfinite(result.probabilities).all()


def test_a_cause_that_gains_little_is_not_needed(made):
    problem, pool, _ = made
    one, two, other = pool["one"], pool["two"], pool["other"]
    three, pair, single = (Hypothesis(m, None) for m in ((one, two, other), (one, two), (one,)))
    none = Hypothesis((), None)
    for found, scores, expected in (
        ((three, pair, single, none), (0.0, -3.0, -20.0, -40.0), pair),
        ((three, pair, single, none), (0.0, -5.0, -20.0, -40.0), three),
        ((three, single, pair, none), (0.0, -2.0, -3.0, -40.0), single),
        ((single, none), (0.0, -3.0), none),
        ((none, single), (0.0, -1.0), none),
    ):
        for e, score in zip(found, scores, strict=True):
            e.score = e.fitted_score = score
        assert needed_hypothesis(found, problem) is expected
    # what only the other bags speak for
    three.score, pair.score, single.score, none.score = 0.0, -9.0, -20.0, -40.0
    three.fitted_score, pair.fitted_score, single.fitted_score, none.fitted_score = 0.0, -1.0, -12.0, -40.0
    assert needed_hypothesis((three, pair, single, none), problem) is pair


def test_a_further_cause_gains_more_than_the_law_of_the_first_may_miss(made, monkeypatch):
    """A tenth of what the first does is left by its law; a cause that collects less than that is not needed, nor in the set of causes."""
    problem, pool, _ = made
    single, pair, none = (fitted(problem, *(pool[n] for n in m)) for m in (("one",), ("one", "two"), ()))
    size = separation(problem, single.fit, single.members)
    limit = 0.5 * (0.1 * size) ** 2
    assert limit > 2.0 * OPTIONS.verdict.needed_gain
    for part, gain, needed in (
        (0.0, 0.9 * limit, pair),
        (0.1, 0.9 * limit, single),
        (0.1, 1.1 * limit, pair),
    ):
        monkeypatch.setitem(EFFECTS, EFFECT["one"], replace(EFFECTS[EFFECT["one"]], form_error=part))
        for e, score in ((pair, gain), (single, 0.0), (none, -1e3)):
            e.score = e.fitted_score = score
        found = WeighedHypotheses([pair, single, none], np.array([0.98, 0.02, 0.0]), none, None, [], [])
        assert needed_hypothesis(found.hypotheses, problem) is needed
        assert found.pooled(problem, needed)[0][0] == needed.effects


@pytest.mark.parametrize(("probability", "clean"), [(0.95, False), (0.85, True)])
def test_no_bag_is_clean_where_a_cause_is_as_sure_as_a_name(made, probability, clean):
    """By the evidence that a cause has to gain it is not needed; nobody would bet on the robot file."""
    problem, pool, _ = made
    single, none = Hypothesis((pool["one"],), None), Hypothesis((), None)
    none.score = none.fitted_score = -3.0
    found = WeighedHypotheses([single, none], np.array([probability, 1.0 - probability]), none, None, [], [])
    assert needed_hypothesis(found.hypotheses, problem) is none
    assert hypothesis_for_verdict(found, problem) is (none if clean else single)
