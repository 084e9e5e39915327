"""SQLite bags of ROS 2 (``.db3``), with or without compression of their messages."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.storage.stored_file import HeldBytes, IndexedFile, StoredTopic, TypedMessage, ros2_type


class SqliteFile(IndexedFile):
    """An SQLite bag; see :class:`StoredFile`."""

    library, profile = "rosbag2_storage_sqlite3", "ros2"

    def messages(self, name_of: Callable[[str], str | None], held: HeldBytes) -> Iterator[TypedMessage]:
        """See :meth:`StoredFile.messages`."""
        try:
            with closing(_connect(self.read_path)) as database:
                topics: dict[int, tuple[str, str, str]] = {}
                for number, own, kind, encoding in database.execute(
                    "SELECT id, name, type, serialization_format FROM topics"
                ):
                    name = name_of(str(own))
                    if name is not None and isinstance(number, int):
                        topics[number] = (name, ros2_type(str(kind)), str(encoding))
                database.create_function(
                    "topic_name", 1, lambda number: topics[number][0], deterministic=True
                )
                wanted = ", ".join(map(str, topics))
                rows = database.execute(
                    f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({wanted}) "
                    "ORDER BY timestamp, topic_name(topic_id), id"
                )
                for number, log_ns, data in rows:
                    if isinstance(data, bytes) and isinstance(log_ns, int):
                        name, kind, encoding = topics[number]
                        yield TypedMessage(name, max(log_ns, 0), data, kind, encoding)
        except sqlite3.Error as error:
            self.damaged(str(error))


def _connect(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)


def read_sqlite(path: Path, read_path: Path | None = None) -> SqliteFile:
    """Index an SQLite bag.

    Args:
        path: of the file. read_path: of its content, if it lies elsewhere.

    Raises:
        InputError: not such a bag, or it cannot be read.
    """
    content = read_path or path
    try:
        size = path.stat().st_size
        with closing(_connect(content)) as database:
            topics = [
                StoredTopic(str(name), ros2_type(str(kind)), str(encoding), int(count))
                for name, kind, encoding, count in database.execute(
                    "SELECT t.name, t.type, t.serialization_format, COUNT(m.id) FROM topics t "
                    "LEFT JOIN messages m ON m.topic_id = t.id GROUP BY t.id ORDER BY t.name"
                )
            ]
            first, last = database.execute("SELECT MIN(timestamp), MAX(timestamp) FROM messages").fetchone()
    except sqlite3.Error as error:
        raise InputError(
            f"is no SQLite bag of ROS 2, or damaged ({error})",
            where=str(path),
            do="give a bag of `ros2 bag record`",
        ) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=str(path)) from None
    return SqliteFile(path, size, content, topics=topics, span_ns=(_time(first), _time(last)))


def _time(value: object) -> int:
    """A column of another kind than a time counts as none."""
    return value if isinstance(value, int) else 0
