"""Publishers that do not fit the inputs, named from the graph over DDS; types of poses that do; and what goes out of a step that grows old."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import NamedTuple

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseStamped, TransformStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import CdrWriter
from ctr_dynamics.io.messages.encode import Encoded
from ctr_dynamics.ros.listener import Listener
from ctr_dynamics.ros.publishers import Outputs
from ctr_dynamics.ros.topic_names import node_topic

pytestmark = pytest.mark.ros


def test_who_publishes_what_is_named(start):
    with start() as live:
        node = live.listener.node
        live.wait_for_status("publishers", 1, "nobody publishes /ctr/joint_states")
        elsewhere = node.create_publisher(JointState, "/robot1/joint_states", 1)
        live.wait_for_status("publishers", 1, "-r /ctr/joint_states:=/robot1/joint_states")
        node.destroy_publisher(elsewhere)

        words = node.create_publisher(String, topics.TRACKER_TIP, 1)
        status = live.wait_for_status("publishers", 2, "std_msgs/msg/String by /ctr/listener")
        assert status.message.startswith("/ctr/tracker/tip is published as")
        node.destroy_publisher(words)

        live.resting_robot()
        live.wait_for_status("publishers", 0)
        second = node.create_publisher(JointState, topics.JOINT_STATES, 1)
        live.wait_for_status("publishers", 1, "/ctr/joint_states has 2 publishers, /ctr/listener")
        node.destroy_publisher(second)
        live.wait_for_status("publishers", 0)


def test_a_tracker_of_another_type_is_read_and_recorded(start, tmp_path):
    """Its publisher has a participant of its own: DDS lets none have a topic in two types."""
    path = tmp_path / "live.mcap"
    with (
        start({"input_timeout_s": 4.0, "record.path": str(path)}) as live,
        Listener(live.domain, [], name="ndi") as other,
    ):
        robot = live.resting_robot()
        live.listener.node.destroy_publisher(robot.publishers.pop(topics.TRACKER_TIP))
        publisher = other.node.create_publisher(TransformStamped, topics.TRACKER_TIP, 10)

        def send(stamp_ns, position, quaternion, frame="ctr_base"):
            writer = CdrWriter()
            writer.header(stamp_ns, frame)
            writer.string("coil")
            writer.float64s([*position, *quaternion])
            publisher.publish(writer.done())

        robot.tracker = send
        live.wait(publisher.get_subscription_count, "a subscription of that type")
        before = live.count(topics.INNOVATION)
        live.wait(lambda: live.count(topics.INNOVATION) > before + 5, "poses that are taken")
        last = live.messages(topics.INNOVATION)[-1]
        assert dict(zip(last.name, last.position, strict=True))["accepted"] == 1.0
        robot.stop()  # its thread publishes by the other participant, which ends first
    bag = open_bag(path)
    assert bag.topics[topics.TRACKER_TIP].messages > 5
    recorded = [item.message for item in bag.inputs() if item.topic == topics.TRACKER_TIP]
    assert all(math.hypot(*pose.position) < 0.5 for pose in recorded), "read as they were received"


def test_a_second_estimator_of_the_same_name_is_noticed(start):
    """And in a namespace the node does not take its own outputs for inputs."""
    with start(ros_arguments=["-r", "__ns:=/arm1"], heard=[topics.DIAGNOSTICS]) as live:
        node = live.listener.node
        status = live.wait_for_status("publishers", 1, "nobody publishes /arm1/joint_states")
        assert "it may be" not in status.message
        assert status.hardware_id == "till2020_tissue (/arm1/estimator)"
        other = node.create_publisher(PoseStamped, "/arm1/estimator/tip_pose_predicted", 1)
        status = live.wait_for_status("publishers", 1, "/arm1/estimator/tip_pose_predicted has 2 publishers")
        live.wait(lambda: "has 2 publishers" in live.process.output(), "a line in the log")
        node.destroy_publisher(other)
        live.wait_for_status("publishers", 1, "nobody publishes /arm1/tracker/tip")


class Step(NamedTuple):
    stamp_ns: int = 1
    valid: bool = True
    reason: str = ""


@pytest.mark.parametrize("sent", range(4))
def test_of_a_step_that_grows_old_while_it_is_sent_nothing_more_goes_out_but_that_it_is_invalid(sent):
    """A process that is held up between two messages: the encoder comes first, then pose, twist and validity."""
    out = []
    known_as = {node_topic(topic.name): topic.name for topic in topics.OUTPUTS}

    def publisher(kind, name, profile, event_callbacks):
        return SimpleNamespace(publish=lambda data: out.append((known_as[name], data)))

    def encode(step):
        names = (topics.TIP_POSE, topics.TIP_TWIST) * step.valid
        return [Encoded(name, 1, b"") for name in names] + [Encoded(topics.VALID, 1, step.valid)]

    outputs = Outputs(
        SimpleNamespace(create_publisher=publisher),
        None,
        SimpleNamespace(publisher=lambda topic: None),
        SimpleNamespace(encode=encode),
    )
    asked = []

    def by_now(step):
        asked.append(step)
        return step if len(asked) <= 1 + sent else step._replace(valid=False, reason="old")

    assert outputs.step(Step(), by_now)
    names = [topics.TIP_POSE, topics.TIP_TWIST, topics.VALID][: min(sent, 3)]
    assert [name for name, _ in out] == names + [topics.VALID] * (sent < 3)
    assert out[-1][1] == outputs.valid == (sent == 3)
    assert outputs.reason == ("" if sent == 3 else "old")
    assert not outputs.step(Step(), by_now)
