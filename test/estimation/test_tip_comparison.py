"""A measurement against the tip of its time: what the tangent of the tip's motion misses."""

import numpy as np
import pytest

from ctr_dynamics.estimation.filter.tip_comparison import NEGLIGIBLE, second_order

LENGTH = 0.2


@pytest.mark.parametrize("deviation", [0.02, 0.1, 0.3])
def test_an_arc_is_missed_by_as_much_as_is_counted(deviation):
    """A tip on a circle about its base, turned by a normal angle: its way along the circle's axis is not in the tangent."""
    angle = deviation * np.random.default_rng(1).standard_normal(200_000)
    sideways = (LENGTH * deviation) ** 2
    found = second_order(np.array([sideways, 0.0, 0.0, deviation**2, 0.0, 0.0]), np.arange(6), LENGTH)
    missed = LENGTH * (1.0 - np.cos(angle))
    assert np.mean(missed**2) == pytest.approx(found[2], rel=0.1)
    assert found[3] == pytest.approx(0.75 * deviation**4)


def test_of_axes_that_are_not_measured_nothing_is_counted():
    all_axes = second_order(np.full(6, 1e-4), np.arange(6), LENGTH)
    some = second_order(np.array([1e-4, 1e-4, 1e-4]), np.array([0, 1, 2]), LENGTH)
    np.testing.assert_allclose(some, all_axes[:3])


def test_a_tip_that_is_known_well_moves_along_its_tangent():
    """To a third of a millimetre per axis: what is missed is lost in the noise of a good tracker, and left out."""
    assert second_order(np.full(3, 9e-8), np.arange(3), LENGTH).max() < NEGLIGIBLE * 2.5e-4**2
