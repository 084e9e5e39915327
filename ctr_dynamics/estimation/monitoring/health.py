"""Health of the estimator: counters of everything odd, turned into statuses by plain functions of numbers; no wall clock."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ctr_dynamics.estimation.monitoring.consistency import MisfitMonitor
from ctr_dynamics.estimation.step_output import ERROR, FUSION_OFF, OK, WARN, Innovation, Status
from ctr_dynamics.model.stability import Stability

Floats = NDArray[np.float64]
SNAP_WARNING_S = 1.0  # a snap that is nearer than this is warned of
TRACKER_LIMIT_S = 1.0  # without a usable sample for longer than this the status says so
WAITING = "waiting for the first complete joint state"


class MeasurementCounts(NamedTuple):
    """What is counted once a measurement, though it is fused again where its step is corrected; see :class:`Health`."""

    nis_count: int
    nis_sum: float
    nis_dof: int
    accepted: int
    rejected: int
    dropped: int
    squares: tuple[float, float]
    compared: int
    recent: list[tuple[float, bool]]


@dataclass
class Counter:
    """How often something happened, and its last occurrence in words."""

    count: int = 0
    last: str = ""

    def add(self, what: str) -> None:
        """Count one."""
        self.count += 1
        self.last = what


@dataclass
class Health:
    """Counters and running figures of the estimator.

    ``joints``, ``tracker``, ``load``: input problems by kind. ``nis_sum``, ``nis_dof``, ``nis_count``: over all samples that reached the gate.
    ``tracker_age_s``: since the newest sample that reached the gate, or the start.
    ``recent``: (nis / dof, within the gate) of the last samples. ``misfit``: watches the innovations. ``stability``: of the
    equilibrium that belongs to the present actuators.
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
    recent: deque[tuple[float, bool]] = field(default_factory=lambda: deque(maxlen=40))
    sweeps: int = 0
    substeps: int = 0
    rolled_back: int = 0
    fusing: bool = True
    force_sigma: float = 0.0
    tracker_age_s: float = 0.0
    misfit: MisfitMonitor = field(default_factory=MisfitMonitor)
    stability: Stability | None = None
    _squares: tuple[float, float] = (0.0, 0.0)  # m^2, of the model alone and fused
    _compared: int = 0

    def note(self, group: str, kind: str, what: str) -> None:
        """Count an input problem of ``kind`` in ``group`` (joints, tracker or load)."""
        getattr(self, group).setdefault(kind, Counter()).add(what)

    def input_problems(self) -> dict[str, dict[str, dict[str, Any]]]:
        """What has been noted of inputs: by group and kind, how often (``count``) and what the ``last`` one was."""
        return {
            group: {kind: {"count": c.count, "last": c.last} for kind, c in getattr(self, group).items()}
            for group in ("joints", "tracker", "load")
        }

    def failed(self, reason: str) -> None:
        """Count a failed step."""
        self.failures += 1
        self.reasons[reason] = self.reasons.get(reason, 0) + 1

    def measured(self, sample: Innovation) -> None:
        """Count a tracker sample: how far it lies from the outputs of its time, whether it reached the gate, lay within and was fused."""
        if sample.motion is not None and sample.fused_residual is not None:
            alone, fused = sample.motion.residual, sample.fused_residual
            self._squares = self._squares[0] + float(alone @ alone), self._squares[1] + float(fused @ fused)
            self._compared += 1
        if not sample.dof:
            self.dropped += 1
            return
        self.nis_count += 1
        self.nis_sum += sample.nis
        self.nis_dof += sample.dof
        within = sample.reason == FUSION_OFF or (sample.accepted and not sample.reason)
        self.recent.append((sample.nis / sample.dof, within))
        if sample.accepted:
            self.accepted += 1
        elif self.fusing:
            self.rejected += 1

    def residual_rms(self) -> dict[str, float | None]:
        """m between readings and outputs: of the model alone, and fused where the filter is on."""
        alone, fused = (math.sqrt(s / self._compared) if self._compared else None for s in self._squares)
        return {"predicted": alone, "fused": fused if self.fusing else None}

    def measurement_counts(self) -> MeasurementCounts:
        """What has been counted of measurements, for :meth:`restore_counts`."""
        return MeasurementCounts(
            self.nis_count, self.nis_sum, self.nis_dof, self.accepted, self.rejected, self.dropped,
            self._squares, self._compared, list(self.recent),
        )  # fmt: skip

    def restore_counts(self, counts: MeasurementCounts) -> None:
        """Have counted of measurements what :meth:`measurement_counts` gave."""
        self.nis_count, self.nis_sum, self.nis_dof = counts.nis_count, counts.nis_sum, counts.nis_dof
        self.accepted, self.rejected, self.dropped = counts.accepted, counts.rejected, counts.dropped
        self._squares, self._compared = counts.squares, counts.compared
        self.recent.clear()
        self.recent.extend(counts.recent)

    def begin_anew(self) -> None:
        """Wait for joints and watch afresh; counters of what was odd stay."""
        self.problem = WAITING
        self.recent.clear()
        self.misfit.clear()

    @property
    def _sampled(self) -> bool:
        return self.tracker_age_s <= TRACKER_LIMIT_S

    @property
    def misfitting(self) -> bool:
        """Whether the misfit monitor's alarm stands and samples still come."""
        return self.misfit.alarm and self._sampled

    @property
    def _outside(self) -> int:
        return sum(not within for _, within in self.recent)

    @property
    def rejecting(self) -> bool:
        """Whether samples come and most of the last lay outside the gate: the tracker and the model do not describe the same robot."""
        return self._sampled and len(self.recent) >= 20 and self._outside > 0.5 * len(self.recent)

    def nis_summary(self) -> dict[str, float | int | bool | None]:
        """Mean NIS per degree of freedom with the 95 % band of that mean for a consistent filter."""
        if not self.nis_dof:
            return {"mean": None, "dof": 0, "lower95": None, "upper95": None, "within": None}
        mean = self.nis_sum / self.nis_dof
        lower, upper = (float(chi2.ppf(p, self.nis_dof)) / self.nis_dof for p in (0.025, 0.975))
        return {
            "mean": mean,
            "dof": self.nis_dof,
            "lower95": lower,
            "upper95": upper,
            "within": lower <= mean <= upper,
        }

    def summary(self) -> dict[str, Any]:
        """The counters as a replay's summary has them."""
        return {
            "steps": self.steps,
            "residual_rms_m": self.residual_rms(),
            "nis": self.nis_summary(),
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
                "steps_taken_again": self.rolled_back,
            },
        }

    def statuses(self) -> list[Status]:
        """One status a part."""
        return [
            self._output(),
            self._solver(),
            self._inputs("joints"),
            self._tracker(),
            self._inputs("load"),
            self._consistency(),
            self.misfit.status(),
            self._stability(),
        ]

    def _output(self) -> Status:
        return Status(
            "output", ERROR if self.problem else OK, self.problem or "valid", {"steps": str(self.steps)}
        )

    def _solver(self) -> Status:
        values = {
            "failures": str(self.failures),
            "restarts": str(self.restarts),
            "steps in substeps": str(self.substeps),
            "steps taken again": str(self.rolled_back),
            "sweeps per step": f"{self.sweeps / self.steps:.1f}" if self.steps else "0",
        }
        values.update({f"failed: {reason}": str(count) for reason, count in self.reasons.items()})
        if self.failures:
            return Status(
                "solver", WARN, f"{self.failures} steps failed; the last reason is in the values", values
            )
        return Status("solver", OK, "ok", values)

    def _inputs(self, group: str) -> Status:
        counters: dict[str, Counter] = getattr(self, group)
        values = {kind: f"{c.count}, last: {c.last}" for kind, c in counters.items()}
        if counters:
            worst = max(counters.items(), key=lambda item: item[1].count)
            return Status(group, WARN, f"{worst[0]} ({worst[1].count}): {worst[1].last}", values)
        return Status(group, OK, "ok", values)

    def _tracker(self) -> Status:
        status = self._inputs("tracker")
        values = {
            **status.values,
            "accepted": str(self.accepted),
            "rejected": str(self.rejected),
            "late": str(self.late),
            "dropped": str(self.dropped),
            "fusion": "on" if self.fusing else "off",
        }
        if self.rejecting:
            message = (
                f"{self._outside} of the last {len(self.recent)} samples are outside the gate (limit half): "
                "check the tracker's frame, units, stamps and the robot file"
            )
            return Status("tracker", ERROR, message, values)
        if not self._sampled:
            message = (
                f"no usable sample for {self.tracker_age_s:.1f} s, limit {TRACKER_LIMIT_S:g} s: "
                "the pose is the model's prediction since then"
            )
            return Status("tracker", WARN, message, values)
        return Status("tracker", status.level, status.message, values)

    @property
    def snap_ahead(self) -> bool:
        """Whether the equilibrium is lost or unstable, or its loss is foretold within SNAP_WARNING_S: news that cannot wait."""
        return self._stability().level > OK

    def _stability(self) -> Status:
        if self.stability is None:
            return Status("stability", OK, "not yet known", {})
        if self.stability.lost:
            message = "no equilibrium near the last one: the robot has snapped or is about to; the outputs follow its dynamics"
            return Status("stability", WARN, message, {})
        values = {"det(d alpha / d psi_L)": f"{self.stability.measure:.4g}"}
        ahead = self.stability.time_to_snap
        if ahead is not None:
            values["time to snap s"] = f"{ahead:.3f}"
        if self.stability.measure <= 0.0:
            return Status(
                "stability",
                WARN,
                f"unstable equilibrium: measure {self.stability.measure:.4g}, limit 0",
                values,
            )
        if ahead is not None and ahead < SNAP_WARNING_S:
            message = f"a snap is ahead in {ahead:.2f} s (warned of below {SNAP_WARNING_S:g} s) at the present actuator rates; stop or turn back"
            return Status("stability", WARN, message, values)
        return Status("stability", OK, f"stable: measure {self.stability.measure:.4g}, limit 0", values)

    def _consistency(self) -> Status:
        values = {"force deviation N": f"{self.force_sigma:.4g}"}
        if not self.recent:
            return Status("consistency", OK, "no samples yet", values)
        mean = sum(ratio for ratio, _ in self.recent) / len(self.recent)
        # the samples of one second: white for a consistent filter, 6 degrees of freedom each
        limit = 1.0 + 4.0 * math.sqrt(2.0 / (6.0 * len(self.recent)))
        values["nis per dof, last second"] = f"{mean:.2f}"
        if mean > limit:
            message = f"mean NIS {mean:.2f} per degree of freedom, limit {limit:.2f}: the model misses an effect, or the noise is larger than stated"
            return Status("consistency", WARN, message, values)
        return Status("consistency", OK, f"mean NIS {mean:.2f} per degree of freedom", values)
