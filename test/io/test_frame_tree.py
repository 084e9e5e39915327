"""Poses in other frames, brought into the tracker's by recorded transforms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctr_dynamics.io.bag_info import inspect
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.inputs.frame_tree import (
    FrameTree,
    NoTransform,
    NotYet,
    Transform,
    composed,
    inverse,
)
from ctr_dynamics.io.messages.cdr import CdrWriter, PoseIn
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped
from ctr_dynamics.io.messages.topics import JOINT_STATES, TF, TF_STATIC, TRACKER_TIP
from ctr_dynamics.parameters import Settings, input_mapping

MS = 1_000_000
START = 1_700_000_000_000_000_000
TF_TYPE = "tf2_msgs/msg/TFMessage"


def unit(values):
    return tuple((np.array(values) / np.linalg.norm(values)).tolist())


def turn_z(angle):
    return (0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2))


def matrix(transform):
    """4 x 4, by the textbook."""
    x, y, z, w = transform.quaternion_xyzw
    found = np.eye(4)
    found[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    found[:3, 3] = transform.position
    return found


def link(parent, transform, stamp_ns=START):
    return PoseIn(stamp_ns, parent, transform.position, transform.quaternion_xyzw)


numbers = st.floats(-2.0, 2.0)
transforms = st.builds(
    lambda p, q: Transform(tuple(p), unit(q)),
    st.tuples(numbers, numbers, numbers),
    st.tuples(numbers, numbers, numbers, numbers).filter(lambda q: sum(v * v for v in q) > 0.01),
)


@given(transforms, transforms, transforms)
def test_frames_are_joined_over_their_common_ancestor(a, b, c):
    # room -> plate -> ctr_base and room -> aurora: known to nobody is ctr_base -> aurora
    tree = FrameTree("ctr_base")
    tree.add(
        [("plate", link("room", a)), ("/ctr_base", link("/plate", b)), ("aurora", link("room", c))], True
    )
    expected = np.linalg.inv(matrix(a) @ matrix(b)) @ matrix(c)
    assert np.allclose(matrix(tree.lookup("aurora", "ctr_base", 0)), expected, atol=1e-9)
    assert np.allclose(matrix(tree.lookup("ctr_base", "aurora", 0)), np.linalg.inv(expected), atol=1e-9)
    assert np.allclose(
        matrix(tree.lookup("room", "ctr_base", 0)), np.linalg.inv(matrix(a) @ matrix(b)), atol=1e-9
    )
    assert np.allclose(matrix(composed(a, inverse(a))), np.eye(4), atol=1e-9)


def test_a_frame_that_nobody_connects():
    tree = FrameTree("ctr_base")
    tree.add([("aurora", link("room", Transform((0, 0, 0), turn_z(0))))], True)
    with pytest.raises(NoTransform, match="'aurora' and 'ctr_base'"):
        tree.lookup("aurora", "ctr_base", 0)
    pose = PoseIn(START, "aurora", (1.0, 0.0, 0.0), turn_z(0.1))
    assert tree.place(pose) == [pose]
    assert not tree.placed


def test_a_ring_of_frames_ends():
    tree = FrameTree("ctr_base")
    still = Transform((0, 0, 0), turn_z(0))
    tree.add([("a", link("b", still)), ("b", link("a", still)), ("c", link("c", still))], True)
    with pytest.raises(NoTransform):
        tree.lookup("a", "ctr_base", 0)


def test_what_is_no_pose_is_left_out():
    tree = FrameTree("ctr_base")
    tree.add([("aurora", link("ctr_base", Transform((0, 0, 0), (0.0, 0.0, 0.0, 0.0))))], True)
    tree.add([("aurora", link("ctr_base", Transform((math.nan, 0, 0), turn_z(0))))], True)
    with pytest.raises(NoTransform):
        tree.lookup("aurora", "ctr_base", 0)


def moving(k):
    """A cart that drives along x and turns: at k * 10 ms."""
    return Transform((0.01 * k, 0.0, 0.0), turn_z(0.02 * k))


def test_a_moving_frame_is_taken_between_its_stamps_and_waited_for():
    tree = FrameTree("ctr_base")
    tip = Transform((0.1, 0.0, 0.3), turn_z(0.4))

    def pose(at_ms):
        return PoseIn(START + at_ms * MS, "cart", tip.position, tip.quaternion_xyzw)

    tree.add([("cart", link("ctr_base", moving(0), START))], False)
    tree.add([("cart", link("ctr_base", moving(1), START + 10 * MS))], False)
    [placed] = tree.place(pose(5))
    assert (placed.frame_id, placed.stamp_ns) == ("ctr_base", START + 5 * MS)
    expected = matrix(Transform((0.005, 0.0, 0.0), turn_z(0.01))) @ matrix(tip)
    found = matrix(Transform(placed.position, placed.quaternion_xyzw))
    assert np.allclose(found, expected, atol=1e-9)

    assert tree.place(pose(12)) == []
    assert tree.place(pose(25)) == []
    with pytest.raises(NotYet):
        tree.lookup("cart", "ctr_base", START + 12 * MS)
    assert tree.released() == []
    tree.add([("cart", link("ctr_base", moving(2), START + 20 * MS))], False)
    assert [p.stamp_ns for p in tree.released()] == [START + 12 * MS]
    assert [(p.stamp_ns, p.frame_id) for p in tree.rest()] == [(START + 25 * MS, "cart")]
    assert tree.place(pose(-1)) == [pose(-1)]  # before the cart was known
    assert tree.placed == {"cart": 2}


def test_a_frame_that_is_published_again_and_again_and_stands_still_is_not_waited_for():
    tree = FrameTree("ctr_base")
    stand = Transform((1.0, 2.0, 3.0), turn_z(0.7))
    for k in range(3):
        tree.add([("camera", link("ctr_base", stand, START + k * 100 * MS))], False)
    for at_ms in (-500, 150, 5000):
        [placed] = tree.place(PoseIn(START + at_ms * MS, "camera", (0.0, 0.0, 0.0), turn_z(0.0)))
        assert placed.position == pytest.approx(stand.position)


def test_a_clock_that_is_set_back_begins_the_frame_anew():
    tree = FrameTree("ctr_base")
    for k in range(5):
        tree.add([("cart", link("ctr_base", moving(k), START + k * 10 * MS))], False)
    for k in range(3):
        tree.add([("cart", link("ctr_base", moving(k), 1000 + k * 10 * MS))], False)
    assert tree.lookup("cart", "ctr_base", 1000 + 10 * MS).position == pytest.approx(moving(1).position)


# In bags.

NAMES = ("tube1_rotation", "tube2_rotation", "tube1_translation", "tube2_translation")
TYPES = {
    JOINT_STATES: "sensor_msgs/msg/JointState",
    TRACKER_TIP: "geometry_msgs/msg/PoseStamped",
    TF: TF_TYPE,
    TF_STATIC: TF_TYPE,
}
STAND = Transform((0.3, -0.2, 1.1), unit((0.3, -0.5, 0.2, 0.7)))  # of the tracker in the room
BASE = Transform((-0.4, 0.1, 0.9), unit((-0.1, 0.2, 0.6, 0.5)))  # of the robot in the room
TIP = Transform((0.01, 0.02, 0.15), unit((0.1, 0.1, -0.2, 0.9)))


def tf_message(*items):
    """A TFMessage of (stamp, parent, child, transform)."""
    writer = CdrWriter()
    writer.uint32(len(items))
    for stamp_ns, parent, child, transform in items:
        writer.header(stamp_ns, parent)
        writer.string(child)
        writer.float64s([*transform.position, *transform.quaternion_xyzw])
    return writer.done()


def stamp(k):
    return START + k * 10 * MS


def seen(k, base):
    """The tip as the tracker sees it, with the robot's base there in the room."""
    return composed(inverse(STAND), composed(base, TIP))


