"""Message types that the inputs may come in, and their decoders: CDR of ROS 2 and the wire format of ROS 1.

Every type of a topic ends in the same three tuples: a joint state, a pose, a wrench. ROS 1 writes the same fields without padding, with a sequence
number before the stamp and without the closing zero of a string.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from ctr_dynamics.io.messages.cdr import (
    NANOSECONDS,
    CdrError,
    JointStateIn,
    PoseIn,
    WrenchIn,
    decode_joint_state,
    decode_pose_stamped,
    decode_wrench_stamped,
)
from ctr_dynamics.io.messages.topics import JOINT_STATES, TIP_LOAD, TRACKER_TIP

Decoded = JointStateIn | PoseIn | WrenchIn
NO_STAMP = 0  # of messages without a header
_MAX_COUNT = 4096
_IDENTITY = (0.0, 0.0, 0.0, 1.0)


class _Fields:
    """Reads a serialised message field by field."""

    def __init__(self, data: bytes, encoding: str) -> None:
        self.data, self.ros1 = data, encoding == "ros1"
        if self.ros1:
            self.order, self.base, self.at = "<", 0, 0
            return
        if len(data) < 4:
            raise CdrError(f"message of {len(data)} bytes, at least 4 are needed")
        if data[0] != 0 or data[1] > 1:
            raise CdrError(f"encapsulation {data[:2].hex()} is not plain CDR (0000 or 0001)")
        self.order, self.base, self.at = "<" if data[1] else ">", 4, 4

    def _take(self, code: str, size: int, count: int = 1) -> tuple:
        if not self.ros1 and count:
            self.at += -(self.at - self.base) % size
        try:
            values = struct.unpack_from(f"{self.order}{count}{code}", self.data, self.at)
        except struct.error:
            raise CdrError(
                f"message of {len(self.data)} bytes ends inside a field at byte {self.at}"
            ) from None
        self.at += size * count
        return values

    def uint32(self) -> int:
        return int(self._take("I", 4)[0])

    def count(self) -> int:
        count = self.uint32()
        if count > _MAX_COUNT:
            raise CdrError(f"message with a list of {count} entries, at most {_MAX_COUNT} are read")
        return count

    def string(self) -> str:
        length = self.uint32()
        end = self.at + length
        if end > len(self.data):
            raise CdrError(
                f"message of {len(self.data)} bytes holds a string of {length} bytes at byte {self.at}"
            )
        text = self.data[self.at : end]
        self.at = end
        return text.rstrip(b"\x00").decode("utf-8", "replace")

    def numbers(self, count: int) -> tuple[float, ...]:
        return self._take("d", 8, count)

    def singles(self, count: int) -> tuple[float, ...]:
        return self._take("f", 4, count)

    def header(self) -> tuple[int, str]:
        if self.ros1:
            self.uint32()  # sequence number
            seconds = self.uint32()
        else:
            seconds = int(self._take("i", 4)[0])
        stamp = seconds * NANOSECONDS + self.uint32()
        return stamp, self.string()


def _joint_state(fields: _Fields) -> JointStateIn:
    stamp, frame = fields.header()
    names = tuple(fields.string() for _ in range(fields.count()))
    return JointStateIn(stamp, frame, names, fields.numbers(fields.count()))


def _array(fields: _Fields, numbers: Callable[[int], tuple[float, ...]]) -> JointStateIn:
    """A MultiArray: its entries are named by the labels of its layout, if there is one for each, else not at all."""
    labels = []
    for _ in range(fields.count()):
        labels.append(fields.string())
        fields.uint32()
        fields.uint32()
    fields.uint32()
    values = numbers(fields.count())
    names = tuple(labels) if len(labels) == len(values) and all(labels) else ()
    return JointStateIn(NO_STAMP, "", names, values)


def _pose(fields: _Fields) -> PoseIn:
    stamp, frame = fields.header()
    numbers = fields.numbers(7)
    return PoseIn(stamp, frame, numbers[:3], numbers[3:])  # type: ignore[arg-type]


def _point(fields: _Fields) -> PoseIn:
    stamp, frame = fields.header()
    return PoseIn(stamp, frame, fields.numbers(3), _IDENTITY)  # type: ignore[arg-type]


def _child_pose(fields: _Fields) -> tuple[str, PoseIn]:
    """TransformStamped and Odometry begin alike: header, name of the child frame, position, quaternion."""
    stamp, frame = fields.header()
    child = fields.string()
    numbers = fields.numbers(7)
    return child.lstrip("/"), PoseIn(stamp, frame, numbers[:3], numbers[3:])  # type: ignore[arg-type]


def _transforms(fields: _Fields) -> list[tuple[str, PoseIn]]:
    return [_child_pose(fields) for _ in range(fields.count())]


def _wrench(fields: _Fields) -> WrenchIn:
    stamp, frame = fields.header()
    numbers = fields.numbers(6)
    return WrenchIn(stamp, frame, numbers[:3], numbers[3:])  # type: ignore[arg-type]


JOINT_STATE = "sensor_msgs/msg/JointState"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
ROS1_TF_MESSAGE = "tf/msg/tfMessage"

# The type of a topic's own first: what it is written in.
TYPES: dict[str, tuple[str, ...]] = {
    JOINT_STATES: (JOINT_STATE, "std_msgs/msg/Float64MultiArray", "std_msgs/msg/Float32MultiArray"),
    TRACKER_TIP: (
        POSE_STAMPED,
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TransformStamped",
        "nav_msgs/msg/Odometry",
        TF_MESSAGE,
        "geometry_msgs/msg/PointStamped",
    ),
    TIP_LOAD: (WRENCH_STAMPED,),
}
_SAME = {ROS1_TF_MESSAGE: TF_MESSAGE}
_WITH_CHILD = {
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
    TF_MESSAGE,
}
# Types decoded without the general reader, for speed.
_FAST: dict[str, Callable[[bytes], Decoded]] = {
    JOINT_STATE: decode_joint_state,
    POSE_STAMPED: decode_pose_stamped,
    WRENCH_STAMPED: decode_wrench_stamped,
}
_GENERAL: dict[str, Callable[[_Fields], Decoded]] = {
    JOINT_STATE: _joint_state,
    "std_msgs/msg/Float64MultiArray": lambda fields: _array(fields, fields.numbers),
    "std_msgs/msg/Float32MultiArray": lambda fields: _array(fields, fields.singles),
    POSE_STAMPED: _pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose,
    "geometry_msgs/msg/PointStamped": _point,
    WRENCH_STAMPED: _wrench,
}


def own_type(ros_type: str) -> str:
    """The name under which a type is known here."""
    return _SAME.get(ros_type, ros_type)


def accepts_type(topic: str, ros_type: str) -> bool:
    """Whether messages of that type can feed the input ``topic``."""
    return own_type(ros_type) in TYPES[topic]


def rank(topic: str, ros_type: str) -> int:
    """Place of a type among those of the input ``topic``, the topic's own first; types that it may not have come last."""
    kinds = TYPES[topic]
    return kinds.index(own_type(ros_type)) if own_type(ros_type) in kinds else len(kinds)


def names_child(ros_type: str) -> bool:
    """Whether messages of that type name a child frame."""
    return own_type(ros_type) in _WITH_CHILD


def child_frames(ros_type: str, encoding: str, data: bytes) -> list[tuple[str, PoseIn]]:
    """Poses in a message that names child frames, each with that name without a leading slash.

    Raises:
        CdrError: the bytes are not such a message.
    """
    fields = _Fields(data, encoding)
    return _transforms(fields) if own_type(ros_type) == TF_MESSAGE else [_child_pose(fields)]


def has_stamp(ros_type: str) -> bool:
    """Whether messages of that type say when they were measured."""
    return "MultiArray" not in ros_type


def decode_input(ros_type: str, encoding: str, data: bytes) -> list[Decoded]:
    """What a message of an input topic holds, of a type that names no child frame.

    Args:
        ros_type: as ROS 2 writes it. encoding: "cdr" or "ros1".

    Raises:
        CdrError: the bytes are not that message.
    """
    fast = _FAST.get(ros_type)
    if fast is not None and encoding == "cdr":
        return [fast(data)]
    return [_GENERAL[ros_type](_Fields(data, encoding))]
