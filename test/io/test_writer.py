"""Written bags: read by rosbags and mcap, same bytes twice, nothing left behind, and usable after a kill."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.bag_writer import LiveRecorder, write_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.schemas import schema, typestore
from ctr_dynamics.runtime.step_encoder import StepEncoder

META = {"version": "1.2.3", "parameters": '{"a": 1}'}


@pytest.fixture
def steps(step):
    encoder = StepEncoder(hardware_id="robot")
    return [message for k in range(40) for message in encoder.encode(step(k=k, points=9), list)]


def save(path, messages):
    with write_bag(path, META) as writer:
        for message in messages:
            writer.write(message.topic, message.stamp_ns, message.data)


def test_every_reader_opens_it(tmp_path, steps):
    path = tmp_path / "out.mcap"
    save(path, steps)
    assert [p.name for p in tmp_path.iterdir()] == ["out.mcap"]
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        header = reader.get_header()
        assert (header.profile, header.library) == ("ros2", "ctr_dynamics")
        (metadata,) = reader.iter_metadata()
        assert (metadata.name, metadata.metadata) == ("ctr_dynamics", META)
        summary = reader.get_summary()
        assert summary.statistics.message_count == len(steps)
        for channel in summary.channels.values():
            embedded = summary.schemas[channel.schema_id]
            assert embedded.encoding == "ros2msg"
            assert embedded.name == topics.TOPIC[channel.topic].ros_type
            assert embedded.data.decode() == schema(embedded.name).text
            assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
        assert sum(1 for _ in reader.iter_messages()) == len(steps)
    with AnyReader([path]) as any_reader:  # types from the file alone
        assert {c.topic for c in any_reader.connections} == {t.name for t in topics.OUTPUTS}
        count = 0
        for connection, log_ns, data in any_reader.messages():
            message = any_reader.deserialize(data, connection.msgtype)
            if topics.TOPIC[connection.topic].has_header:
                assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == log_ns
            count += 1
        assert count == len(steps)
    bag = open_bag(path)
    assert bag.metadata("ctr_dynamics") == META
    assert sorted((m.topic, m.log_ns, m.data) for m in bag.messages()) == sorted(tuple(m) for m in steps)


def test_same_content_same_bytes(tmp_path, steps):
    save(tmp_path / "a.mcap", steps)
    save(tmp_path / "b.mcap", steps)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_other_topics_need_a_type(tmp_path):
    with write_bag(tmp_path / "a.mcap", {}) as writer:
        writer.write("/truth/tip", 5, b"\x00\x01\x00\x00\x01", ros_type="std_msgs/msg/Bool")
        with pytest.raises(KeyError):
            writer.write("/unknown", 5, b"")
    assert open_bag(tmp_path / "a.mcap").topics["/truth/tip"].ros_type == "std_msgs/msg/Bool"


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_nothing_is_left_after_a_failure(tmp_path, steps, error):
    (tmp_path / "out.mcap").write_bytes(b"earlier result")

    def fail():
        with write_bag(tmp_path / "out.mcap", META) as writer:
            writer.write(*steps[0])
            raise error

    with pytest.raises(error):
        fail()
    assert [p.name for p in tmp_path.iterdir()] == ["out.mcap"]
    assert (tmp_path / "out.mcap").read_bytes() == b"earlier result"


def test_live_recording(tmp_path, steps):
    path = tmp_path / "live.mcap"
    with LiveRecorder(path, META) as recorder:
        for message in steps:
            recorder.write(message.topic, message.stamp_ns + 1000, message.data, publish_ns=message.stamp_ns)
        assert recorder.messages == len(steps)
        recorder.flush()
        # Before it is closed, everything up to the flush can be read.
        assert sum(1 for _ in open_bag(path).messages()) == len(steps)
    recorder.close()
    recorder.write(*steps[0])  # after closing: ignored, not an error at shutdown
    bag = open_bag(path)
    assert bag.notes == []
    assert sum(1 for _ in bag.messages()) == len(steps)
    with AnyReader([path]) as reader:
        assert sum(1 for _ in reader.messages()) == len(steps)


def test_live_recording_never_overwrites(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"precious")
    with pytest.raises(InputError, match="exists"):
        LiveRecorder(tmp_path / "a.mcap", {})
    assert (tmp_path / "a.mcap").read_bytes() == b"precious"
    with pytest.raises(InputError, match="cannot be created"):
        LiveRecorder(tmp_path / "no" / "a.mcap", {})


def test_killed_recorder_loses_little(tmp_path):
    """kill -9 in the middle of a recording: all but the last block is in the file."""
    path = tmp_path / "live.mcap"
    program = textwrap.dedent(
        f"""
        import os, signal
        from ctr_dynamics.io.bag_writer import LiveRecorder
        from ctr_dynamics.io.messages.encode import encode_joint_state
        recorder = LiveRecorder({str(path)!r}, {{}})
        for i in range(20000):
            recorder.write("/ctr/joint_states", i, encode_joint_state(i, ["tube1_rotation", "tube1_translation"], [0.1, -0.1]))
        os.kill(os.getpid(), signal.SIGKILL)
        """
    )
    done = subprocess.run([sys.executable, "-c", program], env=dict(os.environ), check=False, timeout=120)
    assert done.returncode == -signal.SIGKILL
    bag = open_bag(path)
    logs = [m.log_ns for m in bag.inputs()]
    assert logs == list(range(len(logs)))
    assert len(logs) > 0.97 * 20000
    assert len(bag.notes) == 1


def test_definitions_are_complete(tmp_path):
    """Each embedded text defines every nested type, so that a reader needs no definitions of its own."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    for topic in topics.TOPICS:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(schema(topic.ros_type).text, topic.ros_type))
        assert store.generate_msgdef(topic.ros_type, ros_version=2) == typestore().generate_msgdef(
            topic.ros_type, ros_version=2
        )
