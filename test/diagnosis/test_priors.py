"""Prior probabilities of causes, and of their sizes and shapes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from ctr_dynamics.diagnosis.diagnosis_options import PriorOptions
from ctr_dynamics.diagnosis.inference.candidates import Candidate, candidates, log_prior
from ctr_dynamics.diagnosis.inference.gaussian_posterior import half_gaussian_gain

OPTIONS = PriorOptions()


@pytest.fixture(scope="module")
def pool(known):
    return candidates(list(known.values()), np.random.default_rng(1).normal(0.1, 0.02, (50, 3)))


def of(pool, effect, **start):
    """The candidate of an effect whose shapes start at the given values."""
    return next(
        c
        for c in pool
        if c.effect == effect and all(v == pytest.approx(dict(c.start)[effect, n]) for n, v in start.items())
    )


def with_preset(candidate, value):
    """A candidate with a shape that starts elsewhere."""
    (shape,) = candidate.shapes
    return replace(candidate, shapes=(replace(shape, off=value),), start=((shape.key, value),))


def test_presets_that_overlap_take_nothing_from_their_effect(pool):
    effects = len({c.effect for c in pool})
    one = math.log(OPTIONS.single / effects)
    clearance = of(pool, "clearance")
    assert sum(c.effect == "clearance" for c in pool) > 1
    assert log_prior((clearance,), pool, OPTIONS, {}) == pytest.approx(one)
    stribeck = of(pool, "stribeck")
    before = log_prior((stribeck,), pool, OPTIONS, {})
    assert one - 0.5 < before <= one
    assert log_prior((stribeck,), [*pool, stribeck], OPTIONS, {}) == before
    more = [*pool, *(with_preset(stribeck, 0.5 + 0.05 * k) for k in range(1, 40))]
    assert log_prior((stribeck,), more, OPTIONS, {}) > before - 0.1


def test_parameters_of_each_tube_share_the_probability_of_an_effect(pool, robot):
    effects = len({c.effect for c in pool})
    tubes = {c.keys for c in pool if c.effect == "ovality"}
    assert len(tubes) == robot.n_tubes
    youngs = [c for c in pool if c.effect == "youngs_modulus"]
    expected = math.log(OPTIONS.single / effects / len(youngs))
    assert log_prior((youngs[0],), pool, OPTIONS, {}) == pytest.approx(expected)


def test_the_priors_around_all_presets_are_that_of_a_shape(pool):
    """Whatever preset a fit has begun from, evidence and prior together have the density of the mixture, and an axis is the same half a turn on."""
    ovality = [c for c in pool if c.keys == of(pool, "ovality").keys]
    (axis,) = ovality[0].shapes
    places = np.array([c.shapes[0].off for c in ovality])
    for x in (0.1, 1.0, 2.9):
        density = np.mean(
            [stats.norm.pdf(x - p + k * math.pi, scale=axis.scale) for p in places for k in (-1, 0, 1)]
        )
        found = [
            log_prior((c,), pool, OPTIONS, {axis.key: x})
            + stats.norm.logpdf(x, loc=c.shapes[0].off, scale=axis.scale)
            for c in ovality
        ]
        assert np.ptp(found) < 1e-9
        without = log_prior((of(pool, "youngs_modulus"),), pool, OPTIONS, {}) + math.log(
            len([c for c in pool if c.effect == "youngs_modulus"])
            / len({c.keys for c in pool if c.effect == "ovality"})
        )
        # of the images of a preset the nearest counts, the others are far off
        assert found[0] - without == pytest.approx(math.log(3.0 * density), abs=0.15)


def test_a_contact_on_one_of_six_sides_is_no_likelier_than_on_that_side(pool):
    """Presets far from one another are places of their own."""
    contact = of(pool, "contact")
    assert isinstance(contact, Candidate)
    sides = sum(c.effect == "contact" for c in pool)
    expected = math.log(OPTIONS.single / len({c.effect for c in pool}) / sides)
    assert log_prior((contact,), pool, OPTIONS, {}) == pytest.approx(expected, abs=0.2)


@pytest.mark.parametrize(("mean", "deviation"), [(0.5, 0.2), (0.1, 0.3), (0.0, 0.5)])
def test_half_gaussian_priors_gain_twice_the_part_of_the_posterior_above_zero(mean, deviation):
    """By a numerical integral over the size."""
    wide = 1.0
    x = np.linspace(-8.0, 8.0, 400_001)
    posterior = stats.norm.logpdf(x, mean, deviation)
    likelihood = posterior - stats.norm.logpdf(x, scale=wide)
    whole = np.trapezoid(np.exp(likelihood + stats.norm.logpdf(x, scale=wide)), x)
    right = x >= 0.0
    half = np.trapezoid(2.0 * np.exp(likelihood[right] + stats.norm.logpdf(x[right], scale=wide)), x[right])
    gain = half_gaussian_gain(np.array([9.0, mean]), np.diag([1.0, deviation**2]), [False, True])
    assert gain == pytest.approx(math.log(half / whole), abs=1e-4)
