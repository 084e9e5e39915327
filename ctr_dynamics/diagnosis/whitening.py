"""Whitening: the noise of the tracker as the robot file states it.

In: a robot and the stamps of its tracker. Out: a function from residuals to independent numbers of unit variance.
"""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded

from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]


class Whitener:
    """Turns residuals (s, 6) into independent numbers of unit variance: white noise plus drift with a correlation time, per axis.

    These are the innovations of a Kalman filter whose state is the drift, over their deviations. They are those of the Cholesky factor of the
    covariance of all poses, which would take memory that grows with the square of their number.

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
        drift, white = noise.drift.value**2, max(noise.position.value, 1e-6) ** 2
        keep = np.exp(-np.diff(stamps[used]) / noise.drift_time.value)
        expected = np.full(int(used.sum()), drift)  # variance of the drift given the poses before each
        for i, kept in enumerate(keep):
            after = expected[i] * white / (expected[i] + white)
            expected[i + 1] = kept**2 * after + drift * (1.0 - kept**2)
        variance = expected + white
        gain = expected / variance
        self._deviation = np.sqrt(variance)
        # the drift that is expected at each pose follows from the one before, measured or given the innovations
        self._into, self._following = (gain * np.append(keep, 0.0))[:-1], keep
        self._decay = keep * (1.0 - gain[:-1])
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
            parts.append(self._innovations(column) if axis < 3 else column / self._rotation)
        out = np.concatenate(parts)
        return out if values.ndim == 3 else out[:, 0]

    def part(self, first: int, end: int) -> Whitener:
        """The same for the poses that count from the one numbered ``first`` to that before ``end``, given what is before them."""
        found = copy.copy(self)
        found.used = np.zeros_like(self.used)
        found.used[np.flatnonzero(self.used)[first:end]] = True
        found._deviation = self._deviation[first:end]
        between = slice(first, max(min(end, len(self._deviation)) - 1, first))
        found._into, found._following, found._decay = (
            a[between] for a in (self._into, self._following, self._decay)
        )
        return found

    def positions(self, whitened: Floats) -> Floats:
        """(n, ...) in m of whitened positions (n, ...) of one axis: the inverse of whitening."""
        deviation = self._deviation.reshape(-1, *[1] * (whitened.ndim - 1))
        innovations = deviation * whitened
        return innovations + self._drift(self._following, innovations)

    def covariance(self, process: Floats, position: bool) -> Floats:
        """Whitened covariance (n, n) of a process on one axis, whose covariance at the poses that count is ``process`` (m^2 or rad^2)."""
        if not position:
            return process / self._rotation**2
        return self._innovations(self._innovations(process).T)

    def _innovations(self, values: Floats) -> Floats:
        """Whitened positions (n, r) of one axis."""
        return np.asarray((values - self._drift(self._decay, values)) / self._deviation[:, None])

    def _drift(self, keep: Floats, values: Floats) -> Floats:
        """Drift (n, ...) that is expected at each pose: x[0] = 0, x[i + 1] = keep[i] x[i] + into[i] values[i]."""
        if len(values) < 2:
            return np.zeros_like(values)
        right = np.zeros_like(values)
        right[1:] = self._into.reshape(-1, *[1] * (values.ndim - 1)) * values[:-1]
        bands = np.stack([np.ones(len(values)), np.append(-keep, 0.0)])
        return np.asarray(solve_banded((1, 0), bands, right))


def noise_floor(robot: Robot) -> float:
    """3-D rms in m of the tracker's position noise."""
    noise = robot.tracker.noise
    return float(np.sqrt(3.0 * (noise.position.value**2 + noise.drift.value**2)))
