"""The checks of all inputs of one robot together: what the joints tell about clock, length and motion is handed on to poses and loads."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn
from ctr_dynamics.sensing.checks.check_limits import CheckOptions
from ctr_dynamics.sensing.checks.joint_checks import JointChecks
from ctr_dynamics.sensing.checks.load_checks import LoadChecks
from ctr_dynamics.sensing.checks.pose_checks import PoseChecks
from ctr_dynamics.sensing.checks.verdicts import Finding, Verdict
from ctr_dynamics.sensing.interpolation import joint_order

if TYPE_CHECKING:
    from ctr_dynamics.io.bag_reader import InputMessage
    from ctr_dynamics.robot import Robot

MOVED_M = 1e-4  # translations that change the reach and the stiffness


class InputChecks:
    """Joint states, poses and loads of one robot, in the order of arrival.

    Args:
        n: number of tubes. robot: None where it is not known; what needs its geometry is then not checked.

    Attributes:
        joints, poses, loads: the checks of each stream.
    """

    def __init__(self, n: int, robot: Robot | None = None, options: CheckOptions | None = None) -> None:
        self.joints = JointChecks(n, robot, options)
        self.poses = PoseChecks(robot, options)
        self.loads = LoadChecks(robot, options)
        self._translations: tuple[float, ...] = ()

    def forget(self) -> None:
        """Start again, as after a reset; findings stay."""
        for stream in (self.joints, self.poses, self.loads):
            stream.forget()
        self._translations = ()

    def joint_state(
        self,
        stamp_ns: int,
        arrival_ns: int | None,
        rotations: Sequence[float],
        translations: Sequence[float],
    ) -> Verdict:
        """See :meth:`JointChecks.check`."""
        arrival_ns = _known(arrival_ns)
        verdict = self.joints.check(stamp_ns, arrival_ns, rotations, translations)
        stamps = self.joints.stamps
        newest = stamps.newest_ns if stamps.believed else None
        self.poses.follow_joints(newest, stamps.clock_offset_ns, self.joints.moving)
        if verdict.use != "drop" and self._have_moved(translations):
            self._translations = tuple(translations)
            self.poses.follow_translations(translations)
            self.loads.follow_translations(translations)
        return verdict

    def _have_moved(self, translations: Sequence[float]) -> bool:
        """Whether the tubes' positions change reach and stiffness since they were last told."""
        known = self._translations
        return not known or any(abs(a - b) > MOVED_M for a, b in zip(translations, known, strict=True))

    def pose(
        self,
        stamp_ns: int,
        arrival_ns: int | None,
        position: Sequence[float],
        quaternion_xyzw: Sequence[float],
        frame_id: str = "",
        expected_wxyz: Sequence[float] | None = None,
    ) -> Verdict:
        """See :meth:`PoseChecks.check`."""
        return self.poses.check(
            stamp_ns, _known(arrival_ns), position, quaternion_xyzw, frame_id, expected_wxyz
        )

    def load(
        self,
        stamp_ns: int,
        arrival_ns: int | None,
        force: Sequence[float],
        torque: Sequence[float],
        frame_id: str = "",
    ) -> Verdict:
        """See :meth:`LoadChecks.check`."""
        return self.loads.check(stamp_ns, _known(arrival_ns), force, torque, frame_id)

    def findings(self) -> list[Finding]:
        """What was found so far, stream by stream."""
        return [*self.joints.findings, *self.poses.findings, *self.loads.findings]


def _known(arrival_ns: int | None) -> int | None:
    """An arrival, or None where a recorder wrote none (zero)."""
    return None if arrival_ns is None or arrival_ns <= 0 else arrival_ns


def check_messages(
    messages: Iterable[InputMessage], robot: Robot | None = None, options: CheckOptions | None = None
) -> list[Finding]:
    """Findings in recorded messages, in the order of their arrival.

    Joint states whose names are not those of the robot's tubes are passed over. Without a robot, the first that names whole tubes
    tells their number.
    """
    checks = InputChecks(robot.n_tubes, robot, options) if robot is not None else None
    found: list[Finding] = []
    waiting: list[InputMessage] = []
    for item in messages:
        if checks is None:
            waiting.append(item)
            n = _tubes(item)
            if n or len(waiting) > 1000:
                checks = InputChecks(n or 1, None, options)
                for early in waiting:
                    _check(checks, early)
                waiting.clear()
            continue
        _check(checks, item)
    if checks is None:
        checks = InputChecks(1, None, options)
        for early in waiting:
            _check(checks, early)
    found.extend(checks.findings())
    return found


def _tubes(item: InputMessage) -> int:
    """Number of tubes that a joint state names, 0 where it is another message or names none."""
    if not isinstance(item.message, JointStateIn):
        return 0
    n = sum(name.endswith("_rotation") for name in item.message.names)
    return n if n and not isinstance(joint_order(item.message.names, n), str) else 0


def _check(checks: InputChecks, item: InputMessage) -> None:
    message, log_ns = item.message, item.log_ns
    if isinstance(message, JointStateIn):
        n = checks.joints.n
        order = joint_order(message.names, n)
        if not isinstance(order, str) and len(message.positions) >= len(message.names):
            values = [message.positions[i] for i in order]
            checks.joint_state(message.stamp_ns, log_ns, values[:n], values[n:])
    elif isinstance(message, PoseIn):
        checks.pose(message.stamp_ns, log_ns, message.position, message.quaternion_xyzw, message.frame_id)
    else:
        checks.load(message.stamp_ns, log_ns, message.force, message.torque, message.frame_id)
