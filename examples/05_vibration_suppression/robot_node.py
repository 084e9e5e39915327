"""The simulated robot as a ROS node: subscribes to joint commands, publishes joints, tracker poses and loads; `simulated_robot.py` is the robot.

    python robot_node.py --ros-args -p seconds:=6.0 -p speed:=0.5 -p report:=truth.npz

With `speed` above 0 it publishes /clock and runs at that share of real time, so that nodes with use_sim_time follow on any
machine; with 0 its stamps are those of the system clock.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from pathlib import Path

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import CdrError, decode_joint_state, split_stamp
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.ros import qos
from ctr_dynamics.ros.node_runner import spin_until_stopped, stop_on_signals
from ctr_dynamics.ros.topic_names import NAMESPACE, message_class

sys.path.insert(0, str(Path(__file__).parent))
from simulated_robot import DT_NS, Hardware, SimulatedRobot

COMMANDS = "/ctr/joint_commands"
SIM_START_NS = 1_000_000_000_000
DEFAULTS = {
    "robot": "till2020_tissue",
    "seconds": 6.0,  # of the robot's time; then the node ends
    "speed": 0.0,  # share of real time; 0: system clock, no /clock
    "report": "",  # .npz for t, tip and delta; empty: none
    "outage_from_s": 0.0,  # no joints from here ..
    "outage_to_s": 0.0,  # .. to here
    "wait_s": 600.0,  # longest wait for the estimator
    "seed": 1,
}


class RobotNode(Node):
    """Node `/ctr/robot`."""

    def __init__(self) -> None:
        super().__init__("robot", namespace=NAMESPACE)
        self.values = {
            name: self.declare_parameter(name, default).value for name, default in DEFAULTS.items()
        }
        self._commands: deque[float] = deque()
        self._file = load_robot(self.values["robot"])
        profile = qos.profile("reliable", 50)
        self.outputs = {
            name: self.create_publisher(message_class(topics.TOPIC[name].ros_type), name, profile)
            for name in (topics.JOINT_STATES, topics.TRACKER_TIP, topics.TIP_LOAD)
        }
        self.clock_output = self.create_publisher(Clock, "/clock", qos.profile("reliable", 10))
        self.create_subscription(JointState, COMMANDS, self._command, qos.profile("reliable", 10), raw=True)

    def _command(self, data: bytes) -> None:
        try:
            message = decode_joint_state(data)
        except CdrError:
            return
        at = dict(zip(message.names, message.positions, strict=False))
        if "tube1_rotation" in at:
            self._commands.append(at["tube1_rotation"] - self._file.rest.alpha.value[0])

    def play(self, stop: threading.Event) -> None:
        """Run the robot until its time is over."""
        values = self.values
        deadline = time.monotonic() + values["wait_s"]
        while not stop.is_set() and not all(p.get_subscription_count() for p in self.outputs.values()):
            if time.monotonic() > deadline:
                raise TimeoutError("no estimator has subscribed to the joints")
            time.sleep(0.05)
        simulated = values["speed"] > 0
        plant = SimulatedRobot(
            self._file,
            SIM_START_NS if simulated else time.time_ns(),
            Hardware(joint_outage_s=(values["outage_from_s"], values["outage_to_s"])),
            int(values["seed"]),
        )
        if not simulated:
            plant.start_ns = time.time_ns()  # building the plant took its time
        begin, wall_per_step = time.monotonic(), DT_NS * 1e-9 / (values["speed"] or 1.0)
        step = 0
        while plant.t < values["seconds"] and not stop.is_set():
            wait = begin + step * wall_per_step - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            elif simulated and wait < -0.05:
                begin -= wait  # this machine is too slow: the robot's time goes slower, it never jumps
            while self._commands:
                plant.send(plant.t, self._commands.popleft())
            messages = plant.step()
            if simulated:
                clock = Clock()
                clock.clock.sec, clock.clock.nanosec = split_stamp(plant.start_ns + round(plant.t * 1e9))
                self.clock_output.publish(serialize_message(clock))
            for topic, data in messages:
                self.outputs[topic].publish(data)
            step += 1
            if values["report"] and step % 10 == 0:
                Path(f"{values['report']}.time").write_text(f"{plant.t:.3f}", encoding="utf-8")
        if values["report"]:
            truth = plant.truth
            np.savez(values["report"], t=truth.t, tip=truth.tip, delta=truth.delta)
        self.get_logger().info(f"{plant.t:.2f} s are over")


def main() -> int:
    with stop_on_signals() as stop:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = RobotNode()
        spinner = threading.Thread(target=spin_until_stopped, args=(node, stop), daemon=True)
        spinner.start()
        try:
            node.play(stop)
        finally:
            stop.set()
            spinner.join()
            node.destroy_node()
            rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
