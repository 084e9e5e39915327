"""The measurement queue: tracker poses by stamp, from their arrival until no step is taken again for them.

A pose waits until the steps have come to its own time, which is its stamp minus the tracker's delay, or later where it is stamped too early. It
remembers the step after which it was fused, so that it is fused again where that step is corrected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.inputs.input_validation import Unusable, pose_values
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.timeline import DT, Timeline
from ctr_dynamics.io.messages.topics import STEP_NS
from ctr_dynamics.io.messages.unit_quaternions import ROUNDED_WITHIN, is_unit
from ctr_dynamics.model.model import Model
from ctr_dynamics.parameters import Settings, axes_mask
from ctr_dynamics.sensing import TrackerModel
from ctr_dynamics.sensing.checks import Kind, rejection_texts
from ctr_dynamics.sensing.tracker_parameters import tracker_corrections

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class QueueOptions:
    """How long poses are stored.

    Attributes:
        ahead_ns: a pose that far after the newest joint state is on another clock.
        before_joints: poses that are stored before the first joint state: 5 s at 40 Hz.
        compared: newest poses that a new one's stamp is compared with. A tracker that repeats itself does so at once.
        extra_ns: poses are stored for twice the window, as far as a correction reaches back, and this time, for the tracker's delay.
        late_steps: a pose that comes later than that after its stamp is counted as late. A punctual one meets a step or two that are taken.
    """

    ahead_ns: int = 10_000_000_000
    before_joints: int = 200
    compared: int = 50
    extra_ns: int = 300_000_000
    late_steps: int = 2


@dataclass
class QueuedMeasurement:
    """A tracker pose on its way into the filter.

    Attributes:
        stamp_ns: of its header. stamp_error_s: 1-sigma of that, s. position: (3,) m, quaternion: (4,) wxyz, in the tracker's frame.
        late_s: how long after its stamp it came, by the steps that were taken.
        fused_k: the step after which it was fused; None before.
    """

    stamp_ns: int
    position: Floats
    quaternion: Floats
    late_s: float
    fused_k: int | None = None
    stamp_error_s: float = 0.0


class DueMeasurement(NamedTuple):
    """A measurement to be fused: time in s from t0, position (3,) m and quaternion (4,) wxyz without what effects change of them."""

    measurement: QueuedMeasurement
    time_s: float
    position: Floats
    quaternion: Floats


class MeasurementQueue:
    """Tracker poses by stamp. Unusable ones are counted, not raised.

    Args:
        tracker: measurement model.
        frame: the frame that poses come in.
        window_ns: how late a pose may come.
        timeline: where the estimator stands.
        health: where odd poses are counted.

    Attributes:
        measurements: oldest first.
        early_s: by which poses are found to be stamped before their time, beyond the nominal delay.
    """

    def __init__(
        self, tracker: TrackerModel, frame: str, window_ns: int, timeline: Timeline, health: Health
    ) -> None:
        self.tracker, self.frame, self.window_ns = tracker, frame, window_ns
        self._timeline, self._health = timeline, health
        self.options = QueueOptions()
        self.measurements: list[QueuedMeasurement] = []
        self.early_s = 0.0

    def clear(self) -> None:
        """Forget all measurements."""
        self.measurements.clear()

    @property
    def period_s(self) -> float:
        """s between the two newest poses; infinite before there are two."""
        if len(self.measurements) < 2:
            return math.inf
        return (self.measurements[-1].stamp_ns - self.measurements[-2].stamp_ns) * 1e-9

    def add(
        self,
        stamp_ns: int,
        position: Sequence[float],
        quaternion_xyzw: Sequence[float],
        frame_id: str,
        joints_ns: int | None,
        stamp_error_s: float = 0.0,
    ) -> None:
        """Take in a tracker pose (m, x y z w); ``joints_ns``: stamp of the newest joint state; ``stamp_error_s``: 1-sigma of the pose's, s."""
        options, health = self.options, self._health
        try:
            point, quaternion, norm = pose_values(stamp_ns, position, quaternion_xyzw, frame_id, self.frame)
        except Unusable as problem:
            self._drop(problem.kind, problem.text)
            return
        if not is_unit(norm, ROUNDED_WITHIN):
            health.note("tracker", "quaternion normalised", f"norm {norm:.4f}, limit 1 +- {ROUNDED_WITHIN:g}")
        if any(m.stamp_ns == stamp_ns for m in self.measurements[-options.compared :]):
            self._drop(Kind.DUPLICATE.value, rejection_texts.second_of_stamp("pose", stamp_ns))
            return
        taken_ns = self._timeline.taken_ns
        late = max(0.0, (taken_ns - stamp_ns) * 1e-9) if taken_ns is not None else 0.0
        window = self.window_ns * 1e-9
        if late > window:
            self._drop("too late", f"pose came {late:.3f} s after its stamp, limit {window:g} s")
            return
        newest = max((t for t in (joints_ns, taken_ns) if t is not None), default=None)
        if newest is not None and stamp_ns - newest > options.ahead_ns:
            ahead = (stamp_ns - newest) * 1e-9
            self._drop(
                "ahead of the joints",
                f"pose {ahead:.3f} s after the newest joint state, limit {options.ahead_ns * 1e-9:g} s; do both clocks agree?",
            )
            return
        if late > options.late_steps * STEP_NS * 1e-9:
            health.late += 1
        self.measurements.append(
            QueuedMeasurement(stamp_ns, point, quaternion, late, stamp_error_s=stamp_error_s)
        )
        self.measurements.sort(key=lambda m: m.stamp_ns)
        if self._timeline.t0_ns is None and len(self.measurements) > options.before_joints:
            del self.measurements[0]
            self._drop("before the joints", "poses come, but no complete joint state has")

    def retract(self, stamp_ns: int) -> None:
        """Drop the pose of that stamp, if it still waits."""
        for i, measurement in enumerate(self.measurements):
            if measurement.stamp_ns == stamp_ns and measurement.fused_k is None:
                del self.measurements[i]
                self._health.measurements.dropped += 1
                return

    def _drop(self, kind: str, text: str) -> None:
        self._health.measurements.dropped += 1
        self._health.note("tracker", kind, text)

    def _shown_s(self, measurement: QueuedMeasurement) -> float:
        """The newest time that a measurement may show, s from t0."""
        assert self._timeline.t0_ns is not None
        stamp_s = (measurement.stamp_ns - self._timeline.t0_ns) * 1e-9
        return self.tracker.own_time(stamp_s) - self.tracker.delay + self.early_s

    def due(self, t: float) -> list[DueMeasurement]:
        """Measurements that have not been fused and whose own time is past, ``t`` (s) included."""
        t0_ns, tracker = self._timeline.t0_ns, self.tracker
        assert t0_ns is not None
        due = []
        for measurement in self.measurements:
            if measurement.fused_k is not None:
                continue
            if self._shown_s(measurement) > t + 1e-9:
                break  # so are all behind it
            stamp_s = (measurement.stamp_ns - t0_ns) * 1e-9
            undistorted = tracker.undistorted(stamp_s, measurement.position, measurement.quaternion)
            due.append(DueMeasurement(measurement, *undistorted))
        return due

    def first_fusion(self, k: int) -> float:
        """The first step after ``k`` at which a measurement has been fused or now will be; infinite where there is none."""
        first = math.inf
        for measurement in self.measurements:
            if measurement.fused_k is None:
                own = math.ceil(self._shown_s(measurement) / DT - 1e-3)
                first = min(first, max(k + 1, own))
            elif measurement.fused_k > k:
                first = min(first, measurement.fused_k)
        return first

    def fused(self) -> dict[int, int]:
        """The step after which each measurement was fused, by its stamp (ns)."""
        return {m.stamp_ns: m.fused_k for m in self.measurements if m.fused_k is not None}

    def restore(self, fused: dict[int, int]) -> None:
        """Have fused what :meth:`fused` told; the others wait."""
        for measurement in self.measurements:
            measurement.fused_k = fused.get(measurement.stamp_ns)

    def fuse_again(self, k: int) -> None:
        """Measurements that were fused after step ``k`` or later wait."""
        for measurement in self.measurements:
            if measurement.fused_k is not None and measurement.fused_k >= k:
                measurement.fused_k = None

    def forget(self, k: int) -> None:
        """Drop measurements that no step around ``k`` will be taken again for."""
        limit = self._timeline.stamp(k) - 2 * self.window_ns - self.options.extra_ns
        while self.measurements and self.measurements[0].stamp_ns < limit:
            if self.measurements.pop(0).fused_k is None:
                self._drop("never compared", "no estimate reached the pose's time within the window")


def tracker_of(model: Model, settings: Settings) -> TrackerModel:
    """The tracker of the robot file with the parameters' corrections."""
    mask = axes_mask(str(settings["tracker.axes"]))
    return model.plant.tracker.corrected(**tracker_corrections(settings), mask=mask)
