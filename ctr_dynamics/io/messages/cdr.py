"""Plain CDR (XCDR1), the wire and bag format of ROS 2 messages: a writer and the decoders of the inputs.

A serialised message is four bytes of encapsulation (``00 01 00 00`` = little-endian CDR) and then the fields
in order, each number aligned to its own size counted from the end of the encapsulation. Strings carry a
uint32 length that includes their closing zero; sequences carry a uint32 count. (OMG DDS-XTypes 1.3, section
7.4.)
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

ENCAPSULATION = b"\x00\x01\x00\x00"
NANOSECONDS = 1_000_000_000
_MAX_NAMES = 4096


class CdrError(ValueError):
    """Bytes that are not the message they claim to be (too short, impossible length, other encoding)."""


def split_stamp(stamp_ns: int) -> tuple[int, int]:
    """Seconds (int32) and nanoseconds (uint32) of a builtin_interfaces/Time."""
    return divmod(stamp_ns, NANOSECONDS)


class CdrWriter:
    """Writes one little-endian message field by field. Each method returns the byte offset of what it
    wrote."""

    def __init__(self) -> None:
        self.data = bytearray(ENCAPSULATION)

    def _aligned(self, size: int) -> int:
        self.data += bytes(-(len(self.data) - 4) % size)
        return len(self.data)

    def _put(self, code: str, size: int, value: float) -> int:
        offset = self._aligned(size)
        self.data += struct.pack(code, value)
        return offset

    def uint8(self, value: int) -> int:
        return self._put("<B", 1, value)

    def boolean(self, value: bool) -> int:
        return self._put("<B", 1, int(value))

    def int32(self, value: int) -> int:
        return self._put("<i", 4, value)

    def uint32(self, value: int) -> int:
        return self._put("<I", 4, value)

    def float64s(self, values: Sequence[float]) -> int:
        """A fixed-size array, or consecutive float64 fields. Nothing at all, not even padding, when empty."""
        if not len(values):
            return len(self.data)
        offset = self._aligned(8)
        self.data += struct.pack(f"<{len(values)}d", *values)
        return offset

    def float32s(self, values: Sequence[float]) -> int:
        """Consecutive float32 fields; nothing at all when empty."""
        if not len(values):
            return len(self.data)
        offset = self._aligned(4)
        self.data += struct.pack(f"<{len(values)}f", *values)
        return offset

    def float64_sequence(self, values: Sequence[float]) -> int:
        """A float64[]; the returned offset is that of its first number."""
        self.uint32(len(values))
        return self.float64s(values)

    def raw(self, data: bytes) -> int:
        """A uint8[] (with its count); the returned offset is that of its first byte."""
        self.uint32(len(data))
        offset = len(self.data)
        self.data += data
        return offset

    def string(self, text: str) -> int:
        encoded = text.encode()
        offset = self.uint32(len(encoded) + 1)
        self.data += encoded + b"\x00"
        return offset

    def strings(self, texts: Sequence[str]) -> int:
        offset = self.uint32(len(texts))
        for text in texts:
            self.string(text)
        return offset

    def header(self, stamp_ns: int, frame_id: str) -> int:
        """A std_msgs/Header; the returned offset is that of its stamp."""
        seconds, nanoseconds = split_stamp(stamp_ns)
        offset = self.int32(seconds)
        self.uint32(nanoseconds)
        self.string(frame_id)
        return offset

    def done(self) -> bytes:
        return bytes(self.data)


class JointStateIn(NamedTuple):
    """What is read of a sensor_msgs/JointState (velocity and effort are not used)."""

    stamp_ns: int
    frame_id: str
    names: tuple[str, ...]
    positions: tuple[float, ...]


class PoseIn(NamedTuple):
    """A geometry_msgs/PoseStamped: position in m, quaternion in ROS order x, y, z, w."""

    stamp_ns: int
    frame_id: str
    position: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]


class WrenchIn(NamedTuple):
    """A geometry_msgs/WrenchStamped: force in N, torque in N m."""

    stamp_ns: int
    frame_id: str
    force: tuple[float, float, float]
    torque: tuple[float, float, float]


def _byte_order(data: bytes) -> str:
    if len(data) < 4:
        raise CdrError(f"message of {len(data)} bytes, at least 4 are needed")
    if data[0] != 0 or data[1] > 1:
        raise CdrError(f"encapsulation {data[:2].hex()} is not plain CDR (0000 or 0001)")
    return "<" if data[1] else ">"


def _unpack(code: str, data: bytes, offset: int) -> tuple:
    try:
        return struct.unpack_from(code, data, offset)
    except struct.error:
        raise CdrError(f"message of {len(data)} bytes ends inside a field at byte {offset}") from None


def _string(order: str, data: bytes, offset: int) -> tuple[str, int]:
    """The string at `offset` (aligned here) and the offset behind it."""
    offset += -offset % 4
    (length,) = _unpack(order + "I", data, offset)
    end = offset + 4 + length
    if end > len(data):
        raise CdrError(f"message of {len(data)} bytes holds a string of {length} bytes at byte {offset}")
    return data[offset + 4 : end].rstrip(b"\x00").decode("utf-8", "replace"), end


def decode_stamp(data: bytes) -> int:
    """Stamp (ns) of any message that begins with a std_msgs/Header.

    Raises:
        CdrError: the message is too short or not plain CDR.
    """
    seconds, nanoseconds = _unpack(_byte_order(data) + "iI", data, 4)
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def decode_header(data: bytes) -> tuple[int, str]:
    """Stamp (ns) and frame of any message that begins with a std_msgs/Header.

    Raises:
        CdrError: the message is too short or not plain CDR.
    """
    return decode_stamp(data), _string(_byte_order(data), data, 12)[0]


class _JointLayout(NamedTuple):
    head: bytes  # all bytes from frame_id to the count of positions
    frame_id: str
    names: tuple[str, ...]
    positions: struct.Struct
    offset: int


# A driver sends the same names again and again: the last layout is tried before the names are parsed.
_last_joint_layout: _JointLayout | None = None


def decode_joint_state(data: bytes) -> JointStateIn:
    """Decode a sensor_msgs/JointState.

    Raises:
        CdrError: the bytes are not that message.
    """
    global _last_joint_layout
    order = _byte_order(data)
    layout = _last_joint_layout
    if (
        layout is None
        or order != "<"
        or data[12 : 12 + len(layout.head)] != layout.head
        or len(data) < layout.offset + layout.positions.size
    ):
        layout = _parse_joint_layout(order, data)
        if order == "<":
            _last_joint_layout = layout
    return JointStateIn(
        decode_stamp(data),
        layout.frame_id,
        layout.names,
        layout.positions.unpack_from(data, layout.offset),
    )


def _parse_joint_layout(order: str, data: bytes) -> _JointLayout:
    frame_id, offset = _string(order, data, 12)
    offset += -offset % 4
    (count,) = _unpack(order + "I", data, offset)
    if count > _MAX_NAMES:
        raise CdrError(f"joint state with {count} names, at most {_MAX_NAMES} are read")
    offset += 4
    names = []
    for _ in range(count):
        name, offset = _string(order, data, offset)
        names.append(name)
    offset += -offset % 4
    (count,) = _unpack(order + "I", data, offset)
    offset += 4
    head = data[12:offset]
    if count:
        offset += -(offset - 4) % 8
    if count * 8 > len(data) - offset:
        raise CdrError(f"message of {len(data)} bytes cannot hold {count} positions at byte {offset}")
    return _JointLayout(head, frame_id, tuple(names), struct.Struct(f"{order}{count}d"), offset)


def decode_numbers(data: bytes, count: int) -> tuple[int, str, tuple]:
    """Stamp, frame and `count` float64 that follow a header."""
    order = _byte_order(data)
    frame_id, offset = _string(order, data, 12)
    offset += -(offset - 4) % 8
    return decode_stamp(data), frame_id, _unpack(f"{order}{count}d", data, offset)


def decode_pose_stamped(data: bytes) -> PoseIn:
    """Decode a geometry_msgs/PoseStamped.

    Raises:
        CdrError: the bytes are not that message.
    """
    stamp_ns, frame_id, numbers = decode_numbers(data, 7)
    return PoseIn(stamp_ns, frame_id, numbers[:3], numbers[3:])


def decode_wrench_stamped(data: bytes) -> WrenchIn:
    """Decode a geometry_msgs/WrenchStamped.

    Raises:
        CdrError: the bytes are not that message.
    """
    stamp_ns, frame_id, numbers = decode_numbers(data, 6)
    return WrenchIn(stamp_ns, frame_id, numbers[:3], numbers[3:])


class PointCloudIn(NamedTuple):
    """A sensor_msgs/PointCloud2 of float32 fields without gaps: names of the fields and rows (points, fields)."""

    stamp_ns: int
    frame_id: str
    names: tuple[str, ...]
    rows: NDArray[np.float32]


def decode_point_cloud(data: bytes) -> PointCloudIn:
    """Decode a little-endian sensor_msgs/PointCloud2 whose fields are all float32, one after the other.

    Raises:
        CdrError: the bytes are not such a message.
    """
    order = _byte_order(data)
    frame_id, offset = _string(order, data, 12)
    offset += -offset % 4
    height, width, count = _unpack(order + "3I", data, offset)
    offset += 12
    if count > _MAX_NAMES:
        raise CdrError(f"point cloud with {count} fields, at most {_MAX_NAMES} are read")
    names = []
    for column in range(count):
        name, offset = _string(order, data, offset)
        offset += -offset % 4
        place, kind = _unpack(order + "IB", data, offset)
        (repeats,) = _unpack(order + "I", data, offset + 8)
        offset += 12
        if (place, kind, repeats) != (4 * column, 7, 1):
            raise CdrError(f"field '{name}' of the point cloud is no plain float32 at byte {4 * column}")
        names.append(name)
    (big,) = _unpack(order + "B", data, offset)
    offset += 1 + -(offset + 1) % 4
    step, row_step, size = _unpack(order + "3I", data, offset)
    offset += 12
    points = height * width
    if big or step != 4 * count or row_step != width * step or size != points * step or not count:
        raise CdrError(
            f"point cloud of {points} points has a point step of {step} bytes for {count} float32 fields"
        )
    if offset + size > len(data):
        raise CdrError(f"message of {len(data)} bytes cannot hold {size} bytes of points at byte {offset}")
    rows = np.frombuffer(data, "<f4", points * count, offset).reshape(points, count)
    return PointCloudIn(decode_stamp(data), frame_id, tuple(names), rows)
