"""What has become of the tracker's measurements: counts, NIS, and how far they lie from the outputs of their time."""

from __future__ import annotations

import copy
import math
import statistics
from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ctr_dynamics import chi_square
from ctr_dynamics.estimation.step_output import NOT_FUSED, Innovation

RECENT = 40  # measurements that the tracker is judged by: one second at 40 Hz
FEWEST_RECENT = 20  # of them, below which nothing is said of a contradiction
APART = 20  # measurements for the distance between tracker and model: half a second at 40 Hz
FEWEST_APART = 3  # of them, below which it is not known: one of three may be an outlier


class Residuals(NamedTuple):
    """Sums over ``compared`` measurements of the squared distance to the open-loop and the fused tip, m^2."""

    compared: int = 0
    open_loop: float = 0.0
    fused: float = 0.0

    def rms(self, fusing: bool) -> dict[str, float | None]:
        """Root of the mean squares, m; None where nothing was compared, and for the fused run where the filter is off."""
        if not self.compared:
            return {"predicted": None, "fused": None}
        open_loop, fused = math.sqrt(self.open_loop / self.compared), math.sqrt(self.fused / self.compared)
        return {"predicted": open_loop, "fused": fused if fusing else None}


NOTHING_COMPARED = Residuals()


@dataclass
class MeasurementRecord:
    """Every measurement counts once, though it is fused again where its step is corrected: a copy is kept, and put back before.

    Attributes:
        accepted, rejected, dropped: measurements that were fused, lay outside the gate, or could not be compared.
        nis_sum, nis_dof, nis_count: over all measurements that reached the gate.
        residuals: of the measurements that were used; unused_residuals: of those that were rejected or dropped.
        recent: (nis, dof, within the gate) of the last of them.
        distances: m, between measured and published positions, of the last measurements.
    """

    accepted: int = 0
    rejected: int = 0
    dropped: int = 0
    nis_sum: float = 0.0
    nis_dof: int = 0
    nis_count: int = 0
    residuals: Residuals = NOTHING_COMPARED
    unused_residuals: Residuals = NOTHING_COMPARED
    recent: deque[tuple[float, int, bool]] = field(default_factory=lambda: deque(maxlen=RECENT))
    distances: deque[float] = field(default_factory=lambda: deque(maxlen=APART))

    def copy(self) -> MeasurementRecord:
        """One that stays as it is when this one goes on."""
        other = copy.copy(self)
        other.recent, other.distances = self.recent.copy(), self.distances.copy()
        return other

    def forget_recent(self) -> None:
        """Judge the tracker afresh; counts stay."""
        self.recent.clear()
        self.distances.clear()

    def add(self, innovation: Innovation, fusing: bool, again: bool = False) -> None:
        """Count a measurement: how far it lies from the outputs of its time, whether it reached the gate, lay within and was fused.

        Args:
            fusing: whether measurements are fused at all.
            again: its time has been published before the clock was set back; its step is in no output, and neither is it in the totals.
        """
        within = innovation.reason in NOT_FUSED or (innovation.accepted and not innovation.reason)
        if innovation.dof:
            self.recent.append((innovation.nis, innovation.dof, within))
        if innovation.fused_residual is not None:
            self.distances.append(float(np.linalg.norm(innovation.fused_residual)))
        if again:
            return
        used = bool(innovation.dof) and (innovation.accepted or not fusing)
        if innovation.motion is not None and innovation.fused_residual is not None:
            open_loop, fused = innovation.motion.residual, innovation.fused_residual
            before = self.residuals if used else self.unused_residuals
            after = Residuals(
                before.compared + 1,
                before.open_loop + float(open_loop @ open_loop),
                before.fused + float(fused @ fused),
            )
            if used:
                self.residuals = after
            else:
                self.unused_residuals = after
        if not innovation.dof:
            self.dropped += 1
            return
        self.nis_count += 1
        self.nis_sum += innovation.nis
        self.nis_dof += innovation.dof
        if innovation.accepted:
            self.accepted += 1
        elif fusing:
            self.rejected += 1

    @property
    def apart_m(self) -> float:
        """m between measured and published positions: the median of the last, as half of them may be outliers, whatever the filter made of them; 0
        before there are ``FEWEST_APART``."""
        return statistics.median(self.distances) if len(self.distances) >= FEWEST_APART else 0.0

    @property
    def outside(self) -> int:
        """How many of the recent measurements lay outside the gate."""
        return sum(not within for _, _, within in self.recent)

    @property
    def mostly_outside(self) -> bool:
        """Whether most of the recent measurements lay outside the gate."""
        return len(self.recent) >= FEWEST_RECENT and self.outside > 0.5 * len(self.recent)

    @property
    def recent_nis(self) -> tuple[float, float]:
        """Mean NIS per degree of freedom of the recent measurements, and the limit for a consistent filter: four deviations of that mean."""
        dof = sum(dof for _, dof, _ in self.recent)
        return sum(nis for nis, _, _ in self.recent) / dof, 1.0 + 4.0 * math.sqrt(2.0 / dof)

    def nis_summary(self) -> dict[str, float | int | bool | None]:
        """Mean NIS per degree of freedom with the 95 % band of that mean for a consistent filter."""
        if not self.nis_dof:
            return {"mean": None, "dof": 0, "lower95": None, "upper95": None, "within": None}
        mean = self.nis_sum / self.nis_dof
        lower, upper = (chi_square.quantile(p, self.nis_dof) / self.nis_dof for p in (0.025, 0.975))
        return {
            "mean": mean,
            "dof": self.nis_dof,
            "lower95": lower,
            "upper95": upper,
            "within": lower <= mean <= upper,
        }

    def summary(self, fusing: bool) -> dict[str, Any]:
        """How many were used, and how far the others lay from the outputs."""
        return {
            "used": self.accepted,
            "not_used": self.rejected + self.dropped,
            "not_used_residual_rms_m": self.unused_residuals.rms(fusing),
        }
