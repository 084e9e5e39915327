"""The gate: which measurements are fused, and what follows several rejections in a row.

One measurement outside the gate is an outlier and is rejected. More of them in a row, while the tracker seems sound
(:class:`~ctr_dynamics.estimation.filter.adapted_variances.AdaptedVariances`), say that the filter has lost the robot. Then the covariance is
inflated until the measurement is plausible, and it is fused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics import chi_square
from ctr_dynamics.estimation.filter.adapted_variances import FORCE_PART, AdaptedVariances

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class GateOptions:
    """The gate, and the inflation after rejections.

    Attributes:
        probability: that a measurement of a consistent filter lies within the gate.
        largest_variance: m^2 and rad^2. A robot is not larger, so a covariance of the measured pose is not inflated beyond.
        most_doublings: of the covariance, in one inflation. A deviation then grows a millionfold.
        farthest: times the gate's limit. A measurement whose NIS is larger even with the inflated covariance is not fused.
        longest: rejections in a row after which the covariance is inflated again, at the latest.
    """

    probability: float = 0.9999
    largest_variance: float = 1.0
    most_doublings: int = 40
    farthest: float = 10.0
    longest: int = 32


class Gate:
    """Chi-square gate on the normalised innovation squared (NIS).

    Attributes:
        limits: largest NIS by degrees of freedom, 1 to 6.
        rejections: measurements in a row that were outside, those fused after an inflation included.
    """

    def __init__(self, options: GateOptions) -> None:
        self.options = options
        self.limits = {dof: chi_square.quantile(options.probability, dof) for dof in range(1, 7)}
        self.rejections = 0

    def outside(self, nis: float, dof: int) -> bool:
        """Whether a measurement with ``nis`` of ``dof`` degrees of freedom is outside the gate."""
        return nis > self.limits[dof]

    def count(self, outside: bool) -> None:
        """Count the measurement that is to be fused now."""
        self.rejections = self.rejections + 1 if outside else 0

    @property
    def recovers(self) -> bool:
        """Whether the covariance is inflated for the last of the rejected measurements.

        That is the second, fourth, eighth ... and every 32nd: a tracker that contradicts the model for good would lead the runs astray with
        every measurement that is fused.
        """
        n = self.rejections
        return n % self.options.longest == 0 or (n > 1 and n & (n - 1) == 0)

    def inflate(
        self, nu: Floats, H: Floats, R: Floats, pi: Floats, columns: int, adapted: AdaptedVariances
    ) -> Floats | None:
        """The covariance ``pi`` (n, n) inflated until an innovation is plausible; None where it never is, and then nothing has changed.

        Args:
            nu, H, R: innovation (k,), its derivative (k, n) and the measurement noise (k, k).
            pi: of the coefficients and the tracker states.
            columns: number of coefficients.
            adapted: raised first, by what its range leaves.
        """
        options, limit = self.options, self.limits[len(nu)]
        plausible = min(limit, max(0.5 * limit, float(len(nu))))

        def nis(covariance: Floats) -> float:
            return float(nu @ np.linalg.solve(H @ covariance @ H.T + R, nu))

        # 1. The variance of the tip force: what the model has missed is most often a force.
        raised, inflated = 1.0, pi
        while nis(inflated) > plausible and 2.0 * raised <= adapted.headroom:
            raised *= 2.0
            inflated = pi + (raised - 1.0) * adapted.parts[FORCE_PART]
        # 2. Where that does not do, the covariance of the coefficients (a fading memory).
        deviations, force_only = np.ones(len(pi)), inflated
        for _ in range(options.most_doublings):
            inflated = force_only * np.multiply.outer(deviations, deviations)
            if nis(inflated) <= plausible or (H @ inflated @ H.T).diagonal().max() > options.largest_variance:
                break
            deviations[:columns] *= math.sqrt(2.0)
        if nis(inflated) > options.farthest * limit:
            return None
        adapted.scale(raised, deviations)
        return inflated
