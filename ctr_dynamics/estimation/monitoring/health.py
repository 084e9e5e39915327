"""Health of the estimator: counters and running figures of everything odd. Their statuses for /diagnostics are in ``statuses.py``."""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ctr_dynamics import chi_square
from ctr_dynamics.estimation.filter.filter_records import ModelErrorSize
from ctr_dynamics.estimation.monitoring.consistency_monitor import ConsistencyMonitor
from ctr_dynamics.estimation.step_output import FUSION_OFF, MOVING_FRAME, UNKNOWN_DELAY, Innovation
from ctr_dynamics.model.stability import Stability

TRACKER_LIMIT_S = 1.0  # without a usable measurement for longer the status says so: 40 are missing at 40 Hz
RECENT = 40  # measurements that the tracker is judged by: one second at 40 Hz
FEWEST_RECENT = 20  # of them, below which nothing is said of a contradiction
APART, FEWEST_APART = (
    20,
    3,
)  # measurements for the distance between tracker and model: half a second at 40 Hz; one of three may be an outlier
WAITING = "waiting for the first complete joint state"


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


class MeasurementCounts(NamedTuple):
    """What is counted once a measurement, though it is fused again where its step is corrected; see :class:`Health`."""

    nis_count: int
    nis_sum: float
    nis_dof: int
    accepted: int
    rejected: int
    dropped: int
    residuals: Residuals
    unused_residuals: Residuals
    recent: list[tuple[float, bool]]
    distances: list[float]


@dataclass
class Counter:
    """How often something happened, and its last occurrence in words."""

    count: int = 0
    last: str = ""

    def add(self, what: str, count: int = 1) -> None:
        """Count one, or as many as ``count`` says."""
        self.count += count
        self.last = what


