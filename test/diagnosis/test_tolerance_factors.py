"""Tolerances that may be too tight by one factor: the mixture of priors against the density of the linear model, and against causes."""

import math

import numpy as np
import pytest
from diagnosis_cases import BentProblem, quantity
from scipy.special import logsumexp, ndtr
from scipy.stats import multivariate_normal

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.inference.gaussian_posterior import posterior, within_tolerance
from ctr_dynamics.diagnosis.inference.hypotheses import (
    Hypothesis,
    fit_exactly,
    fit_with_likeliest_tolerances,
)
from ctr_dynamics.diagnosis.inference.map_fit import fit
from ctr_dynamics.diagnosis.inference.tolerance_factors import log_gain, under_factors

OPTIONS = DiagnosisOptions()
TOLERANCE, SIZE, COUNT = 0.02, 200, 10


def density(columns, data, tolerance, scale, factor):
    """Of ``data`` where every deviation but that of the causes is ``factor`` tolerances."""
    deviation = np.hypot(factor * tolerance, scale)
    covariance = np.eye(len(data)) + (columns * deviation**2) @ columns.T
    return multivariate_normal(np.zeros(len(data)), covariance).logpdf(data)


def test_weights_and_departures_are_those_of_the_linear_model():
    rng = np.random.default_rng(1)
    columns, numerics = rng.normal(size=(20, 3)), rng.normal(size=(20, 1))
    tolerance, scale = np.array([0.3, 0.2, 0.0]), np.array([0.0, 0.0, 1.5])
    active = [quantity(f"p{i}", tolerance=t, scale=1.5) for i, t in enumerate(tolerance)]
    departure = np.array([0.1, -0.2, 0.5])
    data = columns @ np.array([0.9, -0.7, 1.0]) + rng.normal(size=20)
    found = under_factors(
        active, {active[2].key}, data - columns @ departure, columns, departure, numerics, OPTIONS
    )
    factors = np.geomspace(1.0, OPTIONS.tolerances.widest, OPTIONS.tolerances.factors)
    both = np.hstack([columns, numerics])
    expected = []
    for one, factor in zip(found, factors, strict=True):
        deviation = np.append(np.hypot(factor * tolerance, scale), 1.0)
        information = both.T @ both + np.diag(deviation**-2.0)
        mean, covariance = np.linalg.solve(information, both.T @ data), np.linalg.inv(information)
        assert one.departure == pytest.approx(mean[:3])
        assert one.covariance == pytest.approx(covariance[:3, :3])
        log = density(both, data, np.append(factor * tolerance, 0.0), np.append(scale, 1.0), 1.0)
        for i in (0, 1):  # within so many tolerances
            limit, sigma = (
                OPTIONS.calibration.tolerance_limit * factor * tolerance[i],
                math.sqrt(covariance[i, i]),
            )
            log += math.log(ndtr((limit - abs(mean[i])) / sigma)) - math.log(
                ndtr(OPTIONS.calibration.tolerance_limit)
            )
        expected.append(log)
    too_tight = OPTIONS.tolerances.too_tight**OPTIONS.evidence.temperature
    share = too_tight / len(factors)
    priors = np.array([1.0 - too_tight + share] + [share] * (len(factors) - 1))
    weights = np.array([one.log_weight for one in found])
    assert weights == pytest.approx(np.array(expected) - expected[0] + np.log(priors), abs=1e-5)
    assert log_gain(found) == pytest.approx(logsumexp(weights))


def departures_explained(values, rng, cause):
    """Log evidence of ten nuisances at ``values`` without causes, and with the first as a cause of 30 tolerances."""
    columns = 4.0 / TOLERANCE * rng.normal(size=(SIZE, COUNT)) / math.sqrt(SIZE)
    data = columns @ values + rng.normal(size=SIZE)
    active = [quantity(f"p{i}", tolerance=TOLERANCE, scale=30 * TOLERANCE) for i in range(COUNT)]
    out = []
    for causes in (set(), {active[cause].key}):
        scale = np.array([q.scale if q.key in causes else 0.0 for q in active])
        none = np.zeros((SIZE, 0))
        stated = density(columns, data, np.full(COUNT, TOLERANCE), scale, 1.0)
        variance = TOLERANCE**2 + scale**2
        mean, covariance, _ = posterior(data, columns, np.zeros(COUNT), variance, none)
        stated += within_tolerance(active, causes, mean, covariance, OPTIONS.calibration.tolerance_limit)
        found = under_factors(active, causes, data, columns, np.zeros(COUNT), none, OPTIONS)
        out.append((stated, stated + log_gain(found)))
    return out


