"""Both runs of the model, fused and open loop, a step at a time: propagate, then update."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.estimation.discretisation import VibrationErrors
from ctr_dynamics.estimation.filter.ekf import RodEkf
from ctr_dynamics.estimation.filter.filter_records import FilterOptions, FilterState
from ctr_dynamics.estimation.filter.gating import GateOptions
from ctr_dynamics.estimation.fused_run import FusedRun
from ctr_dynamics.estimation.inputs.input_buffer import InputBuffer
from ctr_dynamics.estimation.inputs.run_inputs import InterpolatedInputs, RunInputs, standing
from ctr_dynamics.estimation.load_doubt import HeldLoad, LoadDoubt
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.monitoring.innovation_log import InnovationLog
from ctr_dynamics.estimation.open_loop import OpenLoopRun
from ctr_dynamics.estimation.timeline import DT, seconds
from ctr_dynamics.kernels import rotations
from ctr_dynamics.model.collocation_pair import CollocationPair
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Simulator, StepResult
from ctr_dynamics.model.time_scheme import Collocation, scheme_of
from ctr_dynamics.parameters import Settings

Floats = NDArray[np.float64]
MAX_FAILURES = 10  # steps in a row that may fail before the model is reinitialised: 30 ms without an output


class Runs:
    """The fused and the open-loop run.

    Args:
        model: the robot.
        settings: the parameter table's values.
        inputs: that drive both.
        health, innovations: where outcomes are counted and collected.
        modes: of the robot at rest.

    Attributes:
        fused, open_loop: the runs. load_doubt: a third one, while the known load is in doubt.
        k: the last step that both have taken; -1 before the start.
    """

    def __init__(
        self, model: Model, settings: Settings, inputs: InputBuffer, health: Health, innovations: InnovationLog, modes: VibrationErrors,
    ) -> None:  # fmt: skip
        self._inputs, self._health = inputs, health
        scheme = scheme_of(str(settings["model.scheme"]), DT, float(settings["model.alpha"]))
        tolerance = float(settings["model.tolerance"])
        corrected, nominal = Simulator(model, scheme, tolerance), Simulator(model, scheme, tolerance)
        self._pair = CollocationPair(corrected, nominal) if isinstance(scheme, Collocation) else None
        self._interpolated = InterpolatedInputs(model, inputs)
        load = np.zeros(model.input_count)  # of the robot file
        load[3 * model.n : 3 * model.n + 3] = model.plant.tip_force
        self.tracker = inputs.measurements.tracker
        ekf = RodEkf(corrected, self.tracker, filter_options(settings))
        self.fused = FusedRun(ekf, self._interpolated, load, inputs, health, innovations)
        no_effect = np.zeros((model.input_count, 0))
        tips = ekf.tips.size + math.ceil(self.fused.alternatives.usual_timing.reach_s / DT)
        self.open_loop = OpenLoopRun(
            nominal, RunInputs(self._interpolated, load, no_effect, np.zeros(0)), tips
        )
        held = HeldLoad(self._interpolated, load)
        without = OpenLoopRun(Simulator(model, scheme, tolerance), held, tips)
        self.load_doubt = LoadDoubt(without, held, inputs, modes, model.robot.tracker.noise.position.value)
        self.clear()

    def clear(self) -> None:
        """Forget both runs."""
        self.fused.clear()
        self.open_loop.clear()
        self._interpolated.clear()
        self.load_doubt.clear()
        self.k = -1
        self._failures = 0

    @property
    def running(self) -> bool:
        """Whether there is a state to go on from."""
        return self.fused.state is not None

    def expected_orientation(self) -> tuple[float, float, float, float] | None:
        """(4,) wxyz that the tracker should report by the open-loop run now; None while nothing runs, or where it does not measure all of it."""
        if not self.running or not self.tracker.mask[3:].all():
            return None
        w, x, y, z = rotations.multiply(self.tracker.rotation, self.open_loop.tips.last.mean[3:7]).tolist()
        return w, x, y, z

    def stop(self) -> None:
        """Have no state to go on from: the next step is a start."""
        self.fused.state = None

    def start(self, k: int) -> str:
        """Both runs at rest at step ``k``; returns the reason when there is no equilibrium."""
        t = seconds(k)
        self._interpolated.clear()
        self.load_doubt.clear()
        self.fused.confirmed = 0
        self.fused.ekf.forget_parameters()
        self.fused.ekf.gate.rejections = 0
        try:
            state = self.fused.simulator.rest(self.open_loop.inputs_at(t))
        except InputError as error:
            self.stop()
            return str(error)
        state.inputs = standing(state.inputs)
        self.open_loop.start(state.copy(), t)
        self.fused.start(state, t)
        self._inputs.measurements.fuse_again(k)
        self.k = k
        return ""

    def step(
        self, k: int, *, fuse: bool = True, extrapolated: bool = False, reuse: FilterState | None = None
    ) -> StepResult:
        """Both runs from step k - 1 to k. Where the open-loop run fails, both stay; where the fused run alone does, it is reinitialised.

        Args:
            k: the step.
            fuse: whether measurements that have come due are fused.
            extrapolated: whether the runs were driven by other joints than are known now; they go on from those.
            reuse: the filter after this step, as stored when it was taken before: its covariance is taken over.
        """
        t = seconds(k)
        # 1. Propagate both runs.
        self.load_doubt.before_step(k, self.open_loop)
        result, open_loop = self._propagate(k, extrapolated, record=reuse is None)
        if not open_loop.ok:
            return open_loop
        self.k = k
        self.open_loop.append_tip(t)
        self.load_doubt.after_step(k)
        if not result.ok:
            self.fused.reinitialise(self.open_loop, k)
            self._health.restarts += 1
            return result
        self._health.count_substeps(result.substeps)
        ekf, state = self.fused.ekf, self.fused.state
        assert state is not None
        # 2. Propagate the covariance, or reuse the stored one.
        if reuse is not None:
            ekf.reuse_covariance(reuse, state)
            return result
        due = self._inputs.measurements.due(t) if fuse else []
        idle = self._inputs.covers_no_more(k)
        if not ekf.propagate(state, result, t, measured=bool(due), idle=idle):
            self._health.note(
                "tracker", "tangent", "the step could not be linearised; the covariance was held"
            )
        # 3. Update with the measurements that have come due.
        self.fused.update(k, due, self.open_loop, self.load_doubt)
        self._inputs.measurements.forget(k)
        return result

    def conclude(self, moves_as_modelled: bool) -> bool:
        """Whether measurements show that something else is right than the filter counts on: the fused run is to go on from the open-loop run.

        ``moves_as_modelled``: whether the open-loop run moves as the robot does, but for faults. Else nothing but the timing is concluded.
        """
        if self.load_doubt.seems_wrong:
            return False
        return self.fused.alternatives.conclude(self.open_loop, self.k, moves_as_modelled)

    def leave_wrong_load_out(self) -> int | None:
        """Stamp (ns) from which on the known load is left out, as the tracker shows that the robot does not bear it; None where it is not."""
        doubt, taken_ns = self.load_doubt, self._inputs.timeline.taken_ns
        begin_ns = doubt.begin_ns
        if begin_ns is None or taken_ns is None or not doubt.wrong(taken_ns) or not self._health.fusing:
            return None
        doubt.clear()
        self._inputs.leave_load_out(begin_ns)
        self._health.measurements.forget_recent()
        self.fused.alternatives.clear()
        self.fused.disagreement.clear()
        return begin_ns

    def judge(self, result: StepResult) -> None:
        """Count the outcome of a step; after too many failures in a row there is no state to go on from."""
        if result.ok:
            self._failures = 0
            return
        self._health.failed(result.reason)
        self._failures += 1
        if self._failures >= MAX_FAILURES:
            self._failures = 0
            self.stop()
            self._health.restarts += 1

    def prefetch(self, k: int) -> None:
        """Take step ``k`` with the joints as they are known and fuse a measurement that waits, for the owner to take both back.

        What the step reads and runs is in the processor's caches then. A step that the runs do not take together is not gone into.
        """
        t = seconds(k)
        self._interpolated.clear()
        both = self._together(k, self._inputs.load_discontinuities(k), record=True)
        if both is None or not (both[0].ok and both[1].ok):
            return
        ekf, state = self.fused.ekf, self.fused.state
        assert state is not None
        self.open_loop.append_tip(t)
        ekf.propagate(state, both[0], t)
        for _, time_s, position, quaternion in self._inputs.measurements.due(math.inf)[:1]:
            time_s = min(time_s, t + self.tracker.delay - self._inputs.measurements.early_s)
            self.fused.residuals(time_s, position, quaternion, self.open_loop)
            ekf.update(state, time_s, position, quaternion)
        ekf.tip_estimate()

    def _propagate(self, k: int, extrapolated: bool, record: bool) -> tuple[StepResult, StepResult]:
        """Fields of both runs at step ``k``: together where they can be, else each by itself."""
        self._interpolated.clear()
        if extrapolated:
            assert self.open_loop.state is not None
            self._interpolated.go_on_from(seconds(k - 1), self.open_loop.state.inputs)
        events = self._inputs.load_discontinuities(k)
        return self._together(k, events, record) or self.apart(k, events, record)

    def _together(
        self, k: int, events: Sequence[float], record: bool
    ) -> tuple[StepResult, StepResult] | None:
        """Both runs to step ``k`` in the same sweeps; None where they cannot go together."""
        if self._pair is None:
            return None
        fused, open_loop = self.fused, self.open_loop
        assert fused.state is not None and open_loop.state is not None
        return self._pair.step(
            fused.state, open_loop.state, seconds(k - 1), fused.inputs_at, open_loop.inputs_at,
            record=record, events=events,
        )  # fmt: skip

    def apart(self, k: int, events: Sequence[float], record: bool) -> tuple[StepResult, StepResult]:
        """Each run by itself to step ``k``: a hard step, or sections that change."""
        fused, open_loop, t = self.fused, self.open_loop, seconds(k - 1)
        assert fused.state is not None and open_loop.state is not None
        return (
            fused.simulator.step(
                fused.state, t, fused.inputs_at, record="end" if record else False, events=events
            ),
            open_loop.simulator.step(open_loop.state, t, open_loop.inputs_at, events=events),
        )

    def warm_up_rescue(self, k: int) -> None:
        """Step ``k`` as the rescue takes a hard one, on copies: it is compiled and in memory then."""
        for run in (self.fused, self.open_loop):
            steps = run.simulator.collocation
            if steps is not None and run.state is not None:
                steps.rescue(run.state.copy(), steps.scheme, seconds(k - 1), run.inputs_at, "end")


def filter_options(settings: Settings) -> FilterOptions:
    """Tuning of the filter by the parameter table's values."""
    return FilterOptions(
        rank=int(settings["filter.rank"]),
        force_sigma=float(settings["filter.tip_force_sigma_N"]),
        force_sigma_max=float(settings["filter.tip_force_sigma_max_N"]),
        force_change=float(settings["filter.tip_force_change_s"]),
        force_time=float(settings["filter.tip_force_time_s"]),
        window=float(settings["filter.window_s"]),
        gate=GateOptions(probability=float(settings["filter.gate_probability"])),
    )
