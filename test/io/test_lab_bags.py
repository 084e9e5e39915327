"""A lab's own bags: whatever storage, topics, types, names, units and frames they have, the same inputs come out."""

from __future__ import annotations

import math
import sqlite3

import numpy as np
import pytest
import zstandard
from mcap.writer import Writer

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_info import inspect
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.inputs.input_mapping import InputMapping, parse_remap
from ctr_dynamics.io.inputs.joint_readings import JointConverter, JointReadings
from ctr_dynamics.io.messages.cdr import CdrWriter, JointStateIn
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped
from ctr_dynamics.io.messages.topics import JOINT_STATES, TRACKER_TIP
from ctr_dynamics.parameters import Settings, input_mapping, pose_frame

NAMES = ("tube1_rotation", "tube2_rotation", "tube1_translation", "tube2_translation")
START = 1_700_000_000_000_000_000
TYPES = {JOINT_STATES: "sensor_msgs/msg/JointState", TRACKER_TIP: "geometry_msgs/msg/PoseStamped"}
QUATERNION = (0.1, -0.2, 0.3, math.sqrt(1.0 - 0.14))


def stamp(k):
    return START + 10_000_000 * k


def values(k):
    """alpha (rad) and beta (m) of two tubes."""
    return (0.01 * k, 0.02 * k, -0.2 - 1e-4 * k, -0.1)


def position(k):
    return (0.01, 1e-4 * k, 0.1)


def joints(k, names=NAMES, given=values):
    return encode_joint_state(stamp(k), names, given(k))


def pose(k, frame="ctr_base"):
    return encode_pose_stamped(stamp(k), frame, position(k), QUATERNION)


def usual(count=20):
    """Topic, arrival and bytes of a plain bag."""
    for k in range(count):
        yield JOINT_STATES, stamp(k), joints(k)
        yield TRACKER_TIP, stamp(k), pose(k)


def write(path, messages, types=TYPES, encoding="cdr"):
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        channels = {
            topic: writer.register_channel(
                topic, encoding, writer.register_schema(name, "ros2msg", b"# none")
            )
            for topic, name in types.items()
        }
        for topic, log_ns, data in messages:
            writer.add_message(channels[topic], log_ns, data, log_ns)
        writer.finish()
    return path


@pytest.fixture
def plain(tmp_path):
    return [*open_bag(write(tmp_path / "plain.mcap", usual())).inputs()]


def inputs(path, remap=(), **parameters):
    settings = Settings({name.replace("__", "."): value for name, value in parameters.items()})
    return [*open_bag(path, input_mapping(settings, parse_remap(remap))).inputs()]


def same(found, expected):
    """The same values, joints by name; a product's rounding apart."""
    assert [(m.topic, m.log_ns, m.message.stamp_ns) for m in found] == [
        (m.topic, m.log_ns, m.message.stamp_ns) for m in expected
    ]
    for a, b in zip(found, expected, strict=True):
        if a.topic == JOINT_STATES:
            given = dict(zip(a.message.names, a.message.positions, strict=True))
            wanted = dict(zip(b.message.names, b.message.positions, strict=True))
            assert set(given) >= set(wanted)
            assert [given[name] for name in wanted] == pytest.approx([*wanted.values()], abs=1e-12)
        else:
            assert a.message.position == b.message.position
            assert np.allclose(a.message.quaternion_xyzw, b.message.quaternion_xyzw, atol=1e-12)


# Storage.


def write_sqlite(path, messages):
    database = sqlite3.connect(path)
    database.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
    )
    database.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
    )
    numbers = {}
    for topic, name in TYPES.items():
        numbers[topic] = len(numbers) + 1
        database.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr')", (numbers[topic], topic, name))
    for topic, log_ns, data in messages:
        database.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", (numbers[topic], log_ns, data)
        )
    database.commit()
    database.close()
    return path


def ros1(data, kind):
    """A message of ROS 2 in the wire format of ROS 1."""
    from ctr_dynamics.io.messages.schemas import typestore

    return bytes(typestore().cdr_to_ros1(data, kind))


def test_an_sqlite_bag(tmp_path, plain):
    same(inputs(write_sqlite(tmp_path / "a.db3", [*usual()][::-1])), plain)
    (tmp_path / "bad.db3").write_bytes((tmp_path / "a.db3").read_bytes()[:6000])
    with pytest.raises(InputError, match=r"bad\.db3: is no SQLite bag of ROS 2, or damaged"):
        open_bag(tmp_path / "bad.db3")


