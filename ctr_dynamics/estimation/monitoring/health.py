"""Health of the estimator: counters and running figures of everything odd. Their statuses for /diagnostics are in ``statuses.py``."""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from ctr_dynamics.estimation.filter.filter_records import ModelErrorSize
from ctr_dynamics.estimation.monitoring.consistency_monitor import ConsistencyMonitor
from ctr_dynamics.estimation.monitoring.measurement_record import MeasurementRecord
from ctr_dynamics.estimation.timeline import seconds
from ctr_dynamics.model.stability import Stability

TRACKER_LIMIT_S = 1.0  # without a usable measurement for longer the status says so: 40 are missing at 40 Hz
RECENT_S = 10.0  # of steps: an input problem is said for so long after its last occurrence
SLOW_JOINTS_S = 0.05  # s between joint states: more than twice what 50 Hz make. At 10 rad/s a tube turns by half a radian meanwhile.
JOINTS_COMPARED = 11  # the last joint states, whose median period counts
WAITING = "waiting for the first complete joint state"


@dataclass
class Counter:
    """How often something happened, its ``last`` occurrence in words, and after how many of the estimator's ``steps`` that was.

    ``place``: in the order in which problems of any kind last occurred.
    """

    count: int = 0
    last: str = ""
    steps: int = 0
    place: int = 0


@dataclass
class Health:
    """Counters and running figures of the estimator.

    Attributes:
        joints, tracker, load: input problems by kind.
        problem: why the last output is invalid; empty when it is valid.
        shortfall: what of the accuracy that is asked cannot be had; empty where nothing is missing.
        propagated: steps whose ``substeps_taken`` are counted, and ``most_substeps`` of one.
        joint_stamps: ns, of the last joint states that are used.
        steps, failures, restarts, substeps, sweeps: of the runs; reasons: failures by reason. corrected_steps: taken again for late inputs.
        measurements: what has become of them. late: how many came late. fusing: whether they are fused.
        tracker_age_s: since the newest measurement that reached the gate, or the start.
        force_sigma: N, deviation of the tip force in the process noise.
        shift_m: m, by which measured positions lie beside what any force on the robot explains; 0 where they do not.
        noise_ratio: deviation of the tracker's noise by the stated one; 1 while nothing else is established.
        model_error: by which the robot is found to depart from its model beyond the robot file; None while it is not.
        refutation: what refutes the tolerances of the robot file; empty where nothing does.
        consistency: watches the innovations. stability: of the equilibrium that belongs to the present actuators.
    """

    joints: dict[str, Counter] = field(default_factory=dict)
    tracker: dict[str, Counter] = field(default_factory=dict)
    load: dict[str, Counter] = field(default_factory=dict)
    problem: str = WAITING
    steps: int = 0
    joint_stamps: deque[int] = field(default_factory=lambda: deque(maxlen=JOINTS_COMPARED))
    failures: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    restarts: int = 0
    measurements: MeasurementRecord = field(default_factory=MeasurementRecord)
    late: int = 0
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
    _noted: int = 0

    # -- counting --

    def note(self, group: str, kind: str, what: str, count: int = 1) -> None:
        """Count an input problem of ``kind`` in ``group`` (joints, tracker or load); a negative ``count`` takes some back."""
        counters = getattr(self, group)
        counter = counters.setdefault(kind, Counter())
        counter.count += count
        counter.last = what or counter.last
        if count > 0:
            self._noted += 1
            counter.steps, counter.place = self.steps, self._noted
        if counter.count <= 0:
            del counters[kind]

    def failed(self, reason: str) -> None:
        """Count a failed step."""
        self.failures += 1
        self.reasons[reason] = self.reasons.get(reason, 0) + 1

    def reinitialise(self) -> None:
        """Wait for joints and watch afresh; counters of what was odd stay, and so does a model error that was found."""
        self.problem = WAITING
        self.measurements.forget_recent()
        self.consistency.clear()
        self.stability, self.refutation = None, ""
        self.tracker_age_s = self.force_sigma = self.shift_m = 0.0
        self.noise_ratio = 1.0
        self.joint_stamps.clear()

    # -- what it comes to --

    def newest_first(self, group: str) -> list[tuple[str, Counter]]:
        """Problems of the input ``group`` with their kinds, those that occurred last first."""
        counters: dict[str, Counter] = getattr(self, group)
        return sorted(counters.items(), key=lambda item: -item[1].place)

    def is_recent(self, counter: Counter) -> bool:
        """Whether the last occurrence is less than ``RECENT_S`` of steps ago; steps rise whatever clocks do."""
        return seconds(self.steps - counter.steps) < RECENT_S

    @property
    def joint_period_s(self) -> float:
        """Median time between the last joint states, s; 0 while fewer than half of those that count are known."""
        if len(self.joint_stamps) <= JOINTS_COMPARED // 2:
            return 0.0
        return statistics.median(b - a for a, b in pairwise(sorted(self.joint_stamps))) * 1e-9

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
        return self.tracker_alive and self.measurements.mostly_outside

    # -- the summary of a replay --

    def input_problems(self) -> dict[str, dict[str, dict[str, Any]]]:
        """What has been noted of inputs: by group and kind, how often (``count``) and what the ``last`` one was."""
        return {
            group: {kind: {"count": c.count, "last": c.last} for kind, c in getattr(self, group).items()}
            for group in ("joints", "tracker", "load")
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
            "residual_rms_m": self.measurements.residuals.rms(self.fusing),
            "measurements": self.measurements.summary(self.fusing),
            "nis": self.measurements.nis_summary(),
            "model_error": self.model_error._asdict() if self.model_error else None,
            "refutation": self.refutation,
            "rejected": self.measurements.rejected,
            "late": self.late,
            "dropped": self.measurements.dropped,
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
