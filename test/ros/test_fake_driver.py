"""The example of a driver: commands in, joint states out, and the estimator follows."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import JointState

from ctr_dynamics.io.messages import topics
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.ros.node_processes import NodeProcess

SCRIPT = Path(__file__).parents[2] / "examples" / "07_fake_driver.py"
pytestmark = pytest.mark.ros


@pytest.fixture
def drives():
    spec = importlib.util.spec_from_file_location("fake_driver", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Drives(load_robot("till2020_tissue"), rotation_speed=2.0, translation_speed=0.01)


def test_drives_go_no_faster_than_they_can_and_stop_at_the_goal(drives):
    before = dict(drives.position)
    assert drives.command(["tube1_rotation"], [before["tube1_rotation"] - 1.0]) == ""
    drives.move(0.25)
    assert drives.position["tube1_rotation"] == pytest.approx(before["tube1_rotation"] - 0.5)
    drives.move(10.0)
    assert drives.position == {**before, "tube1_rotation": pytest.approx(before["tube1_rotation"] - 1.0)}


def test_a_command_that_no_robot_can_follow_is_rejected(drives):
    goal = dict(drives.goal)
    assert "above 0 m" in drives.command(["tube1_translation", "tube2_translation"], [0.1, 0.1])
    assert "unknown joints elbow" in drives.command(["elbow"], [0.0])
    assert "number" in drives.command(["tube1_rotation"], [])
    assert drives.goal == goal


def test_the_estimator_follows_commands(start, tmp_path):
    parameters = {"rotation_speed": 5.0}
    with (
        start({"input_timeout_s": 4.0, "filter.enabled": False}) as live,
        NodeProcess(str(SCRIPT), parameters, live.domain, tmp_path / "driver.log") as driver,
    ):
        live.wait_for_more(topics.TIP_POSE_PREDICTED, 5)
        node = live.listener.node
        heard = []
        node.create_subscription(JointState, topics.JOINT_STATES, heard.append, 10)
        publisher = node.create_publisher(JointState, "/ctr/joint_commands", 1)
        live.wait(publisher.get_subscription_count, "the driver")
        live.wait(lambda: heard, "joint states")
        start_angle = dict(zip(heard[-1].name, heard[-1].position, strict=True))["tube1_rotation"]
        x0 = live.messages(topics.TIP_POSE_PREDICTED)[-1].pose.position.x
        names = [name for name in heard[-1].name if name.endswith("rotation")]
        publisher.publish(JointState(name=names, position=[start_angle + 1.0] * len(names)))
        live.wait(
            lambda: heard[-1].position[list(heard[-1].name).index("tube1_rotation")] > start_angle + 0.999,
            "the goal",
        )
        # tubes that turn together by 1 rad swing the tip to the side
        live.wait(
            lambda: abs(live.messages(topics.TIP_POSE_PREDICTED)[-1].pose.position.x - x0) > 5e-3, "the tip"
        )
        assert driver.code is None, driver.output()
