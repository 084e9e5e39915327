"""The estimator: input signals in, one output for every 3 ms stamp out. No ROS, no clock; the node, replay and diagnosis use this door.

Two runs of the model go side by side: the fused one, which the filter corrects, and the model alone. Steps are taken when their joints are
known (``wait``) or on time with extrapolated joints (``predict``); what comes later is applied by returning to a kept state and stepping again.
"""

from __future__ import annotations

import math
import time
from array import array
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.model.mesh import node_points, node_positions
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.scheme import make_scheme
from ctr_dynamics.model.simulator import Simulator, State, StepResult
from ctr_dynamics.parameters import Settings, axes_mask
from ctr_dynamics.robot import Robot
from ctr_dynamics.snap.stability import StabilityWatch

from .actuation import Actuation, standing
from .fusion import Fusion, FusionOptions
from .health import Health
from .intake import UNIT, Unusable, joint_values, pose_values, wrench_values
from .kernels import backbone_rows, conjugate, from_vector, matrix
from .misfit import misfit_monitor
from .modes import ModeTracker
from .outputs import Innovation, Modes, Moment, SolverStats, StepOutput
from .signals import Drives, Signal
from .tip import TipWindow
from .tracker import ROTATION, TRANSLATION, registered, tracker_model

Floats = NDArray[np.float64]
DT_NS = 3_000_000
LOAD_GRACE_NS = 100_000_000  # a first load that comes this soon after the joints is there from the start
AHEAD_NS = 10_000_000_000  # a pose that far after the newest joint state is on another clock
WAITING_SAMPLES = 200  # poses kept until the first joint state
STABILITY_EVERY = 33  # steps between looks at the elastic stability
KEEP_EVERY = 8  # steps between kept states that late inputs return to
MODES_EVERY = 132  # steps between refreshes of the vibration modes
MOST_UNPAUSED = 66  # steps before what waits for a pause is done without one
RETRY_EVERY = 33  # steps between starts while there is no equilibrium: looking for one in vain takes long
MAX_FAILURES = 10  # steps in a row that may fail before the model starts anew at rest
SAME_COURSE = (
    8  # steps: joints no later than that move the robot so little that the covariance need not be moved again
)
MOST_BEFORE_REDONE = 32  # steps: a course that waits for its correction is not continued farther than this
MARGIN = 2.0  # times the mean cost of a step: so much time must be left for taking one again
MAX_BEHIND = 1000  # steps to catch up at once; beyond, the model starts anew


@dataclass
class Sample:
    """A tracker pose on its way into the filter; ``fused_k`` is the step after which it was used."""

    stamp_ns: int
    position: Floats
    quaternion: Floats
    late_s: float
    fused_k: int | None = None


@dataclass(frozen=True)
class Kept:
    """The whole estimator after step ``k``; ``taken``: by the stamp (ns) of a tracker sample, the step after which it was fused."""

    k: int
    fused: State
    alone: State
    fusion: tuple
    alone_tips: tuple
    taken: dict[int, int]


