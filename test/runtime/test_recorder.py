"""The recorder: what it drops it counts, and a file that is gone ends the recording with one line."""

import threading
import time

from ctr_dynamics.io.bag_writer import LiveRecorder
from ctr_dynamics.io.messages.topics import JOINT_STATES
from ctr_dynamics.runtime.recorder import Recorder


class Held:
    """A disk that takes nothing until it is let go."""

    def __init__(self):
        self.go = threading.Event()
        self.taken = []

    def write(self, topic, log_ns, data):
        self.go.wait()
        self.taken.append(log_ns)

    def close(self):
        pass


def test_bytes_that_wait_for_the_disk_are_bounded(monkeypatch):
    monkeypatch.setattr(Recorder, "LIMIT_BYTES", 1000)
    disk, lines = Held(), []
    recorder = Recorder(disk, lines.append)
    recorder.put(JOINT_STATES, 0, bytes(100))
    while recorder._bytes:  # until the thread holds the first one
        time.sleep(0.001)
    for k in range(1, 15):
        recorder.put(JOINT_STATES, k, bytes(100))
    assert recorder.dropped == 4
    disk.go.set()
    recorder.close()
    assert disk.taken == list(range(11))
    assert lines == [
        "the disk is behind by 10 messages of 1000 bytes: further ones are not recorded",
        "the recording lacks 4 of 15 messages",
    ]


def test_a_recording_that_is_deleted_is_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr("ctr_dynamics.io.bag_writer._LIVE_FLUSH_S", 0.0)
    path, lines = tmp_path / "a.mcap", []
    recorder = Recorder(LiveRecorder(path, {}), lines.append)
    recorder.put(JOINT_STATES, 1, bytes(10))
    while not recorder.written:
        time.sleep(0.001)
    path.unlink()
    recorder.put(JOINT_STATES, 2, bytes(10))
    deadline = time.monotonic() + 10.0
    while not recorder.error and time.monotonic() < deadline:
        time.sleep(0.001)
    recorder.put(JOINT_STATES, 3, bytes(10))
    recorder.close()
    assert "deleted while it was recorded" in recorder.error
    assert recorder.dropped == 1
    assert any(line.startswith("recording stopped") for line in lines)
