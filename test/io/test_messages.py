"""Encoded messages are byte for byte what rosbags serialises, and the inputs are decoded as rosbags does."""

from __future__ import annotations

import struct
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.monitoring.statuses import all_statuses
from ctr_dynamics.estimation.step_output import ERROR
from ctr_dynamics.io.messages import cdr, encode, topics
from ctr_dynamics.io.messages.schemas import schema, typestore
from ctr_dynamics.io.messages.templates import NotFiniteError
from ctr_dynamics.runtime import step_encoder
from tools.message_pages import leaf_fields

STORE = typestore()
OUTPUT_TOPICS = [topic.name for topic in topics.OUTPUTS if topic.name != topics.DIAGNOSTICS]


def by_topic(messages: list[encode.Encoded]) -> dict[str, encode.Encoded]:
    return {message.topic: message for message in messages}


@pytest.mark.parametrize("topic", OUTPUT_TOPICS)
@pytest.mark.parametrize("frame_id", ["ctr_base", "base", "a_longer_frame_name"])
@pytest.mark.parametrize(("points", "modes"), [(1, 1), (2, 4), (37, 3), (102, 6)])
def test_output_is_byte_equal_to_rosbags(step, reference, topic, frame_id, points, modes):
    reference.frame_id = frame_id
    out = step(k=22, points=points, modes=modes)
    encoder = step_encoder.StepEncoder(frame_id)
    encoder.encode(step(k=0, points=points, modes=modes, seed=5))  # the templates hold another step's numbers
    message = by_topic(encoder.encode(out))[topic]
    expected = reference.step(out)[topic]
    ros_type = topics.TOPIC[topic].ros_type
    assert message.data == bytes(STORE.serialize_cdr(expected, ros_type))
    assert bytes(STORE.serialize_cdr(STORE.deserialize_cdr(message.data, ros_type), ros_type)) == message.data


def test_every_output_topic_is_encoded(step):
    messages = step_encoder.StepEncoder().encode(step(k=0), list)
    assert {message.topic for message in messages} == {topic.name for topic in topics.OUTPUTS}
    assert messages[-1].topic == topics.VALID
    stamps = {message.topic: message.stamp_ns for message in messages}
    out = step(k=0)
    assert stamps.pop(topics.INNOVATION) == out.innovations[0].stamp_ns
    assert set(stamps.values()) == {out.stamp_ns}


def test_header_stamp_is_the_stamp_of_the_entry(step):
    for message in step_encoder.StepEncoder().encode(step(k=0), list):
        if topics.TOPIC[message.topic].has_header:
            assert cdr.decode_stamp(message.data) == message.stamp_ns


def test_display_backbone_every_eleventh_step(step):
    encoder = step_encoder.StepEncoder()
    ks = [k for k in range(45) if topics.BACKBONE in by_topic(encoder.encode(step(k=k, points=3)))]
    assert ks == [0, 11, 22, 33, 44]


def test_invalid_step_publishes_valid_false_and_the_reason(step, innovation):
    out = step(valid=False, reason="joint gap of 2.1 s, limit 0.1 s")
    out.tip_position[:] = np.nan
    encoder = step_encoder.StepEncoder(hardware_id="robot")
    messages = by_topic(encoder.encode(out, list))
    assert set(messages) == {topics.VALID, topics.DIAGNOSTICS, topics.INNOVATION}
    assert messages[topics.VALID].data == b"\x00\x01\x00\x00\x00"
    diagnostics = STORE.deserialize_cdr(
        messages[topics.DIAGNOSTICS].data, "diagnostic_msgs/msg/DiagnosticArray"
    )
    assert diagnostics.status[0].level == ERROR
    assert diagnostics.status[0].message == "joint gap of 2.1 s, limit 0.1 s"
    assert diagnostics.status[0].hardware_id == "robot"


def test_diagnostics_once_a_second_and_at_changes_of_validity_or_alarm(step):
    encoder = step_encoder.StepEncoder()
    due = []
    for k in range(700):
        out = step(k=k, points=2, valid=not 100 <= k < 103, reason="x")
        if topics.DIAGNOSTICS in by_topic(encoder.encode(out, list, alarm=400 <= k < 500)):
            due.append(k)
    assert due == [0, 100, 103, 333, 400, 500, 666]


def test_the_status_of_the_output_is_that_of_its_own_step(step):
    """The estimator may be steps ahead of what is encoded, as where a replay takes several at once."""
    health = Health(problem="", steps=40)
    out = step(k=7, points=2, valid=False, reason="joint states are missing")
    data = step_encoder.StepEncoder().diagnostics(out, all_statuses(health))
    found = STORE.deserialize_cdr(data, "diagnostic_msgs/msg/DiagnosticArray").status
    named = [status for status in found if status.name.endswith("output")]
    assert [status.message for status in named] == ["joint states are missing"]
    assert found[0] is named[0]
    assert len(found) == len(all_statuses(health))


