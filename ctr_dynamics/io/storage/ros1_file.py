"""ROS 1 bags (``.bag``, version 2.0)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Reader, ReaderError

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.storage.stored_file import HeldBytes, IndexedFile, StoredTopic, TypedMessage, ros2_type

_ERRORS = (ReaderError, struct.error, ValueError, KeyError, TypeError, IndexError, OSError, RuntimeError, EOFError)  # fmt: skip


class Ros1File(IndexedFile):
    """A ROS 1 bag; see :class:`StoredFile`."""

    library, profile = "rosbag", "ros1"

    def messages(self, name_of: Callable[[str], str | None], held: HeldBytes) -> Iterator[TypedMessage]:
        """See :meth:`StoredFile.messages`."""
        try:
            with Reader(self.read_path) as reader:
                names = {c.id: name for c in reader.connections if (name := name_of(c.topic)) is not None}
                chosen = [c for c in reader.connections if c.id in names]
                if not chosen:
                    return
                # The reader goes by time; equal times are ordered by topic here.
                for log_ns, group in groupby(reader.messages(chosen), key=lambda item: item[1]):
                    together: list[tuple[str, int, Any, bytes]] = []
                    for connection, _, data in group:
                        together.append((names[connection.id], len(together), connection, bytes(data)))
                        held.take(together[-1][-1], log_ns, len(together), self.path)
                    for name, _, connection, content in sorted(together, key=lambda item: item[:2]):
                        held.release(content)
                        yield TypedMessage(name, log_ns, content, ros2_type(connection.msgtype), "ros1")
        except _ERRORS as error:
            self.damaged(_short(error))


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__


def read_ros1(path: Path, read_path: Path | None = None) -> Ros1File:
    """Index a ROS 1 bag.

    Args:
        path: of the file. read_path: of its content, if it lies elsewhere.

    Raises:
        InputError: not such a bag, not closed, or it cannot be read.
    """
    content = read_path or path
    try:
        size = path.stat().st_size
        with Reader(content) as reader:
            topics = [
                StoredTopic(c.topic, ros2_type(c.msgtype), "ros1", c.msgcount) for c in reader.connections
            ]
            span = (reader.start_time, reader.end_time - 1) if reader.message_count else (0, 0)
    except _ERRORS as error:
        raise InputError(
            f"is a ROS 1 bag that cannot be read ({_short(error)})",
            where=str(path),
            do="mend it with `rosbag reindex`",
        ) from None
    return Ros1File(path, size, content, topics=topics, span_ns=span)
