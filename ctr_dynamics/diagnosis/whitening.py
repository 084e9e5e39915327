"""Whitening: the noise of the tracker as the robot file states it.

In: a robot and the stamps of its tracker. Out: a function from residuals to independent numbers of unit variance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]


class Whitener:
    """Turns residuals (s, 6) into independent numbers of unit variance: white noise plus drift with a correlation time, per axis.

    Args:
        stamps: (s,) s.
        mask: (6,) axes that are measured: position, then rotation.
        used: (s,) poses that count.
    """

    def __init__(
        self, robot: Robot, stamps: Floats, mask: NDArray[np.bool_], used: NDArray[np.bool_]
    ) -> None:
        noise = robot.tracker.noise
        self.mask, self.used = mask, used
        t = stamps[used]
        covariance = noise.drift.value**2 * np.exp(-np.abs(t[:, None] - t[None]) / noise.drift_time.value)
        covariance[np.diag_indices(len(t))] += max(noise.position.value, 1e-6) ** 2
        self._factor = cholesky(covariance, lower=True)
        self._rotation = max(noise.rotation.value, 1e-6)

    @property
    def size(self) -> int:
        """Number of whitened values."""
        return int(self.used.sum() * self.mask.sum())

    def __call__(self, values: Floats) -> Floats:
        """(s, 6) or (s, 6, r) to (size,) or (size, r), axis by axis."""
        flat = (values if values.ndim == 3 else values[:, :, None])[self.used]
        parts = []
        for axis in np.flatnonzero(self.mask):
            column = flat[:, axis]
            parts.append(
                solve_triangular(self._factor, column, lower=True) if axis < 3 else column / self._rotation
            )
        out = np.concatenate(parts)
        return out if values.ndim == 3 else out[:, 0]

    def positions(self, whitened: Floats) -> Floats:
        """(n, ...) in m of whitened positions (n, ...) of one axis: the inverse of whitening."""
        return np.asarray(self._factor @ whitened)

    def covariance(self, process: Floats, position: bool) -> Floats:
        """Whitened covariance (n, n) of a process on one axis, whose covariance at the poses that count is ``process`` (m^2 or rad^2)."""
        if not position:
            return process / self._rotation**2
        half = solve_triangular(self._factor, process, lower=True)
        return np.asarray(solve_triangular(self._factor, half.T, lower=True))


def noise_floor(robot: Robot) -> float:
    """3-D rms in m of the tracker's position noise."""
    noise = robot.tracker.noise
    return float(np.sqrt(3.0 * (noise.position.value**2 + noise.drift.value**2)))
