"""Properties of bags and messages: whatever is written comes back, in order of log time, and cut files give what is before the cut."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import cdr, topics
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped, encode_wrench_stamped
from ctr_dynamics.io.messages.schemas import typestore

STAMPS = st.integers(0, 2**31 * 10**9 - 1)
NUMBERS = st.floats(width=64)
FRAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=20)
VECTOR = st.tuples(NUMBERS, NUMBERS, NUMBERS)
FEW = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def same(a, b) -> bool:
    """Equal floats, NaN to NaN."""
    return all(x == y or (math.isnan(x) and math.isnan(y)) for x, y in zip(a, b, strict=True))


@given(STAMPS, st.lists(st.tuples(FRAMES, NUMBERS), max_size=12))
def test_joint_states_come_back(stamp, joints):
    names, positions = [n for n, _ in joints], [p for _, p in joints]
    data = encode_joint_state(stamp, names, positions)
    found = cdr.decode_joint_state(data)
    assert (found.stamp_ns, found.names) == (stamp, tuple(names))
    assert same(found.positions, positions)
    if joints:  # rosbags reads no padding behind an empty array
        other = typestore().deserialize_cdr(data, "sensor_msgs/msg/JointState")
        assert list(other.name) == names
        assert same(other.position, positions)


@given(STAMPS, FRAMES, VECTOR, st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS))
def test_poses_come_back(stamp, frame, position, quaternion):
    found = cdr.decode_pose_stamped(encode_pose_stamped(stamp, frame, position, quaternion))
    assert (found.stamp_ns, found.frame_id) == (stamp, frame)
    assert same(found.position, position)
    assert same(found.quaternion_xyzw, quaternion)


@given(STAMPS, FRAMES, VECTOR, VECTOR)
def test_wrenches_come_back(stamp, frame, force, torque):
    found = cdr.decode_wrench_stamped(encode_wrench_stamped(stamp, frame, force, torque))
    assert same(found.force, force)
    assert same(found.torque, torque)


@settings(max_examples=300)
@given(st.binary(max_size=300), st.booleans())
def test_any_bytes_are_a_message_or_no_message(data, little):
    data = (b"\x00\x01\x00\x00" if little else b"\x00\x00\x00\x00") + data
    for decode in (
        cdr.decode_joint_state,
        cdr.decode_pose_stamped,
        cdr.decode_wrench_stamped,
        cdr.decode_point_cloud,
    ):
        try:
            decode(data)
        except cdr.CdrError as error:
            assert "\n" not in str(error)


RECORDS = st.lists(
    st.tuples(st.integers(0, 10**12), st.sampled_from([topics.JOINT_STATES, topics.TRACKER_TIP]), NUMBERS),
    min_size=1,
    max_size=60,
)


def write(path, records) -> list[tuple[int, str, bytes]]:
    listed = []
    for stamp, topic, number in records:
        if topic == topics.JOINT_STATES:
            data = encode_joint_state(stamp, ["tube1_rotation"], [number])
        else:
            data = encode_pose_stamped(stamp, "ctr_base", (number, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        listed.append((stamp, topic, data))
    with write_bag(path, {"a": "b"}) as writer:
        for stamp, topic, data in listed:
            writer.write(topic, stamp, data)
    return listed


@FEW
@given(RECORDS)
def test_bags_come_back_in_order(tmp_path, records):
    path = tmp_path / "bag.mcap"
    listed = write(path, records)
    bag = open_bag(path)
    found = [(m.log_ns, m.topic, m.data) for m in bag.messages()]
    assert found == sorted(listed, key=lambda item: item[:2])
    assert bag.notes == []
    assert bag.metadata("ctr_dynamics") == {"a": "b"}


@FEW
@given(RECORDS, st.floats(0, 1))
def test_a_cut_bag_gives_messages_that_were_written(tmp_path, records, share):
    path = tmp_path / "bag.mcap"
    listed = write(path, records)
    data = path.read_bytes()
    cut = data[: int(share * len(data))]
    path.write_bytes(cut)
    try:
        bag = open_bag(path)
    except InputError as error:
        assert "\n" not in str(error)
        return
    found = [(m.log_ns, m.topic, m.data) for m in bag.messages()]
    left = list(listed)
    for item in found:
        left.remove(item)  # each was written, and none comes twice
    assert [item[0] for item in found] == sorted(item[0] for item in found)
    assert bag.notes or len(cut) == len(data)


@FEW
@given(RECORDS, st.data())
def test_a_flipped_byte_never_gives_other_messages(tmp_path, records, data):
    """Chunks carry checksums: damage costs messages, it does not change them."""
    path = tmp_path / "bag.mcap"
    listed = {item[2] for item in write(path, records)}
    whole = bytearray(path.read_bytes())
    whole[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(bytes(whole))
    try:
        found = list(open_bag(path).messages())
    except InputError:
        return
    assert all(message.data in listed for message in found)
    assert np.all(np.diff([message.log_ns for message in found]) >= 0)