def test_diagnostics_bytes(reference):
    statuses = [
        SimpleNamespace(name="solver", level=0, message="ok", values={"iterations": "5", "sweeps": "9"}),
        SimpleNamespace(name="tracker", level=2, message="gap of 2.1 s, limit 0.5 s", values={}),
        SimpleNamespace(name="joints", level=1, message="", values={"késs": "µ"}),
    ]
    data = encode.encode_diagnostics(1_700_000_000_123_456_789, statuses, "till2020_tissue")
    expected = reference.diagnostics(1_700_000_000_123_456_789, statuses, "till2020_tissue")
    assert data == bytes(STORE.serialize_cdr(expected, "diagnostic_msgs/msg/DiagnosticArray"))


@pytest.mark.parametrize(
    ("path", "topic"),
    [
        ("tip_position", topics.TIP_POSE),
        ("tip_quaternion_wxyz", topics.TIP_POSE),
        ("tip_covariance", topics.TIP_POSE),
        ("tip_velocity", topics.TIP_TWIST),
        ("tip_velocity_covariance", topics.TIP_TWIST),
        ("predicted_position", topics.TIP_POSE_PREDICTED),
        ("predicted_quaternion_wxyz", topics.TIP_POSE_PREDICTED),
        ("backbone", topics.BACKBONE_STATE),
        ("disturbance_force", topics.DISTURBANCE),
        ("disturbance_sigma", topics.DISTURBANCE_SIGMA),
        ("modes.rate", topics.MODES),
        ("modes.damping", topics.MODES),
        ("jacobian", topics.TIP_JACOBIAN),
    ],
)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_valid_step_never_carries_nan(step, path, topic, bad):
    out = step()
    *parents, name = path.split(".")
    holder = out
    for parent in parents:
        holder = getattr(holder, parent)
    getattr(holder, name).reshape(-1)[-1] = bad
    encoder = step_encoder.StepEncoder()
    with pytest.raises(NotFiniteError, match=topic):
        encoder.encode(out)
    # The encoder is usable afterwards: nothing of the bad step is left in its templates.
    assert encoder.encode(step()) == step_encoder.StepEncoder().encode(step())


def test_innovation_of_a_sample_with_nan_leaves_the_missing_numbers_out(step, innovation):
    item = innovation(
        np.random.default_rng(0),
        5,
        residual=np.full(6, np.nan),
        nis=np.nan,
        dof=0,
        accepted=False,
        reason="not finite: position.x",
    )
    message = step_encoder.StepEncoder().encode(step(innovations=[item]))[0]
    decoded = cdr.decode_joint_state(message.data)
    entries = dict(zip(decoded.names, decoded.positions, strict=True))
    assert not any(name.startswith("residual") for name in entries)
    assert entries["accepted"] == 0.0
    assert entries["reason.not_finite_position_x"] == 1.0
    assert np.all(np.isfinite(decoded.positions))


def test_negative_and_large_stamps(reference):
    for stamp_ns in (-1, 0, -1_500_000_000, (2**31 - 1) * 10**9 + 999_999_999):
        data = encode.encode_pose_stamped(stamp_ns, "ctr_base", (1, 2, 3), (0, 0, 0, 1))
        expected = reference.pose_stamped(stamp_ns, (1, 2, 3), (1, 0, 0, 0))
        assert data == bytes(STORE.serialize_cdr(expected, "geometry_msgs/msg/PoseStamped"))
        assert cdr.decode_pose_stamped(data).stamp_ns == stamp_ns


finite = st.floats(allow_nan=False, width=64)
names = st.text(st.characters(codec="utf-8", exclude_characters="\x00"), max_size=9)
stamps = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)


@settings(max_examples=60, deadline=None)
@given(stamp=stamps, labels=st.lists(names, max_size=6), numbers=st.lists(finite, max_size=6), frame=names)
def test_joint_state_against_rosbags(stamp, labels, numbers, frame):
    from_rosbags = STORE.types["sensor_msgs/msg/JointState"](
        STORE.types["std_msgs/msg/Header"](
            STORE.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9), frame
        ),
        labels,
        np.array(numbers, dtype=float),
        np.array([1.0, 2.0]),
        np.array([], dtype=float),
    )
    for little in (True, False):
        data = bytes(STORE.serialize_cdr(from_rosbags, "sensor_msgs/msg/JointState", little_endian=little))
        for _ in range(2):  # the second time by the remembered layout
            decoded = cdr.decode_joint_state(data)
            assert decoded == (stamp, frame, tuple(labels), tuple(numbers))
    if not frame:
        assert encode.encode_joint_state(stamp, labels, numbers, [1.0, 2.0]) == bytes(
            STORE.serialize_cdr(from_rosbags, "sensor_msgs/msg/JointState")
        )


