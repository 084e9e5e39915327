"""Keeps the last seconds of the inputs in memory and writes them as a bag when the model is found to misfit, or on demand."""

from __future__ import annotations

import queue
import shlex
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ctr_dynamics.errors import InputError
from ctr_dynamics.estimation.step_output import Status
from ctr_dynamics.io.atomic_files import check_target
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages.topics import TIP_LOAD
from ctr_dynamics.runtime.recorder import Recorded

LIMIT_BYTES = 256 * 2**20  # kept in memory, whatever the rates of the inputs


class RingBufferRecording:
    """Inputs of the last ``seconds``; any thread may call any method, a thread of its own writes, so that no step waits for a disk.

    Args:
        path: file to write, replaced each time.
        seconds: length to keep, s of the arrival times.
        robot: as `ctr-dynamics diagnose --robot` takes it.
        metadata: text entries of the bag's record.
        log: takes one line for the log.

    Raises:
        InputError: the folder of ``path`` does not exist.
    """

    def __init__(
        self,
        path: str | Path,
        seconds: float,
        robot: str,
        metadata: Mapping[str, str],
        log: Callable[[str], Any],
    ) -> None:
        self.path = Path(path)
        check_target(self.path, "record.rolling_path")
        named = f"{shlex.quote(str(self.path))} --robot {shlex.quote(robot)}"
        self.command = f"ctr-dynamics diagnose {named} --output findings"
        self.written = 0
        self.error = ""
        self._span_ns = round(seconds * 1e9)
        self._metadata, self._log = dict(metadata), log
        self._kept: deque[Recorded] = deque()
        self._load: Recorded | None = None  # the last known load before what is kept
        self._bytes = 0
        self._lock = threading.Lock()
        self._asked_ns: int | None = None
        self._queue: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="ring buffer recording", daemon=True)
        self._thread.start()

    def put(self, message: Recorded) -> None:
        """Keep one message, and let go of what is too old."""
        log_ns = message.log_ns
        with self._lock:
            if self._kept and log_ns < self._kept[-1].log_ns - self._span_ns:
                self._kept.clear()  # the clock went back: what was before is of another time
                self._load, self._bytes = None, 0
            self._kept.append(message)
            self._bytes += len(message.data)
            while log_ns - self._kept[0].log_ns > self._span_ns or self._bytes > LIMIT_BYTES:
                old = self._kept.popleft()
                self._bytes -= len(old.data)
                if old.topic == TIP_LOAD:
                    self._load = old
                if not self._kept:
                    break

    def alarm(self, active: bool, monotonic_ns: int) -> None:
        """Have the recording written under an alarm: when it rises, and again while it lasts, at most once in the kept length."""
        if not active or (self._asked_ns is not None and monotonic_ns - self._asked_ns < self._span_ns):
            return
        self._asked_ns = monotonic_ns
        self.save("misfit reported")

    def save(self, why: str) -> None:
        """Have the recording written; returns at once."""
        self._queue.put(why)

    def messages(self) -> list[Recorded]:
        """What is kept now, in order of arrival; a load that was given before stands first."""
        with self._lock:
            kept, load = list(self._kept), self._load
        if load is not None and kept:
            kept.insert(0, load._replace(log_ns=kept[0].log_ns))
        return kept

    def describe(self, status: Status) -> Status:
        """``status`` (misfit) with the recording and the command to run on it."""
        values = {**status.values, "ring buffer recording": self.error or f"{self.written} times written"}
        if not self.written:
            return replace(status, values=values)
        values |= {"recording": str(self.path), "diagnose": self.command}
        message = f"{status.message}; recorded, run: {self.command}" if status.level else status.message
        return replace(status, message=message, values=values)

    def close(self, active: bool) -> None:
        """Write once more if an alarm is ``active``, finish what was asked for, end the thread."""
        if active:
            self.save("exit under an alarm")
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (why := self._queue.get()) is not None:
            try:
                self._write()
            except (InputError, OSError) as error:
                self.error = f"not written: {error}"
                self._log(f"ring buffer recording {self.error}")
            else:
                self.error = ""
                self.written += 1
                self._log(f"{why}: the last inputs are in {self.path}; run: {self.command}")

    def _write(self) -> None:
        messages = self.messages()
        if not messages:
            raise InputError("no input has come yet", where=str(self.path))
        with write_bag(self.path, self._metadata) as writer:
            for message in messages:
                writer.write(*message)
