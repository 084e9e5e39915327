"""Quantiles and tails of the chi-square distribution against scipy.stats."""

import pytest
from scipy.stats import chi2

from ctr_dynamics import chi_square


@pytest.mark.parametrize("dof", [1, 2.5, 6, 4000])
def test_same_as_scipy_stats(dof):
    for p in (1e-9, 0.025, 0.5, 0.999):
        assert chi_square.quantile(p, dof) == chi2.ppf(p, dof)
        assert chi_square.upper_tail(chi2.ppf(p, dof), dof) == chi2.sf(chi2.ppf(p, dof), dof)
