"""Reading bags: whole, cut, damaged, split, of other kinds; always in arrival order, never with a crash."""

from __future__ import annotations

import math
import os
import struct
import tracemalloc
from collections import Counter
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.highlevel import AnyReader

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import INPUT_TOPICS, open_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped
from ctr_dynamics.io.messages.schemas import schema

JOINTS = ["tube1_rotation", "tube1_translation", "tube2_rotation", "tube2_translation"]
NAMES = (
    "exact_release",
    "clean_release",
    "clean_protocol",
    "clean_sweep",
    "payload_protocol",
    "latency_sweep",
)


def one_line(error: pytest.ExceptionInfo[InputError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < 500
    return text


def write(
    path: Path,
    messages: list[tuple[str, int, bytes]],
    *,
    finish: bool = True,
    types: dict[str, str] | None = None,
    encoding: str = "cdr",
    **options: object,
) -> None:
    """A small MCAP file straight from the mcap library."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)  # type: ignore[arg-type]
        writer.start(profile="ros2", library="test")
        channels: dict[str, int] = {}
        for topic, log_ns, data in messages:
            if topic not in channels:
                ros_type = (types or {}).get(topic) or topics.TOPIC[topic].ros_type
                text = schema(ros_type).text.encode()
                channels[topic] = writer.register_channel(
                    topic, encoding, writer.register_schema(ros_type, "ros2msg", text)
                )
            writer.add_message(channels[topic], log_ns, data, log_ns)
        if finish:
            writer.finish()
        else:
            writer.flush()


def joint(stamp_ns: int) -> bytes:
    return encode_joint_state(stamp_ns, JOINTS, [0.1, -0.2, 0.3, -0.1])


def pose(stamp_ns: int) -> bytes:
    return encode_pose_stamped(stamp_ns, "ctr_base", (0, 0, 0.1), (0, 0, 0, 1))


def stream_of(count: int) -> list[tuple[str, int, bytes]]:
    """Joints at 100 Hz with a tracker at 50 Hz on the same log times, the tracker written first."""
    messages = []
    for i in range(count):
        stamp = 1_000_000_000 + i * 10_000_000
        if i % 2 == 0:
            messages.append((topics.TRACKER_TIP, stamp, pose(stamp)))
        messages.append((topics.JOINT_STATES, stamp, joint(stamp)))
    return messages


@pytest.mark.parametrize("name", NAMES)
def test_shipped_bags_are_read_as_rosbags_reads_them(bags, name):
    path = bags / f"{name}.mcap"
    bag = open_bag(path)
    mine = list(bag.inputs())
    assert bag.notes == []
    assert [(m.log_ns, m.topic) for m in mine] == sorted((m.log_ns, m.topic) for m in mine)
    counted = Counter(m.topic for m in mine)
    assert counted == {t.name: t.messages for t in bag.topics.values()}
    # AnyReader orders by time alone: compare per topic.
    with AnyReader([path.resolve()]) as reader:
        for topic in counted:
            theirs = reader.messages([c for c in reader.connections if c.topic == topic])
            own = [m for m in mine if m.topic == topic]
            for item, (connection, log_ns, data) in zip(own, theirs, strict=True):
                assert item.log_ns == log_ns
                message = reader.deserialize(data, connection.msgtype)
                stamp = message.header.stamp
                assert item.message.stamp_ns == stamp.sec * 10**9 + stamp.nanosec
                if topic == topics.JOINT_STATES:
                    assert item.message.names == tuple(message.name)
                    assert item.message.positions == tuple(message.position)
                elif topic == topics.TRACKER_TIP:
                    q = message.pose.orientation
                    assert item.message.quaternion_xyzw == (q.x, q.y, q.z, q.w)


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunk_size", [300, 5000, 2**20])
@pytest.mark.parametrize("finish", [True, False])
def test_compressions_and_chunk_sizes(tmp_path, compression, chunk_size, finish):
    messages = stream_of(60)
    write(tmp_path / "a.mcap", messages, compression=compression, chunk_size=chunk_size, finish=finish)
    bag = open_bag(tmp_path / "a.mcap")
    got = [(m.topic, m.log_ns, m.data) for m in bag.messages()]
    assert got == sorted(messages, key=lambda m: (m[1], m[0]))
    assert bag.files[0].complete == finish
    assert len(bag.notes) == (0 if finish else 1)
    assert bag.topics[topics.JOINT_STATES].messages == 60


@pytest.mark.parametrize(
    "options", [{"use_chunking": False}, {"index_types": IndexType.NONE}, {"use_statistics": False}]
)
@pytest.mark.parametrize("finish", [True, False])
def test_files_without_chunks_or_index(tmp_path, options, finish):
    messages = stream_of(60)
    write(tmp_path / "a.mcap", messages, finish=finish, chunk_size=2000, **options)
    bag = open_bag(tmp_path / "a.mcap")
    got = [(m.topic, m.log_ns, m.data) for m in bag.messages()]
    assert got == sorted(messages, key=lambda m: (m[1], m[0]))


def test_arrival_order_when_the_file_is_not_in_order(tmp_path):
    messages = stream_of(200)
    shuffled = [messages[(i * 7919) % len(messages)] for i in range(len(messages))]
    assert len(messages) % 7919 != 0
    write(tmp_path / "a.mcap", shuffled, chunk_size=1000)
    got = [(m.topic, m.log_ns, m.data) for m in open_bag(tmp_path / "a.mcap").messages()]
    assert got == sorted(messages, key=lambda m: (m[1], m[0]))


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}])
def test_memory_does_not_grow_with_the_file(tmp_path, options):
    """Only what overlaps in time is in memory: far less than the messages together."""
    padded = [(topic, log_ns, data + bytes(5000)) for topic, log_ns, data in stream_of(2000)]
    write(tmp_path / "a.mcap", padded, chunk_size=50_000, compression=CompressionType.NONE, **options)
    tracemalloc.start()
    try:
        assert sum(1 for _ in open_bag(tmp_path / "a.mcap").messages()) == 3000
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    total = sum(len(data) for _, _, data in padded)
    assert total > 15_000_000
    assert peak < 0.3 * total


def test_only_wanted_topics(bags):
    bag = open_bag(bags / "clean_release.mcap")
    assert {m.topic for m in bag.messages({topics.TIP_LOAD})} == {topics.TIP_LOAD}


# Cut and damaged files.


def test_cut_at_any_byte(tmp_path):
    """Every prefix of a file gives a clear error or a prefix of its messages, and says that something is
    missing."""
    messages = stream_of(40)
    path = tmp_path / "whole.mcap"
    write(path, messages, chunk_size=900)
    whole = path.read_bytes()
    expected = [(m.topic, m.log_ns, m.data) for m in open_bag(path).messages()]
    cut = tmp_path / "cut.mcap"
    most = 0
    for size in range(0, len(whole), 7):
        cut.write_bytes(whole[:size])
        try:
            bag = open_bag(cut)
        except InputError as error:
            assert size <= 8
            assert "\n" not in str(error)
            continue
        got = [(m.topic, m.log_ns, m.data) for m in bag.messages()]
        assert set(got) <= set(expected)
        assert len(got) >= most, "a longer file gives fewer messages"
        most = len(got)
        assert len(bag.notes) == 1
        assert "cut.mcap" in bag.notes[0]
    assert most == len(expected)


@pytest.mark.parametrize("part", [0.6, 0.9])  # zstd gives its content in blocks of 128 KiB
@pytest.mark.parametrize("name", ["clean_release", "clean_protocol"])
def test_messages_inside_a_cut_chunk_are_saved(bags, tmp_path, name, part):
    """These bags are one chunk each: a cut one would be lost without its content up to the cut."""
    whole = (bags / f"{name}.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: int(part * len(whole))])
    all_messages = list(open_bag(bags / f"{name}.mcap").messages())
    got = list(open_bag(tmp_path / "cut.mcap").messages())
    assert len(got) > 0.4 * part * len(all_messages)
    assert set(got) <= set(all_messages)


def test_a_damaged_chunk_is_left_out_and_named(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, stream_of(100), chunk_size=3000, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    middle = open_bag(path).files[0].blocks[3]
    data[middle.offset + middle.length // 2] ^= 0xFF
    path.write_bytes(data)
    bag = open_bag(path)
    got = list(bag.messages())
    assert 0 < len(got) < 150
    assert bag.notes == [
        f"a.mcap: chunk at byte {middle.offset} is damaged ({middle.length} bytes) and left out"
    ]


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    changes=st.lists(st.tuples(st.floats(0, 1), st.binary(min_size=1, max_size=9)), max_size=4),
    cut=st.floats(0.0, 1.0),
    options=st.sampled_from(
        [
            {"compression": CompressionType.ZSTD},
            {"compression": CompressionType.LZ4},
            {"compression": CompressionType.NONE},
            {"use_chunking": False},
            {"enable_crcs": False, "compression": CompressionType.NONE},
        ]
    ),
)
def test_fuzz(tmp_path, changes, cut, options):
    """Any damage: either an InputError of one line, or messages that can be gone through to the end."""
    path = tmp_path / "fuzz.mcap"
    write(path, stream_of(30), chunk_size=900, **options)
    data = bytearray(path.read_bytes())
    for place, new in changes:
        at = int(place * len(data))
        data[at : at + len(new)] = new
    if cut < 0.7:
        data = data[: int(len(data) * cut / 0.7)]
    path.write_bytes(data)
    try:
        bag = open_bag(path)
        count = sum(1 for _ in bag.inputs())
        bag.check_inputs()
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert count <= 1000
        assert all("\n" not in note for note in bag.notes)


def test_lengths_that_lie_do_not_allocate(tmp_path):
    path = tmp_path / "a.mcap"
    for opcode in range(1, 0x10):
        record = struct.pack("<BQ", opcode, 2**62) + bytes(100)
        path.write_bytes(b"\x89MCAP0\r\n" + record)
        assert list(open_bag(path).messages()) == []
        inner = b"\xff" * 60
        path.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", opcode, len(inner)) + inner)
        assert list(open_bag(path).messages()) == []


# What is not a bag.


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "empty"),
        (b"\x89MCA", "cut after 4 bytes"),
        (b"hello, this is not a bag", "not an MCAP file, SQLite bag or ROS 1 bag"),
        (b"\x89MCAP1\r\n" + bytes(50), "not an MCAP file, SQLite bag or ROS 1 bag"),
        (b"SQLite format 3\0" + bytes(100), "SQLite bag"),
        (b"#ROSBAG V2.0\n" + bytes(100), "ROS 1 bag"),
        (b"\x28\xb5\x2f\xfd" + bytes(100), "damaged zstd file"),
    ],
)
def test_other_files(tmp_path, content, text):
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(InputError, match=text) as error:
        open_bag(tmp_path / "x.mcap")
    assert "x.mcap" in one_line(error)


def test_no_such_path_and_special_files(tmp_path):
    with pytest.raises(InputError, match="no such bag") as error:
        open_bag(tmp_path / "nothing")
    one_line(error)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="not a regular file"):
        open_bag(tmp_path / "pipe")
    with pytest.raises(InputError, match="not a regular file"):
        open_bag("/dev/zero")


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_unreadable_file(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, stream_of(3))
    path.chmod(0)
    with pytest.raises(InputError, match="cannot be read"):
        open_bag(path)


def test_folders(tmp_path, bags):
    with pytest.raises(InputError, match=r"holds no \.mcap"):
        open_bag(tmp_path)
    (tmp_path / "old.db3").write_bytes(b"x")
    with pytest.raises(InputError, match=r"old\.db3: is not an MCAP file"):
        open_bag(tmp_path)
    content = (bags / "clean_release.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(content)
    assert sum(1 for _ in open_bag(tmp_path).inputs()) == 905
    (tmp_path / "b.mcap").write_bytes(content)
    with pytest.raises(InputError, match=r"holds 3 bags \(a\.mcap, b\.mcap, old\.db3\)") as error:
        open_bag(tmp_path)
    one_line(error)


def metadata(folder: Path, **changes: object) -> None:
    information: dict[str, object] = {
        "version": 9,
        "storage_identifier": "mcap",
        "relative_file_paths": ["a.mcap"],
        "compression_mode": "",
    }
    information.update(changes)
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))


def test_split_bag_and_its_missing_part(tmp_path):
    messages = stream_of(90)
    for number, part in enumerate((messages[:60], messages[60:], messages[100:])):
        write(tmp_path / f"part_{number}.mcap", part)
    metadata(tmp_path, relative_file_paths=["part_0.mcap", "part_1.mcap"])
    bag = open_bag(tmp_path)
    assert [m.data for m in bag.messages()] == [m[2] for m in sorted(messages, key=lambda m: (m[1], m[0]))]
    assert bag.topics[topics.JOINT_STATES].messages == 90
    (tmp_path / "part_0.mcap").unlink()
    bag = open_bag(tmp_path / "metadata.yaml")
    assert sum(1 for _ in bag.messages()) == len(messages) - 60
    assert bag.notes == ["part_0.mcap is named in metadata.yaml but is not there"]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"storage_identifier": "sqlite3", "relative_file_paths": ["a.db3"]}, r"a\.db3"),
        ({"compression_mode": "FILE", "compression_format": "zstd"}, r"a\.mcap"),
        ({"compression_mode": "message"}, r"a\.mcap"),
        ({"relative_file_paths": ["gone.mcap", "also.mcap"]}, "gone.mcap, also.mcap"),
        ({"relative_file_paths": 5}, "none of the files"),
    ],
)
def test_metadata_that_rules_reading_out(tmp_path, changes, text):
    metadata(tmp_path, **changes)
    with pytest.raises(InputError, match=text) as error:
        open_bag(tmp_path)
    one_line(error)


@pytest.mark.parametrize(
    "text", ["", "][", "a: 1", "- 1", "rosbag2_bagfile_information: 7", "\x00", "x: !!python/name:os.system"]
)
def test_unusable_metadata_beside_one_file(tmp_path, text):
    write(tmp_path / "a.mcap", stream_of(10))
    (tmp_path / "metadata.yaml").write_text(text)
    bag = open_bag(tmp_path)
    assert sum(1 for _ in bag.messages()) == 15
    assert len(bag.notes) == 1
    assert "metadata.yaml is not usable" in bag.notes[0]


# Topics that do not fit.


def test_bag_of_another_robot(tmp_path):
    types = {"/arm/joints": "sensor_msgs/msg/JointState"}
    write(tmp_path / "a.mcap", [("/arm/joints", 5, joint(5))], types=types)
    bag = open_bag(tmp_path)
    with pytest.raises(InputError, match=r"no topic /ctr/joint_states.*/arm/joints") as error:
        bag.check_inputs()
    one_line(error)
    assert list(bag.inputs()) == []


def test_bag_without_any_message(tmp_path):
    write(tmp_path / "a.mcap", [])
    with pytest.raises(InputError, match="no topics at all"):
        open_bag(tmp_path).check_inputs()


def test_wrong_type_or_encoding_is_named(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, [(topics.TRACKER_TIP, 5, pose(5))], types={topics.TRACKER_TIP: "nav_msgs/msg/Path"})
    with pytest.raises(InputError, match=r"nav_msgs/msg/Path.*geometry_msgs/msg/PoseStamped"):
        list(open_bag(path).inputs())
    write(path, [(topics.TRACKER_TIP, 5, b"{}")], encoding="json")
    with pytest.raises(InputError, match="encoding 'json'"):
        list(open_bag(path).inputs())
    # The old name of a type, without /msg/, is the same type.
    write(path, [(topics.TRACKER_TIP, 5, pose(5))])
    data = path.read_bytes()
    assert len(list(open_bag(path).inputs())) == 1
    assert b"geometry_msgs/msg/PoseStamped" in data


def test_unknown_compression_is_named(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, stream_of(3), compression=CompressionType.LZ4, enable_crcs=False)
    path.write_bytes(path.read_bytes().replace(b"\x03\0\0\0lz4", b"\x03\0\0\0xzz"))
    with pytest.raises(InputError, match=r"compression 'xzz'.*'zstd', 'lz4' and none") as error:
        list(open_bag(path).messages())
    one_line(error)


def test_messages_that_cannot_be_decoded_are_counted(tmp_path):
    messages = stream_of(10)
    for i in (3, 5):
        topic, log_ns, data = messages[i]
        messages[i] = (topic, log_ns, data[:30])
    write(tmp_path / "a.mcap", messages)
    bag = open_bag(tmp_path)
    for _ in range(2):  # counted anew each time
        assert sum(1 for _ in bag.inputs()) == 13
        assert sum(bag.malformed.values()) == 2
    assert any("cannot be decoded" in note for note in bag.notes)


def test_nan_reaches_the_reader_as_it_is(tmp_path):
    data = encode_pose_stamped(5, "ctr_base", (math.nan, 0, 0), (0, 0, 0, 1))
    write(tmp_path / "a.mcap", [(topics.TRACKER_TIP, 5, data)])
    (item,) = open_bag(tmp_path).inputs()
    assert math.isnan(item.message.position[0])


def test_decoders_cover_the_inputs():
    assert set(INPUT_TOPICS) == {topic.name for topic in topics.INPUTS}


def test_sha256(tmp_path):
    write(tmp_path / "a.mcap", stream_of(3))
    import hashlib

    assert open_bag(tmp_path).sha256() == {
        "a.mcap": hashlib.sha256((tmp_path / "a.mcap").read_bytes()).hexdigest()
    }


def test_the_demo_bag_is_package_data(bags):
    from importlib import resources

    shipped = resources.files("ctr_dynamics") / "data" / "bags"
    assert (shipped / "clean_release.mcap").read_bytes() == (bags / "clean_release.mcap").read_bytes()
    assert (shipped / "clean_release.npz").is_file()
