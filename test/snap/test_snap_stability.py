"""The watch over stability: a snap is seen coming, a loss is said, rest is no alarm."""

import numpy as np
import pytest

from ctr_dynamics.model.model import Model
from ctr_dynamics.model.stability import StabilityWatch, time_to_snap
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot_files import load_robot

BETA = np.array([-0.112, 0.0])


@pytest.fixture(scope="module")
def model():
    return Model(load_robot("till2020_snap_example"), nodes=24)


def test_line_through_the_square_of_the_measure():
    measure = lambda t: 2.0 * np.sqrt(3.0 - t)  # noqa: E731
    assert time_to_snap(1.0, measure(1.0), 1.5, measure(1.5)) == pytest.approx(1.5)
    assert time_to_snap(1.0, 1.0, 1.5, 1.2) is None
    assert time_to_snap(1.0, 1.0, 1.0, 0.9) is None
    assert time_to_snap(1.0, 1.0, 2.0, -0.1) is None


def test_snap_is_predicted_before_it_happens(model):
    """theta_b at 0.5 rad/s, looked at 30 times a second: the fold at 3.573 rad is reached at 7.146 s."""
    watch, rate, predicted, lost = StabilityWatch(model), 0.5, [], None
    for t in np.arange(0.0, 7.4, 1 / 30):
        now = watch.update(t, BETA, np.array([-rate * t, 0.0]))
        if now.lost:
            lost = t
            break
        assert now.stable
        if now.time_to_snap is not None:
            predicted.append((t, t + now.time_to_snap))
    assert lost is not None
    assert abs(lost - 3.573 / rate) < 2 / 30 + 1e-3
    t, at = np.array(predicted).T
    last_half_second = (t > 3.573 / rate - 0.5) & (t < 3.573 / rate - 0.05)
    assert np.abs(at[last_half_second] - 3.573 / rate).max() < 0.05
    last_two_seconds = t > 3.573 / rate - 2.0
    assert np.abs(at[last_two_seconds] - 3.573 / rate).max() < 1.0


def test_measure_is_that_of_the_static_solver(model):
    alpha = np.array([-2.0, 0.0])
    statics = Statics(model)
    equilibrium = statics.solve(BETA, alpha)
    expected = statics.stability(equilibrium, BETA, alpha)
    assert StabilityWatch(model).update(0.0, BETA, alpha).measure == pytest.approx(expected, rel=1e-4)


def test_standing_robot_and_retreat_raise_no_alarm(model):
    watch = StabilityWatch(model)
    for k in range(20):
        assert watch.update(0.1 * k, BETA, np.array([-3.4, 0.0])).time_to_snap is None
    for k in range(20):
        assert watch.update(2.0 + 0.1 * k, BETA, np.array([-3.4 + 0.05 * k, 0.0])).time_to_snap is None


def test_watch_goes_on_behind_the_snap_from_a_guess(model):
    """With the unknowns of a shape behind the snap it follows the new branch, which is stable."""
    watch = StabilityWatch(model)
    watch.update(0.0, BETA, np.array([-3.5, 0.0]))
    behind = Statics(model).solve(BETA, (-3.7, 0.0), end_angles=(-5.2, 0.0))
    assert behind.converged
    now = watch.update(0.1, BETA, np.array([-3.7, 0.0]), guess=behind.x)
    assert now.stable
    assert now.time_to_snap is None


def test_moving_translations_and_load(model):
    watch = StabilityWatch(model)
    first = watch.update(0.0, BETA, np.array([-2.0, 0.0]))
    moved = watch.update(0.1, BETA - np.array([0.001, 0.0]), np.array([-2.0, 0.0]))
    pushed = watch.update(0.2, BETA, np.array([-2.0, 0.0]), np.array([0.0, -0.1, 0.0]), np.zeros(3))
    assert len({first.measure, moved.measure, pushed.measure}) == 3
    assert moved.stable
    assert pushed.stable


def test_nonsense_is_a_loss_and_not_a_number_that_travels_on(model):
    watch = StabilityWatch(model)
    assert watch.update(0.0, BETA, np.array([np.nan, 0.0])).lost
    assert watch.update(0.1, BETA, np.array([-1.0, 0.0])).stable
