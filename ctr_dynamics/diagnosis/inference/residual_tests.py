"""Residual tests: is what a model leaves noise, and is the noise of the stated size.

In: a problem and whitened residuals. Out: the probabilities of two tests.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import chi_square
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.map_fit import Fit

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Whiteness:
    """Tests of whitened residuals against independent unit noise.

    Attributes:
        p: of the more extreme of the two tests, corrected for there being two.
        power: mean square.
        p_power, p_correlation: of each test.
    """

    p: float
    power: float
    p_power: float
    p_correlation: float


def by_axis(problem: Problem, whitened: Floats) -> list[Floats]:
    """One sequence for each recording and measured axis."""
    out, start = [], 0
    for whiten in problem.whiteners:
        samples = int(whiten.used.sum())
        for _ in range(int(whiten.mask.sum())):
            out.append(whitened[start : start + samples])
            start += samples
    return out


def whiteness(problem: Problem, fit: Fit) -> Whiteness:
    """Ljung-Box test over all axes together, and whether the mean square of what ``fit`` leaves exceeds one.

    Noise loses what the fit follows of it: as many squares as there are effective parameters, and next to nothing of its correlation. Parameters
    of a regression are none of a time series' own, which would take degrees of freedom from the Ljung-Box test.
    """
    q, dof = 0.0, 0
    for x in by_axis(problem, fit.whitened):
        n = len(x)
        lags = min(problem.options.residual_tests.lags, n // 4)
        if lags < 1 or not np.any(x):
            continue
        power = float(x @ x)
        r = np.array([float(x[k:] @ x[:-k]) / power for k in range(1, lags + 1)])
        q += n * (n + 2) * float(np.sum(r**2 / (n - np.arange(1, lags + 1))))
        dof += lags
    p_correlation = chi_square.upper_tail(q, dof) if dof else 1.0
    m = max(len(fit.whitened) - round(fit.effective_parameters), 1)
    power = float(fit.whitened @ fit.whitened)
    p_power = chi_square.upper_tail(power, m)
    p = min(1.0, 2.0 * min(p_correlation, p_power))
    return Whiteness(p, power / m, p_power, p_correlation)


def rms(values: Floats) -> float:
    """3-D rms of (s, 3), over finite rows; NaN where there are none."""
    squares = np.sum(values**2, axis=1)
    squares = squares[np.isfinite(squares)]
    return math.sqrt(float(squares.mean())) if len(squares) else math.nan
