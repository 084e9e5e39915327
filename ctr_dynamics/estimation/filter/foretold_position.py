"""How well a filter foretells a measured position."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def log_density(innovation: Floats, covariance: Floats, noise: Floats, places: NDArray[np.bool_]) -> float:
    """Logarithm of the normal density of the position in an ``innovation`` (k,), by that of the stated noise at its middle.

    Args:
        innovation, covariance: (k,) and (k, k).
        noise: (k, k) covariance that the robot file states; diagonal.
        places: (k,) which of the rows are the position's.

    Returns:
        Minus infinity where the covariance is not positive definite.
    """
    rows = np.flatnonzero(places)
    try:
        root = np.linalg.cholesky(covariance[np.ix_(rows, rows)])
    except np.linalg.LinAlgError:
        return -math.inf
    white = np.linalg.solve(root, innovation[rows])
    stated = np.log(noise.diagonal()[rows]).sum()
    return -0.5 * float(white @ white + 2.0 * np.log(root.diagonal()).sum() - stated)