class Estimator:
    """Dynamic model and filter of one robot, driven by stamped inputs.

    Args:
        robot: from a robot file.
        settings: the parameter table's values.
    """

    def __init__(self, robot: Robot, settings: Settings) -> None:
        self.robot, self.settings = robot, settings
        self.model = Model(robot, nodes=int(settings["model.nodes"]))
        dt = DT_NS * 1e-9
        scheme = make_scheme(str(settings["model.scheme"]), dt, float(settings["model.alpha"]))
        tolerance = float(settings["model.tolerance"])
        self.simulator = Simulator(self.model, scheme, tolerance)
        self.reference = Simulator(self.model, scheme, tolerance)
        self.window_ns = round(float(settings["filter.window_s"]) * 1e9)
        self.setup = self.model.setup
        self.tracker = tracker_model(
            self.setup,
            delay=float(settings["tracker.delay_s"]),
            lever=np.array(settings["tracker.lever_arm_m"]),
            rotation=np.array(settings["tracker.registration_rotation_rad"]),
            translation=np.array(settings["tracker.registration_translation_m"]),
            mask=axes_mask(str(settings["tracker.axes"])),
        )
        self.fusion = Fusion(
            self.simulator,
            self.tracker,
            FusionOptions(
                rank=int(settings["filter.rank"]),
                gate_probability=float(settings["filter.gate_probability"]),
                force_sigma=float(settings["filter.tip_force_sigma_N"]),
                force_sigma_max=float(settings["filter.tip_force_sigma_max_N"]),
                adaptation=float(settings["filter.adaptation"]),
                force_time=float(settings["filter.tip_force_time_s"]),
                window=float(settings["filter.window_s"]),
            ),
        )
        self._offset_rows = [
            (i, self.fusion.uncertainty.names.index(f"encoder_offset.tube{i + 1}"))
            for i in range(self.model.n)
            if f"encoder_offset.tube{i + 1}" in self.fusion.uncertainty.names
        ]
        self._load_delay_ns = round(self.setup.load_shift * 1e9)
        # share of the rates of beta that the model's own velocities hold already
        self._inserted = (
            float(self.setup.block[self.model.layout["insertion"]][0]) if self.model.extended else 0.0
        )
        self.fusion.inserted = self._inserted
        self.step_times_s: array[float] | None = (
            None  # s of every step, where someone sets an array to be filled
        )
        self._reported: deque[Innovation] = deque(maxlen=200)
        self._unjudged: deque[Innovation] = deque()  # by the misfit monitor
        self._clear()
        self.health = Health(misfit=misfit_monitor(settings, robot.tracker.noise.position.value))
        self.health.fusing = self._fusing = bool(settings["filter.enabled"])

    def _clear(self) -> None:
        n = self.model.n
        self.t0_ns: int | None = None
        self.k = -1
        self._joints = Drives(n, self.setup.backlash, round(self.setup.actuator_delay * 1e9))
        self._load = Signal(6)
        self._samples: list[Sample] = []
        self._kept: deque[Kept] = deque()
        self._return_to: int | None = None  # ns: inputs from here on have changed
        self._joints_only = True  # and nothing but joints
        self._urgent = False  # the load among them, by a jump: what goes on without it soon has nothing to do with the robot
        self._redo_s = 1e-3  # what stepping again costs in the mean, a step
        self._fused: State | None = None
        self._alone: State | None = None
        self._alone_tips = TipWindow(self.fusion.tips.size)
        self._innovations: list[Innovation] = []
        self._failures = 0
        self._no_start: tuple[int, str] | None = None  # step and reason of a start that found no equilibrium
        self._watch = StabilityWatch(self.model)
        self._modes = ModeTracker(self.model, MODES_EVERY)
        self._backwards = 0
        self._sampled_ns: int | None = None
        self._squares = [0.0, 0.0]
        self._residuals = 0
        self._known: dict[tuple[float, float], tuple[Floats, Floats]] = {}  # the signals of one step
        self._rows: dict[tuple, tuple[Floats, NDArray[np.int64]]] = {}
        self._watch_due = False
        self._unpaused = 0  # steps since the last pause was used
        self._turn: tuple[bytes, tuple[Floats, Floats]] | None = None

    # -- inputs --

    def add_joint_state(self, stamp_ns: int, names: Sequence[str], positions: Sequence[float]) -> None:
        """Take in a joint state: ``tubeN_rotation`` (rad) and ``tubeN_translation`` (m, negative) by name. Wrong ones are counted, not raised."""
        try:
            value = joint_values(self.setup, stamp_ns, names, positions)
        except Unusable as problem:
            self.health.note("joints", problem.kind, problem.text)
            return
        if self._joints.stamps and stamp_ns < self._joints.stamps[-1] - self.window_ns:
            self._backwards += 1
            back = (self._joints.stamps[-1] - stamp_ns) * 1e-9
            self.health.note(
                "joints",
                "time ran backwards",
                f"stamp {back:.3f} s before the last, limit {self.window_ns * 1e-9:g} s",
            )
            if self._backwards >= 3:  # not a stray sample: the clock or the bag began anew
                self.reset()
                self.health.restarts += 1
            return
        self._backwards = 0
        last = self._joints.stamps[-1] if self._joints.stamps else None
        taken = self._stamp(self.k)
        if (
            last is not None
            and taken is not None
            and last < taken < stamp_ns
            and taken - last > self._timeout_ns
        ):
            # steps were taken with the held value: go on from there, not from a straight line over the gap
            self._joints.add(taken, self._joints.values[-1])
        kind = self._joints.add(stamp_ns, value)
        if kind == "duplicate":
            self.health.note(
                "joints", "duplicate stamp", f"a second joint state of {stamp_ns} ns; the first one counts"
            )
            return
        if self.t0_ns is None:
            self.t0_ns = stamp_ns
            if self._load.stamps:
                self._open_load()
            return
        i = self._joints.stamps.index(stamp_ns) if kind == "late" else len(self._joints.stamps) - 1
        self._changed((self._joints.stamps[i - 1] if i else stamp_ns) + min(self._joints.delay_ns, 0))

    def add_tracker_pose(
        self, stamp_ns: int, position: Sequence[float], quaternion_xyzw: Sequence[float], frame_id: str = ""
    ) -> None:
        """Take in a tracker pose (m, x y z w) of its header's stamp."""
        frame = str(self.settings["output.frame_id"])
        try:
            point, quaternion, norm = pose_values(stamp_ns, position, quaternion_xyzw, frame_id, frame)
        except Unusable as problem:
            self.health.note("tracker", problem.kind, problem.text)
            self.health.dropped += 1
            return
        if abs(norm - 1.0) > UNIT:
            self.health.note("tracker", "quaternion normalised", f"norm {norm:.4f}, limit 1 +- 0.001")
        if any(s.stamp_ns == stamp_ns for s in self._samples[-50:]):
            self.health.note(
                "tracker", "duplicate stamp", f"a second pose of {stamp_ns} ns; the first one counts"
            )
            self.health.dropped += 1
            return
        taken = self._stamp(self.k)
        late = max(0.0, (taken - stamp_ns) * 1e-9) if taken is not None else 0.0
        if late > self.window_ns * 1e-9:
            self.health.note(
                "tracker",
                "too late",
                f"pose came {late:.3f} s after its stamp, limit {self.window_ns * 1e-9:g} s",
            )
            self.health.dropped += 1
            return
        newest = max(self._joints.stamps[-1:] + ([taken] if taken is not None else []), default=None)
        if newest is not None and stamp_ns - newest > AHEAD_NS:
            ahead = (stamp_ns - newest) * 1e-9
            self.health.note(
                "tracker",
                "ahead of the joints",
                f"pose {ahead:.3f} s after the newest joint state, limit {AHEAD_NS * 1e-9:g} s; do both clocks agree?",
            )
            self.health.dropped += 1
            return
        if late > 2 * DT_NS * 1e-9:
            self.health.late += 1
        self._samples.append(Sample(stamp_ns, point, quaternion, late))
        self._samples.sort(key=lambda s: s.stamp_ns)
        if self.t0_ns is None and len(self._samples) > WAITING_SAMPLES:
            del self._samples[0]
            self.health.dropped += 1
            self.health.note("tracker", "before the joints", "poses come, but no complete joint state has")

    def add_tip_load(
        self, stamp_ns: int, force: Sequence[float], torque: Sequence[float], frame_id: str = ""
    ) -> None:
        """Take in a known wrench on the tip (N, N m about the tip point, ``ctr_base`` axes)."""
        frame = str(self.settings["output.frame_id"])
        try:
            value = wrench_values(stamp_ns, force, torque, frame_id, frame)
        except Unusable as problem:
            self.health.note("load", problem.kind, problem.text)
            return
        stamp_ns += self._load_delay_ns
        kind = self._load.add(stamp_ns, value)
        if kind == "duplicate":
            self.health.note(
                "load", "duplicate stamp", f"a second load of {stamp_ns} ns; the first one counts"
            )
            return
        if self.t0_ns is None:
            self._load.forget(stamp_ns - self.window_ns)
            return
        i = self._load.stamps.index(stamp_ns)
        before = self._load.values[i - 1] if i else np.zeros(6)
        if len(self._load.stamps) == 1:
            self._open_load()
            self._changed((self.t0_ns if len(self._load.stamps) == 1 else stamp_ns) - 1)
        elif i == 0:
            self._changed(self.t0_ns - 1)
        elif kind == "late" or not np.array_equal(self._load.values[i], self._load.values[i - 1]):
            self._changed(self._load.stamps[i - 1])
        else:
            return
        self._joints_only = False
        self._urgent |= self._return_to is not None and bool(
            np.any(np.abs(value - before) > self.model.load_kink)
        )

    def _open_load(self) -> None:
        """Before the first load there is none, or that one if it comes soon enough after the first joints."""
        assert self.t0_ns is not None
        first = self._load.stamps[0]
        if first - self.t0_ns > LOAD_GRACE_NS:
            self._load.stamps.insert(0, first - 1)
            self._load.values.insert(0, np.zeros(6))

    def _changed(self, from_ns: int) -> None:
        """Steps after ``from_ns`` were taken with other inputs than are known now."""
        taken = self._stamp(self.k)
        if taken is not None and from_ns < taken and self._fused is not None:
            self._return_to = from_ns if self._return_to is None else min(self._return_to, from_ns)

    # -- time --

    @property
    def _timeout_ns(self) -> int:
        return round(float(self.settings["input_timeout_s"]) * 1e9)

    @property
    def _predicting(self) -> bool:
        return self.settings["output.policy"] == "predict"

    def _stamp(self, k: int) -> int | None:
        return None if self.t0_ns is None or k < 0 else self.t0_ns + k * DT_NS

    def _due(self, k: int, now_ns: int | None) -> bool:
        stamp = self._stamp(k)
        if stamp is None:
            return False
        if stamp <= self._joints.known_until:
            return True
        if now_ns is None:
            return False
        return stamp <= now_ns if self._predicting else stamp <= now_ns - self._timeout_ns

    def advance(
        self, now_ns: int | None = None, spare_s: Callable[[], float] | None = None
    ) -> list[StepOutput]:
        """Take every step that is due. ``now_ns``: time on the stamps' clock; None takes only steps that the joints cover.

        ``spare_s``: tells the time (s) until the next step falls due. Given it, a correction by late inputs goes only as far as there is time;
        steps on time are then taken on the course that is not yet corrected, and later calls go on with the correction.
        Once the outputs are on their way, :meth:`use_pause` does what they need not wait for.
        """
        if self.t0_ns is None:
            return []
        self._skip_ahead(now_ns)
        outputs: list[StepOutput] = []
        if self.correcting and not self._due(self.k + 1, now_ns):
            self._go_back(spare_s)  # now, while nothing waits for it
        while self._due(self.k + 1, now_ns):
            begin = time.perf_counter()
            if self._return_to is not None and (spare_s is None or not self._may_wait()):
                self._go_back(spare_s)
            self.k += 1
            outputs.append(self._take(self.k))
            if self.step_times_s is not None:
                self.step_times_s.append(time.perf_counter() - begin)
            self._unpaused += 1
            if self._unpaused >= MOST_UNPAUSED:
                self.use_pause()
        return outputs

    @property
    def correcting(self) -> bool:
        """Whether inputs have changed steps that are out already, and the correction is not done."""
        return self._return_to is not None and self._predicting

    def _may_wait(self) -> bool:
        """Whether the next step may be taken before the correction that is due: not where the load has jumped, or it is too far behind."""
        assert self.t0_ns is not None and self._return_to is not None
        begun = bool(self._kept) and self._kept[-1].k == self.k
        behind = self.k - (self._return_to - self.t0_ns) // DT_NS
        return self._predicting and begun and behind < MOST_BEFORE_REDONE and not self._urgent

    def use_pause(self) -> None:
        """A part of the work that no output waits for: the misfit monitor's, and a look at the stability or a part of the modes' refresh."""
        self._unpaused = 0
        while self._unjudged:
            self.health.misfit.add(self._unjudged.popleft())
        if self._fused is None:
            return
        if self._watch_due:
            self._watch_due = False
            self._watch_stability(self.k)
        else:
            self._modes.refresh(self._fused, self.simulator.parameters)

    def finish(self) -> list[StepOutput]:
        """Steps up to the last joint stamp."""
        outputs = self.advance(None)
        self.use_pause()
        return outputs

    def reset(self) -> None:
        """Forget everything and wait for the next complete joint state. Counters stay."""
        self._clear()
        self.fusion.theta[:] = 0.0
        self.fusion._apply_theta()
        self.health.problem = "waiting for the first complete joint state"
        self.health.recent.clear()
        self.health.misfit.clear()
        self._unjudged.clear()

    def set_fusion(self, on: bool) -> None:
        """Use tracker samples, or let the model run alone; samples are compared all the same."""
        self._fusing = self.health.fusing = on

    def _skip_ahead(self, now_ns: int | None) -> None:
        """Start anew at the newest joints when more steps are due than can be caught up with."""
        assert self.t0_ns is not None
        until = (
            self._joints.stamps[-1]
            if now_ns is None or not self._predicting
            else max(now_ns, self._joints.stamps[-1])
        )
        behind = (until - self.t0_ns) // DT_NS - self.k
        if behind <= MAX_BEHIND or self.k < 0 or len(self._joints.stamps) < 2:
            return
        if self._joints.stamps[-1] - self._joints.stamps[-2] <= MAX_BEHIND * DT_NS:
            return  # a long call without a gap: take every step
        newest = self._joints.stamps[-1]
        self.health.note(
            "joints", "gap", f"{behind * DT_NS * 1e-9:.1f} s without joints; the model starts anew at rest"
        )
        self.health.restarts += 1
        self.k = (newest - self.t0_ns) // DT_NS - 1
        self._fused = self._alone = None
        self._kept.clear()
        self._return_to = None

    # -- steps --

    def _inputs(self, corrected: bool) -> Actuation:
        """Actuators and load at a time (s from t0), with the estimated offsets and force for the fused run."""
        assert self.t0_ns is not None
        n = self.model.n
        shift = np.zeros(self.model.input_count)
        shift[3 * n : 3 * n + 3] = self.setup.tip_force
        if corrected:
            for i, row in self._offset_rows:
                shift[i] += self.fusion.theta[row]
            shift[3 * n : 3 * n + 3] += self.fusion.force
        extrapolate = self._timeout_ns if self._predicting else 0
        return Actuation(self.model, self.t0_ns, self._joints, self._load, extrapolate, shift, self._known)

    def _start(self, k: int) -> str:
        """Both runs at rest at step ``k``; returns the reason when there is no equilibrium."""
        t = k * DT_NS * 1e-9
        self._known.clear()
        self.fusion.theta[:] = 0.0
        self.fusion._apply_theta()
        try:
            self._fused = self.simulator.rest(self._inputs(False)(t))
        except InputError as error:
            self._fused = self._alone = None
            return str(error)
        self._fused.inputs = standing(self._fused.inputs)
        self._alone = self._fused.copy()
        self.fusion.start(self._fused, t)
        self._alone_tips.clear(1)
        self._keep_alone_tip(t)
        self._modes.clear()
        for sample in self._samples:
            sample.fused_k = None
        while self._kept and self._kept[-1].k >= k:
            self._kept.pop()
        self._keep(k)
        return ""

    def _take(self, k: int) -> StepOutput:
        """Take step ``k`` and describe it."""
        self.health.steps += 1
        if self._fused is None:
            if self._no_start and k < self._no_start[0] + RETRY_EVERY:
                return self._invalid(k, self._no_start[1])
            reason = self._start(k)
            self._no_start = (k, reason) if reason else None
            if reason:
                self.health.failed("no static equilibrium")
                return self._invalid(k, reason)
            return self._output(k, StepResult(True, "at rest", 0, 0, 0))
        result = self._step(k)
        self.health.sweeps += result.sweeps
        if not result.ok:
            self.health.failed(result.reason)
            self._failures += 1
            if self._failures >= MAX_FAILURES:
                self._failures = 0
                self._fused = None
                self.health.restarts += 1
            return self._invalid(k, f"step failed: {result.reason}")
        self._failures = 0
        return self._output(k, result)

    def _step(self, k: int, track: Kept | None = None, keep: bool = True) -> StepResult:
        """Both runs from step k - 1 to k, and every sample that has become due; with ``track`` the covariance is taken from there. Without
        ``keep`` the state is kept at every eighth step only."""
        assert self._fused is not None and self._alone is not None
        before, t = (k - 1) * DT_NS * 1e-9, k * DT_NS * 1e-9
        self._known.clear()
        f, a = self._fused, self._alone
        apart = (
            3.0 * (a.unknowns - f.unknowns)
            - 3.0 * (a.earlier[0] - f.earlier[0])
            + (a.earlier[1] - f.earlier[1])
        )
        events = self._load_events(k)
        result = self.simulator.step(
            f, before, self._inputs(True), record=False if track else "end", events=events
        )
        # the actuators' noise moves both runs alike: what lies between their unknowns is smooth, so a parabola meets it
        start = f.unknowns + apart if result.ok else None
        alone = self.reference.step(a, before, self._inputs(False), start=start, events=events)
        if not alone.ok:
            return alone
        self._keep_alone_tip(t)
        if not result.ok:
            self._start_filter(k)
            return result
        if result.substeps > 1:
            self.health.substeps += 1
        if track is not None:
            self.fusion.follow(track.fusion, self._fused)
        else:
            due = self._due_samples(t)
            if not self.fusion.predict(self._fused, result, t, sampled=bool(due)):
                self.health.note(
                    "tracker", "tangent", "the step could not be linearised; the covariance was held"
                )
            self._fuse(k, due)
        if keep or k % KEEP_EVERY == 0:
            self._keep(k)
        return result

    def _load_events(self, k: int) -> list[float]:
        """Times (s) within step ``k`` at which the load bends sharply."""
        assert self.t0_ns is not None
        if len(self._load.stamps) < 2:
            return []
        end_ns = self.t0_ns + k * DT_NS
        bends = self._load.bends(end_ns - DT_NS, end_ns, self.model.load_kink / (DT_NS * 1e-9))
        return [(stamp - self.t0_ns) * 1e-9 for stamp in bends]

    def _start_filter(self, k: int) -> None:
        """Start the filter anew from the model alone at step ``k``: a correction has led the fused run astray."""
        assert self._alone is not None
        self._fused = self._alone.copy()
        self.fusion.start(self._fused, k * DT_NS * 1e-9)
        self.health.restarts += 1
        self._keep(k)

    def _keep_alone_tip(self, t: float) -> None:
        assert self._alone is not None
        S = self._alone.nodes.shape[1]
        self._alone_tips.append(
            t,
            self._alone.nodes[-1],
            np.zeros((S, 1)),
            float(self._alone.inputs.beta_rate[0]) * (1.0 - self._inserted),
        )

    def _due_samples(self, t: float) -> list[tuple[Sample, float, Floats]]:
        """Samples whose own time is now past, t (s) included, with the time and position of their readings."""
        assert self.t0_ns is not None
        due = []
        for sample in self._samples:
            if sample.fused_k is None:
                time_s, position = self.tracker.reading(
                    (sample.stamp_ns - self.t0_ns) * 1e-9, sample.position
                )
                if time_s - self.tracker.delay <= t + 1e-9:
                    due.append((sample, time_s, position))
        return due

    def _fuse(self, k: int, due: list[tuple[Sample, float, Floats]]) -> None:
        """Compare and fuse what :meth:`_due_samples` found after step ``k``."""
        assert self._fused is not None and self.t0_ns is not None
        for sample, time_s, position in due:
            sample.fused_k = k
            moment = self._compare(time_s, position, sample.quaternion)
            if self._fusing:
                update = self.fusion.update(self._fused, time_s, position, sample.quaternion)
            else:
                update = self.fusion.compare(time_s, position, sample.quaternion)
            if update.dof:
                self._sampled_ns = max(self._sampled_ns or 0, sample.stamp_ns)
                self.health.measured(
                    update.nis, update.dof, update.accepted, update.accepted and not update.reason
                )
            else:
                self.health.dropped += 1
                self.health.note(
                    "tracker",
                    "outside the window",
                    f"pose of t = {time_s:.3f} s at step {k}: {update.reason}",
                )
            self._innovations.append(
                Innovation(
                    sample.stamp_ns,
                    update.residual,
                    update.variance,
                    update.nis,
                    update.dof,
                    update.accepted,
                    sample.late_s,
                    update.reason,
                    update.white,
                    moment,
                )
            )
        limit = self.t0_ns + k * DT_NS - 2 * self.window_ns - 300_000_000
        while self._samples and self._samples[0].stamp_ns < limit:
            self._samples.pop(0)
        self.health.force_sigma = self.fusion.force_sigma

    def _compare(self, time_s: float, position: Floats, quaternion: Floats) -> Moment | None:
        """Residuals of the published outputs against a reading, before its update, and the moment of it."""
        dt, n = DT_NS * 1e-9, self.model.n
        own_s = time_s - self.tracker.delay
        fused = self.fusion.tips.at(own_s, dt, columns=False)
        alone = self._alone_tips.at(own_s, dt, columns=False)
        earlier = self._alone_tips.at(own_s - 2 * dt, dt, columns=False) or alone
        if fused is None or alone is None or earlier is None:
            return None
        position, _ = self.tracker.to_base(position, quaternion)
        estimate = registered(self.tracker, self.fusion.bias, fused)[:3]
        left = position - alone.position
        self._squares[0] += float(left @ left)
        self._squares[1] += float((position - estimate) @ (position - estimate))
        self._residuals += 1
        assert self.t0_ns is not None
        joints, rates = self._joints.at(self.t0_ns + own_s * 1e9)
        acceleration = (alone.velocity - earlier.velocity) / (2 * dt)
        return Moment(
            left, alone.position, alone.quaternion, alone.velocity, acceleration,
            joints[:n], rates[:n], rates[n:],
        )  # fmt: skip

    # -- roll-back --

    def _keep(self, k: int, always: bool = False) -> None:
        """Remember the whole state after step ``k``, for as long as inputs may come late."""
        if not (always or self._predicting) and k % KEEP_EVERY:
            return
        assert self._fused is not None and self._alone is not None
        self._kept.append(
            Kept(
                k,
                self._fused.copy(),
                self._alone.copy(),
                self.fusion.snapshot(),
                self._alone_tips.snapshot(),
                {s.stamp_ns: s.fused_k for s in self._samples if s.fused_k is not None},
            )
        )
        oldest = k - self.window_ns // DT_NS - 9
        while len(self._kept) > 1 and self._kept[1].k <= oldest:
            self._kept.popleft()
        assert self.t0_ns is not None
        horizon = self.t0_ns + self._kept[0].k * DT_NS
        self._joints.forget(horizon)
        self._load.forget(horizon)

    def _return(self, kept: Kept) -> None:
        """Be where the estimator was at ``kept``."""
        self._fused, self._alone = kept.fused.copy(), kept.alone.copy()
        self.fusion.restore(kept.fusion)
        self._alone_tips.restore(kept.alone_tips)
        for sample in self._samples:
            sample.fused_k = kept.taken.get(sample.stamp_ns)

    def _go_back(self, spare_s: Callable[[], float] | None = None) -> None:
        """Return to the last kept state before the changed inputs and step again, silently, to where the estimator was.

        With ``spare_s``, only while there is time: what has been corrected is kept, and the course goes on where it was.
        """
        if spare_s is not None and self._may_wait() and spare_s() < MARGIN * self._redo_s:
            return
        if self._urgent:
            spare_s, self._urgent = None, False
        from_ns, self._return_to = self._return_to, None
        joints_only, self._joints_only = self._joints_only, True
        assert from_ns is not None and self.t0_ns is not None
        reached = self.k
        usable = [kept for kept in self._kept if self.t0_ns + kept.k * DT_NS <= from_ns]
        course: dict[int, Kept] = {}  # the steps that are taken again, as they were
        changed = 0.0  # first of them whose covariance is another now
        if not usable and self._kept and self._kept[0].k == 0:
            if self._start(0):
                return
            k = 0
        elif self._kept:
            kept = usable[-1] if usable else self._kept[0]
            k = kept.k
            while self._kept and self._kept[-1].k > k:
                once = self._kept.pop()
                course[once.k] = once
            if joints_only and reached - k <= SAME_COURSE:
                changed = self._first_fusion(k)
            self._return(kept)
        else:
            return
        before = len(self._innovations)
        counters = self._frozen()
        # the next joints will return to the last step that these cover; what comes later than it should, to one of every eighth
        covered = (self._joints.stamps[-1] - self.t0_ns) // DT_NS
        done = True
        for again in range(k + 1, reached + 1):
            if (
                spare_s is not None
                and reached in course
                and reached - again < MOST_BEFORE_REDONE
                and spare_s() < MARGIN * self._redo_s
            ):
                self._put_off(again - 1, course, joints_only and again <= changed)
                done = False
                break
            begin = time.perf_counter()
            self.health.rolled_back += 1
            result = self._step(again, course.get(again) if again < changed else None, keep=again >= covered)
            if not result.ok:
                changed = 0.0
                self.health.failed(result.reason)
                if self._alone_tips.last.stamp < again * DT_NS * 1e-9 - 1e-9:  # the model alone failed too
                    self._fused = None
                    break
            self._redo_s += 0.1 * (time.perf_counter() - begin - self._redo_s)
        self._thaw(counters, before, done)

    def _put_off(self, corrected: int, course: dict[int, Kept], same: bool) -> None:
        """Leave the correction at the step ``corrected``, to be gone on with from there, and return to the end of the ``course`` as it was.

        ``same``: the covariance is that of the course still.
        """
        assert self.t0_ns is not None
        if self._kept[-1].k != corrected:
            self._keep(corrected, always=True)
        self._kept.extend(course[k] for k in sorted(course) if k > corrected)
        self._return(self._kept[-1])
        self._return_to = self.t0_ns + corrected * DT_NS
        self._joints_only = same

    def _first_fusion(self, k: int) -> float:
        """The first step after ``k`` at which a sample has been fused or now will be; up to there the covariance knows no other course."""
        assert self.t0_ns is not None
        delay_ns = self.tracker.delay * 1e9
        first = math.inf
        for sample in self._samples:
            if sample.fused_k is None:
                first = min(
                    first, max(k + 1, math.ceil((sample.stamp_ns - self.t0_ns - delay_ns) / DT_NS - 1e-3))
                )
            elif sample.fused_k > k:
                first = min(first, sample.fused_k)
        return first

    def _frozen(self) -> tuple:
        h = self.health
        return (
            h.nis_count,
            h.nis_sum,
            h.nis_dof,
            h.accepted,
            h.rejected,
            h.dropped,
            list(h.recent),
            list(self._squares),
            self._residuals,
        )

    def _thaw(self, counters: tuple, innovations: int, done: bool) -> None:
        """Samples that were counted when they were first fused are not counted again; none while the correction is not ``done``."""
        h = self.health
        again = self._innovations[innovations:] if done else []
        del self._innovations[innovations:]
        repeated = {i.stamp_ns for i in self._reported} if again else set()
        fresh = [i for i in again if i.stamp_ns not in repeated]
        (
            h.nis_count,
            h.nis_sum,
            h.nis_dof,
            h.accepted,
            h.rejected,
            h.dropped,
            recent,
            self._squares,
            self._residuals,
        ) = counters
        h.recent.clear()
        h.recent.extend(recent)
        for innovation in fresh:
            if innovation.dof:
                h.measured(
                    innovation.nis,
                    innovation.dof,
                    innovation.accepted,
                    innovation.accepted and not innovation.reason,
                )
            self._innovations.append(innovation)

    # -- outputs --

    def _take_innovations(self) -> list[Innovation]:
        innovations, self._innovations = self._innovations, []
        self._reported.extend(innovations)
        self._unjudged.extend(innovations)
        return innovations

    def _invalid(self, k: int, reason: str) -> StepOutput:
        self.health.problem = reason
        nan3, nan4, nan6 = np.full(3, np.nan), np.full(4, np.nan), np.full(6, np.nan)
        stamp = self._stamp(k)
        assert stamp is not None
        return StepOutput(
            stamp, k, False, reason, nan3, nan4, np.full((6, 6), np.nan), nan6, np.full((6, 6), np.nan), nan3, nan4,
            np.zeros((0, 15), np.float32), Modes.none(), nan3, nan3, self._take_innovations(), SolverStats(0, 0, reason),
        )  # fmt: skip

    def _problem(self, k: int) -> str:
        """Why the output of step ``k`` cannot be trusted; empty when it can."""
        stamp = self._stamp(k)
        assert stamp is not None
        age = (stamp - self._joints.stamps[-1]) * 1e-9
        limit = self._timeout_ns * 1e-9
        if age > limit:
            return f"joint states are missing: the last is {age:.3f} s old, limit {limit:g} s"
        if self._fusing and self.health.rejecting:
            return "the tracker contradicts the model: most samples of the last second are outside the gate"
        return ""

    def _output(self, k: int, result: StepResult) -> StepOutput:
        assert self._fused is not None and self._alone is not None
        stamp = self._stamp(k)
        assert stamp is not None
        tip = self.fusion.tip_estimate()
        variance = self.fusion.force_variance()
        alone = self._alone_tips.last
        predicted_q = alone.quaternion.copy()
        if not (tip.finite and math.isfinite(float(alone.position.sum() + variance.sum()))):
            self._fused = None
            self.health.failed("not finite")
            self.health.restarts += 1
            return self._invalid(k, "the estimate is not finite; the model starts anew at rest")
        problem = self._problem(k)
        self.health.problem = problem
        self._watch_due |= k % STABILITY_EVERY == 0
        since = self._sampled_ns if self._sampled_ns is not None else self.t0_ns
        self.health.tracker_age_s = max(0.0, (stamp - (since or stamp)) * 1e-9)
        return StepOutput(
            stamp, k, not problem, problem, tip.position, tip.quaternion, tip.covariance[:6, :6], tip.twist, tip.covariance[6:, 6:],
            alone.position.copy(), predicted_q, self._backbone(), self._modes.measure(self._fused), self.fusion.force,
            np.sqrt(variance), self._take_innovations(), SolverStats(result.iterations, result.sweeps, result.reason),
        )  # fmt: skip

    def _watch_stability(self, k: int) -> None:
        """How far the equilibrium of the present actuators is from its fold, and when a snap is to be expected."""
        assert self._fused is not None
        now = self._fused.inputs
        self.health.stability = self._watch.update(
            k * DT_NS * 1e-9, now.beta, now.alpha, now.force, now.torque, guess=self._fused.unknowns[-1]
        )

    def _backbone(self) -> NDArray[np.float32]:
        state = self._fused
        assert state is not None
        turn, shift = self._registration()
        key = (state.key, state.inputs.beta.tobytes())
        if key not in self._rows:
            if len(self._rows) > 8:
                self._rows.clear()
            self._rows[key] = (
                node_positions(state.mesh, state.inputs.beta),
                node_points(state.mesh.sec_cells),
            )
        s, points = self._rows[key]
        rows = np.empty((len(state.nodes), 15), np.float32)
        c = self.fusion.columns
        r = c.theta.shape[1]
        backbone_rows(
            s, state.nodes, state.fields, points, self.model.n, float(state.inputs.beta_rate[0]) * (1.0 - self._inserted), turn, shift,
            c.position_deviation(self.fusion.pi[:r, :r]), rows,
        )  # fmt: skip
        rates = state.inputs.beta_rate
        if self._inserted and np.any(rates):
            # the model's velocities are those of the grid, which lies still at the plate and follows tube 1 at the tip only
            beta = state.inputs.beta
            grid = (node_positions(state.mesh, beta + 1e-4 * rates) - s) / 1e-4
            tangents = np.array([matrix(h)[:, 2] for h in state.nodes[:, 3:7]])
            rows[:, 8:11] += self._inserted * (rates[0] - grid)[:, None] * tangents
        return rows

    def _registration(self) -> tuple[Floats, Floats]:
        """Estimated error of the registration in base axes: rotation (3, 3) and translation (3,) m."""
        bias = self.fusion.bias[:6]
        key = bias.tobytes()
        if self._turn is None or self._turn[0] != key:
            back = matrix(conjugate(self.tracker.rotation))
            turn = matrix(from_vector(back @ bias[ROTATION]))
            self._turn = key, (turn, back @ bias[TRANSLATION])
        return self._turn[1]

    def snapshot(self) -> dict[str, Any]:
        """Where the estimator stands, for a file."""
        f = self.fusion
        names = f.uncertainty.names
        r = f.columns.theta.shape[1] if self._fused is not None else 0
        deviation = (
            np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", f.columns.theta, f.pi[:r, :r], f.columns.theta), 0.0))
            if r
            else None
        )
        return {
            "k": self.k,
            "stamp_ns": self._stamp(self.k),
            "problem": self.health.problem,
            "parameters": {
                name: {
                    "value": float(f.theta[i]),
                    "sigma": float(deviation[i]) if deviation is not None else None,
                }
                for i, name in enumerate(names)
            },
            "tracker_bias": [float(x) for x in f.bias],
            "tip_force_drive_N": f.force_sigma,
            "statuses": [
                {"name": s.name, "level": s.level, "message": s.message, "values": s.values}
                for s in self.health.statuses()
            ],
        }

    def summary(self) -> dict[str, Any]:
        """The estimator's part of a replay's summary."""
        h, count = self.health, self._residuals
        rms = [math.sqrt(square / count) if count else None for square in self._squares]
        return {
            "steps": h.steps,
            "residual_rms_m": {"predicted": rms[0], "fused": rms[1] if self._fusing else None},
            "nis": h.nis_summary(),
            "rejected": h.rejected,
            "late": h.late,
            "dropped": h.dropped,
            "solver": {
                "failures": h.failures,
                "reasons": dict(h.reasons),
                "restarts": h.restarts,
                "substeps": h.substeps,
                "sweeps_per_step": h.sweeps / h.steps if h.steps else 0.0,
                "steps_taken_again": h.rolled_back,
            },
        }
