"""A tracker that is noisier than its file says, told from a robot that departs from its model."""

import numpy as np
import pytest
from test_model_error_search import NONE, search, wandering

from ctr_dynamics.estimation.monitoring.noisy_tracker import NoisyTracker

NOISE = 3e-4


def fed(residuals):
    """Evidence of a noisy tracker after all of them, at 40 Hz."""
    found = NoisyTracker(NOISE, 0.2, 5e-4)
    return [found.add(25_000_000 * k, residual) for k, residual in enumerate(residuals)][-1]


def noise(size, tails, count=240):
    rng = np.random.default_rng(8)
    return size * (rng.standard_t(2.0, (count, 3)) if tails else rng.standard_normal((count, 3)))


@pytest.mark.parametrize("tails", [False, True])
@pytest.mark.parametrize("size", [1e-3, 3e-3])
def test_noise_of_any_size_is_no_departure_of_the_robot(size, tails):
    """However badly a filter foretells it that counts on the stated noise."""
    found = search(noise(size, tails), predictive=(-9.0, -9.0))
    assert found.found(NONE) is None
    assert found.probability(NONE) < 0.05


@pytest.mark.parametrize("time", [0.3, 3.0])
def test_a_robot_that_departs_from_its_model_is_not_noise(time):
    departures = wandering(3e-3, time, 400)
    assert search(departures, predictive=(-20.0, -4.0)).found(NONE) is not None


def test_the_size_is_that_of_the_noise():
    """By the evidence, whose increments are then those of the right distribution."""
    rows = NoisyTracker(NOISE, 0.2, 5e-4)
    for k, residual in enumerate(noise(2e-3, False)):
        rows.add(25_000_000 * k, residual)
    best = np.sqrt(rows._squares[int(rows._known[-1].evidence.argmax())])
    assert best == pytest.approx(2e-3, rel=0.4)  # Student's scale is less than the deviation


def test_measurements_that_are_taken_again_count_once():
    residuals = noise(1e-3, False)
    found = NoisyTracker(NOISE, 0.2, 5e-4)
    for k in [*range(60), *range(40, 240)]:
        last = found.add(25_000_000 * k, residuals[k])
    assert last == pytest.approx(fed(residuals))
