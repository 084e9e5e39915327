"""Prior probabilities of causes, and of their sizes and shapes."""

import math

import numpy as np
import pytest
from scipy import stats

from ctr_dynamics.diagnosis.inference.gaussian_posterior import half_gaussian_gain


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