@settings(max_examples=60, deadline=None)
@given(stamp=stamps, frame=names, v=st.lists(finite, min_size=7, max_size=7))
def test_pose_and_wrench_against_rosbags(stamp, frame, v):
    kinds = (
        ("geometry_msgs/msg/PoseStamped", cdr.decode_pose_stamped, encode.encode_pose_stamped, v[:3], v[3:]),
        (
            "geometry_msgs/msg/WrenchStamped",
            cdr.decode_wrench_stamped,
            encode.encode_wrench_stamped,
            v[:3],
            v[3:6],
        ),
    )
    for ros_type, decode, encoder, first, second in kinds:
        data = encoder(stamp, frame, first, second)
        message = STORE.deserialize_cdr(data, ros_type)
        for little in (True, False):
            again = bytes(STORE.serialize_cdr(message, ros_type, little_endian=little))
            assert decode(again) == (stamp, frame, tuple(first), tuple(second))
        assert data == bytes(STORE.serialize_cdr(message, ros_type))


def test_decoders_ignore_bytes_behind_the_message():
    """Fast DDS pads messages, and appends bytes to empty arrays."""
    data = encode.encode_joint_state(7, ["tube1_rotation"], [0.5])
    for padding in range(1, 9):
        assert cdr.decode_joint_state(data + bytes(padding)).positions == (0.5,)


@settings(max_examples=150, deadline=None)
@given(data=st.binary(max_size=120), at=st.integers(0, 200), cut=st.integers(0, 200))
def test_decoders_raise_only_cdr_errors(data, at, cut):
    good = encode.encode_joint_state(7, ["tube1_rotation", "tube1_translation"], [0.5, -0.1], [0.0, 0.0])
    mixed = (good[:at] + data + good[at:])[: max(cut, len(data))]
    for decode in (
        cdr.decode_joint_state,
        cdr.decode_pose_stamped,
        cdr.decode_wrench_stamped,
        cdr.decode_header,
    ):
        for sample in (data, mixed, cdr.ENCAPSULATION + data):
            try:
                decode(sample)
            except cdr.CdrError as error:
                assert "\n" not in str(error)


def test_other_encapsulations_are_named():
    data = b"\x00\x07" + encode.encode_joint_state(7, ["a"], [0.5])[2:]
    with pytest.raises(cdr.CdrError, match="0007"):
        cdr.decode_joint_state(data)


def test_impossible_lengths_are_rejected_at_once():
    huge = struct.pack("<I", 0xFFFFFFF0)
    with pytest.raises(cdr.CdrError, match="string of 4294967280"):
        cdr.decode_joint_state(cdr.ENCAPSULATION + bytes(8) + huge + bytes(20))
    with pytest.raises(cdr.CdrError, match="4294967280 names"):
        cdr.decode_joint_state(cdr.ENCAPSULATION + bytes(8) + b"\x01\0\0\0\0\0\0\0" + huge + bytes(20))


def test_schemas_are_those_of_the_bags():
    text, type_hash = schema("sensor_msgs/msg/JointState")
    assert text.startswith("std_msgs/Header header")
    assert "MSG: builtin_interfaces/Time" in text
    # The hash that ROS 2 itself computes for this type (rosbag2 metadata of any distribution).
    assert type_hash == "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
    with pytest.raises(KeyError):
        schema("std_msgs/msg/Nonsense")


def test_table_names_contract_topics_and_known_types():
    assert len({topic.name for topic in topics.TOPICS}) == len(topics.TOPICS)
    for topic in topics.TOPICS:
        assert leaf_fields(topic.ros_type)
        assert topic.qos.reliability == ("best_effort" if topic.direction == "in" else "reliable")
        assert topic.has_header == (leaf_fields(topic.ros_type)[0] == "header.stamp.sec")
    assert topics.BACKBONE_FIELDS == (
        "s",
        "x",
        "y",
        "z",
        "qx",
        "qy",
        "qz",
        "qw",
        "vx",
        "vy",
        "vz",
        "ux",
        "uy",
        "uz",
        "sd",
    )


@pytest.mark.ros
def test_rclpy_reads_every_output(step):
    pytest.importorskip("rclpy")
    import importlib

    from rclpy.serialization import deserialize_message

    for message in step_encoder.StepEncoder().encode(step(k=0), list):
        package, _, name = topics.TOPIC[message.topic].ros_type.split("/")
        kind = getattr(importlib.import_module(f"{package}.msg"), name)
        decoded = deserialize_message(message.data, kind)
        if topics.TOPIC[message.topic].has_header:
            assert decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec == message.stamp_ns
        if name == "PointCloud2":
            points = np.frombuffer(decoded.data, np.float32).reshape(-1, 15)
            assert np.array_equal(points, step(k=0).backbone)