def recorded(base_at, static):
    """A bag whose tracker reports in its own frame; the robot's base is at ``base_at(k)`` in the room, on /tf_static if that is ``static``."""
    messages = [(TF_STATIC, stamp(9), tf_message((0, "room", "aurora", STAND)))]  # late, as after a split
    if static:
        messages.append((TF_STATIC, stamp(9), tf_message((0, "room", "ctr_base", base_at(0)))))
    for k in range(20):
        tip = seen(k, base_at(k))
        messages.append((JOINT_STATES, stamp(k), encode_joint_state(stamp(k), NAMES, (0.0, 0.0, -0.2, -0.1))))
        messages.append(
            (
                TRACKER_TIP,
                stamp(k),
                encode_pose_stamped(stamp(k), "aurora", tip.position, tip.quaternion_xyzw),
            )
        )
        if not static:  # a little after the pose of that time has come
            messages.append((TF, stamp(k) + MS, tf_message((stamp(k), "room", "/ctr_base", base_at(k)))))
    return messages


def carried(k):
    return composed(BASE, moving(k))


def write(write_mcap, path, messages):
    return write_mcap(path, messages, {t: TYPES[t] for t in dict.fromkeys(m[0] for m in messages)})


@pytest.fixture
def write_mcap():
    from mcap.writer import Writer

    def make(path, messages, types):
        with path.open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile="ros2", library="test")
            channels = {
                topic: writer.register_channel(
                    topic, "cdr", writer.register_schema(kind, "ros2msg", b"# none")
                )
                for topic, kind in types.items()
            }
            for topic, log_ns, data in sorted(messages, key=lambda m: m[1]):
                writer.add_message(channels[topic], log_ns, data, log_ns)
            writer.finish()
        return path

    return make


