"""The rational functions that columns follow, and over how many steps at once."""

import numpy as np
import pytest

from ctr_dynamics.estimation.filter.rational_step import (
    FRACTIONS,
    LARGEST_ERROR,
    MOST_STEPS,
    ColumnStrides,
    column_error,
    stability,
)

DT = 0.003


@pytest.mark.parametrize(("stages", "order"), [(2, 3), (3, 5)])
def test_the_functions_have_the_order_of_radau_and_damp_what_is_stiff(stages, order):
    fraction = FRACTIONS[stages]
    z = np.array([0.4j, 0.2j])
    error = np.abs(stability(fraction, z) - np.exp(z))
    assert np.log2(error[0] / error[1]) == pytest.approx(order + 1, abs=0.3)
    assert abs(stability(fraction, np.array([0j]))[0] - 1.0) < 1e-12
    assert abs(stability(fraction, np.array([1e6j]))[0]) < 1e-4
    assert (np.abs(stability(fraction, 1j * np.linspace(0.0, 100.0, 1001))) < 1.0 + 1e-12).all()


def strides(frequency, growth=0.08):
    return ColumnStrides(np.array(frequency), 0.15, growth, DT)


def test_slow_robots_are_followed_in_long_strides_and_fast_ones_in_every_step():
    slow, fast = strides([5.6, 8.7, 35.0]).at(0.15), strides([58.0, 61.0, 250.0]).at(0.15)
    assert slow.steps >= 3
    assert fast.steps == 1
    assert fast.fraction is FRACTIONS[3]
    assert column_error(slow.fraction, np.array([5.6, 8.7, 35.0]), slow.steps * DT) < LARGEST_ERROR


def test_a_robot_that_is_drawn_in_is_followed_in_shorter_strides():
    found = strides([10.0, 12.0])
    assert found.at(0.15).steps > found.at(0.06).steps
    assert found.at(0.15) is found.at(0.15)


def test_a_long_robot_whose_equations_grow_fast_takes_longer_strides():
    assert strides([40.0], growth=0.08).at(0.15).steps < strides([40.0], growth=0.33).at(0.15).steps


def test_without_vibration_nothing_has_to_be_resolved():
    assert strides([]).at(0.15).steps == MOST_STEPS
