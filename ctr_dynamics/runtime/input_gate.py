"""Messages on their way to an estimator, through the checks of its inputs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn, WrenchIn
from ctr_dynamics.sensing.checks import CheckOptions, InputChecks, Verdict
from ctr_dynamics.sensing.interpolation import joint_order

if TYPE_CHECKING:
    from ctr_dynamics.estimation.estimator import Estimator


class InputGate:
    """Lets messages through as the checks want them, and notes in the estimator's health what was found.

    A pose of which only the position counts is left out: the estimator cannot use one yet.
    """

    def __init__(self, estimator: Estimator) -> None:
        self.health, robot = estimator.health, estimator.robot
        options = CheckOptions(frame_id=str(estimator.settings["output.frame_id"]))
        self.n = robot.n_tubes
        self.checks = InputChecks(self.n, robot, options)

    def joint_state(self, message: JointStateIn, arrival_ns: int) -> JointStateIn | None:
        """The joint state to use; None where it is left out."""
        order = joint_order(tuple(message.names), self.n)
        if isinstance(order, str) or len(message.positions) < len(message.names):
            return message  # the estimator says what is missing
        values = [message.positions[i] for i in order]
        verdict = self.checks.joint_state(message.stamp_ns, arrival_ns, values[: self.n], values[self.n :])
        if self._left_out("joints", verdict):
            return None
        positions = list(message.positions)
        for i, rotation in zip(order, verdict.rotations or (), strict=False):
            positions[i] = rotation
        stamp_ns = message.stamp_ns if verdict.stamp_ns is None else verdict.stamp_ns
        return message._replace(stamp_ns=stamp_ns, positions=tuple(positions))

    def pose(self, message: PoseIn, arrival_ns: int) -> PoseIn | None:
        """The pose to use; None where it is left out."""
        verdict = self.checks.pose(
            message.stamp_ns, arrival_ns, message.position, message.quaternion_xyzw, message.frame_id
        )
        if self._left_out("tracker", verdict):
            self.health.dropped += 1
            return None
        if not verdict.orientation:
            return None
        return message if verdict.stamp_ns is None else message._replace(stamp_ns=verdict.stamp_ns)

    def load(self, message: WrenchIn, arrival_ns: int) -> bool:
        """Whether a load is to be used."""
        verdict = self.checks.load(
            message.stamp_ns, arrival_ns, message.force, message.torque, message.frame_id
        )
        return not self._left_out("load", verdict)

    def _left_out(self, group: str, verdict: Verdict) -> bool:
        if verdict.kind is not None:
            self.health.note(group, verdict.kind.value, verdict.text)
        return verdict.use == "drop"
