"""Publishers that do not fit the inputs, named from the graph over DDS; and types of poses that do."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import CdrWriter
from ctr_dynamics.ros.listener import Listener

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


def test_a_tracker_of_another_type_is_read(start):
    """Its publisher has a participant of its own: DDS lets none have a topic in two types."""
    with start({"input_timeout_s": 4.0}) as live, Listener(live.domain, [], name="ndi") as other:
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
