"""Transforms over DDS: in for poses in another frame, out the frames of the robot."""

from __future__ import annotations

import importlib.util
import os

import pytest

pytest.importorskip("rclpy")

from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import CdrWriter
from ctr_dynamics.io.messages.input_types import child_frames
from ctr_dynamics.ros import qos, transform_topics
from ctr_dynamics.ros.topic_names import message_class

pytestmark = pytest.mark.ros
ORIGIN = (0.1, -0.2, 0.3)  # of the tracker's frame in ctr_base; its axes are the same
TF_TYPE = topics.TOPIC[topics.TF].ros_type
STAND_IN = '''"""Stands in for a package that is not on PyPI. Nodes and test send and receive bytes, and DDS compares names of types only."""
from nav_msgs.msg import Path as TFMessage
'''


@pytest.fixture
def tf2_msgs(tmp_path, monkeypatch):
    """That package, for this process and its children; its own where there is one."""
    if importlib.util.find_spec("tf2_msgs") is None:
        package = tmp_path / "path" / "tf2_msgs" / "msg"
        package.mkdir(parents=True)
        (package.parent / "__init__.py").touch()
        (package / "__init__.py").write_text(STAND_IN)
        monkeypatch.syspath_prepend(str(tmp_path / "path"))
        monkeypatch.setenv(
            "PYTHONPATH", os.pathsep.join([str(tmp_path / "path"), os.environ.get("PYTHONPATH", "")])
        )


def static_transform():
    writer = CdrWriter()
    writer.uint32(1)
    writer.header(0, "ctr_base")
    writer.string("aurora")
    writer.float64s([*ORIGIN, 0.0, 0.0, 0.0, 1.0])
    return writer.done()


def accepted(live):
    return sum(
        dict(zip(m.name, m.position, strict=True))["accepted"] == 1.0
        for m in live.messages(topics.INNOVATION)
    )


def test_frames_in_and_out(tf2_msgs, start):
    heard = [*(topic.name for topic in topics.OUTPUTS), topics.TF]
    parameters = {"output.publish_tf": True, "input_timeout_s": 4.0}
    with start(parameters, heard=heard) as live:
        robot = live.resting_robot()
        send = robot.tracker

        def in_its_own_frame(stamp_ns, position, quaternion, frame="aurora"):
            send(stamp_ns, [p - o for p, o in zip(position, ORIGIN, strict=True)], quaternion, frame)

        robot.tracker = in_its_own_frame
        live.wait_for_status("tracker", text="pose in frame 'aurora', expected 'ctr_base'")
        assert accepted(live) == 0

        publisher = live.listener.node.create_publisher(
            message_class(TF_TYPE), topics.TF_STATIC, qos.profile("reliable", 1, "transient_local")
        )
        publisher.publish(static_transform())
        live.wait(lambda: accepted(live) > 5, "poses that are fused")
        # what is known of frames outlives an estimator
        assert live.set_parameter("tracker.delay_s", 0.001).successful
        before = accepted(live)
        live.wait(lambda: accepted(live) > before + 5, "poses that are fused by the new estimator")

        live.wait_for_more(topics.TF, 3)
        frames = child_frames(TF_TYPE, "cdr", live.listener.received[topics.TF][-1].data)
        assert [(name, pose.frame_id) for name, pose in frames] == [
            ("ctr_tube1_tip", "ctr_base"),
            ("ctr_tube2_tip", "ctr_base"),
        ]
        assert frames[0][1].stamp_ns in live.stamps(topics.TIP_POSE)


def test_without_tf2_msgs_the_wish_for_frames_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(transform_topics, "available", lambda: False)
    assert transform_topics.subscribe(None, None) == []
    with pytest.raises(Exception, match="tf2_msgs is not installed"):
        transform_topics.publisher(None, object())
    assert transform_topics.publisher(None, None) is None
