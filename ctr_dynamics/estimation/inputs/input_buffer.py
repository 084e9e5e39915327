"""What is known of actuators, load and tracker, by stamp.

What comes in is checked and counted, and said from which stamp on it changes what was known.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.inputs.input_validation import (
    UNIT,
    Unusable,
    joint_values,
    pose_values,
    wrench_values,
)
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.model.model import Model
from ctr_dynamics.parameters import Settings
from ctr_dynamics.sensing import ActuatorSignal, TrackerModel
from ctr_dynamics.sensing.interpolation import Signal

Floats = NDArray[np.float64]
DT_NS = 3_000_000
LOAD_GRACE_NS = 100_000_000  # a first load that comes this soon after the joints is there from the start
AHEAD_NS = 10_000_000_000  # a pose that far after the newest joint state is on another clock
WAITING_SAMPLES = 200  # poses kept until the first joint state


def seconds(k: int) -> float:
    """s from t0 of step ``k``; multiplied in this order everywhere, as another rounding moves what is read of inputs by 1 ns."""
    return k * DT_NS * 1e-9


@dataclass
class Sample:
    """A tracker pose on its way into the filter; ``fused_k`` is the step after which it was used."""

    stamp_ns: int
    position: Floats
    quaternion: Floats
    late_s: float
    fused_k: int | None = None


class InputBuffer:
    """Joints, loads and tracker poses, kept for as long as steps may be taken again. Wrong ones are counted, not raised.

    Attributes:
        t0_ns: stamp of step 0, that of the first complete joint state; None before it.
        joints, load: by stamp. samples: tracker poses by stamp. backwards: joint states in a row whose time ran backwards.
        window_ns: how late an input may come. timeout_ns: how long after the last joints steps are taken without.
        predicting: whether steps are taken on time, with extrapolated joints.
    """

    def __init__(self, model: Model, settings: Settings, health: Health) -> None:
        self.model, self.settings, self.health = model, settings, health
        self.window_ns = round(float(settings["filter.window_s"]) * 1e9)
        self.timeout_ns = round(float(settings["input_timeout_s"]) * 1e9)
        self.predicting = settings["output.policy"] == "predict"
        self._load_delay_ns = round(model.plant.load_delay * 1e9)
        self._load_bend = model.load_kink / (DT_NS * 1e-9)
        self.load = Signal(6)
        self.clear()

    def clear(self) -> None:
        """Forget everything but the last known load, which goes on acting."""
        self.t0_ns: int | None = None
        self.joints = ActuatorSignal(self.model.plant.actuators)
        self.carry_load(self.load)
        self._opening: int | None = None  # ns of the sample without load that was put before the first load
        self.samples: list[Sample] = []
        self.backwards = 0

    def carry_load(self, load: Signal) -> None:
        """Have of loads the last one of ``load`` alone: what hangs on the robot does so whatever the estimator is told. It is forgotten where
        joints then come from before its time: the clock, and with it the world, began anew."""
        self.load = Signal(6)
        self._carried = load.stamps[-1] if load.stamps else None
        if self._carried is not None:
            self.load.add(self._carried, load.values[-1])

    def stamp(self, k: int) -> int | None:
        """ns of step ``k``; None before the first."""
        return None if self.t0_ns is None or k < 0 else self.t0_ns + k * DT_NS

    # -- what comes in --

    def add_joints(
        self, stamp_ns: int, names: Sequence[str], positions: Sequence[float], k: int
    ) -> int | None:
        """Take in a joint state after step ``k``; returns the ns from which on actuators are known otherwise than before."""
        try:
            value = joint_values(self.model.plant, stamp_ns, names, positions)
        except Unusable as problem:
            self.health.note("joints", problem.kind, problem.text)
            return None
        if self.joints.stamps and stamp_ns < self.joints.stamps[-1] - self.window_ns:
            self.backwards += 1
            back = (self.joints.stamps[-1] - stamp_ns) * 1e-9
            self.health.note(
                "joints",
                "time ran backwards",
                f"stamp {back:.3f} s before the last, limit {self.window_ns * 1e-9:g} s",
            )
            return None
        self.backwards = 0
        last = self.joints.stamps[-1] if self.joints.stamps else None
        taken = self.stamp(k)
        if (
            last is not None
            and taken is not None
            and last < taken < stamp_ns
            and taken - last > self.timeout_ns
        ):
            # steps were taken with the held value: go on from there, not from a straight line over the gap
            held, _ = Signal.at(self.joints, taken, self.timeout_ns if self.predicting else 0)
            self.joints.add(taken, held)
        kind = self.joints.add(stamp_ns, value)
        if kind == "duplicate":
            self.health.note(
                "joints", "duplicate stamp", f"a second joint state of {stamp_ns} ns; the first one counts"
            )
            return None
        if self.t0_ns is None:
            self.t0_ns = stamp_ns
            if self._carried is not None and self._carried > stamp_ns + LOAD_GRACE_NS:
                self.load.drop(self._carried)
            if self.load.stamps:
                self._open_load(stamp_ns)
            return None
        i = self.joints.stamps.index(stamp_ns) if kind == "late" else len(self.joints.stamps) - 1
        return (self.joints.stamps[i - 1] if i else stamp_ns) + min(self.joints.delay_ns, 0)

    def add_pose(
        self,
        stamp_ns: int,
        position: Sequence[float],
        quaternion_xyzw: Sequence[float],
        frame_id: str,
        k: int,
    ) -> None:
        """Take in a tracker pose after step ``k``."""
        frame = str(self.settings["output.frame_id"])
        try:
            point, quaternion, norm = pose_values(stamp_ns, position, quaternion_xyzw, frame_id, frame)
        except Unusable as problem:
            self._drop(problem.kind, problem.text)
            return
        if abs(norm - 1.0) > UNIT:
            self.health.note("tracker", "quaternion normalised", f"norm {norm:.4f}, limit 1 +- 0.001")
        if any(s.stamp_ns == stamp_ns for s in self.samples[-50:]):
            self._drop("duplicate stamp", f"a second pose of {stamp_ns} ns; the first one counts")
            return
        taken = self.stamp(k)
        late = max(0.0, (taken - stamp_ns) * 1e-9) if taken is not None else 0.0
        if late > self.window_ns * 1e-9:
            self._drop(
                "too late", f"pose came {late:.3f} s after its stamp, limit {self.window_ns * 1e-9:g} s"
            )
            return
        newest = max(self.joints.stamps[-1:] + ([taken] if taken is not None else []), default=None)
        if newest is not None and stamp_ns - newest > AHEAD_NS:
            ahead = (stamp_ns - newest) * 1e-9
            self._drop(
                "ahead of the joints",
                f"pose {ahead:.3f} s after the newest joint state, limit {AHEAD_NS * 1e-9:g} s; do both clocks agree?",
            )
            return
        if late > 2 * DT_NS * 1e-9:
            self.health.late += 1
        self.samples.append(Sample(stamp_ns, point, quaternion, late))
        self.samples.sort(key=lambda s: s.stamp_ns)
        if self.t0_ns is None and len(self.samples) > WAITING_SAMPLES:
            del self.samples[0]
            self._drop("before the joints", "poses come, but no complete joint state has")

    def _drop(self, kind: str, text: str) -> None:
        self.health.dropped += 1
        self.health.note("tracker", kind, text)

    def add_load(
        self, stamp_ns: int, force: Sequence[float], torque: Sequence[float], frame_id: str, k: int
    ) -> tuple[int, bool] | None:
        """Take in a known wrench after step ``k``; returns the ns from which on the load is known otherwise than before, and whether it has jumped.

        One that comes beyond the window counts only where it is the newest: it acts from the oldest step on that can be taken again."""
        frame = str(self.settings["output.frame_id"])
        try:
            value = wrench_values(stamp_ns, force, torque, frame_id, frame)
        except Unusable as problem:
            self.health.note("load", problem.kind, problem.text)
            return None
        stamp_ns += self._load_delay_ns
        load, taken = self.load, self.stamp(k)
        if load.stamps and taken is not None and stamp_ns < min(load.stamps[-1], taken - self.window_ns):
            late = (taken - stamp_ns) * 1e-9
            self.health.note(
                "load",
                "too late",
                f"load came {late:.3f} s after its stamp and after newer ones, limit {self.window_ns * 1e-9:g} s",
            )
            return None
        known = load.at(stamp_ns)[0] if load.stamps else np.zeros(6)
        if load.stamps[:1] == [self._opening] and stamp_ns < load.stamps[0]:
            del load.stamps[0], load.values[0]  # it opened before a load that was taken for the first
            first = True
        else:
            first = not load.stamps
        kind = load.add(stamp_ns, value)
        if kind == "duplicate":
            self.health.note(
                "load", "duplicate stamp", f"a second load of {stamp_ns} ns; the first one counts"
            )
            return None
        if self.t0_ns is None:
            load.forget(stamp_ns - self.window_ns)
            return None
        i = load.stamps.index(stamp_ns)
        before = load.values[i - 1] if i else np.zeros(6)
        if first:
            self._open_load(self.t0_ns)
            from_ns = (self.t0_ns if self._opening is None else stamp_ns) - 1
        elif i == 0:
            from_ns = self.t0_ns - 1
        elif kind == "late" or not np.array_equal(value, before):
            from_ns = load.stamps[i - 1]
        else:
            return None
        return from_ns, bool(np.any(np.abs(value - known) > self.model.load_kink))

    def _open_load(self, t0_ns: int) -> None:
        """Before the first load there is none, or that one if it comes soon enough after the first joints."""
        first = self.load.stamps[0]
        self._opening = first - 1 if first - t0_ns > LOAD_GRACE_NS else None
        if self._opening is not None:
            self.load.stamps.insert(0, self._opening)
            self.load.values.insert(0, np.zeros(6))

    # -- what steps need of it --

    def load_bends(self, k: int) -> list[float]:
        """Times (s from t0) within step ``k`` at which the load bends sharply."""
        assert self.t0_ns is not None
        if len(self.load.stamps) < 2:
            return []
        end_ns = self.t0_ns + k * DT_NS
        bends = self.load.bends(end_ns - DT_NS, end_ns, self._load_bend)
        return [(stamp - self.t0_ns) * 1e-9 for stamp in bends]

    def due_samples(self, tracker: TrackerModel, t: float) -> list[tuple[Sample, float, Floats, Floats]]:
        """Samples not yet used whose own time is past, ``t`` (s) included, with stamp (s), position and quaternion of the undistorted reading."""
        assert self.t0_ns is not None
        due = []
        for sample in self.samples:
            if sample.fused_k is None:
                stamp_s = (sample.stamp_ns - self.t0_ns) * 1e-9
                time_s, position, quaternion = tracker.undistorted(
                    stamp_s, sample.position, sample.quaternion
                )
                if time_s - tracker.delay <= t + 1e-9:
                    due.append((sample, time_s, position, quaternion))
        return due

    def covers_no_more(self, k: int) -> bool:
        """Whether step ``k`` is the last one that a joint state covers; joints that are not in yet are taken to keep their rhythm."""
        stamp, stamps = self.stamp(k), self.joints.stamps
        assert stamp is not None
        i = bisect.bisect_left(stamps, stamp)
        if i < len(stamps):
            return stamps[i] < stamp + DT_NS
        if len(stamps) < 2:
            return True
        period = stamps[-1] - stamps[-2]
        return -(stamp - stamps[-1]) % period < DT_NS

    def first_fusion(self, tracker: TrackerModel, k: int) -> float:
        """The first step after ``k`` at which a sample has been used or now will be; infinite where there is none."""
        assert self.t0_ns is not None
        delay_ns = tracker.delay * 1e9
        first = math.inf
        for sample in self.samples:
            if sample.fused_k is None:
                first = min(
                    first, max(k + 1, math.ceil((sample.stamp_ns - self.t0_ns - delay_ns) / DT_NS - 1e-3))
                )
            elif sample.fused_k > k:
                first = min(first, sample.fused_k)
        return first

    def forget(self, k: int) -> None:
        """Drop what no start at step ``k`` or later needs."""
        self.forget_signals(k - self.window_ns // DT_NS)
        self.forget_samples(k)

    def forget_signals(self, k: int) -> None:
        """Drop joints and loads that no step from ``k`` on needs."""
        assert self.t0_ns is not None
        horizon = self.t0_ns + k * DT_NS
        self.joints.forget(horizon)
        self.load.forget(horizon)

    def forget_samples(self, k: int) -> None:
        """Drop samples that no step around ``k`` will be taken again for."""
        assert self.t0_ns is not None
        limit = self.t0_ns + k * DT_NS - 2 * self.window_ns - 300_000_000
        while self.samples and self.samples[0].stamp_ns < limit:
            if self.samples.pop(0).fused_k is None:
                self._drop("never compared", "no estimate reached the pose's time within the window")
