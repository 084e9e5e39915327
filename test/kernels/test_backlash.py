"""Backlash between encoder and tube."""

import numpy as np
import pytest

from ctr_dynamics.kernels.backlash import behind_backlash


def test_backlash_follows_after_the_dead_zone():
    x = np.concatenate([np.linspace(0, 1, 50), np.linspace(1, -1, 100)])
    y = behind_backlash(x, 0.2, x[0])
    assert y[49] == pytest.approx(0.9)
    assert y[55] == pytest.approx(0.9)  # still inside the dead zone of the reversal
    assert y[-1] == pytest.approx(-0.9)