def test_a_file_compressed_as_a_whole(tmp_path, plain):
    content = write(tmp_path / "a.mcap", usual()).read_bytes()
    (tmp_path / "x.mcap.zstd").write_bytes(zstandard.compress(content))
    same(inputs(tmp_path / "x.mcap.zstd"), plain)


def test_messages_compressed_one_by_one(tmp_path, plain):
    packed = [(topic, log_ns, zstandard.compress(data)) for topic, log_ns, data in usual()]
    same(inputs(write(tmp_path / "a.mcap", packed)), plain)


def test_a_split_bag_without_metadata(tmp_path, plain):
    folder = tmp_path / "split"
    folder.mkdir()
    messages = [*usual()]
    for number in (0, 2, 10):  # in the order of numbers, not of names
        part = {0: messages[:12], 2: messages[12:30], 10: messages[30:]}[number]
        write(folder / f"trial_{number}.mcap", part)
    same(inputs(folder), plain)
    write(folder / "other_0.mcap", messages)
    with pytest.raises(InputError, match="holds 4 bags"):
        open_bag(folder)


def test_a_bag_of_ros_1(tmp_path, plain):
    from rosbags.rosbag1 import Writer as Ros1Writer

    from ctr_dynamics.io.messages.schemas import typestore

    with Ros1Writer(tmp_path / "a.bag") as writer:
        connections = {
            topic: writer.add_connection(topic, name, typestore=typestore()) for topic, name in TYPES.items()
        }
        for topic, log_ns, data in usual():
            writer.write(connections[topic], log_ns, ros1(data, TYPES[topic]))
    same(inputs(tmp_path / "a.bag"), plain)
    # what `mcap convert` makes of it
    kept = [(topic, log_ns, ros1(data, TYPES[topic])) for topic, log_ns, data in usual()]
    names = {topic: name.replace("/msg/", "/") for topic, name in TYPES.items()}
    same(inputs(write(tmp_path / "a.mcap", kept, names, "ros1")), plain)


# Topics.


def test_topics_with_other_names(tmp_path, plain):
    names = {JOINT_STATES: "/robot/joints", TRACKER_TIP: "/aurora/pose"}
    types = {names[topic]: kind for topic, kind in TYPES.items()}
    path = write(tmp_path / "a.mcap", ((names[t], log, data) for t, log, data in usual()), types)
    remap = ["/robot/joints:=/ctr/joint_states", "/aurora/pose:=/ctr/tracker/tip"]
    same(inputs(path, remap), plain)
    with pytest.raises(InputError) as error:
        open_bag(path).check_inputs()
    assert all(f"--remap {option}" in str(error.value) for option in remap)  # the advice is what works
    with pytest.raises(InputError, match=r"no topic /nothing to remap; the bag holds /aurora/pose"):
        inputs(path, ["/nothing:=/ctr/joint_states"])


def test_a_remapped_topic_takes_the_place_of_the_bags_own(tmp_path):
    types = {**TYPES, "/other": TYPES[TRACKER_TIP]}
    messages = [
        *usual(),
        *(
            ("/other", stamp(k), encode_pose_stamped(stamp(k), "", (9.0, 0, 0), QUATERNION))
            for k in range(20)
        ),
    ]
    found = inputs(write(tmp_path / "a.mcap", messages, types), ["/other:=/ctr/tracker/tip"])
    assert {m.message.position[0] for m in found if m.topic == TRACKER_TIP} == {9.0}


@pytest.mark.parametrize("text", ["/a", "/a:=/ctr/nothing", ":=/ctr/joint_states", "/a:="])
def test_a_remap_that_means_nothing(text):
    with pytest.raises(InputError):
        parse_remap([text])
    with pytest.raises(InputError, match="twice"):
        parse_remap(["/a:=/ctr/tracker/tip", "/b:=/ctr/tracker/tip"])


# Types.


def transform(k, *children):
    """TransformStamped without children's count, or a TFMessage of several."""
    writer = CdrWriter()
    if len(children) > 1:
        writer.uint32(len(children))
    for child in children:
        at = position(k) if child == "coil" else (5.0, 5.0, 5.0)
        writer.header(stamp(k), "ctr_base")
        writer.string(child)
        writer.float64s([*at, *QUATERNION])
    return writer.done()


