"""The ring buffer recording: what it keeps, when it writes and what it says."""

import threading

import pytest

from ctr_dynamics.errors import InputError
from ctr_dynamics.estimation.step_output import WARN, Status
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import decode_stamp
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_wrench_stamped
from ctr_dynamics.runtime import ring_buffer_recording
from ctr_dynamics.runtime.recorder import Recorded
from ctr_dynamics.runtime.ring_buffer_recording import RingBufferRecording

MS = 1_000_000
S = 1_000 * MS


def joints(stamp_ns):
    return encode_joint_state(stamp_ns, ["tube1_rotation"], [0.1])


@pytest.fixture
def made(tmp_path):
    """A recording of two seconds and the lines of its log; closed at the end."""
    lines = []
    recording = RingBufferRecording(tmp_path / "rolling.mcap", 2.0, "my robot.yaml", {}, lines.append)
    yield recording, lines
    if recording._thread.is_alive():
        recording.close(active=False)


def test_it_keeps_the_last_seconds_and_the_load_that_stood_before_them(made):
    recording, lines = made
    load = encode_wrench_stamped(0, "ctr_base", (0.0, -0.5, 0.0), (0.0, 0.0, 0.0))
    recording.put(Recorded(topics.TIP_LOAD, 0, load))
    for i in range(1000):
        recording.put(Recorded(topics.JOINT_STATES, i * 10 * MS, joints(i * 10 * MS)))
    kept = recording.messages()
    assert kept[0] == Recorded(topics.TIP_LOAD, kept[1].log_ns, load)
    assert len(kept) == 1 + 201
    recording.close(active=True)
    bag = open_bag(recording.path)
    assert bag.topics[topics.JOINT_STATES].messages == 201
    assert bag.topics[topics.TIP_LOAD].messages == 1
    stamps = [item.message.stamp_ns for item in bag.inputs() if item.topic == topics.JOINT_STATES]
    assert (min(stamps), max(stamps)) == (decode_stamp(joints(7990 * MS)), 9990 * MS)
    assert any("exit under an alarm" in line and recording.command in line for line in lines)


def test_memory_is_bounded_and_a_clock_that_goes_back_starts_again(made, monkeypatch):
    recording, _ = made
    monkeypatch.setattr(ring_buffer_recording, "LIMIT_BYTES", 1000)
    for i in range(100):
        recording.put(Recorded(topics.JOINT_STATES, 100 * S + i, bytes(100)))
    assert sum(len(message.data) for message in recording.messages()) <= 1000
    recording.put(Recorded(topics.JOINT_STATES, 5 * S, bytes(2000)))
    assert recording.messages() == []  # a single message beyond the limit is not kept either
    recording.put(Recorded(topics.JOINT_STATES, 5 * S, bytes(20)))
    assert [message.log_ns for message in recording.messages()] == [5 * S]


def test_an_alarm_is_written_at_once_and_then_once_in_the_kept_length(made, monkeypatch):
    recording, _ = made
    asked = []
    monkeypatch.setattr(recording, "save", asked.append)
    for t in (0.0, 1.0, 1.99, 2.0, 3.9):
        recording.alarm(True, round(t * 1e9))
    assert len(asked) == 2
    recording.alarm(False, 100 * S)
    assert len(asked) == 2


def test_what_cannot_be_written_is_said_and_the_thread_goes_on(made, tmp_path):
    recording, lines = made
    done = threading.Event()
    recording._log = lambda line: (lines.append(line), done.set())
    recording.save("asked")
    assert done.wait(30)
    assert "no input has come yet" in recording.error
    assert (
        "no input" in recording.describe(Status("misfit", WARN, "misfit", {})).values["ring buffer recording"]
    )
    recording.put(Recorded(topics.JOINT_STATES, 0, joints(0)))
    recording.save("asked again")
    recording.close(active=False)
    assert recording.error == ""
    status = recording.describe(Status("misfit", WARN, "misfit", {}))
    assert f"diagnose {recording.path} --robot 'my robot.yaml' --output findings" in status.message
    assert status.values["recording"] == str(recording.path)


def test_a_path_that_cannot_be_is_rejected_at_the_start(tmp_path):
    with pytest.raises(InputError, match=r"record\.rolling_path"):
        RingBufferRecording(tmp_path / "none" / "a.mcap", 2.0, "r", {}, print)
