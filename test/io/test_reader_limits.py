"""What an MCAP file can ask of the reader is bounded, and a file without checksums is said."""

import struct

import pytest
import zstandard
from mcap.writer import Writer

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_info import inspect
from ctr_dynamics.io.bag_reader import MAX_HELD_BYTES, open_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.schemas import schema
from ctr_dynamics.io.storage.mcap_file import MAX_CHUNK_BYTES


def write(path, messages, **options):
    """Joint states (log time, bytes) as an MCAP file."""
    ros_type = topics.TOPIC[topics.JOINT_STATES].ros_type
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2", library="test")
        number = writer.register_schema(ros_type, "ros2msg", schema(ros_type).text.encode())
        channel = writer.register_channel(topics.JOINT_STATES, "cdr", number)
        for log_ns, data in messages:
            writer.add_message(channel, log_ns, data, log_ns)
        writer.finish()


def test_a_chunk_that_unpacks_to_too_much(tmp_path):
    """A decompression bomb: a small chunk that claims, or unpacks to, gigabytes."""
    packed = zstandard.compress(bytes(50_000_000))
    for claimed in (1000, 2**40):
        head = struct.pack("<QQQII", 0, 1, claimed, 0, 4) + b"zstd" + struct.pack("<Q", len(packed))
        content = head + packed
        (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(content)) + content)
        bag = open_bag(tmp_path / "a.mcap")
        assert list(bag.messages()) == []


def test_a_chunk_beyond_the_limit_is_named(tmp_path):
    size = MAX_CHUNK_BYTES + 1
    packed = zstandard.compress(bytes(size))
    content = struct.pack("<QQQII", 0, 1, size, 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(content)) + content)
    bag = open_bag(tmp_path / "a.mcap")
    assert any(f"claims {size} bytes, at most {MAX_CHUNK_BYTES}" in note for note in bag.notes)


def test_messages_that_all_overlap_in_time_are_bounded(tmp_path):
    """Chunks of one time each fit into memory, all of them together do not."""
    messages = [(5, bytes(2**20)) for _ in range(MAX_HELD_BYTES // 2**20 + 2)]
    write(tmp_path / "a.mcap", messages, chunk_size=2**21)
    with pytest.raises(
        InputError, match=f"overlap in time at 5 ns, more than {MAX_HELD_BYTES} bytes"
    ) as error:
        for _ in open_bag(tmp_path / "a.mcap").messages():
            pass
    assert "mcap sort" in str(error.value)


def test_a_file_without_checksums_is_said(tmp_path):
    for checked in (True, False):
        path = tmp_path / f"{checked}.mcap"
        write(path, [(k, bytes(40)) for k in range(30)], enable_crcs=checked)
        bag = open_bag(path)
        list(bag.messages())
        expected = (
            []
            if checked
            else ["False.mcap: written without checksums (CRC 0), a damaged value would not be noticed"]
        )
        assert bag.unchecked == expected
        assert [p.text for p in inspect(path).problems if "checksums" in p.text] == expected


def test_a_description_of_a_bag_that_multiplies_itself_is_noted_and_left_out(tmp_path):
    write(tmp_path / "a.mcap", [(k, bytes(40)) for k in range(3)])
    merges = ["a: &a0 {x: 1}"]
    merges += [f"k{i}: &a{i} {{<<: [{','.join(10 * [f'*a{i - 1}'])}]}}" for i in range(1, 10)]
    (tmp_path / "metadata.yaml").write_text("\n".join(merges))
    bag = open_bag(tmp_path)
    assert len(list(bag.messages())) == 3
    assert any("metadata.yaml is not usable" in note and "aliases and merges" in note for note in bag.notes)
