"""What the covariance of a published tip holds beside the errors that the filter follows."""

from __future__ import annotations

from collections.abc import Sequence

from ctr_dynamics.estimation.discretisation import Discretisation
from ctr_dynamics.estimation.filter.filter_records import TipEstimate
from ctr_dynamics.estimation.inputs.input_buffer import InputBuffer, LoadChange
from ctr_dynamics.estimation.monitoring.deviations import Deviations
from ctr_dynamics.estimation.monitoring.settling import Settling
from ctr_dynamics.estimation.monitoring.twist_error import TwistError, UnseenVibration
from ctr_dynamics.estimation.monitoring.unexpected_innovation import UnexpectedInnovation
from ctr_dynamics.estimation.runs import Runs
from ctr_dynamics.estimation.step_output import Innovation, Modes
from ctr_dynamics.robot import Robot


class PublishedCovariance:
    """Errors of the tip that no column of the filter's covariance factor follows.

    Args:
        discretisation: how the robot vibrates at rest.
        robot: has the noise of tracker and encoders, and the tolerances.
        largest: m, deviation beyond which outputs are invalid. unseen: m, of a robot that may move when the model starts.

    Attributes:
        unseen_vibration: of such a robot.
        driven_m: m, by which actuators may have moved the tip unknown to the last step. by_load_m: by which a known load in doubt has moved it.
    """

    def __init__(self, discretisation: Discretisation, robot: Robot, largest: float, unseen: float) -> None:
        self._length, self._largest = robot.tubes[0].length, largest
        self._unexpected = UnexpectedInnovation(largest, robot.tracker.noise.position.value)
        self._twist_error = TwistError(discretisation.vibration, robot)
        self.unseen_vibration = UnseenVibration(discretisation.vibration, unseen)
        self.driven_m = self.by_load_m = 0.0

    def load_changed(self, change: LoadChange) -> None:
        """The known load has changed."""
        self._twist_error.load_changed(change.begin_ns, change.end_ns, change.difference)
        if change.jumped:
            self._unexpected.load_jumped(change.from_ns)

    def take(self, innovations: Sequence[Innovation], refuted: bool, confirmed: bool) -> None:
        """The measurements of one step; see :meth:`UnexpectedInnovation.take`."""
        self._unexpected.take(innovations, refuted, confirmed)

    def deviations(self, tip: float) -> Deviations:
        """What the last covariance holds, with that of the ``tip``, m."""
        return Deviations(tip, self.driven_m, self.by_load_m, self._largest)

    def inflate(
        self, tip: TipEstimate, stamp: int, runs: Runs, inputs: InputBuffer, settling: Settling, modes: Modes, lag_ns: int
    ) -> None:  # fmt: skip
        """Add these errors to the covariance of ``tip`` at ``stamp`` (ns), in place.

        Args:
            runs, inputs: after the step. settling: whether the robot may move as nobody knows yet. modes: as it vibrates now.
            lag_ns: how far a correction of late inputs is behind.
        """
        fused, covariance = runs.fused, tip.covariance
        self._unexpected.inflate(covariance, stamp)
        periods_s = inputs.joint_period_s, fused.pose_period_s
        self._twist_error.inflate(tip, stamp, runs.open_loop.tips.last, fused.ekf, periods_s, modes)
        if (apart := settling.unseen(stamp)) is not None:
            self.unseen_vibration.inflate(covariance, apart)
        # without measurements nothing tells whether a load is right
        told = inputs.health.fusing and inputs.health.tracker_alive
        mean = runs.open_loop.tips.last.mean
        self.by_load_m = runs.load_doubt.inflate(covariance, mean) if told else 0.0
        self.driven_m = inputs.actuator_error.inflate(covariance, tip.position, self._length, stamp, lag_ns)
