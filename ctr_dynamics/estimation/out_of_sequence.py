"""Delayed and out-of-sequence inputs: state history, revert to a checkpoint, and the schedule of corrections.

A joint state or a load that comes after its step was taken changes what that step was driven by. The estimator then reverts to the last
checkpoint before the change and takes the steps again, silently: a published stamp is not published again. A tracker measurement needs no
revert. It waits in the measurement queue for its time, and a late one is compared with the stored tip of its time (docs/filter.md).

The words are those of robot_localization (measurement queue, state history, revert) and PX4 (outputs run ahead of the corrections):

1. :meth:`OutOfSequence.changed` notes from which stamp on inputs have changed.
2. A step that is due may go ahead uncorrected (:meth:`OutOfSequence.may_go_ahead`), so that outputs are on time.
3. :meth:`OutOfSequence.correct` reverts and takes the steps again. Below a small lag they reuse the stored covariance.
4. Where time runs out, the corrected part is stored and the steps go on from the end of the published trajectory.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from ctr_dynamics.estimation.filter.filter_records import FilterState
from ctr_dynamics.estimation.fused_run import FusedState
from ctr_dynamics.estimation.inputs.input_buffer import InputBuffer
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.monitoring.innovation_log import InnovationLog
from ctr_dynamics.estimation.open_loop import OpenLoopState
from ctr_dynamics.estimation.runs import Runs
from ctr_dynamics.io.messages.topics import STEP_NS


@dataclass(frozen=True)
class CorrectionOptions:
    """Figures of history and schedule.

    Attributes:
        checkpoint_every: steps between checkpoints where joints are waited for. Inputs then come late seldom, and eight steps are taken again
            in the time of one or two outputs. With extrapolated joints every step has one.
        reuse_lag: steps. Joints that are no later, as in regular operation, move the robot so little that the corrected steps can reuse the
            stored covariance: that moves the fused tip by micrometres.
        largest_lag: steps. Uncorrected steps go no farther ahead than 0.1 s of a changed load. Beyond, the correction goes first.
        first_cost_s: what taking a step again is thought to cost before the first has been measured.
        cost_weight: of the newest cost in the running mean.
    """

    checkpoint_every: int = 8
    reuse_lag: int = 8
    largest_lag: int = 32
    first_cost_s: float = 1e-3
    cost_weight: float = 0.1


class Checkpoint(NamedTuple):
    """Both runs and the filter after step ``k``; ``fused_after``: the step after which each measurement was fused, by its stamp (ns)."""

    k: int
    fused: FusedState
    open_loop: OpenLoopState
    fused_after: dict[int, int]


class StateHistory:
    """Checkpoints of the last steps, oldest first, for as long as inputs may come late.

    Args:
        runs: what is stored and restored.
        inputs: with the window, and the queue whose measurements are marked as fused.
        every: steps between checkpoints where joints are waited for.
    """

    def __init__(self, runs: Runs, inputs: InputBuffer, every: int) -> None:
        self._runs, self._inputs, self._every = runs, inputs, every
        self.checkpoints: deque[Checkpoint] = deque()

    @property
    def last(self) -> Checkpoint | None:
        """The newest checkpoint."""
        return self.checkpoints[-1] if self.checkpoints else None

    def restart(self, k: int) -> None:
        """Begin with a start at step ``k``: what was before does not lead to it."""
        self.checkpoints.clear()
        self.record(k, always=True)

    def record(self, k: int, always: bool = False) -> None:
        """Store step ``k``, if both runs have taken it and it is one of those that are stored; ``always``: whether or not."""
        stored = self._runs.k == k and (self._inputs.extrapolating or k % self._every == 0)
        if not (always or stored):
            return
        if self.checkpoints and self.checkpoints[-1].k == k:
            self.checkpoints.pop()  # the filter has been reinitialised or reduced since
        self.checkpoints.append(self.checkpoint(k))
        oldest = k - self._inputs.window_ns // STEP_NS
        doubted_ns = self._runs.load_doubt.begin_ns
        if doubted_ns is not None:  # what comes after may have to be taken again without the load
            oldest = min(oldest, (doubted_ns - self._inputs.timeline.stamp(0)) // STEP_NS)
        oldest -= self._every + 1
        # while joints are missing, the last checkpoint that they cover stays: what comes after is taken again when they come back
        covered = self._inputs.covered_step(k)
        while len(self.checkpoints) > 1 and self.checkpoints[1].k <= oldest:
            if self.checkpoints[1].k > covered:
                del self.checkpoints[1]
            else:
                self.checkpoints.popleft()
        self._inputs.forget_inputs(self.checkpoints[0].k)

    def checkpoint(self, k: int) -> Checkpoint:
        """Where both runs are now, after step ``k``."""
        fused, open_loop = self._runs.fused.checkpoint(), self._runs.open_loop.checkpoint()
        return Checkpoint(k, fused, open_loop, self._inputs.measurements.fused())

    def restore(self, checkpoint: Checkpoint) -> None:
        """Have both runs where they were at ``checkpoint``."""
        self._runs.fused.restore(checkpoint.fused)
        self._runs.open_loop.restore(checkpoint.open_loop)
        self._runs.k = checkpoint.k
        self._inputs.measurements.restore(checkpoint.fused_after)

    def take_after(self, stamp_ns: int) -> list[Checkpoint]:
        """Take the checkpoints after ``stamp_ns`` out, but for the oldest; returns them, oldest first."""
        t0_ns = self._inputs.t0_ns
        assert t0_ns is not None
        later: list[Checkpoint] = []
        while len(self.checkpoints) > 1 and t0_ns + self.checkpoints[-1].k * STEP_NS > stamp_ns:
            later.append(self.checkpoints.pop())
        return later[::-1]

    def revert(self) -> None:
        """Return to the newest checkpoint."""
        self.restore(self.checkpoints[-1])


class OutOfSequence:
    """Corrects steps that were taken with other inputs than are known now.

    Args:
        runs: that take the steps.
        inputs: that have changed.
        health: counts the steps that are taken again.
        innovations: so that no measurement is counted twice.

    Attributes:
        history: checkpoints.
        repeated: a step, and what is done after it whenever it is taken again; None for nothing.
    """

    def __init__(self, runs: Runs, inputs: InputBuffer, health: Health, innovations: InnovationLog) -> None:
        self._runs, self._inputs = runs, inputs
        self._health, self._innovations = health, innovations
        self.options = CorrectionOptions()
        self.history = StateHistory(runs, inputs, self.options.checkpoint_every)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.history.checkpoints.clear()
        self.repeated: tuple[int, Callable[[], None]] | None = None
        self._from_ns: int | None = None  # inputs from here on have changed
        self._joints_only = True  # and nothing but joints
        self._urgent = False  # the load among them, by a jump
        self._step_s = self.options.first_cost_s  # what taking a step again costs in the mean

    def forget(self) -> None:
        """Have nothing to correct and nothing to return to: the steps go on elsewhere."""
        self.history.checkpoints.clear()
        self._from_ns = self.repeated = None
        self._joints_only, self._urgent = True, False
        self._inputs.actuator_error.corrected()

    # -- 1. what has changed --

    def changed(self, from_ns: int) -> bool:
        """Inputs from the stamp ``from_ns`` on are others than before; returns whether steps were taken with those."""
        taken_ns = self._inputs.timeline.taken_ns
        if taken_ns is None or from_ns >= taken_ns or not self._runs.running:
            return False
        self._from_ns = from_ns if self._from_ns is None else min(self._from_ns, from_ns)
        return True

    def load_changed(self, from_ns: int, jumped: bool) -> None:
        """The same for the known load. Where it has ``jumped``, uncorrected steps soon have nothing to do with the robot."""
        if self.changed(from_ns):
            self._joints_only = False
            self._urgent |= jumped

    @property
    def pending(self) -> bool:
        """Whether there are steps to correct."""
        return self._from_ns is not None

    @property
    def lag(self) -> int:
        """Steps that have been taken with other inputs than are known now; 0 only where none have been."""
        timeline = self._inputs.timeline
        if self._from_ns is None or timeline.t0_ns is None:
            return 0
        return timeline.k - (self._from_ns - timeline.t0_ns) // STEP_NS

    # -- 2. what goes first --

    @property
    def may_go_ahead(self) -> bool:
        """Whether the next step may be taken before the correction.

        Not where joints are waited for, as steps are then not due by a clock. Not where the load has jumped: measurements fused into a
        trajectory without the jump would throw the estimate off by more than what they measure. And not where the lag is large. For joints
        it is where the covariance could not be reused any more: a machine that is too slow for both would from then on have even more to do.
        """
        last, options = self.history.last, self.options
        stored = last is not None and last.k == self._inputs.timeline.k
        limit = options.reuse_lag if self._joints_only else options.largest_lag
        return self._inputs.extrapolating and stored and self.lag < limit and not self._urgent

    # -- 3. correct --

    def correct(self, spare_s: Callable[[], float] | None = None) -> bool:
        """Revert to the last checkpoint before the change and take the steps again, up to the last that was taken.

        Args:
            spare_s: tells the time (s) until the next step is due. With it, the correction goes on only while there is time, or to its end where
                no step may go ahead of it.

        Returns:
            Whether the runs have started again at step 0.
        """
        timeline, options = self._inputs.timeline, self.options
        if not self.may_go_ahead:
            spare_s, self._urgent = None, False
        elif spare_s is not None and spare_s() < self._step_s:
            return False
        from_ns, self._from_ns = self._from_ns, None
        joints_only, self._joints_only = self._joints_only, True
        assert from_ns is not None and timeline.t0_ns is not None
        reached, history = timeline.k, self.history
        if not history.checkpoints:
            return False
        # 1. Revert to the last checkpoint before the change. Where the change is older than the start, both runs start again.
        later: dict[int, Checkpoint] = {}
        reuse_before = 0.0  # steps before this one reuse the stored covariance
        restarted = history.checkpoints[0].k == 0 and timeline.t0_ns > from_ns
        if restarted:
            if self._runs.start(0):
                return False
            history.restart(0)
            self.repeated = None
        else:
            later = {checkpoint.k: checkpoint for checkpoint in history.take_after(from_ns)}
            # 2. Small lag: the stored covariance can be reused until the first measurement after the checkpoint.
            first = history.checkpoints[-1].k
            if joints_only and reached - first <= options.reuse_lag:
                reuse_before = self._inputs.measurements.first_fusion(first)
            history.revert()
        # 3. Take the steps again.
        mark = self._innovations.mark()
        # the next joints will return to the last step that these cover; later changes return to one of every eighth
        covered = (self._inputs.joints.stamps[-1] - timeline.t0_ns) // STEP_NS
        for k in range(self._runs.k + 1, reached + 1):
            if spare_s is not None and reached in later and spare_s() < self._step_s:
                self._postpone(k - 1, later, joints_only and k <= reuse_before)
                break
            begin = time.perf_counter()
            self._health.corrected_steps += 1
            stored = later.get(k) if k < reuse_before else None
            reuse: FilterState | None = stored.fused.filter if stored is not None else None
            result = self._runs.step(k, reuse=reuse)
            if result.ok and self.repeated is not None and self.repeated[0] == k:
                self.repeated[1]()
            if k >= covered or k % options.checkpoint_every == 0 or not result.ok:
                history.record(k)
            self._runs.judge(result)
            if not self._runs.running:
                break
            if not result.ok:
                reuse_before = 0.0
            self._step_s += options.cost_weight * (time.perf_counter() - begin - self._step_s)
        if self._from_ns is None:
            self._inputs.actuator_error.corrected()
        # 4. Measurements that were counted before are not counted again.
        self._innovations.keep_new(mark)
        return restarted

    def _postpone(self, corrected: int, later: dict[int, Checkpoint], same_covariance: bool) -> None:
        """Leave the correction at the step ``corrected`` and return to the end of the published trajectory, whose checkpoints are ``later``.

        ``same_covariance``: the corrected steps have the stored covariance so far.
        """
        history, t0_ns = self.history, self._inputs.t0_ns
        assert t0_ns is not None and history.last is not None
        if history.last.k != corrected:
            history.record(corrected, always=True)
        history.checkpoints.extend(checkpoint for k, checkpoint in later.items() if k > corrected)
        history.revert()
        self._from_ns = t0_ns + corrected * STEP_NS
        self._joints_only = same_covariance