def poses(bag):
    return [m.message for m in bag.inputs() if m.topic == TRACKER_TIP]


@pytest.mark.parametrize(
    ("base_at", "static"), [(lambda k: BASE, True), (lambda k: BASE, False), (carried, False)]
)
def test_a_bag_whose_tracker_has_its_own_frame(tmp_path, write_mcap, base_at, static):
    path = write(write_mcap, tmp_path / "a.mcap", recorded(base_at, static))
    bag = open_bag(path, input_mapping(Settings({})))
    found = poses(bag)
    assert [p.stamp_ns for p in found] == [stamp(k) for k in range(20)]
    lost = 0 if static else 1  # the first came before anything was known of its frame
    for pose in found[lost:]:
        assert pose.frame_id == "ctr_base"
        assert pose.position == pytest.approx(TIP.position, abs=1e-12)
        assert abs(np.dot(pose.quaternion_xyzw, TIP.quaternion_xyzw)) == pytest.approx(1.0, abs=1e-12)
    assert any(
        f"{20 - lost} poses in frame 'aurora' were brought into 'ctr_base'" in note for note in bag.notes
    )
    again = [m for m in bag.standard_messages() if m.topic == TRACKER_TIP]
    assert len(again) == 20
    report = inspect(path, input_mapping(Settings({})))
    assert any("brought into 'ctr_base'" in finding.text for finding in report.problems)


def test_the_frame_of_the_registration_is_left_alone(tmp_path, write_mcap):
    path = write(write_mcap, tmp_path / "a.mcap", recorded(lambda k: BASE, True))
    settings = Settings({"tracker.frame_id": "aurora"})
    found = poses(open_bag(path, input_mapping(settings)))
    assert {p.frame_id for p in found} == {"aurora"}
    assert found[0].position == pytest.approx(seen(0, BASE).position)
    # and it may itself be the frame that others are brought into
    settings = Settings({"tracker.frame_id": "room"})
    found = poses(open_bag(path, input_mapping(settings)))
    assert found[0].position == pytest.approx(composed(BASE, TIP).position)


def test_a_tracker_that_is_itself_a_transform(tmp_path, write_mcap):
    messages = [
        (topic, log_ns, data)
        for topic, log_ns, data in recorded(lambda k: BASE, True)
        if topic != TRACKER_TIP
    ]
    for k in range(20):
        messages.append(
            (TF, stamp(k), tf_message((stamp(k), "aurora", "coil", seen(k, BASE)), (stamp(k), "a", "b", TIP)))
        )
    path = write(write_mcap, tmp_path / "a.mcap", messages)
    settings = Settings({"tracker.child_frame_id": "coil"})
    found = poses(open_bag(path, input_mapping(settings)))
    assert len(found) == 20
    assert found[0].position == pytest.approx(TIP.position, abs=1e-12)


def test_without_a_transform_the_pose_keeps_its_frame(tmp_path, write_mcap):
    messages = [m for m in recorded(lambda k: BASE, True) if m[0] != TF_STATIC]
    path = write(write_mcap, tmp_path / "a.mcap", messages)
    bag = open_bag(path, input_mapping(Settings({})))
    assert {p.frame_id for p in poses(bag)} == {"aurora"}
    assert not any("brought" in note for note in bag.notes)
