"""Messages from plain numbers: the input topics (for simulated bags and the driver) and /diagnostics, serialised."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

from ctr_dynamics.io.messages.cdr import CdrWriter, JointStateIn, PoseIn, WrenchIn


class Encoded(NamedTuple):
    """One message ready to be published or written: its topic, stamp and bytes."""

    topic: str
    stamp_ns: int
    data: bytes


class StatusLike(Protocol):
    """One line of health: level 0 ok, 1 warning, 2 error, 3 stale."""

    @property
    def name(self) -> str: ...
    @property
    def level(self) -> int: ...
    @property
    def message(self) -> str: ...
    @property
    def values(self) -> dict[str, str]: ...


def encode_diagnostics(stamp_ns: int, statuses: Iterable[StatusLike], hardware_id: str = "") -> bytes:
    """A diagnostic_msgs/DiagnosticArray; each name gets the prefix ``ctr_estimator: ``."""
    listed = list(statuses)
    writer = CdrWriter()
    writer.header(stamp_ns, "")
    writer.uint32(len(listed))
    for status in listed:
        writer.uint8(int(status.level))
        writer.string(f"ctr_estimator: {status.name}")
        writer.string(status.message)
        writer.string(hardware_id)
        writer.uint32(len(status.values))
        for key, value in status.values.items():
            writer.string(str(key))
            writer.string(str(value))
    return writer.done()


def encode_joint_state(
    stamp_ns: int, names: Sequence[str], positions: Sequence[float], velocities: Sequence[float] = ()
) -> bytes:
    """A sensor_msgs/JointState with an empty frame and no efforts."""
    writer = CdrWriter()
    writer.header(stamp_ns, "")
    writer.strings(names)
    writer.float64_sequence(positions)
    writer.float64_sequence(velocities)
    writer.float64_sequence(())
    return writer.done()


def encode_pose_stamped(
    stamp_ns: int, frame_id: str, position: Sequence[float], quaternion_xyzw: Sequence[float]
) -> bytes:
    """A geometry_msgs/PoseStamped: position (3,) in m, quaternion in ROS order x, y, z, w."""
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.float64s([*position, *quaternion_xyzw])
    return writer.done()


def encode_wrench_stamped(
    stamp_ns: int, frame_id: str, force: Sequence[float], torque: Sequence[float]
) -> bytes:
    """A geometry_msgs/WrenchStamped: force (3,) in N, torque (3,) in N m."""
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.float64s([*force, *torque])
    return writer.done()


def encode_input(message: JointStateIn | PoseIn | WrenchIn) -> bytes:
    """An input in the type of its own topic."""
    if isinstance(message, JointStateIn):
        return encode_joint_state(message.stamp_ns, message.names, message.positions)
    if isinstance(message, PoseIn):
        return encode_pose_stamped(
            message.stamp_ns, message.frame_id, message.position, message.quaternion_xyzw
        )
    return encode_wrench_stamped(message.stamp_ns, message.frame_id, message.force, message.torque)
