"""The recorder: what it drops it counts, and a file that is gone ends the recording with one line."""

import threading
import time

import pytest

from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.bag_writer import LiveRecorder
from ctr_dynamics.io.messages.cdr import CdrWriter
from ctr_dynamics.io.messages.encode import encode_pose_stamped
from ctr_dynamics.io.messages.topics import JOINT_STATES, TRACKER_TIP
from ctr_dynamics.runtime.recorder import Recorded, Recorder


class Held:
    """A disk that takes nothing until it is let go."""

    def __init__(self):
        self.go = threading.Event()
        self.taken = []

    def write(self, topic, log_ns, data, ros_type):
        self.go.wait()
        self.taken.append(log_ns)

    def close(self):
        pass


def test_bytes_that_wait_for_the_disk_are_bounded(monkeypatch):
    monkeypatch.setattr(Recorder, "LIMIT_BYTES", 1000)
    disk, lines = Held(), []
    recorder = Recorder(disk, lines.append)
    recorder.put(Recorded(JOINT_STATES, 0, bytes(100)))
    while recorder._bytes:  # until the thread holds the first one
        time.sleep(0.001)
    for k in range(1, 15):
        recorder.put(Recorded(JOINT_STATES, k, bytes(100)))
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
    recorder.put(Recorded(JOINT_STATES, 1, bytes(10)))
    while not recorder.written:
        time.sleep(0.001)
    path.unlink()
    recorder.put(Recorded(JOINT_STATES, 2, bytes(10)))
    deadline = time.monotonic() + 10.0
    while not recorder.error and time.monotonic() < deadline:
        time.sleep(0.001)
    recorder.put(Recorded(JOINT_STATES, 3, bytes(10)))
    recorder.close()
    assert "deleted while it was recorded" in recorder.error
    assert recorder.dropped == 1
    assert any(line.startswith("recording stopped") for line in lines)


def transform(stamp_ns, position):
    writer = CdrWriter()
    writer.header(stamp_ns, "ctr_base")
    writer.string("coil")
    writer.float64s([*position, 0.0, 0.0, 0.0, 1.0])
    return writer.done()


@pytest.mark.parametrize("replaced", [False, True], ids=["one driver", "another one later"])
def test_messages_are_recorded_in_the_type_in_which_they_came(tmp_path, replaced):
    """Of a driver that is replaced by one of another type, it is said which poses a reader leaves out."""
    path, lines = tmp_path / "a.mcap", []
    recorder = Recorder(LiveRecorder(path, {}), lines.append)
    position, upright = (0.01, 0.02, 0.1), (0.0, 0.0, 0.0, 1.0)
    recorder.put(Recorded(TRACKER_TIP, 1000, transform(1000, position), "geometry_msgs/msg/TransformStamped"))
    if replaced:
        recorder.put(Recorded(TRACKER_TIP, 2000, encode_pose_stamped(2000, "ctr_base", position, upright)))
    recorder.close()
    bag = open_bag(path)
    poses = [item.message for item in bag.inputs()]
    assert [(pose.stamp_ns, pose.position) for pose in poses] == [(2000 if replaced else 1000, position)]
    assert any("TransformStamped are left out" in note for note in bag.notes) == replaced
    assert not lines


def test_an_error_of_any_kind_ends_the_recording_with_one_line():
    disk, lines = Held(), []
    disk.go.set()
    recorder = Recorder(disk, lines.append)
    disk.write = None
    recorder.put(Recorded(JOINT_STATES, 1, bytes(10)))
    recorder.close()
    assert recorder.error.startswith("TypeError")
    assert len(lines) == 1
