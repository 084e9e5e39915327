"""Writing bags: one MCAP file with embedded definitions, which Foxglove and `ros2 bag` open as it is.

`BagWriter` writes a finished file in one go, with the same bytes whenever the content is the same (no wall
clock, no host name), under a temporary name until it is complete. `LiveRecorder` writes while a node runs and
gives every block to the operating system at once, so that a killed process loses a fraction of a second.
"""

from __future__ import annotations

import contextlib
import errno
import os
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import IO, cast

from mcap.writer import CompressionType, Writer

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.atomic_files import atomic_file
from ctr_dynamics.io.messages.schemas import schema
from ctr_dynamics.io.messages.topics import TOPIC

LIBRARY = "ctr_dynamics"
METADATA_NAME = "ctr_dynamics"
_FILE_CHUNK_BYTES = 2**20
_LIVE_CHUNK_BYTES = 2**16
_LIVE_FLUSH_S = 0.5
_COMPRESSION = CompressionType.LZ4
"""Digits of numbers hardly compress: zstd makes 15 % less of them, in five times the time."""


class _Channels:
    """Registers a topic's definition and channel when its first message of a type comes."""

    def __init__(self, writer: Writer) -> None:
        self.writer = writer
        self.schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}

    def of(self, topic: str, ros_type: str) -> int:
        """The channel of a topic; ``ros_type``: empty stands for that of the topic table."""
        kind = ros_type or TOPIC[topic].ros_type
        channel = self._channels.get((topic, kind))
        return self._add(topic, kind) if channel is None else channel

    def _add(self, topic: str, ros_type: str) -> int:
        definition = schema(ros_type)
        if ros_type not in self.schemas:
            self.schemas[ros_type] = self.writer.register_schema(
                ros_type, "ros2msg", definition.text.encode()
            )
        metadata = {"offered_qos_profiles": "", "topic_type_hash": definition.type_hash}
        channel = self.writer.register_channel(topic, "cdr", self.schemas[ros_type], metadata)
        self._channels[topic, ros_type] = channel
        return channel


class BagWriter:
    """Writes messages to an open binary stream. Use `write_bag` for a file.

    Args:
        stream: where to write.
        metadata: text entries of the record ``ctr_dynamics`` (version, hashes, parameters).
    """

    def __init__(self, stream: IO[bytes], metadata: Mapping[str, str]) -> None:
        self._writer = Writer(stream, chunk_size=_FILE_CHUNK_BYTES, compression=_COMPRESSION)
        self._writer.start(profile="ros2", library=LIBRARY)
        self._writer.add_metadata(METADATA_NAME, dict(metadata))
        self._channels = _Channels(self._writer)
        self._sequence: dict[int, int] = {}

    def write(self, topic: str, log_ns: int, data: bytes, ros_type: str = "") -> None:
        """Write one serialised message; log time and publish time are both `log_ns`.

        Args:
            ros_type: that of the topic table where it is empty; needed for other types and for topics outside the table.

        Raises:
            KeyError: a topic outside the table without a type.
        """
        channel = self._channels.of(topic, ros_type)
        sequence = self._sequence.get(channel, 0)
        self._sequence[channel] = sequence + 1
        log_ns = max(log_ns, 0)  # unsigned in MCAP
        self._writer.add_message(channel, log_ns, data, log_ns, sequence)

    def finish(self) -> None:
        """Write index and summary. The stream stays open."""
        self._writer.finish()


@contextlib.contextmanager
def write_bag(path: Path, metadata: Mapping[str, str]) -> Iterator[BagWriter]:
    """Write a bag to `path`, which appears when it is complete and not at all after a failure.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_file(Path(path)) as temporary, temporary.open("wb") as stream:
        writer = BagWriter(stream, metadata)
        yield writer
        writer.finish()


class LiveRecorder:
    """Records serialised messages while a node runs; any thread may call `write`.

    Args:
        path: file to create; its folder must exist, the file must not.
        metadata: as for `BagWriter`.

    Raises:
        InputError: the file exists or cannot be created.
    """

    def __init__(self, path: str | Path, metadata: Mapping[str, str]) -> None:
        self.path = Path(path)
        self.messages = 0
        self._lock = threading.Lock()
        try:
            # Unbuffered: a block that is complete is in the hands of the system, whatever happens to this
            # process.
            self._stream: IO[bytes] = self.path.open("xb", buffering=0)
        except FileExistsError:
            raise InputError("the file exists", where=str(self.path), do="give another name") from None
        except OSError as error:
            raise InputError(f"cannot be created ({error.strerror})", where=str(self.path)) from None
        self._writer = Writer(
            cast(IO[bytes], _Unbuffered(self._stream)),
            chunk_size=_LIVE_CHUNK_BYTES,
            compression=_COMPRESSION,
        )
        self._writer.start(profile="ros2", library=LIBRARY)
        self._writer.add_metadata(METADATA_NAME, dict(metadata))
        self._channels = _Channels(self._writer)
        self._open = True
        self._flushed = time.monotonic()

    def write(
        self, topic: str, log_ns: int, data: bytes, ros_type: str = "", publish_ns: int | None = None
    ) -> None:
        """Record one message.

        Args:
            log_ns: time of arrival.
            publish_ns: time of publishing, `log_ns` when not known.
            ros_type: that of the topic table where it is empty; needed for other types and for topics outside the table.

        Raises:
            OSError: the disk is full or gone, then the file so far stays readable; or the file was deleted.
        """
        with self._lock:
            if not self._open:
                return
            channel = self._channels.of(topic, ros_type)
            log_ns = max(log_ns, 0)
            self._writer.add_message(
                channel, log_ns, data, log_ns if publish_ns is None else max(publish_ns, 0)
            )
            self.messages += 1
            now = time.monotonic()
            if now - self._flushed > _LIVE_FLUSH_S:
                self._flushed = now
                self._writer.flush()
                if not os.fstat(self._stream.fileno()).st_nlink:
                    raise OSError(errno.ENOENT, "the file was deleted while it was recorded", str(self.path))

    def flush(self) -> None:
        """Hand everything recorded so far to the operating system."""
        with self._lock:
            if self._open:
                self._flushed = time.monotonic()
                self._writer.flush()

    def close(self) -> None:
        """Write index and summary and close the file. A second call does nothing."""
        with self._lock:
            if self._open:
                self._open = False
                try:
                    self._writer.finish()
                finally:
                    self._stream.close()

    def __enter__(self) -> LiveRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _Unbuffered:
    """A raw file as the MCAP writer wants it: whole writes, no buffer of its own in between."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._position = 0

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        while len(view):
            view = view[self._stream.write(view) :]
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Nothing to do: every write went to the file."""