def with_poses(tmp_path, make, kind, topic=TRACKER_TIP):
    messages = (
        (topic, log, make(k // 2)) if t == TRACKER_TIP else (t, log, data)
        for k, (t, log, data) in enumerate(usual())
    )
    return write(tmp_path / "poses.mcap", messages, {JOINT_STATES: TYPES[JOINT_STATES], topic: kind})


@pytest.mark.parametrize(
    ("kind", "make"),
    [
        ("geometry_msgs/msg/PoseWithCovarianceStamped", lambda k: pose(k) + bytes(288)),
        ("geometry_msgs/msg/TransformStamped", lambda k: transform(k, "coil")),
        ("nav_msgs/msg/Odometry", lambda k: transform(k, "coil") + bytes(8 * 36 + 8 * 42)),
    ],
)
def test_types_of_poses(tmp_path, plain, kind, make):
    same(inputs(with_poses(tmp_path, make, kind)), plain)


def test_a_child_frame_of_several(tmp_path, plain):
    def make(k):
        return transform(k, "camera", "coil")

    path = with_poses(tmp_path, make, "tf2_msgs/msg/TFMessage", "/tf")
    same(inputs(path, tracker__child_frame_id="coil"), plain)
    same(inputs(path, ["/tf:=/ctr/tracker/tip"], tracker__child_frame_id="/coil"), plain)
    with pytest.raises(InputError, match=r"child frames camera, coil.*tracker\.child_frame_id=NAME"):
        inputs(path, ["/tf:=/ctr/tracker/tip"])
    with pytest.raises(InputError, match=r"no child frame 'tip', but camera, coil"):
        inputs(path, tracker__child_frame_id="tip")


def test_child_frames_are_listed_before_anybody_knows_them(tmp_path):
    path = with_poses(tmp_path, lambda k: transform(k, "camera", "coil"), "tf2_msgs/msg/TFMessage", "/tf")
    report = inspect(path)
    parents_and_children = next(t for t in report.topics if t.name == "/tf").frames
    assert [name.split(" > ")[1] for name in parents_and_children] == ["camera", "coil"]
    advice = next(p.text for p in report.problems if p.topic == "/ctr/tracker/tip")
    assert "--set tracker.child_frame_id=NAME" in advice
    assert "--remap" not in advice


def test_a_type_that_is_no_pose_is_named_with_what_to_do(tmp_path):
    path = with_poses(tmp_path, pose, "sensor_msgs/msg/Image")
    with pytest.raises(
        InputError, match=r"/ctr/tracker/tip has type 'sensor_msgs/msg/Image', geometry_msgs/msg/PoseStamped"
    ):
        open_bag(path).check_inputs()


def test_of_two_types_on_a_topic_the_usual_one_counts(tmp_path):
    path = write(tmp_path / "a.mcap", usual())
    with (tmp_path / "b.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for kind, make in (
            ("geometry_msgs/msg/TransformStamped", lambda k: transform(k, "coil")),
            (TYPES[TRACKER_TIP], pose),
        ):
            channel = writer.register_channel(
                TRACKER_TIP, "cdr", writer.register_schema(kind, "ros2msg", b"#")
            )
            for k in range(10):
                writer.add_message(channel, stamp(k), make(k), stamp(k))
        writer.finish()
    bag = open_bag(tmp_path / "b.mcap")
    assert len([*bag.inputs()]) == 10
    assert any("TransformStamped are left out" in note for note in bag.notes)
    assert open_bag(path).topics[TRACKER_TIP].messages == 20


# Joints.


@pytest.mark.parametrize(
    "names",
    [
        [f"robot1/{name}" for name in NAMES],
        ["tube0_rotation", "tube1_rotation", "tube0_translation", "tube1_translation"],
    ],
)
def test_prefixes_and_tubes_from_zero(tmp_path, plain, names):
    messages = (
        (t, log, joints(i // 2, names) if t == JOINT_STATES else data)
        for i, (t, log, data) in enumerate(usual())
    )
    same(inputs(write(tmp_path / "a.mcap", messages)), plain)


def with_joints(tmp_path, make):
    messages = (
        (t, log, make(i // 2) if t == JOINT_STATES else data) for i, (t, log, data) in enumerate(usual())
    )
    return write(tmp_path / "joints.mcap", messages)


def test_declared_names_scales_and_offsets(tmp_path, plain):
    def given(k):
        a1, a2, b1, b2 = values(k)
        return (math.degrees(a1 - 0.3), math.degrees(a2 + a1 - 0.4), 1e3 * (0.05 - b1), 1e3 * (0.02 - b2))

    path = with_joints(tmp_path, lambda k: joints(k, ("m1", "m2", "s1", "s2"), given))
    degree = math.radians(1.0)
    same(
        inputs(
            path,
            joints__rotation_names="m1,m2",
            joints__translation_names=["s1", "s2"],
            joints__rotation_scale=[
                degree,
                0.0,
                -degree,
                degree,
            ],  # the outer angle is relative to the inner one
            joints__rotation_offset_rad=[0.3, 0.1],
            joints__translation_scale=-1e-3,
            joints__translation_offset_m=[0.05, 0.02],
        ),
        plain,
    )
    with pytest.raises(InputError, match=r"rotation_names has 1 names and joints\.translation_names 2"):
        inputs(path, joints__rotation_names="m1", joints__translation_names="s1,s2")
    with pytest.raises(InputError, match=r"joints\.rotation_scale: has 3 numbers for 2 tubes"):
        inputs(
            path,
            joints__rotation_names="m1,m2",
            joints__translation_names="s1,s2",
            joints__rotation_scale="1,2,3",
        )


def test_an_array_of_numbers(tmp_path, plain):
    """Its time is that of its arrival."""

    def make(k):
        writer = CdrWriter()
        writer.uint32(0)
        writer.uint32(0)
        writer.float64_sequence(values(k))
        return writer.done()

    path = tmp_path / "a.mcap"
    messages = (
        (t, log, make(i // 2) if t == JOINT_STATES else data) for i, (t, log, data) in enumerate(usual())
    )
    write(path, messages, {**TYPES, JOINT_STATES: "std_msgs/msg/Float64MultiArray"})
    same(inputs(path, joints__rotation_names="0,1", joints__translation_names="2,3"), plain)


def test_joint_states_in_two_messages_of_a_stamp(tmp_path, plain):
    def parts(k):
        v = values(k)
        yield JOINT_STATES, stamp(k), encode_joint_state(stamp(k), NAMES[2:], v[2:])
        yield JOINT_STATES, stamp(k), encode_joint_state(stamp(k), NAMES[:2], v[:2])
        yield TRACKER_TIP, stamp(k), pose(k)

    path = write(tmp_path / "a.mcap", [m for k in range(20) for m in parts(k)])
    same(inputs(path), plain)
    assert not any("joint" in p.topic and p.level != "note" for p in inspect(path).problems)


def test_joints_that_never_come_are_named(tmp_path):
    path = with_joints(tmp_path, lambda k: encode_joint_state(stamp(k), NAMES[:3], values(k)[:3]))
    found = [m.message.names for m in inputs(path) if m.topic == JOINT_STATES]
    assert set(found) == {NAMES[:3]}
    assert any("missing joints: tube2_translation" in p.text for p in inspect(path).problems)


# Poses.


def test_the_frame_of_the_poses(tmp_path):
    path = with_poses(tmp_path, lambda k: pose(k, "aurora"), TYPES[TRACKER_TIP])
    wrong = [p.text for p in inspect(path).problems if p.level == "error"]
    assert any("set tracker.frame_id=aurora" in text for text in wrong)
    frame = pose_frame(Settings({"tracker.frame_id": "aurora"}))
    assert not any(p.level == "error" for p in inspect(path, pose_frame=frame).problems)


def test_mount_and_arrival(tmp_path):
    """A sensor turned by 90 deg about the tip's x axis, read at its arrival."""
    half = math.sqrt(0.5)
    path = with_poses(
        tmp_path,
        lambda k: encode_pose_stamped(stamp(k) - 7, "", position(k), (half, 0.0, 0.0, half)),
        TYPES[TRACKER_TIP],
    )
    found = inputs(path, tracker__mount_rotation_rad=[math.pi / 2, 0.0, 0.0], tracker__stamps="arrival")
    for item in (m for m in found if m.topic == TRACKER_TIP):
        assert item.message.stamp_ns == item.log_ns
        assert np.allclose(item.message.quaternion_xyzw, (0.0, 0.0, 0.0, 1.0))


def test_standard_messages_are_those_of_the_bag_or_the_same_in_the_usual_types(tmp_path):
    bag = open_bag(write(tmp_path / "a.mcap", usual()))
    assert [*bag.standard_messages()] == [*bag.messages()]
    path = with_poses(tmp_path, lambda k: transform(k, "coil"), "geometry_msgs/msg/TransformStamped")
    given = [m.data for m in open_bag(path, InputMapping()).standard_messages() if m.topic == TRACKER_TIP]
    assert given == [pose(k) for k in range(20)]


def test_a_bag_of_more_tubes_than_the_robot_has_is_said():
    names = tuple(f"tube{i}_{kind}" for i in (1, 2, 3) for kind in ("rotation", "translation"))
    whole = JointStateIn(1, "", names, tuple(float(i) for i in range(6)))
    for n, said in ((2, True), (3, False), (0, False)):
        converter = JointConverter(JointReadings(), n)
        assert converter.convert(whole)
        assert ("3 tubes, the robot has 2" in converter.surplus) is said
        assert ([converter.surplus] == converter.notes) is said
