"""A tracker that has been moved: the filter finds that after a while, and is right again."""

import math

import numpy as np
import pytest

from ctr_dynamics.estimation.monitoring.moved_tracker import MovedTracker, MovedTrackerOptions

NOISE, LENGTH, REGISTERED, RATE = 2.5e-4, 0.25, 1e-3, 0.025
BADLY = -9.0  # logarithm of a density, as of a filter that has met a jump


def follow(residuals, filter_densities):
    """Evidence of the filter, and what is known of moves, after ``residuals`` (k, 3) m that the filter has foretold with ``filter_densities``."""
    tracker = MovedTracker(NOISE, LENGTH, REGISTERED)
    moved, of_filter = tracker.begin(residuals[0]), 0.0
    for residual, density in zip(residuals[1:], filter_densities[1:], strict=True):
        before = float(np.logaddexp(of_filter, moved.evidence))
        of_filter = tracker.filter_goes_on(of_filter, moved.evidence, RATE, 1.0) + density
        moved = tracker.add(moved, residual, RATE, 1.0, before, of_filter)
    return of_filter, moved


def noise(count, seed=1):
    return NOISE * np.random.default_rng(seed).standard_normal((count, 3))


@pytest.mark.parametrize("to", [(0.0, 0.0, 0.0), (0.03, 0.0, -0.01)])
def test_a_filter_that_finds_a_move_late_pays_for_it_once(to):
    residuals = noise(60) + np.where(np.arange(60) < 20, 1.0, 0.0)[:, None] * np.array([5e-3, 0.0, 2e-3])
    residuals[20:] += np.array(to)
    told = np.full(60, -1.5)
    told[20:40] = BADLY
    of_filter, moved = follow(residuals, told)
    np.testing.assert_allclose(moved.level, to, atol=4.0 * NOISE)
    options = MovedTrackerOptions()
    # two places to move to, a tracker that was moved, a filter that has found it, and 58 measurements as they are foretold from then on
    square = (LENGTH if any(to) else REGISTERED) ** 2
    once = (
        -1.5 * math.log(square / NOISE**2)
        + math.log(RATE / options.sound_s)
        + math.log(RATE / options.found_s)
    )
    assert of_filter > once - 1.5 * 58 - 6.0
    assert of_filter > told[1:].sum() + 80.0


def test_moves_do_not_help_a_filter_that_foretells_well():
    of_filter, moved = follow(noise(200), np.full(200, -1.5))
    assert of_filter == pytest.approx(-1.5 * 199, abs=8.0)  # what noise happens to favour
    assert moved.evidence < of_filter - 5.0


def test_a_departure_that_wanders_is_no_move():
    """A filter that foretells it badly must not seem right by one move after another."""
    wandering = np.cumsum(8.0 * noise(200, seed=2), axis=0)
    of_filter, moved = follow(wandering, np.full(200, BADLY))
    assert of_filter == pytest.approx(BADLY * 199, abs=40.0)
    assert moved.evidence < of_filter
