"""Joint readings without the noise of their encoders, for those who know what comes after.

The noise of an encoder is a motion that the robot did not make. A model that is driven by it vibrates: with little damping, more from second to
second. So a simulation of recorded joints takes the noise off first, as far as the readings before and after tell what is noise.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Floats = NDArray[np.float64]

HALF_WIDTHS = (3, 4, 6, 8, 11, 16, 23, 32, 45, 64)
"""Samples on either side: each window holds half as many again as the one before."""
DEGREE = 4
"""Of the polynomials. A motion of some Hz bends so much within a window that parabolas would change it by as much as the noise."""
DEVIATIONS = 1.5
"""Width of the interval around each estimate. With more, an error that lasts replaces noise that does not; with less, windows stay narrow."""
_THIRD_DIFFERENCE = np.sqrt(20.0) * 0.6745  # its median size for white noise of one


def noise_of(values: Floats) -> Floats:
    """Standard deviation (n,) of white noise that the third differences of readings (s, n) leave room for; motion adds to it."""
    if len(values) < 4:
        return np.zeros(values.shape[1])
    return np.median(np.abs(np.diff(values, 3, axis=0)), axis=0) / _THIRD_DIFFERENCE


def without_noise(t: Floats, values: Floats, deviation: float) -> Floats:
    """Readings (s, n) at the rising times ``t`` (s,) without white noise of standard ``deviation``.

    A polynomial of fourth degree through the readings around each, over the widest window that the noise allows: its value must agree with those
    of all narrower windows within their uncertainties (intersection of confidence intervals, Goldenshluger and Nemirovski 1997). So a slope
    discontinuity or a step of the motion stays as sharp as the readings show it. Readings with less noise than stated (:func:`noise_of`) are
    changed less.
    """
    sigma = np.minimum(noise_of(values), deviation)
    out = values.copy()
    if not np.any(sigma > 0.0):
        return out
    low, high = values - DEVIATIONS * sigma, values + DEVIATIONS * sigma
    agreeing = np.broadcast_to(sigma > 0.0, values.shape).copy()
    for half in HALF_WIDTHS:
        width = 2 * half + 1
        if width > len(t):
            break
        estimate, gain = _polynomial(t, values, half)
        reach = DEVIATIONS * sigma * gain[:, None]
        low, high = np.maximum(low, estimate - reach), np.minimum(high, estimate + reach)
        agreeing &= low <= high
        out[agreeing] = estimate[agreeing]
    return out


def _polynomial(t: Floats, values: Floats, half: int) -> tuple[Floats, Floats]:
    """Value at each time of the least-squares polynomial through ``2 half + 1`` readings around it, and its deviation (s,) per unit of noise."""
    count, width = len(t), 2 * half + 1
    first = np.clip(np.arange(count) - half, 0, count - width)
    around = sliding_window_view(t, width)[first] - t[:, None]
    scaled = around / np.abs(around).max(axis=1, keepdims=True)
    basis = scaled[:, :, None] ** np.arange(DEGREE + 1)
    normal = np.einsum("swi,swj->sij", basis, basis)
    one = np.broadcast_to(np.eye(DEGREE + 1)[:, :1], (count, DEGREE + 1, 1))
    at_centre = np.linalg.solve(normal, one)[:, :, 0]
    weights = np.einsum("swi,si->sw", basis, at_centre)
    estimate = np.einsum("sw,snw->sn", weights, sliding_window_view(values, width, axis=0)[first])
    return estimate, np.sqrt((weights**2).sum(axis=1))
