"""A driver that plays a bag as live topics, its stamps moved to now by one constant shift."""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.exceptions import ParameterException
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.atomic_files import atomic_file, check_targets
from ctr_dynamics.io.bag_path import locate
from ctr_dynamics.io.bag_reader import RawMessage
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import CdrError, split_stamp
from ctr_dynamics.ros import qos
from ctr_dynamics.ros.node_runner import RCLError, Stopped, exit_at_once, run_in_thread, stop_on_signals
from ctr_dynamics.ros.parameter_declaration import TableNode, declare_table
from ctr_dynamics.ros.topic_names import NAMESPACE, message_class, node_topic
from ctr_dynamics.runtime.node_parameters import DRIVER
from ctr_dynamics.runtime.playback import load, pace, shifted

LEAD_NS = 500_000_000
"""From the match of the topics, as the publishers see it, to the first message: on a busy machine subscribers see it that much later."""


class DriverNode(TableNode):
    """Node `/ctr/driver`: publishes a bag's inputs in real time.

    Raises:
        InputError: a parameter cannot be used.
        Stopped: `stop` was set before the bag was read.
    """

    def __init__(self, stop: threading.Event) -> None:
        super().__init__("driver", NAMESPACE)
        self.values = declare_table(self, DRIVER)
        values = self.values
        if not values["bag"]:
            raise InputError("no bag is given", do="set the parameter bag, e.g. -p bag:=FILE.mcap")
        bag = Path(values["bag"])
        check_targets({"report": values["report"]}, {f"bag {file.name}": file for file in locate(bag).files})
        self.messages = run_in_thread(lambda: load(bag, values["start_s"], values["duration_s"]), stop)
        profile = qos.profile(values["reliability"], values["depth"])
        present = {message.topic for message in self.messages}
        self.outputs: dict[str, Publisher[Any]] = {
            topic.name: self.create_publisher(message_class(topic.ros_type), node_topic(topic.name), profile)
            for topic in topics.INPUTS
            if topic.name in present
        }
        self.clock_output = (
            self.create_publisher(Clock, "/clock", qos.profile("best_effort", 1))
            if values["clock_hz"] > 0
            else None
        )

    def wait_for_subscribers(self, stop: threading.Event) -> None:
        """Wait until every topic has a subscriber.

        Raises:
            InputError: the joint states found none in time.
        """
        deadline = time.monotonic() + self.values["wait_s"]
        while not stop.is_set() and not all(p.get_subscription_count() for p in self.outputs.values()):
            if time.monotonic() > deadline:
                if self.outputs[topics.JOINT_STATES].get_subscription_count():
                    self.get_logger().warning("not every topic has found a subscriber; playing all the same")
                    return
                raise InputError(
                    f"no subscriber of {topics.JOINT_STATES} within {self.values['wait_s']:g} s",
                    do="start the estimator, check ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE",
                )
            time.sleep(0.02)

    def play(self, stop: threading.Event) -> dict[str, Any]:
        """Publish everything at its time; returns what was played, times in ns."""
        first_ns = self.messages[0].log_ns
        start_ns = time.time_ns() + LEAD_NS
        shift_ns = 0 if self.clock_output is not None else start_ns - first_ns
        items = self._with_clock(first_ns)
        published, left_out, worst_ns = 0, 0, 0
        for index, late_ns in pace([m.log_ns for m in items], start_ns, stop.is_set, time.time_ns):
            message = items[index]
            worst_ns = max(worst_ns, late_ns)
            if message.topic:
                try:
                    data = shifted(message.data, shift_ns)
                except CdrError:
                    left_out += 1
                    continue
                self.outputs[message.topic].publish(data)
                published += 1
            elif self.clock_output is not None:
                self.clock_output.publish(message.data)
        for publisher in self.outputs.values():
            publisher.wait_for_all_acked(Duration(seconds=1))
        return {
            "bag": str(self.values["bag"]),
            "shift_ns": shift_ns,
            "first_log_time_ns": first_ns,
            "messages": published,
            "left_out": left_out,
            "of": len(self.messages),
            "max_lateness_ns": worst_ns,
        }

    def _with_clock(self, first_ns: int) -> list[RawMessage]:
        """The messages, with clock messages (no topic) among them if they are asked for."""
        if self.clock_output is None:
            return self.messages
        period_ns = round(1e9 / self.values["clock_hz"])
        ticks = []
        for moment in range(first_ns, self.messages[-1].log_ns + 1_000_000_000, period_ns):
            clock = Clock()
            clock.clock.sec, clock.clock.nanosec = split_stamp(moment)
            ticks.append(RawMessage("", moment, serialize_message(clock)))
        return sorted([*self.messages, *ticks], key=lambda m: (m.log_ns, m.topic))


def main(args: list[str] | None = None) -> int:
    """Play a bag; returns 0 at its end or after SIGINT or SIGTERM, 2 when it cannot be played."""
    with stop_on_signals() as stop:
        try:
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
            node = DriverNode(stop)
            node.get_logger().info(f"playing {node.values['bag']} once the estimator listens")
            node.wait_for_subscribers(stop)
            report = node.play(stop)
            node.get_logger().info(
                f"published {report['messages']} of {report['of']} messages, "
                f"at most {report['max_lateness_ns'] * 1e-6:.2f} ms late"
            )
            if report["left_out"]:
                node.get_logger().warning(f"{report['left_out']} messages have no usable stamp: left out")
            if node.values["report"]:
                with atomic_file(Path(node.values["report"])) as part:
                    part.write_text(json.dumps(report), encoding="utf-8")
            node.destroy_node()
        except Stopped:
            exit_at_once()
        except (InputError, ParameterException, RCLError) as error:
            print(f"driver: {' '.join(str(error).split())}", file=sys.stderr)
            return 2
        finally:
            rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
