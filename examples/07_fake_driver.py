"""Drives that are not there: commanded positions in, joint states out, as a ros2_control system with mock hardware has them.

Node `/ctr/fake_driver` takes `/ctr/joint_commands` (JointState with names and positions of some or all joints), moves towards them no faster than
the drives could, and publishes `/ctr/joint_states`. A driver of real motors has the same topics: put the reading of encoders and the writing of
setpoints where `Drives.move` is. Start the estimator beside it:

    python examples/07_fake_driver.py --ros-args -p robot:=till2020_tissue
    python -m ctr_dynamics.ros.estimator_node --ros-args -p robot:=till2020_tissue
    ros2 topic pub -1 /ctr/joint_commands sensor_msgs/msg/JointState '{name: [tube1_rotation], position: [3.0]}'
"""

from __future__ import annotations

import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState

from ctr_dynamics.robot import Robot
from ctr_dynamics.robot_files import load_robot


class Drives:
    """Positions of all joints, in SI units.

    Args:
        robot: where it rests, and how far its tubes go.
        rotation_speed: rad/s. translation_speed: m/s.
    """

    def __init__(self, robot: Robot, rotation_speed: float, translation_speed: float) -> None:
        self.robot = robot
        self.position = {
            f"tube{i + 1}_{kind}": value
            for i, pair in enumerate(zip(robot.rest.alpha.value, robot.rest.beta.value, strict=True))
            for kind, value in zip(("rotation", "translation"), pair, strict=True)
        }
        self.goal = dict(self.position)
        self._speed = {
            name: rotation_speed if name.endswith("rotation") else translation_speed for name in self.position
        }

    def command(self, names: list[str], positions: list[float]) -> str:
        """Take new goals; returns why they are rejected, or nothing."""
        goal = {**self.goal, **dict(zip(names, positions, strict=False))}
        unknown = set(goal) - set(self.position)
        if unknown or len(names) != len(positions):
            return (
                f"unknown joints {', '.join(sorted(unknown))}"
                if unknown
                else "names and positions differ in number"
            )
        tubes = range(1, self.robot.n_tubes + 1)
        alpha, beta = ([goal[f"tube{i}_{kind}"] for i in tubes] for kind in ("rotation", "translation"))
        problem = self.robot.actuator_problem(beta, alpha)
        if problem is None:
            self.goal = goal
        return problem or ""

    def move(self, seconds: float) -> None:
        """Go on towards the goals for that time."""
        for name, goal in self.goal.items():
            step = self._speed[name] * seconds
            self.position[name] += min(max(goal - self.position[name], -step), step)


class FakeDriver(Node):
    """Node `/ctr/fake_driver`; parameters robot, rate_hz, rotation_speed (rad/s), translation_speed (m/s)."""

    def __init__(self) -> None:
        super().__init__("fake_driver", namespace="/ctr")
        values = {
            name: self.declare_parameter(name, default).value
            for name, default in {
                "robot": "till2020_tissue",
                "rate_hz": 100.0,
                "rotation_speed": 1.0,
                "translation_speed": 0.02,
            }.items()
        }
        self.drives = Drives(
            load_robot(values["robot"]), values["rotation_speed"], values["translation_speed"]
        )
        self._output = self.create_publisher(JointState, "joint_states", 10)
        self._input = self.create_subscription(JointState, "joint_commands", self._command, 10)
        self._last_ns = self.get_clock().now().nanoseconds
        self._timer = self.create_timer(1.0 / values["rate_hz"], self._tick)

    def _command(self, message: JointState) -> None:
        rejection = self.drives.command(list(message.name), list(message.position))
        if rejection:
            self.get_logger().error(f"command rejected: {rejection}")

    def _tick(self) -> None:
        now = self.get_clock().now()
        self.drives.move(1e-9 * (now.nanoseconds - self._last_ns))
        self._last_ns = now.nanoseconds
        message = JointState(name=list(self.drives.position), position=list(self.drives.position.values()))
        message.header.stamp = now.to_msg()  # the time at which the encoders were read
        self._output.publish(message)


def main() -> int:
    """Run until Ctrl-C."""
    rclpy.init()
    node = FakeDriver()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
