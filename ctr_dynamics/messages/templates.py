"""Message templates: messages of fixed size in which only the numbers change.

Writing a message field by field costs tens of microseconds in Python. All outputs keep their strings and
lengths from one step to the next, so each is laid out once by `CdrWriter`, and a step only writes numbers
into place through NumPy views. A template is a buffer that is used again: it belongs to one thread.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.messages.cdr import CdrWriter, split_stamp


class NotFiniteError(RuntimeError):
    """A message was about to carry a NaN or an infinity. A valid output never does: this is a fault
    inside."""

    def __init__(self, topic: str, stamp_ns: int, values: NDArray) -> None:
        bad = np.flatnonzero(~np.isfinite(np.asarray(values, dtype=float).ravel()))
        super().__init__(
            f"{topic} at stamp {stamp_ns} ns holds {bad.size} numbers that are not finite (first at index "
            f"{bad[0]})"
        )


class Template:
    """One message layout: its bytes, where its stamps are, and a block of float64 numbers.

    Args:
        topic: name of the topic, for error texts.
        writer: the message as laid out with placeholders.
        stamps: byte offsets of every stamp in it.
        numbers: byte offset of every float64 to fill, in the order of filling.
    """

    def __init__(
        self, topic: str, writer: CdrWriter, stamps: Sequence[int], numbers: Sequence[int] = ()
    ) -> None:
        self.topic = topic
        self.data = writer.data
        size = len(self.data) - 4
        self._words = np.frombuffer(self.data, "<u4", count=size // 4, offset=4)
        self._doubles = np.frombuffer(self.data, "<f8", count=size // 8, offset=4)
        self._seconds = np.array([(offset - 4) // 4 for offset in stamps], dtype=np.intp)
        self._nanoseconds = self._seconds + 1
        index = np.array([(offset - 4) // 8 for offset in numbers], dtype=np.intp)
        contiguous = index.size > 0 and bool(np.all(np.diff(index) == 1))
        self._slots: slice | NDArray[np.intp] = (
            slice(int(index[0]), int(index[-1]) + 1) if contiguous else index
        )
        self._single = int(self._seconds[0]) if self._seconds.size == 1 else -1

    def stamp(self, stamp_ns: int) -> None:
        """Write the stamp wherever it stands."""
        seconds, nanoseconds = split_stamp(stamp_ns)
        seconds &= 0xFFFFFFFF  # int32 seconds in a uint32 view
        if self._single >= 0:
            self._words[self._single] = seconds
            self._words[self._single + 1] = nanoseconds
        else:
            self._words[self._seconds] = seconds
            self._words[self._nanoseconds] = nanoseconds

    def fill(self, stamp_ns: int, *values: NDArray | Sequence[float]) -> bytes:
        """The message with this stamp and these numbers.

        Raises:
            NotFiniteError: a number is NaN or infinite.
        """
        numbers = np.concatenate(values) if len(values) > 1 else np.asarray(values[0], dtype=float)
        if not np.isfinite(numbers).all():
            raise NotFiniteError(self.topic, stamp_ns, numbers)
        self.stamp(stamp_ns)
        self._doubles[self._slots] = numbers
        return bytes(self.data)


def _span(offset: int, count: int) -> list[int]:
    return list(range(offset, offset + 8 * count, 8))


def stamped_numbers(topic: str, frame_id: str, count: int) -> Template:
    """A header and then `count` float64.

    PoseStamped has 7, PoseWithCovarianceStamped 43, TwistWithCovarianceStamped 42, WrenchStamped 6,
    Vector3Stamped 3.
    """
    writer = CdrWriter()
    stamp = writer.header(0, frame_id)
    offset = writer.float64s([0.0] * count)
    return Template(topic, writer, [stamp], _span(offset, count))


def joint_state(topic: str, frame_id: str, names: Sequence[str], velocities: bool) -> Template:
    """A JointState with these names; fills positions, then velocities when wanted. Efforts are empty."""
    count = len(names)
    writer = CdrWriter()
    stamp = writer.header(0, frame_id)
    writer.strings(names)
    numbers = _span(writer.float64_sequence([0.0] * count), count)
    moving = count if velocities else 0
    numbers += _span(writer.float64_sequence([0.0] * moving), moving)
    writer.float64_sequence([])
    return Template(topic, writer, [stamp], numbers)


def path(topic: str, frame_id: str, points: int) -> Template:
    """A nav_msgs/Path of that many poses; fills x, y, z, qx, qy, qz, qw of each."""
    writer = CdrWriter()
    stamps = [writer.header(0, frame_id)]
    numbers: list[int] = []
    writer.uint32(points)
    for _ in range(points):
        stamps.append(writer.header(0, frame_id))
        numbers += _span(writer.float64s([0.0] * 7), 7)
    return Template(topic, writer, stamps, numbers)


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
        super().__init__(topic, writer, [stamp])
        self._points = np.frombuffer(self.data, "<f4", count=len(fields) * points, offset=offset)

    def fill(self, stamp_ns: int, *values: NDArray | Sequence[float]) -> bytes:
        """The message with this stamp and these points, shape (points, fields)."""
        (points,) = values
        self._points[:] = np.asarray(points, dtype=np.float32).reshape(-1)
        if not np.isfinite(self._points).all():
            raise NotFiniteError(self.topic, stamp_ns, self._points.copy())
        self.stamp(stamp_ns)
        return bytes(self.data)