def test_many_small_departures_need_no_cause_where_tolerances_may_be_too_tight():
    rng = np.random.default_rng(2)
    stated, mixed = [], []
    for _ in range(40):
        values = 2.5 * TOLERANCE * rng.normal(size=COUNT)
        none, one = departures_explained(values, rng, int(np.argmax(np.abs(values))))
        stated.append(one[0] - none[0])
        mixed.append(one[1] - none[1])
    assert np.median(stated) > 4.0  # by the file as stated, the largest of them is a cause
    assert np.median(mixed) < 0.0
    assert np.mean(np.array(mixed) > 4.0) < 0.1


def test_one_large_departure_among_tolerances_that_hold_stays_a_cause():
    rng = np.random.default_rng(3)
    gains = []
    for _ in range(40):
        values = TOLERANCE * rng.normal(size=COUNT)
        values[0] = 15 * TOLERANCE
        none, one = departures_explained(values, rng, 0)
        gains.append(one[1] - none[1])
    assert min(gains) > 4.0


def scattered(rng, factor, bend=math.inf):
    """A hypothesis without causes, fitted with tolerances as stated to values that scatter ``factor`` times as much, and the problem."""
    J = 40.0 / TOLERANCE * rng.normal(size=(SIZE, COUNT)) / math.sqrt(SIZE)
    values = factor * TOLERANCE * np.sign(rng.normal(size=COUNT))
    nuisances = tuple(quantity(f"p{i}", tolerance=TOLERANCE) for i in range(COUNT))
    problem = BentProblem(J @ values + rng.normal(size=SIZE), J, nuisances, bend)
    found = fit(problem, (), {})
    assert found is not None
    return problem, Hypothesis((), found), values


def test_a_hypothesis_is_fitted_with_the_likeliest_tolerances():
    problem, hypothesis, values = scattered(np.random.default_rng(4), 4.2)
    stated = hypothesis.fit
    assert np.max(np.abs(stated.values)) == pytest.approx(4.0 * TOLERANCE)  # where fits end
    fit_with_likeliest_tolerances(problem, hypothesis)
    assert hypothesis.fit.has_likeliest_tolerances
    assert hypothesis.fit.tolerance_factor > 3.0
    assert hypothesis.fit.values == pytest.approx(values, abs=0.2 * TOLERANCE)
    assert hypothesis.fit.cost < stated.cost
    # an exact fit afterwards keeps the tolerances
    fit_exactly(problem, hypothesis)
    assert hypothesis.fit.tolerance_factor > 3.0


def test_tolerances_that_hold_are_not_made_larger():
    problem, hypothesis, _ = scattered(np.random.default_rng(5), 1.0)
    before = hypothesis.fit
    fit_with_likeliest_tolerances(problem, hypothesis)
    assert hypothesis.fit is before
    assert before.tolerance_factor == 1.0


def test_evidence_that_no_fit_finds_does_not_count():
    problem, hypothesis, _ = scattered(np.random.default_rng(6), 4.2, bend=4.0)
    promised = hypothesis.fit.log_evidence
    fit_with_likeliest_tolerances(problem, hypothesis)
    assert hypothesis.fit.has_likeliest_tolerances
    assert hypothesis.fit.log_evidence < promised - 5.0


def test_what_needs_more_than_the_widest_factor_is_no_matter_of_tolerances():
    problem, hypothesis, _ = scattered(np.random.default_rng(8), 9.0)
    before = hypothesis.fit
    assert before.has_likeliest_tolerances
    assert before.log_evidence == before.own_evidence
    fit_with_likeliest_tolerances(problem, hypothesis)
    assert hypothesis.fit is before


def test_costs_with_different_tolerances_compare_as_their_evidence_does():
    problem, hypothesis, _ = scattered(np.random.default_rng(7), 2.5)
    stated = hypothesis.fit
    fit_with_likeliest_tolerances(problem, hypothesis)
    wide = hypothesis.fit
    assert wide.tolerance_factor > 1.0
    assert stated.cost - wide.cost == pytest.approx(2.0 * (wide.log_evidence - stated.own_evidence), abs=0.1)
