"""Quantiles and tail probabilities of the chi-square distribution.

They are those of ``scipy.stats.chi2``, whose package alone takes half a second to import, at the start of every command.
"""

from __future__ import annotations

from scipy.special import chdtrc, gammaincinv


def quantile(probability: float, dof: float) -> float:
    """Value that a chi-square variable of ``dof`` degrees of freedom exceeds with 1 - ``probability``."""
    return 2.0 * float(gammaincinv(0.5 * dof, probability))


def upper_tail(value: float, dof: float) -> float:
    """Probability that a chi-square variable of ``dof`` degrees of freedom exceeds ``value``."""
    return float(chdtrc(dof, value))