@dataclass
class Health:
    """Counters and running figures of the estimator.

    Attributes:
        joints, tracker, load: input problems by kind.
        problem: why the last output is invalid; empty when it is valid.
        shortfall: what of the accuracy that is asked cannot be had; empty where nothing is missing.
        propagated: steps whose ``substeps_taken`` are counted, and ``most_substeps`` of one.
        steps, failures, restarts, substeps, sweeps: of the runs; reasons: failures by reason. corrected_steps: taken again for late inputs.
        accepted, rejected, dropped, late: measurements. fusing: whether they are fused.
        nis_sum, nis_dof, nis_count: over all measurements that reached the gate.
        recent: (nis / dof, within the gate) of the last of them.
        tracker_age_s: since the newest measurement that reached the gate, or the start.
        force_sigma: N, deviation of the tip force in the process noise.
        shift_m: m, by which measured positions lie beside what any force on the robot explains; 0 where they do not.
        noise_ratio: deviation of the tracker's noise by the stated one; 1 while nothing else is established.
        model_error: by which the robot is found to depart from its model beyond the robot file; None while it is not.
        refutation: what refutes the tolerances of the robot file; empty where nothing does.
        residuals: of the measurements that were used; unused_residuals: of those that were rejected or dropped.
        distances: m, between measured and published positions, of the last measurements.
        outside: how many of the recent measurements lay outside the gate.
        consistency: watches the innovations. stability: of the equilibrium that belongs to the present actuators.
    """

    joints: dict[str, Counter] = field(default_factory=dict)
    tracker: dict[str, Counter] = field(default_factory=dict)
    load: dict[str, Counter] = field(default_factory=dict)
    problem: str = WAITING
    steps: int = 0
    failures: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    restarts: int = 0
    rejected: int = 0
    late: int = 0
    dropped: int = 0
    accepted: int = 0
    nis_sum: float = 0.0
    nis_dof: int = 0
    nis_count: int = 0
    recent: deque[tuple[float, bool]] = field(default_factory=lambda: deque(maxlen=RECENT))
    sweeps: int = 0
    substeps: int = 0
    shortfall: str = ""
    propagated: int = 0
    substeps_taken: int = 0
    most_substeps: int = 0
    corrected_steps: int = 0
    fusing: bool = True
    force_sigma: float = 0.0
    shift_m: float = 0.0
    noise_ratio: float = 1.0
    model_error: ModelErrorSize | None = None
    tracker_age_s: float = 0.0
    consistency: ConsistencyMonitor = field(default_factory=ConsistencyMonitor)
    stability: Stability | None = None
    refutation: str = ""
    residuals: Residuals = NOTHING_COMPARED
    unused_residuals: Residuals = NOTHING_COMPARED

    distances: deque[float] = field(default_factory=lambda: deque(maxlen=APART))
    outside: int = 0

    # -- counting --

    def note(self, group: str, kind: str, what: str, count: int = 1) -> None:
        """Count an input problem of ``kind`` in ``group`` (joints, tracker or load); a negative ``count`` takes some back."""
        counters = getattr(self, group)
        counter = counters.setdefault(kind, Counter())
        counter.add(what or counter.last, count)
        if counter.count <= 0:
            del counters[kind]

    def failed(self, reason: str) -> None:
        """Count a failed step."""
        self.failures += 1
        self.reasons[reason] = self.reasons.get(reason, 0) + 1

    def measured(self, innovation: Innovation, again: bool = False) -> None:
        """Count a measurement: how far it lies from the outputs of its time, whether it reached the gate, lay within and was fused.

        Args:
            again: its time has been published before the clock was set back; its step is in no output, and neither is it in the totals.
        """
        within = innovation.reason in (FUSION_OFF, MOVING_FRAME, UNKNOWN_DELAY) or (
            innovation.accepted and not innovation.reason
        )
        if innovation.dof:
            self.recent.append((innovation.nis / innovation.dof, within))
            self.outside = sum(not other for _, other in self.recent)
        if innovation.fused_residual is not None:
            self.distances.append(float(np.linalg.norm(innovation.fused_residual)))
        if again:
            return
        used = bool(innovation.dof) and (innovation.accepted or not self.fusing)
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
        elif self.fusing:
            self.rejected += 1

    def measurement_counts(self) -> MeasurementCounts:
        """What has been counted of measurements, for :meth:`restore_counts`."""
        return MeasurementCounts(
            self.nis_count, self.nis_sum, self.nis_dof, self.accepted, self.rejected, self.dropped,
            self.residuals, self.unused_residuals, list(self.recent), list(self.distances),
        )  # fmt: skip

    def restore_counts(self, counts: MeasurementCounts) -> None:
        """Have counted of measurements what :meth:`measurement_counts` gave."""
        self.nis_count, self.nis_sum, self.nis_dof = counts.nis_count, counts.nis_sum, counts.nis_dof
        self.accepted, self.rejected, self.dropped = counts.accepted, counts.rejected, counts.dropped
        self.residuals, self.unused_residuals = counts.residuals, counts.unused_residuals
        self.recent.clear()
        self.recent.extend(counts.recent)
        self.distances.clear()
        self.distances.extend(counts.distances)
        self.outside = sum(not within for _, within in self.recent)

    def reinitialise(self) -> None:
        """Wait for joints and watch afresh; counters of what was odd stay, and so does a model error that was found."""
        self.problem = WAITING
        self.recent.clear()
        self.distances.clear()
        self.outside = 0
        self.consistency.clear()
        self.stability, self.refutation = None, ""
        self.tracker_age_s = self.force_sigma = self.shift_m = 0.0
        self.noise_ratio = 1.0

    # -- what it comes to --

    @property
    def apart_m(self) -> float:
        """m between measured and published positions: the median of the last, as half of them may be outliers, whatever the filter made of them; 0
        before there are ``FEWEST_APART``."""
        return statistics.median(self.distances) if len(self.distances) >= FEWEST_APART else 0.0

    @property
    def tracker_alive(self) -> bool:
        """Whether usable measurements come."""
        return self.tracker_age_s <= TRACKER_LIMIT_S

    @property
    def inconsistent(self) -> bool:
        """Whether the consistency monitor's alarm stands and measurements still come."""
        return self.consistency.alarm and self.tracker_alive

    @property
    def rejecting(self) -> bool:
        """Whether measurements come and most of the last lay outside the gate: the tracker and the model do not describe the same robot."""
        enough = len(self.recent) >= FEWEST_RECENT
        return self.tracker_alive and enough and self.outside > 0.5 * len(self.recent)

    # -- the summary of a replay --

    def input_problems(self) -> dict[str, dict[str, dict[str, Any]]]:
        """What has been noted of inputs: by group and kind, how often (``count``) and what the ``last`` one was."""
        return {
            group: {kind: {"count": c.count, "last": c.last} for kind, c in getattr(self, group).items()}
            for group in ("joints", "tracker", "load")
        }

    def residual_rms(self) -> dict[str, float | None]:
        """m between the measurements that were used and the outputs: open loop, and fused where the filter is on."""
        return self.residuals.rms(self.fusing)

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

    def count_substeps(self, count: int) -> None:
        """A step has been taken in ``count`` substeps."""
        self.substeps += count > 1
        self.propagated += 1
        self.substeps_taken += count
        self.most_substeps = max(self.most_substeps, count)

    def substeps_summary(self) -> dict[str, float | None]:
        """Substeps a step, in the mean and at most; None before the first step."""
        if not self.propagated:
            return {"mean": None, "max": None}
        return {"mean": self.substeps_taken / self.propagated, "max": self.most_substeps}

    def summary(self) -> dict[str, Any]:
        """The counters as a replay's summary has them."""
        return {
            "steps": self.steps,
            "residual_rms_m": self.residual_rms(),
            "measurements": {
                "used": self.accepted,
                "not_used": self.rejected + self.dropped,
                "not_used_residual_rms_m": self.unused_residuals.rms(self.fusing),
            },
            "nis": self.nis_summary(),
            "model_error": self.model_error._asdict() if self.model_error else None,
            "refutation": self.refutation,
            "rejected": self.rejected,
            "late": self.late,
            "dropped": self.dropped,
            "input_problems": self.input_problems(),
            "solver": {
                "failures": self.failures,
                "reasons": dict(self.reasons),
                "restarts": self.restarts,
                "substeps": self.substeps,
                "sweeps_per_step": self.sweeps / self.steps if self.steps else 0.0,
                "steps_taken_again": self.corrected_steps,
            },
        }
