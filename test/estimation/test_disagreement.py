"""What tracker and estimate have between them beyond noise."""

import numpy as np
import pytest

from ctr_dynamics.estimation.monitoring.disagreement import LAST, Disagreement

NOISE = 3e-4
PERIOD_NS = 25_000_000


def size(residual, model=None, tracker=None, steps=40):
    """Largest and last 3-D deviation (m) that is added beside ``residual(t)`` (3,) m of a tip on ``model(t)``, which the tracker sees moved by
    ``tracker(t)``, at 40 Hz."""
    rng, found = np.random.default_rng(1), Disagreement(NOISE)
    nothing = lambda t: np.zeros(3)  # noqa: E731
    deviations = []
    for k in range(steps):
        t, noise = 0.025 * k, NOISE * rng.standard_normal(3)
        tip = (model or nothing)(t)
        wrong = residual(t) + (tracker or nothing)(t)
        found.add(k * PERIOD_NS, tip + wrong + noise, tip, wrong + noise)
        deviations.append(float(np.sqrt(np.trace(found.covariance))))
    return max(deviations), deviations[-1]


def after(begin, value):
    return lambda t: np.asarray(value) * (t > begin)


def none(t):
    return np.zeros(3)


def test_noise_is_none():
    most, _ = size(none, steps=400)
    assert most < 2.0 * NOISE


def test_larger_noise_and_outliers_are_none():
    rng = np.random.default_rng(2)
    noisy = [size(lambda t: rng.normal(0.0, 5e-3, 3), steps=LAST)[1] for _ in range(300)]
    assert np.mean(np.array(noisy) > 0.0) < 0.02
    outliers = [
        size(lambda t: rng.normal(0.0, 0.05, 3) * (rng.random() < 0.3), steps=LAST)[1] for _ in range(300)
    ]
    assert np.mean(np.array(outliers) > 0.0) < 0.02


@pytest.mark.parametrize("hertz", [3.0, 5.6, 10.0, 16.0])
def test_a_vibration_that_the_robot_does_not_make(hertz):
    def wrong(t):
        return 4e-3 * np.array([np.sin(2 * np.pi * hertz * t), np.cos(2 * np.pi * hertz * t), 0.0])

    assert size(wrong)[1] == pytest.approx(4e-3, rel=0.2)


def test_a_departure_that_grows_is_seen_within_a_fifth_of_a_second():
    def blocked(t):
        return np.array([0.04 * max(t - 0.5, 0.0), 0.0, 0.0])

    _, last = size(blocked, steps=29)  # until 0.7 s
    assert last > 8e-3 / 3.0
    assert size(blocked, steps=21)[1] < NOISE


def test_a_jump_of_the_tracker_is_its_own():
    moving = lambda t: np.array([0.05 * np.sin(5.0 * t), 0.0, 0.1])  # noqa: E731
    jump = [0.01, -0.02, 0.0]
    assert size(none, moving, after(0.5, jump))[0] < 6.0 * NOISE
    # the same distance where the model jumps and the tracker does not
    _, last = size(after(0.5, jump), lambda t: moving(t) - after(0.5, jump)(t))
    assert last == pytest.approx(np.linalg.norm(jump), rel=0.1)
    # and a jump that ends is forgotten
    there_and_back = lambda t: np.asarray(jump) * (0.3 < t < 0.6)  # noqa: E731
    assert (
        size(after(0.7, [0.0, 5e-3, 0.0]), lambda t: -after(0.7, [0.0, 5e-3, 0.0])(t), there_and_back)[1]
        > 3e-3
    )


def test_steps_that_are_taken_again_count_once():
    found, again = Disagreement(NOISE), Disagreement(NOISE)
    rng = np.random.default_rng(4)
    values = [(k * PERIOD_NS, rng.normal(size=3), np.zeros(3), np.full(3, 2e-3)) for k in range(12)]
    for one in values:
        found.add(*one)
    for one in values[:10] + values[6:]:
        again.add(*one)
    np.testing.assert_array_equal(found.covariance, again.covariance)
    assert np.trace(found.covariance) > 0.0


def test_a_tracker_without_noise_may_leave_nothing():
    found = Disagreement(0.0)
    for k in range(2 * LAST):
        found.add(k * PERIOD_NS, np.zeros(3), np.zeros(3), np.zeros(3))
    np.testing.assert_array_equal(found.covariance, np.zeros((3, 3)))
