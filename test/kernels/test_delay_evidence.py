"""The kernels that weigh delays, against their NumPy twins."""

import numpy as np
import pytest

from ctr_dynamics.estimation.monitoring.densities import log_density
from ctr_dynamics.kernels.delay_evidence import (
    compare_delays,
    weigh_changes,
    weigh_delays,
    weigh_vibrating,
)

NOISE, TOTAL, GAIN, DECAY = 6e-8, 9e-8, 0.3, 0.99


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def lengths(change):
    return np.sum(change**2, axis=1)


def test_delays_since_the_start_are_weighed_as_by_numpy(rng):
    residual, before, evidence = (
        rng.normal(0, 4e-4, (30, 3)),
        rng.normal(0, 4e-4, (30, 3)),
        rng.normal(0, 5, 30),
    )
    level, found = np.empty((30, 3)), np.empty(30)
    weigh_delays(residual, (before, evidence), (NOISE, TOTAL, GAIN, DECAY), level, found)
    np.testing.assert_allclose(level, before + GAIN * (residual - before), rtol=1e-12)
    expected = DECAY * evidence + log_density(lengths(residual - before), TOTAL, NOISE)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_changes_are_weighed_as_by_numpy(rng):
    residual, before, evidence = (
        rng.normal(0, 4e-4, (30, 3)),
        rng.normal(0, 4e-4, (30, 3)),
        rng.normal(0, 5, 30),
    )
    began_ns, now_level, now, now_ns = np.arange(30), rng.normal(0, 4e-4, 3), -1.0, 1000
    level, found, begins_ns = np.empty((30, 3)), np.empty(30), np.empty(30, int)
    weigh_changes(
        residual, (before, evidence, began_ns), (NOISE, TOTAL, GAIN, DECAY), (now_level, now, now_ns), level, found, begins_ns
    )  # fmt: skip
    on = DECAY * evidence + log_density(lengths(residual - before), TOTAL, NOISE)
    begun = now + log_density(lengths(residual - now_level), TOTAL, NOISE)
    new = begun > on
    assert 0 < new.sum() < 30
    np.testing.assert_allclose(found, np.where(new, begun, on), rtol=1e-12)
    np.testing.assert_array_equal(begins_ns, np.where(new, now_ns, began_ns))
    was = np.where(new[:, None], now_level, before)
    np.testing.assert_allclose(level, was + GAIN * (residual - was), rtol=1e-12)


def test_delays_beside_vibrations_are_weighed_as_by_numpy(rng):
    amplitudes, size = 4, 7
    residual, states = rng.normal(0, 4e-4, (30, 3)), rng.normal(0, 4e-4, (amplitudes, 30, 3, size))
    evidence = rng.normal(0, 5, (amplitudes, 30))
    transition, seen = rng.normal(0, 0.4, (size, size)), rng.integers(0, 2, size).astype(float)
    gains, totals = rng.uniform(0, 0.5, (amplitudes, size)), TOTAL * rng.uniform(1, 4, amplitudes)
    found, after = evidence.copy(), states.copy()
    weigh_vibrating(residual, transition, seen, gains, totals, NOISE, DECAY, after, found)
    before = states @ transition.T
    apart = residual - before @ seen
    np.testing.assert_allclose(
        after, before + apart[..., None] * gains[:, None, None], rtol=1e-11, atol=1e-15
    )
    for g, total in enumerate(totals):
        expected = DECAY * evidence[g] + log_density(lengths(apart[g]), total, NOISE)
        np.testing.assert_allclose(found[g], expected, rtol=1e-11)


def compared(delays, ways, present, least, prior, now):
    """The NumPy twin: all delays of all ways in one row."""
    kept = np.isfinite(ways)
    at, evidence = np.broadcast_to(delays, ways.shape)[kept], ways[kept]
    other = np.abs(at - present) > least
    now = max(now, evidence[~other].max(initial=-np.inf))
    at, likely = at[other], evidence[other] + prior
    weights = np.exp(likely - likely.max())
    near = np.abs(at - at[weights.argmax()]) <= 2.0 * least
    mean = np.average(at[near], weights=weights[near])
    spread = np.sqrt(np.average((at[near] - mean) ** 2, weights=weights[near]))
    return likely.max() + np.log(weights.sum()) - now, mean, spread, weights[near].sum() / weights.sum()


@pytest.mark.parametrize("present", [0.0, 0.031])
@pytest.mark.parametrize("now", [-200.0, 10.0])
def test_delays_are_compared_as_by_numpy(rng, present, now):
    delays = 0.00025 * np.arange(240)
    ways = rng.normal(0.0, 6.0, (2, 240)) - 0.5 * ((delays - 0.04) / 0.004) ** 2
    ways[0, 5] = -np.inf
    given = delays, ways, present, 0.005, -7.0, now
    np.testing.assert_allclose(compare_delays(*given), compared(*given), rtol=1e-10)


def test_where_no_other_delay_counts_nothing_is_likely():
    delays, ways = np.zeros(30), np.zeros((1, 30))
    assert compare_delays(delays, ways, 0.0, 0.005, -7.0, 0.0) == (-np.inf, 0.0, 0.0, 0.0)
