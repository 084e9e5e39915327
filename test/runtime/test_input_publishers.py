"""What is said about the publishers of the inputs."""

from __future__ import annotations

import pytest

from ctr_dynamics.estimation.step_output import ERROR, OK, WARN
from ctr_dynamics.io.messages.input_types import TYPES
from ctr_dynamics.io.messages.topics import (
    BACKBONE_STATE,
    JOINT_STATES,
    MODES,
    TIP_LOAD,
    TIP_POSE,
    TRACKER_TIP,
)
from ctr_dynamics.runtime.input_publishers import Endpoint, publishers_status, wanted_type

JOINT_STATE, POSE = TYPES[JOINT_STATES][0], TYPES[TRACKER_TIP][0]
TRANSFORM = "geometry_msgs/msg/TransformStamped"
NAMES = {name: name for name in (JOINT_STATES, TRACKER_TIP, TIP_LOAD)}
GOOD = {JOINT_STATES: [Endpoint("/drives", JOINT_STATE)], TRACKER_TIP: [Endpoint("/ndi", POSE)], TIP_LOAD: []}


def status(others=(), **changes):
    publishers = {**GOOD, **{{"joints": JOINT_STATES, "tip": TRACKER_TIP}[k]: v for k, v in changes.items()}}
    return publishers_status(publishers, NAMES, dict(others))


def test_one_publisher_each_is_well_and_a_load_is_optional():
    found = status()
    assert found.level == OK
    assert found.values[TRACKER_TIP] == "/ndi (geometry_msgs/msg/PoseStamped)"
    assert found.values[TIP_LOAD] == "nobody"


def test_another_type_is_named_with_its_publisher():
    found = status(tip=[Endpoint("/camera", "sensor_msgs/msg/Image")])
    assert found.level == ERROR
    assert found.message.startswith(
        f"{TRACKER_TIP} is published as sensor_msgs/msg/Image by /camera, expected {POSE} or"
    )


def test_several_publishers_are_named():
    found = status(joints=[Endpoint("/drives", JOINT_STATE), Endpoint("/gui", JOINT_STATE)])
    assert found.level == WARN
    assert f"2 publishers, /drives ({JOINT_STATE}), /gui ({JOINT_STATE}): stop all but one" in found.message


def test_nobody_and_who_it_may_be():
    others = {
        MODES: [JOINT_STATE],  # the node's own output is none
        BACKBONE_STATE: ["sensor_msgs/msg/PointCloud2"],
        "/a/readings": [JOINT_STATE],
        "/robot1/joint_states": [JOINT_STATE],
        "/image": ["sensor_msgs/msg/Image"],
    }
    found = status(others.items(), joints=[])
    assert found.level == WARN
    assert f"nobody publishes {JOINT_STATES}" in found.message
    assert "it may be /robot1/joint_states (sensor_msgs/msg/JointState), /a/readings" in found.message
    assert "-r /ctr/joint_states:=/robot1/joint_states" in found.message
    assert MODES not in found.message
    assert "may be" not in status(joints=[]).message


@pytest.mark.parametrize(
    ("kinds", "wanted"),
    [
        ([], POSE),
        ([POSE], POSE),
        ([TRANSFORM], TRANSFORM),
        ([TRANSFORM, POSE], POSE),
        (["sensor_msgs/msg/Image"], POSE),
    ],
)
def test_the_type_to_read(kinds, wanted):
    assert wanted_type(TRACKER_TIP, [Endpoint("/x", kind) for kind in kinds]) == wanted


def test_outputs_of_any_estimator_are_no_inputs():
    others = {
        "/arm1/left/tip_pose": ["geometry_msgs/msg/PoseWithCovarianceStamped"],
        "/arm1/left/tip_pose_predicted": [POSE],
        "/arm1/left/backbone_state": ["sensor_msgs/msg/PointCloud2"],
    }
    assert "may be" not in status(others.items(), tip=[]).message
    others["/camera/tip_pose"] = [POSE]
    assert f"it may be /camera/tip_pose ({POSE}): start" in status(others.items(), tip=[]).message


def test_a_second_publisher_of_an_output_is_named():
    twice = [Endpoint("/ctr/estimator", POSE)] * 2
    found = publishers_status(GOOD, NAMES, {}, {TIP_POSE: twice, MODES: twice})
    assert found.level == WARN
    assert (
        f"{TIP_POSE} (and 1 further outputs) has 2 publishers, /ctr/estimator, /ctr/estimator, limit 1"
        in found.message
    )
    assert "-r __ns:=" in found.message
