"""Two runs of the model side by side, step by step: the fused one, which the filter corrects, and the model alone; and states that both return to."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.estimation.filter.ekf import FilterOptions, FilterState, RodEkf
from ctr_dynamics.estimation.filter.gating import GateOptions
from ctr_dynamics.estimation.filter.tip_window import TipWindow, TipWindowState
from ctr_dynamics.estimation.inputs.actuation import Actuation, Signals, standing
from ctr_dynamics.estimation.inputs.input_buffer import DT_NS, InputBuffer, Sample, seconds
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.step_output import Innovation, Moment
from ctr_dynamics.kernels.workspace import input_row
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.paired_steps import Pair
from ctr_dynamics.model.simulator import Simulator, State, StepResult
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.parameters import Settings, axes_mask

Floats = NDArray[np.float64]
DT = seconds(1)
KEEP_EVERY = 8  # steps between kept states that late inputs return to


@dataclass(frozen=True)
class Kept:
    """Both runs and the filter after step ``k``; ``taken``: by the stamp (ns) of a tracker sample, the step after which it was fused."""

    k: int
    fused: State
    alone: State
    fusion: FilterState
    alone_tips: TipWindowState
    taken: dict[int, int]


class Runs:
    """The fused run with its filter, and the model alone, driven by an :class:`InputBuffer`.

    Attributes:
        fused, alone: states after the last step; None before the start and after what cannot be gone on from.
        alone_tips: of the model alone. kept: states to return to, oldest first. innovations: of samples, until someone takes them.
        sampled_ns: stamp of the newest sample that reached the gate.
    """

    def __init__(self, model: Model, settings: Settings, inputs: InputBuffer, health: Health) -> None:
        self.model, self.inputs, self.health = model, inputs, health
        scheme = make_scheme(str(settings["model.scheme"]), DT, float(settings["model.alpha"]))
        tolerance = float(settings["model.tolerance"])
        self.simulator = Simulator(model, scheme, tolerance)
        self.reference = Simulator(model, scheme, tolerance)
        self.pair = Pair(self.simulator, self.reference)
        self.tracker = model.plant.tracker.corrected(
            delay=float(settings["tracker.delay_s"]),
            lever=np.array(settings["tracker.lever_arm_m"]),
            rotation=np.array(settings["tracker.registration_rotation_rad"]),
            translation=np.array(settings["tracker.registration_translation_m"]),
            mask=axes_mask(str(settings["tracker.axes"])),
        )
        self.fusion = RodEkf(
            self.simulator,
            self.tracker,
            FilterOptions(
                rank=int(settings["filter.rank"]),
                force_sigma=float(settings["filter.tip_force_sigma_N"]),
                force_sigma_max=float(settings["filter.tip_force_sigma_max_N"]),
                force_change=float(settings["filter.tip_force_change_s"]),
                force_time=float(settings["filter.tip_force_time_s"]),
                window=float(settings["filter.window_s"]),
                gate=GateOptions(probability=float(settings["filter.gate_probability"])),
            ),
        )
        rows = [input_row(model.tubes, i) for i in range(model.input_count)]
        self._by_theta = self.fusion.uncertainty.effect[rows]  # encoder offsets and tip force
        self._signals = Signals(model, inputs)
        self._load = np.zeros(model.input_count)  # of the robot file
        self._load[3 * model.n : 3 * model.n + 3] = model.plant.tip_force
        # the model alone has no parameters
        self._bare = Actuation(self._signals, self._load, self._by_theta[:, :0].copy(), np.zeros(0))
        self.clear()

    def clear(self) -> None:
        """Forget both runs."""
        self.fusion.forget_parameters()
        self.fused: State | None = None
        self.alone: State | None = None
        self.alone_tips = TipWindow(self.fusion.tips.size)
        self.kept: deque[Kept] = deque()
        self.innovations: list[Innovation] = []
        self.sampled_ns: int | None = None
        self._signals.clear()

    # -- steps --

    def start(self, k: int) -> str:
        """Both runs at rest at step ``k``; returns the reason when there is no equilibrium."""
        t = seconds(k)
        self._signals.clear()
        self.fusion.forget_parameters()
        self.fusion.gate.rejections = 0
        try:
            self.fused = self.simulator.rest(self._bare(t))
        except InputError as error:
            self.fused = self.alone = None
            return str(error)
        self.fused.inputs = standing(self.fused.inputs)
        self.alone = self.fused.copy()
        self.fusion.start(self.fused, t)
        self.alone_tips.clear(1)
        self._no_columns = np.zeros((self.alone.nodes.shape[1], 1))
        self._keep_alone_tip(t)
        for sample in self.inputs.samples:
            if sample.fused_k is not None and sample.fused_k >= k:
                sample.fused_k = None
        self.kept.clear()  # what was before the start does not lead to it
        self.keep(k, always=True)
        return ""

    def step(
        self,
        k: int,
        track: Kept | None = None,
        *,
        keep: bool = True,
        fuse: bool = True,
        uncorrected: bool = False,
    ) -> StepResult:
        """Both runs from step k - 1 to k, and, unless not to ``fuse``, every sample that has become due; with ``track`` the covariance is taken
        from there. Without ``keep`` the state is kept at every eighth step only. ``uncorrected``: the runs were driven by other joints than
        are known now, and go on from those."""
        assert self.fused is not None and self.alone is not None
        before, t = seconds(k - 1), seconds(k)
        self._signals.clear()
        if uncorrected:
            self._signals.go_on_from(before, self.alone.inputs)
        events, record = self.inputs.load_bends(k), track is None
        result, alone = self._together(before, events, record) or self.apart(before, events, record)
        if not alone.ok:
            return alone
        self._keep_alone_tip(t)
        if not result.ok:
            self.start_filter(k)
            return result
        if result.substeps > 1:
            self.health.substeps += 1
        if track is not None:
            self.fusion.reuse_covariance(track.fusion, self.fused)
        else:
            due = self.inputs.due_samples(self.tracker, t) if fuse else []
            pause = self.inputs.covers_no_more(k)
            if not self.fusion.propagate(self.fused, result, t, measured=bool(due), idle=pause):
                self.health.note(
                    "tracker", "tangent", "the step could not be linearised; the covariance was held"
                )
            self._fuse(k, due)
        if keep or k % KEEP_EVERY == 0:
            self.keep(k)
        return result

    def rehearse(self, k: int) -> None:
        """Take step ``k`` with the joints as they are known, fuse a sample that waits, and take both back: what they read and run is in the
        processor's caches then. A step in which the runs do not go together is not gone into."""
        here, t = self._now(k - 1), seconds(k)
        self._signals.clear()
        both = self._together(seconds(k - 1), self.inputs.load_bends(k), record=True)
        if both is not None and both[0].ok and both[1].ok:
            assert self.fused is not None
            self._keep_alone_tip(t)
            self.fusion.propagate(self.fused, both[0], t)
            for _, time_s, position, quaternion in self.inputs.due_samples(self.tracker, math.inf)[:1]:
                time_s = min(time_s, t + self.tracker.delay)
                self._compare(time_s, position, quaternion)
                self.fusion.update(self.fused, time_s, position, quaternion)
            self.fusion.tip_estimate()
        self.restore(here)

    def _together(
        self, t: float, events: Sequence[float], record: bool
    ) -> tuple[StepResult, StepResult] | None:
        """Both runs from ``t`` (s) on in the same sweeps; None where they cannot go together."""
        assert self.fused is not None and self.alone is not None
        return self.pair.step(
            self.fused, self.alone, t, self._corrected(), self._bare, record=record, events=events
        )

    def apart(self, t: float, events: Sequence[float], record: bool) -> tuple[StepResult, StepResult]:
        """Each run by itself from ``t`` (s) on: a hard step, or sections that change."""
        assert self.fused is not None and self.alone is not None
        return (
            self.simulator.step(
                self.fused, t, self._corrected(), record="end" if record else False, events=events
            ),
            self.reference.step(self.alone, t, self._bare, events=events),
        )

    def _corrected(self) -> Actuation:
        """Actuators and load with the estimated offsets and force."""
        return Actuation(self._signals, self._load, self._by_theta, self.fusion.theta)

    def start_filter(self, k: int) -> None:
        """Start the filter anew from the model alone at step ``k``: a correction has led the fused run astray."""
        assert self.alone is not None
        self.fused = self.alone.copy()
        self.fusion.start(self.fused, seconds(k))
        self.health.restarts += 1
        self.keep(k)

    def _keep_alone_tip(self, t: float) -> None:
        assert self.alone is not None
        rate = float(self.alone.inputs.beta_rate[0]) * (1.0 - self.fusion.insertion_fraction)
        self.alone_tips.append(t, self.alone.nodes[-1], self._no_columns, rate)

    def _fuse(self, k: int, due: list[tuple[Sample, float, Floats, Floats]]) -> None:
        """Compare and fuse the samples ``due`` after step ``k``."""
        assert self.fused is not None
        for sample, time_s, position, quaternion in due:
            sample.fused_k = k
            moment, left = self._compare(time_s, position, quaternion)
            if self.health.fusing:
                update = self.fusion.update(self.fused, time_s, position, quaternion)
            else:
                update = self.fusion.compare(time_s, position, quaternion)
            if update.dof:
                self.sampled_ns = max(self.sampled_ns or 0, sample.stamp_ns)
            else:
                self.health.note(
                    "tracker",
                    "outside the window",
                    f"pose of t = {time_s:.3f} s at step {k}: {update.reason}",
                )
            innovation = Innovation(
                sample.stamp_ns, update.residual, update.variance, update.nis, update.dof, update.accepted, sample.late_s,
                update.reason, update.white, moment, left,
            )  # fmt: skip
            self.health.measured(innovation)
            self.innovations.append(innovation)
        self.inputs.forget_samples(k)
        self.health.force_sigma = self.fusion.force_variance.sigma

    def _compare(
        self, time_s: float, position: Floats, quaternion: Floats
    ) -> tuple[Moment | None, Floats | None]:
        """The moment of a reading, before its update, and how far it lies from the fused tip that was published for its time."""
        n = self.model.n
        own_s, observed = time_s - self.tracker.delay, self.tracker.observed_tip
        fused = observed(lambda s: self.fusion.tips.at(s, DT, columns=False), own_s)
        alone = observed(lambda s: self.alone_tips.at(s, DT, columns=False), own_s)
        earlier = observed(lambda s: self.alone_tips.at(s, DT, columns=False), own_s - 2 * DT) or alone
        if fused is None or alone is None or earlier is None:
            return None, None
        position, _ = self.tracker.to_base(position, quaternion, fused.quaternion)
        estimate = self.tracker.registered(self.fusion.bias, fused)[:3]
        assert self.inputs.t0_ns is not None
        joints, rates = self.inputs.joints.at(self.inputs.t0_ns + (time_s - self.tracker.age) * 1e9)
        acceleration = (alone.velocity - earlier.velocity) / (2 * DT)
        moment = Moment(
            position - alone.position, alone.position, alone.quaternion, alone.velocity, acceleration,
            joints[:n], rates[:n], rates[n:],
        )  # fmt: skip
        return moment, position - estimate

    def settle(self, k: int) -> None:
        """What the outputs of step ``k`` did not wait for; who returns to that step need not do it again."""
        if self.fusion.add_noise_and_reduce() and self.kept[-1].k == k:
            self.keep(k)

    # -- states to return to --

    def keep(self, k: int, always: bool = False) -> None:
        """Remember both runs after step ``k``, for as long as inputs may come late: every step where joints are extrapolated, else every eighth."""
        if not (always or self.inputs.predicting) and k % KEEP_EVERY:
            return
        if self.kept and self.kept[-1].k == k:
            self.kept.pop()  # the filter has started anew or been settled since
        self.kept.append(self._now(k))
        oldest = k - self.inputs.window_ns // DT_NS - 9
        while len(self.kept) > 1 and self.kept[1].k <= oldest:
            self.kept.popleft()
        self.inputs.forget_signals(self.kept[0].k)

    def _now(self, k: int) -> Kept:
        """Where both runs are, after step ``k``."""
        assert self.fused is not None and self.alone is not None
        return Kept(
            k,
            self.fused.copy(),
            self.alone.copy(),
            self.fusion.checkpoint(),
            self.alone_tips.checkpoint(),
            {s.stamp_ns: s.fused_k for s in self.inputs.samples if s.fused_k is not None},
        )

    def restore(self, kept: Kept) -> None:
        """Be where the runs were at ``kept``."""
        self.fused, self.alone = kept.fused.copy(), kept.alone.copy()
        self.fusion.restore(kept.fusion)
        self.alone_tips.restore(kept.alone_tips)
        for sample in self.inputs.samples:
            sample.fused_k = kept.taken.get(sample.stamp_ns)

    def parameters(self) -> dict[str, Any]:
        """Values and deviations of what the filter estimates beside the state, for a file."""
        f = self.fusion
        r = f.factor.theta.shape[1] if self.fused is not None else 0
        deviation = (
            np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", f.factor.theta, f.pi[:r, :r], f.factor.theta), 0.0))
            if r
            else None
        )
        return {
            name: {
                "value": float(f.theta[i]),
                "sigma": float(deviation[i]) if deviation is not None else None,
            }
            for i, name in enumerate(f.uncertainty.names)
        }
