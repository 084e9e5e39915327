"""A smooth departure of the robot from its model."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from ctr_dynamics.estimation.monitoring.smooth_departure import SmoothDeparture

NOISE = 3e-4


@pytest.mark.parametrize(("size", "time_s"), [(2e-3, 0.5), (5e-3, 3.0)])
def test_the_evidence_is_that_of_a_gaussian_process(size, time_s):
    """With Matern's covariance of smoothness 3/2, at uneven times; by the density of the noise at zero."""
    rng = np.random.default_rng(4)
    stamps = np.cumsum(rng.integers(10_000_000, 60_000_000, 30))
    residuals = 2e-3 * rng.standard_normal((30, 3))
    found = SmoothDeparture(NOISE, np.array([size]), np.array([time_s]), 0.01, math.inf)
    evidence = [found.add(int(s), r) for s, r in zip(stamps, residuals, strict=True)][-1]
    apart = math.sqrt(3.0) * np.abs(stamps[:, None] - stamps) * 1e-9 / time_s
    covariance = size**2 * (1.0 + apart) * np.exp(-apart) + NOISE**2 * np.eye(30)
    process = multivariate_normal(np.zeros(30), covariance)
    expected = sum(float(process.logpdf(axis)) for axis in residuals.T)
    expected += 30 * 3 * (0.5 * math.log(2.0 * math.pi) + math.log(NOISE)) + math.log(0.01)
    assert evidence == pytest.approx(expected)
    assert found.evidence[0] == pytest.approx(expected - math.log(0.01))


def test_measurements_that_are_taken_again_count_once():
    residuals = 2e-3 * np.random.default_rng(5).standard_normal((40, 3))
    once, again = (SmoothDeparture(NOISE, np.array([2e-3]), np.array([1.0]), 0.01, 10.0) for _ in range(2))
    for k in range(40):
        last = once.add(25_000_000 * k, residuals[k])
    for k in [*range(30), *range(20, 40)]:
        repeated = again.add(25_000_000 * k, residuals[k])
    assert repeated == pytest.approx(last)
