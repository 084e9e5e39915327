"""Motion that nobody knows: of a robot that moves when the model starts at rest, or while joints are missing.

Joints, loads and measurements tell whether the robot moved then. Outputs wait until it is known how, and the filter begins again about the
open-loop run, with the vibrations that the robot may have.
"""

from __future__ import annotations

from collections.abc import Sequence

from ctr_dynamics.estimation.discretisation import VibrationErrors
from ctr_dynamics.estimation.estimator_options import EstimatorOptions
from ctr_dynamics.estimation.filter.covariance_factor import Vibrating
from ctr_dynamics.estimation.inputs.input_buffer import InputBuffer, LoadChange
from ctr_dynamics.estimation.inputs.unseen_load import UnseenLoad
from ctr_dynamics.estimation.mode_tracker import ModeTracker
from ctr_dynamics.estimation.monitoring.settling import Settling
from ctr_dynamics.estimation.out_of_sequence import OutOfSequence
from ctr_dynamics.estimation.runs import Runs
from ctr_dynamics.estimation.step_output import Innovation
from ctr_dynamics.model.model import Model


class UnknownMotion:
    """Whether outputs have to wait because the robot's motion is not known, and how the filter begins again then.

    Args:
        model: of the robot.
        options: of the estimator.
        inputs: that tell whether the robot moved.
        runs: both runs of the model.
        late: where a new beginning is stored, so that corrections repeat it.
        vibration: how the robot vibrates at rest.

    Attributes:
        settling: what outputs wait for.
    """

    def __init__(
        self, model: Model, options: EstimatorOptions, inputs: InputBuffer, runs: Runs, late: OutOfSequence, vibration: VibrationErrors,
    ) -> None:  # fmt: skip
        self._model, self._inputs, self._runs, self._late = model, inputs, runs, late
        self._vibration = vibration
        self._noise = model.robot.tracker.noise.position.value
        self._largest = options.vibrating_fraction * model.robot.tubes[0].length
        self.clear()

    def clear(self) -> None:
        """Nothing to wait for."""
        self.settling = Settling(self._noise, self._model.robot.encoders.noise.value)
        self._unseen_load = UnseenLoad(self._vibration, self._noise)

    # -- what tells of it --

    def watch_start(self, stamp: int) -> None:
        """The model has started at rest at ``stamp`` (ns): joints and measurements tell whether the robot did."""
        self.settling.start(stamp, self._inputs.joints.at(stamp)[0])
        self.look()

    def look(self) -> None:
        """Have outputs wait after a gap of the joints, or after a start, in which the robot moved."""
        inputs, settling = self._inputs, self.settling
        gap = inputs.gap
        if gap is not None:
            inputs.gap = None
            if self._runs.running:
                self._unseen_load.look(settling, gap=gap)
                if settling.moved(gap.change.tolist()):
                    settling.begin(gap.until_ns, f"{gap.words} while the robot moved", vibrating=False)
        if inputs.joints.stamps:
            settling.watch(inputs.joints.stamps[-1], inputs.joints.values[-1])

    def load_changed(self, change: LoadChange) -> None:
        """Have outputs wait where the known load has changed while joints were missing."""
        self._unseen_load.look(self.settling, change=change)

    def problem(self, stamp: int, innovations: Sequence[Innovation]) -> str:
        """Why the motion at ``stamp`` (ns) is not known yet; empty where it is. ``innovations``: of the step."""
        fused = self._runs.fused
        self.settling.take(innovations, fused.ekf.tracker_fault()[0] > 0.0)
        return self.settling.problem(stamp, fused.on_time)

    # -- what is done about it --

    def begin_again(self, k: int, modes: ModeTracker, apart: float) -> None:
        """Reinitialise the filter at step ``k`` from the open-loop run, about which the robot may vibrate in a way that is not known.

        Args:
            modes: vibrations that the robot may have.
            apart: m, least deviation of the tip by them.
        """
        open_loop, fused, settling, vibrating = self._runs.open_loop, self._runs.fused, self.settling, None
        settling.begun = False
        if settling.vibrates:
            vibrating = self.vibrations(modes, max(apart, settling.apart))
        fused.reinitialise(open_loop, k, vibrating)
        fused.alternatives.starts_in_motion(self._vibration)
        self._late.repeated = k, lambda: fused.reinitialise(open_loop, k, vibrating)
        self._late.history.record(k, always=True)

    def vibrations(self, modes: ModeTracker, deviation: float) -> Vibrating | None:
        """How the robot may vibrate about the open-loop run, which moves its tip by ``deviation`` (m); None where it is less than is measured."""
        state = self._runs.open_loop.state
        if state is None or deviation < self._noise:
            return None
        return modes.vibrating(state, self._model.parameters, min(deviation, self._largest))
