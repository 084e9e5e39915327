"""Frames that the estimator publishes: tube ends and the registration."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ctr_dynamics import replay
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages import cdr, topics
from ctr_dynamics.io.messages.input_types import child_frames
from ctr_dynamics.io.messages.schemas import schema, typestore
from ctr_dynamics.io.shipped_bags import shipped_bag
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.transform_encoder import TransformEncoder, tip_frame, transform_encoder

TF_TYPE = topics.TOPIC[topics.TF].ros_type


@pytest.fixture
def robot():
    return load_robot("till2020_tissue")


def a_step(robot):
    """Rows every 1 mm and at the end of tube 2; the position is (s, 2 s, 3 s)."""
    beta = robot.rest.beta.value
    ends = [b + length for b, length in zip(beta, robot.lengths, strict=True)]
    s = np.unique([*np.arange(0.0, ends[0], 1e-3), *ends])
    rows = np.zeros((len(s), 15), np.float32)
    rows[:, 0] = s
    rows[:, 1:4] = np.outer(s, (1.0, 2.0, 3.0))
    rows[:, 4:8] = (0.5, -0.5, 0.5, 0.5)
    tip = {"tip_position": np.array([1.0, 2.0, 3.0]), "tip_quaternion_wxyz": np.array([0.1, 0.2, 0.3, 0.9])}
    return ends, SimpleNamespace(stamp_ns=1_700_000_000_000_000_123, k=0, backbone=rows, beta=beta, **tip)


@pytest.mark.parametrize(
    ("frame", "name"),
    [
        ("ctr_base", "ctr_tube2_tip"),
        ("left/base", "left/tube2_tip"),
        ("base", "base_tube2_tip"),
        ("plate", "plate_tube2_tip"),
    ],
)
def test_names_of_frames(frame, name):
    assert tip_frame(frame, 2) == name


def test_every_tube_ends_where_the_backbone_says(robot):
    ends, out = a_step(robot)
    message = TransformEncoder(Settings({}), robot).encode(out)
    assert message[:2] == (topics.TF, out.stamp_ns)
    (first, inner), (second, outer) = child_frames(TF_TYPE, "cdr", message.data)
    assert (first, second) == ("ctr_tube1_tip", "ctr_tube2_tip")
    assert inner == cdr.PoseIn(out.stamp_ns, "ctr_base", (1.0, 2.0, 3.0), (0.2, 0.3, 0.9, 0.1))
    assert outer.position == pytest.approx(np.multiply(ends[1], (1.0, 2.0, 3.0)), rel=1e-6)
    assert outer.quaternion_xyzw == (0.5, -0.5, 0.5, 0.5)


def test_the_registration_is_a_frame_where_the_tracker_has_its_own(robot):
    _, out = a_step(robot)
    settings = Settings(
        {
            "tracker.frame_id": "aurora",
            "tracker.registration_translation_m": [0.1, 0.2, 0.3],
            "tracker.registration_rotation_rad": [0.0, 0.0, np.pi / 2],
        }
    )
    name, base = child_frames(TF_TYPE, "cdr", TransformEncoder(settings, robot).encode(out).data)[-1]
    assert (name, base.frame_id) == ("ctr_base", "aurora")
    assert base.position == pytest.approx((0.1, 0.2, 0.3))
    assert base.quaternion_xyzw == pytest.approx((0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))


def test_the_bytes_are_those_of_other_programs(robot):
    _, out = a_step(robot)
    data = TransformEncoder(Settings({"tracker.frame_id": "aurora"}), robot).encode(out).data
    store = typestore()
    assert bytes(store.serialize_cdr(store.deserialize_cdr(data, TF_TYPE), TF_TYPE)) == data
    assert "TransformStamped[] transforms" in schema(TF_TYPE).text


def test_a_replay_writes_frames_where_they_are_wanted(robot, tmp_path):
    assert transform_encoder(Settings({}), robot) is None
    output = tmp_path / "out.mcap"
    settings = {
        "output.publish_tf": True,
        "output.backbone_every": 50,
        "model.nodes": 12,
        "filter.enabled": False,
    }
    replay(shipped_bag(), robot, settings, output)
    bag = open_bag(output)
    assert bag.topics[topics.TF].ros_type == TF_TYPE
    tips = {m.log_ns: cdr.decode_numbers(m.data, 7)[2] for m in bag.messages({topics.TIP_POSE})}
    count = 0
    for message in bag.messages({topics.TF}):
        (_, inner), (_, outer) = child_frames(TF_TYPE, "cdr", message.data)
        fused = tips[message.log_ns]
        assert np.allclose(inner.position, fused[:3], atol=1e-12)
        # the outer tube ends between plate and tip
        assert 0.0 < outer.position[2] < inner.position[2]
        count += 1
    assert count == bag.topics[topics.BACKBONE].messages
    assert count > 20
