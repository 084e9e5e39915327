"""Records a live run: serialised messages go through a queue to a thread that writes them as MCAP."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol


class Recorded(NamedTuple):
    """A serialised message of a live run: topic, time of arrival or stamp, bytes, and its type; empty stands for that of the topic table."""

    topic: str
    log_ns: int
    data: bytes
    ros_type: str = ""


class Writer(Protocol):
    """What the recorder needs of a bag writer, such as `io.bag_writer.LiveRecorder`."""

    def write(self, topic: str, log_ns: int, data: bytes, ros_type: str) -> None: ...
    def close(self) -> None: ...


class Recorder:
    """Writes in its own thread, so that no disk ever holds up a step.

    When the disk falls behind by more than `LIMIT` messages or `LIMIT_BYTES`, further ones are dropped and counted. A disk
    that fails ends the recording, not the node; so does a file that was deleted.
    """

    LIMIT = 100_000
    LIMIT_BYTES = 256 * 2**20

    def __init__(self, writer: Writer, log_error: Callable[[str], Any]) -> None:
        self.written = 0
        self.dropped = 0
        self.error = ""
        self._writer = writer
        self._log_error = log_error
        self._queue: queue.SimpleQueue[Recorded | None] = queue.SimpleQueue()
        self._bytes = 0  # that wait
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def put(self, message: Recorded) -> None:
        """Have one message written; returns at once."""
        size = len(message.data)
        if self.error or self._queue.qsize() > self.LIMIT or self._bytes + size > self.LIMIT_BYTES:
            if not (self.dropped or self.error):
                self._log_error(
                    f"the disk is behind by {self._queue.qsize()} messages of {self._bytes} bytes: further ones are not recorded"
                )
            self.dropped += 1
            return
        with self._lock:
            self._bytes += size
        self._queue.put(message)

    def close(self) -> None:
        """Write what is queued, finish the file, end the thread."""
        self._queue.put(None)
        self._thread.join()
        if self.dropped:
            self._log_error(f"the recording lacks {self.dropped} of {self.dropped + self.written} messages")

    def _run(self) -> None:
        try:
            while (message := self._queue.get()) is not None:
                with self._lock:
                    self._bytes -= len(message.data)
                self._writer.write(*message)
                self.written += 1
        except Exception as error:  # whatever it is: nobody would see this thread end
            self.error = f"{type(error).__name__}: {error}"
            self._log_error(f"recording stopped: {self.error}")
        try:
            self._writer.close()
        except OSError as error:
            self.error = self.error or f"{type(error).__name__}: {error}"
            self._log_error(f"the recording could not be finished: {error}")
