"""Message templates: messages of fixed size in which only the numbers change.

Writing a message field by field costs tens of microseconds in Python. All outputs keep their strings and
lengths from one step to the next, so each is laid out once by `CdrWriter`, and a step only writes numbers
into place through NumPy views. A template is a buffer that is used again: it belongs to one thread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.io.messages.cdr import CdrWriter, split_stamp


class NotFiniteError(RuntimeError):
    """A message was about to carry a NaN or an infinity. A valid output never does: this is a fault
    inside."""

    def __init__(self, topic: str, stamp_ns: int, values: NDArray) -> None:
        bad = np.flatnonzero(~np.isfinite(np.asarray(values, dtype=float).ravel()))
        super().__init__(
            f"{topic} at stamp {stamp_ns} ns holds {bad.size} numbers that are not finite (first at index "
            f"{bad[0]})"
        )


class Layout(NamedTuple):
    """A message with placeholders: topic, bytes, and byte offsets of every stamp and of every float64, in the order of filling."""

    topic: str
    data: bytes
    stamps: Sequence[int]
    numbers: Sequence[int] = ()


class Template:
    """One or more messages that are filled together, in one buffer: one stamp, one block of float64 numbers.

    Args:
        layouts: of the messages, in the order of their numbers.
    """

    def __init__(self, *layouts: Layout) -> None:
        self.topics = [layout.topic for layout in layouts]
        self.counts = [len(layout.numbers) for layout in layouts]
        self.data = bytearray()
        stamps: list[int] = []
        numbers: list[int] = []
        spans: list[tuple[int, int]] = []
        for layout in layouts:
            # behind its first four bytes a message is aligned to eight
            self.data += bytes((4 - len(self.data)) % 8)
            begin = len(self.data)
            self.data += layout.data
            spans.append((begin, len(self.data)))
            stamps += [begin + offset for offset in layout.stamps]
            numbers += [begin + offset for offset in layout.numbers]
        self._spans = spans
        self._words = np.frombuffer(self.data, "<u4", count=len(self.data) // 4)
        self._doubles = np.frombuffer(self.data, "<f8", count=len(self.data) // 8)
        self._seconds = np.array(stamps, dtype=np.intp) // 4
        self._nanoseconds = self._seconds + 1
        self._slots = np.array(numbers, dtype=np.intp) // 8

    def stamped(self, stamp_ns: int) -> list[bytes]:
        """The messages with the numbers that they hold and this stamp."""
        seconds, nanoseconds = split_stamp(stamp_ns)
        self._words[self._seconds] = seconds & 0xFFFFFFFF  # int32 seconds in a uint32 view
        self._words[self._nanoseconds] = nanoseconds
        whole = bytes(self.data)
        return [whole[begin:end] for begin, end in self._spans]

    def fill(self, stamp_ns: int, *values: NDArray | Sequence[float]) -> list[bytes]:
        """The messages with this stamp and these numbers.

        Raises:
            NotFiniteError: a number is NaN or infinite.
        """
        numbers = np.concatenate(values, axis=None)
        if not math.isfinite(numbers.sum()):
            self._reject(stamp_ns, numbers)
        self._doubles[self._slots] = numbers
        return self.stamped(stamp_ns)

    def _reject(self, stamp_ns: int, numbers: NDArray) -> None:
        """Raises NotFiniteError for the first message whose numbers are not finite."""
        for topic, part in zip(self.topics, np.split(numbers, np.cumsum(self.counts)[:-1]), strict=True):
            if not np.isfinite(part).all():
                raise NotFiniteError(topic, stamp_ns, part)


def _span(offset: int, count: int) -> list[int]:
    return list(range(offset, offset + 8 * count, 8))


def stamped_numbers(topic: str, frame_id: str, count: int) -> Layout:
    """A header and then `count` float64.

    PoseStamped has 7, PoseWithCovarianceStamped 43, TwistWithCovarianceStamped 42, WrenchStamped 6,
    Vector3Stamped 3.
    """
    writer = CdrWriter()
    stamp = writer.header(0, frame_id)
    offset = writer.float64s([0.0] * count)
    return Layout(topic, writer.done(), [stamp], _span(offset, count))


def joint_state(
    topic: str, frame_id: str, names: Sequence[str], velocities: bool, efforts: bool = False
) -> Layout:
    """A JointState with these names; fills positions, then velocities and efforts when wanted."""
    count = len(names)
    writer = CdrWriter()
    stamp = writer.header(0, frame_id)
    writer.strings(names)
    numbers = _span(writer.float64_sequence([0.0] * count), count)
    moving = count if velocities else 0
    numbers += _span(writer.float64_sequence([0.0] * moving), moving)
    pushing = count if efforts else 0
    numbers += _span(writer.float64_sequence([0.0] * pushing), pushing)
    return Layout(topic, writer.done(), [stamp], numbers)


def path(topic: str, frame_id: str, points: int) -> Layout:
    """A nav_msgs/Path of that many poses; fills x, y, z, qx, qy, qz, qw of each."""
    writer = CdrWriter()
    stamps = [writer.header(0, frame_id)]
    numbers: list[int] = []
    writer.uint32(points)
    for _ in range(points):
        stamps.append(writer.header(0, frame_id))
        numbers += _span(writer.float64s([0.0] * 7), 7)
    return Layout(topic, writer.done(), stamps, numbers)


def transforms(topic: str, frames: Sequence[tuple[str, str]]) -> Layout:
    """A tf2_msgs/TFMessage of those (parent, child) frames; fills x, y, z, qx, qy, qz, qw of each."""
    writer = CdrWriter()
    stamps: list[int] = []
    numbers: list[int] = []
    writer.uint32(len(frames))
    for parent, child in frames:
        stamps.append(writer.header(0, parent))
        writer.string(child)
        numbers += _span(writer.float64s([0.0] * 7), 7)
    return Layout(topic, writer.done(), stamps, numbers)


_FLOAT32 = 7  # sensor_msgs/PointField.FLOAT32


class PointCloudTemplate(Template):
    """A sensor_msgs/PointCloud2 of float32 fields; fills the points."""

    def __init__(self, topic: str, frame_id: str, fields: Sequence[str], points: int) -> None:
        writer = CdrWriter()
        stamp = writer.header(0, frame_id)
        writer.uint32(1)
        writer.uint32(points)
        writer.uint32(len(fields))
        for column, name in enumerate(fields):
            writer.string(name)
            writer.uint32(4 * column)
            writer.uint8(_FLOAT32)
            writer.uint32(1)
        writer.boolean(False)
        writer.uint32(4 * len(fields))
        writer.uint32(4 * len(fields) * points)
        offset = writer.raw(bytes(4 * len(fields) * points))
        writer.boolean(True)
        super().__init__(Layout(topic, writer.done(), [stamp]))
        begin, _ = self._spans[0]
        self._points = np.frombuffer(self.data, "<f4", count=len(fields) * points, offset=begin + offset)

    def fill(self, stamp_ns: int, *values: NDArray | Sequence[float]) -> list[bytes]:
        """The message with this stamp and these points, shape (points, fields)."""
        (points,) = values
        self._points[:] = np.asarray(points, dtype=np.float32).reshape(-1)
        if not np.isfinite(self._points).all():
            raise NotFiniteError(self.topics[0], stamp_ns, self._points.copy())
        return self.stamped(stamp_ns)
