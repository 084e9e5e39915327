"""A measurement that the covariance makes all but impossible shows how far off the tip is, before the filter has learnt why."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import chi_square
from ctr_dynamics.estimation.monitoring.settling import SettlingOptions
from ctr_dynamics.estimation.step_output import Innovation

Floats = NDArray[np.float64]
# in which the vibration of a jump dies down, as that of a start does
AFTER_JUMP_NS = round(1e9 * SettlingOptions.longest_s)
GROWS = 2.0  # periods of the tracker for which the distance grows on
AGREEING = 4  # measurements in a row that end it, half a period of a slow vibration at 40 Hz: one agrees where the error swings through zero
MEAN_OF = 12  # measurements that the mean remembers, 0.3 s at 40 Hz: some periods of a vibration
PROBABILITY = 0.999  # below which a normalised innovation is taken for chance: one in a thousand of a consistent filter is beyond


class UnexpectedInnovation:
    """The variance that the last measurement has shown to be missing.

    After an abrupt change, as the release of a load by a robot whose payload is not that of its file, the error grows faster than the variances of
    force and noise are found from a few measurements. Until some in a row agree, the largest distance is part of the covariance. Just
    after the known load has jumped, that is so of one outside the gate, too: the model is then as likely to be wrong as the tracker.

    Args:
        largest: m, deviation beyond which outputs are invalid. A measurement that would lead there is an outlier, or noise.
        noise: m per axis, deviation of a measured position.
    """

    def __init__(self, largest: float, noise: float) -> None:
        self._largest, self._farthest = largest, largest / (1.0 + GROWS)
        self._noise = 3.0 * noise**2
        self.clear()

    def clear(self) -> None:
        """Nothing was unexpected."""
        self._variance = 0.0  # m^2, of the position in all
        self._last_ns: int | None = None
        self._mean = (
            0.0  # m^2, mean square of the distances less that of the noise, where the robot file is refuted
        )
        self._agreed = 0
        self._period_s = 1.0
        self._jump_ns: int | None = None

    def load_jumped(self, stamp_ns: int) -> None:
        """The known load has jumped at ``stamp_ns``."""
        self._jump_ns = stamp_ns

    def take(self, innovations: Sequence[Innovation], refuted: bool = False, confirmed: bool = True) -> None:
        """The measurements of one step.

        Args:
            innovations: of the step.
            refuted: whether the estimate refutes the tolerances of the robot file. What seems to be noise of the tracker may then as well be a motion
                that the model lacks.
            confirmed: whether measurements have agreed since the start. Before that, neither tracker nor model is known to be right, and outputs
                are invalid where they lie far apart.
        """
        if not refuted:
            self._mean = 0.0
        for innovation in innovations:
            jumped = self._jump_ns is not None and 0 <= innovation.stamp_ns - self._jump_ns < AFTER_JUMP_NS
            apart = innovation.residual[:3]
            farthest = self._farthest if confirmed else self._largest
            near = float(apart @ apart) < farthest**2  # never where the position is not measured
            if not (innovation.dof and near and (innovation.accepted or jumped or refuted or not confirmed)):
                continue
            if refuted:
                more = max(float(apart @ apart) - self._noise, 0.0)
                self._mean += (more - self._mean) / MEAN_OF
            if self._last_ns is not None and innovation.stamp_ns > self._last_ns:
                self._period_s = (innovation.stamp_ns - self._last_ns) * 1e-9
            self._last_ns = innovation.stamp_ns
            unexpected = innovation.nis > chi_square.quantile(PROBABILITY, innovation.dof)
            self._agreed = 0 if unexpected else self._agreed + 1
            if unexpected:
                self._variance = max(self._variance, float(apart @ apart))
            elif self._agreed >= AGREEING:
                self._variance = 0.0

    def inflate(self, covariance: Floats, stamp_ns: int) -> None:
        """Add it to position and velocity in the ``covariance`` (12, 12) of the tip at ``stamp_ns``, in place.

        The distance has come about within a period of the tracker. It may grow on at that rate for a while; then a vibration turns back.
        """
        for i in range(3):
            covariance[i, i] += self._mean / 3.0
            covariance[6 + i, 6 + i] += self._mean / (3.0 * self._period_s**2)
        if not self._variance or self._last_ns is None:
            return
        age_s = (stamp_ns - self._last_ns) * 1e-9
        grown = 1.0 + min(max(age_s / self._period_s, 0.0), GROWS)
        for i in range(3):
            covariance[i, i] += self._variance * grown**2 / 3.0
            covariance[6 + i, 6 + i] += self._variance / (3.0 * self._period_s**2)
