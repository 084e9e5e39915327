"""Messages on their way to an estimator, through the checks of its inputs: the same for the node and for replay."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ctr_dynamics.io.inputs.joint_readings import JointReadings
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn, WrenchIn
from ctr_dynamics.parameters import pose_frame
from ctr_dynamics.sensing.checks import CheckLimits, CheckOptions, Findings, InputChecks, Kind, Verdict
from ctr_dynamics.sensing.interpolation import joint_order

if TYPE_CHECKING:
    from ctr_dynamics.estimation.estimator import Estimator
    from ctr_dynamics.estimation.monitoring.health import Health

LEFT_TO_THE_ESTIMATOR = {
    Kind.NOT_FINITE, Kind.OTHER_FRAME, Kind.QUATERNION, Kind.DUPLICATE, Kind.LATE, Kind.CLOCK_BACK, Kind.GAP,
}  # fmt: skip
"""The estimator rejects and counts these itself, by its parameters; it reinitialises where the clock of the joints was set back."""


class InputGate:
    """Lets messages through as the checks want them, and counts what they find in the estimator's health.

    The estimator takes what comes out here. A pose of which only the position counts is left out, as the estimator cannot use one.
    Once the estimator has been reset, the checks start again with the next message.

    Args:
        estimator: what the messages are for; the checks go by its robot, its settings and its tracker model.
    """

    def __init__(self, estimator: Estimator) -> None:
        self._estimator = estimator
        robot, settings, tracker = estimator.robot, estimator.settings, estimator.tracker
        self._n = robot.n_tubes
        limits = CheckLimits()
        x, y, z = tracker.translation.tolist()
        options = CheckOptions(
            frame_id=str(settings["output.frame_id"]),
            pose_frame_id=pose_frame(settings),
            unwrap=bool(settings["joints.unwrap"]),
            turns=JointReadings(rotation_scale=settings["joints.rotation_scale"]).turns,
            translation=(x, y, z),
            lever=tuple(tracker.lever.tolist()),
            scale=float(tracker.scale),
            orientation=bool(tracker.mask[3:].any()),
            limits=replace(
                limits,
                late_s=max(limits.late_s, float(settings["filter.window_s"])),
                gap_s=max(limits.gap_s, float(settings["input_timeout_s"])),
            ),
        )
        self.checks = InputChecks(self._n, robot, options)
        self._started = False
        self._told: dict[tuple[str, Kind], int] = {}  # messages that the health knows of

    def joint_state(self, message: JointStateIn, arrival_ns: int) -> JointStateIn | None:
        """The joint state to use, with its time and its angles as the checks want them; None where it is left out.

        Where it shows that the one before was wrong, the estimator leaves that one out.

        Args:
            arrival_ns: time of arrival on one clock for all messages; 0 where there is none.
        """
        self._follow_resets()
        order = joint_order(tuple(message.names), self._n)
        if isinstance(order, str) or len(message.positions) < len(message.names):
            return message  # the estimator says what is missing
        values = [message.positions[i] for i in order]
        verdict = self.checks.joint_state(message.stamp_ns, arrival_ns, values[: self._n], values[self._n :])
        if verdict.kind is Kind.REPEATED:  # the same stamp as well
            return message
        if self._left_out(self.checks.joints.findings, verdict):
            return None
        if verdict.retract_ns is not None:
            self._retract("retract_joint_state", verdict.retract_ns)
        if verdict.stamp_ns is None and verdict.rotations is None:
            return message
        positions = list(message.positions)
        for i, rotation in zip(order, verdict.rotations or (), strict=False):
            positions[i] = rotation
        stamp_ns = message.stamp_ns if verdict.stamp_ns is None else verdict.stamp_ns
        return message._replace(stamp_ns=stamp_ns, positions=tuple(positions))

    def give_pose(self, message: PoseIn, arrival_ns: int) -> None:
        """Give the estimator the pose to use, if there is one. ``arrival_ns``: see :meth:`joint_state`."""
        verdict = self._pose_verdict(message, arrival_ns)
        if verdict is None:
            return
        if verdict.retract_ns is not None:
            self._retract("retract_tracker_pose", verdict.retract_ns)
        stamp_ns = message.stamp_ns if verdict.stamp_ns is None else verdict.stamp_ns
        quaternion = verdict.quaternion_xyzw or message.quaternion_xyzw
        # an error that is zero need not be known by other estimators of the same interface
        error = {"stamp_error_s": verdict.error_s} if verdict.error_s else {}
        self._estimator.add_tracker_pose(stamp_ns, message.position, quaternion, message.frame_id, **error)

    def _pose_verdict(self, message: PoseIn, arrival_ns: int) -> Verdict | None:
        """The verdict on a pose that is used; None for one that is left out."""
        self._follow_resets()
        expected = self._estimator.runs.expected_orientation()
        verdict = self.checks.pose(
            message.stamp_ns,
            arrival_ns,
            message.position,
            message.quaternion_xyzw,
            message.frame_id,
            expected,
        )
        if self._left_out(self.checks.poses.findings, verdict) or not verdict.orientation:
            self._health.measurements.dropped += 1
            return None
        return verdict

    def load(self, message: WrenchIn, arrival_ns: int) -> WrenchIn | None:
        """The load to use; None where it is left out. ``arrival_ns``: see :meth:`joint_state`."""
        verdict = self.checks.load(
            message.stamp_ns, arrival_ns, message.force, message.torque, message.frame_id
        )
        return None if self._left_out(self.checks.loads.findings, verdict) else message

    @property
    def _health(self) -> Health:
        return self._estimator.health

    def _follow_resets(self) -> None:
        """Forget what came before a reset of the estimator."""
        started = self._estimator.t0_ns is not None
        if self._started and not started:
            self.checks.forget()
        self._started = started

    def _retract(self, method: str, stamp_ns: int) -> None:
        """Have the estimator take a message back; other estimators of the same interface need not be able to."""
        retract = getattr(self._estimator, method, None)
        if retract is not None:
            retract(stamp_ns)

    def _left_out(self, findings: Findings, verdict: Verdict) -> bool:
        """Whether a message is left out here; what was found is counted."""
        if verdict.kind is None:
            return False
        self._tell(findings, verdict)
        return verdict.use == "drop" and verdict.kind not in LEFT_TO_THE_ESTIMATOR

    def _tell(self, findings: Findings, verdict: Verdict) -> None:
        """Have the health count as many messages of each kind as the checks do, which may put earlier ones down to another kind."""
        stream, note = findings.stream, self._health.note
        found = {
            (stream, f.kind): f
            for f in findings
            if f.kind not in LEFT_TO_THE_ESTIMATOR and (stream, f.kind) != ("joints", Kind.REPEATED)
        }
        for key in [key for key in self._told if key[0] == stream and key not in found]:
            note(stream, key[1].value, "", -self._told.pop(key))
        for key, finding in found.items():
            more = finding.count - self._told.get(key, 0)
            if more:
                text = verdict.text if key[1] is verdict.kind else finding.text
                note(stream, key[1].value, text, more)
                self._told[key] = finding.count
