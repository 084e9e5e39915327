"""The controller as a ROS node: estimator's modes in, joint commands out; `damper.py` is the control law.

    python controller_node.py --ros-args -p damping:=0.12 -p use_sim_time:=true

A command goes out on /ctr/joint_commands at `rate_hz`, always: while the estimator is invalid or silent it decays to the rest angles.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import CdrError, decode_joint_state
from ctr_dynamics.io.messages.encode import encode_joint_state
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.ros import qos
from ctr_dynamics.ros.node_runner import spin_until_stopped, stop_on_signals
from ctr_dynamics.ros.topic_names import NAMESPACE, message_class

sys.path.insert(0, str(Path(__file__).parent))
from damper import DriveHistory, Estimate, Limits, ModalDamper, Tuning

COMMANDS = "/ctr/joint_commands"
DEFAULTS = {
    "robot": "till2020_tissue",
    "rate_hz": 100.0,  # of the commands
    "mode": 1,  # which of the published modes; 1 is the slowest
    "enabled": True,  # false: sends the rest angles all the time
    "damping": Tuning.damping,
    "latency_s": Tuning.latency_s,
    "stale_s": Tuning.stale_s,
    "max_angle_rad": Limits.angle,
    "max_rate_rad_s": Limits.rate,
    "max_acceleration_rad_s2": Limits.acceleration,
}


class ControllerNode(Node):
    """Node `/ctr/controller`."""

    def __init__(self) -> None:
        super().__init__("controller", namespace=NAMESPACE)
        values = {name: self.declare_parameter(name, default).value for name, default in DEFAULTS.items()}
        self.values = values
        robot = load_robot(values["robot"])
        self._rest = np.array([robot.rest.alpha.value, robot.rest.beta.value])
        self._tubes = robot.n_tubes
        self._turned: np.ndarray | None = (
            None  # (3,) m/rad: motion of the static tip when all tubes turn together
        )
        self._mode = int(values["mode"]) - 1
        self._damper = ModalDamper(
            robot.tubes[0].length,  # no tip moves farther; each estimate brings its own authority
            1.0 / values["rate_hz"],
            Tuning(damping=values["damping"], latency_s=values["latency_s"], stale_s=values["stale_s"]),
            Limits(values["max_angle_rad"], values["max_rate_rad_s"], values["max_acceleration_rad_s2"]),
        )
        self._drives = DriveHistory()
        self._rate_covariance: np.ndarray | None = None  # (3, 3) of the tip's velocity
        self.rejected = {"no mode": 0, "no joints": 0, "invalid": 0}
        profile = qos.profile("reliable", 10)
        self._output = self.create_publisher(JointState, COMMANDS, profile)
        twist = message_class(topics.TOPIC[topics.TIP_TWIST].ros_type)
        self._inputs: list[Any] = [
            self.create_subscription(
                JointState, topics.JOINT_STATES, self._joints, qos.profile("best_effort", 50), raw=True
            ),
            self.create_subscription(twist, topics.TIP_TWIST, self._twist, profile),
            self.create_subscription(JointState, topics.TIP_JACOBIAN, self._jacobian, profile, raw=True),
            self.create_subscription(JointState, topics.MODES, self._modes, profile, raw=True),
            self.create_subscription(Bool, topics.VALID, self._valid, profile),
        ]
        self._timer = self.create_timer(1.0 / values["rate_hz"], self._tick)
        self.get_logger().info(f"damping mode {self._mode + 1} by turning all tubes")

    @property
    def counts(self) -> dict[str, int]:
        """Commands by what was known when they were sent."""
        return self._damper.counts

    def _joints(self, data: bytes) -> None:
        try:
            message = decode_joint_state(data)
        except CdrError:
            return
        at = dict(zip(message.names, message.positions, strict=False))
        if "tube1_rotation" in at:
            self._drives.add(message.stamp_ns * 1e-9, at["tube1_rotation"] - float(self._rest[0, 0]))

    def _twist(self, message: Any) -> None:
        """Covariance of the tip's velocity; it comes before the modes of the same step."""
        self._rate_covariance = np.reshape(message.twist.covariance, (6, 6))[:3, :3]

    def _jacobian(self, data: bytes) -> None:
        """The tip's Jacobian, row by row: x, y and z by the rotations of all tubes, and more. It changes by little from step to step."""
        message = decode_joint_state(data)
        rows = np.reshape(message.positions, (6, -1))
        self._turned = rows[:3, : self._tubes].sum(axis=1)

    def _modes(self, data: bytes) -> None:
        message = decode_modes(data)
        if message is None:
            self._reject("no mode")
            return
        t, count, position, velocity, direction = message
        drive = self._drives.at(t)
        if self._mode >= count or self._rate_covariance is None or self._turned is None:
            self._reject("no mode")
            return
        if drive is None:
            self._reject("no joints")
            return
        m = self._mode
        along = direction[m]
        self._damper.take(
            Estimate(
                t,
                position[m],
                velocity[m],
                2 * math.pi * position[count + m],
                position[2 * count + m],
                math.sqrt(max(float(along @ self._rate_covariance @ along), 0.0)),
                *drive,
                authority=float(along @ self._turned),
            )
        )

    def _valid(self, message: Bool) -> None:
        if not message.data:
            self._reject("invalid")

    def _reject(self, why: str) -> None:
        self.rejected[why] += 1
        self._damper.invalid()

    def _tick(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        delta = self._damper.command(now_ns * 1e-9)
        if not self.values["enabled"]:
            delta = 0.0
        n = self._rest.shape[1]
        names = [f"tube{i}_{kind}" for kind in ("rotation", "translation") for i in range(1, n + 1)]
        positions = [*(self._rest[0] + delta).tolist(), *self._rest[1].tolist()]
        self._output.publish(encode_joint_state(now_ns, names, positions))


def decode_modes(data: bytes) -> tuple[float, int, list[float], list[float], np.ndarray] | None:
    """Stamp (s), number of modes, position, velocity and directions (m, 3) of a modes message; None when it is not one."""
    from rclpy.serialization import deserialize_message

    message = deserialize_message(data, JointState)
    count, rest = divmod(len(message.name), 3)
    if rest or not len(message.position) == len(message.effort) == 3 * count or len(message.velocity) < count:
        return None
    stamp, direction = message.header.stamp, np.reshape(message.effort, (3, count)).T
    return stamp.sec + 1e-9 * stamp.nanosec, count, list(message.position), list(message.velocity), direction


def main() -> int:
    with stop_on_signals() as stop:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = ControllerNode()
        try:
            spin_until_stopped(node, stop)
        finally:
            node.get_logger().info(f"commands: {node.counts}; estimates rejected: {node.rejected}")
            node.destroy_node()
            rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
