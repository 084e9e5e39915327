"""Subscriptions to the inputs, in the types in which they are published, and what the graph of topics says about their publishers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from ctr_dynamics.estimation.step_output import OK, Status
from ctr_dynamics.io.messages import topics
from ctr_dynamics.ros.node_runner import RCLError
from ctr_dynamics.ros.topic_names import message_class, node_topic
from ctr_dynamics.runtime.input_publishers import Endpoint, publishers_status, shared_outputs, wanted_type

PERIOD_S = 1.0
SHARED = (topics.DIAGNOSTICS, *topics.TRANSFORMS)  # which any number of nodes publish
_NAMELESS = "_NODE_NAME_UNKNOWN_"


class InputSubscriptions:
    """Listens to the inputs while it is open, and looks at the graph every second.

    A topic cannot be subscribed to in two types at once. Where its own is not published and another that can be read is, the subscription has that
    type.

    Args:
        node: the estimator's.
        subscribe: makes the subscription to a topic with its type.
    """

    def __init__(self, node: Node, subscribe: Callable[[topics.Topic], Any]) -> None:
        self._node, self._subscribe = node, subscribe
        self.names = {topic.name: node.resolve_topic_name(node_topic(topic.name)) for topic in topics.INPUTS}
        self._outputs = [
            node.resolve_topic_name(node_topic(topic.name))
            for topic in topics.OUTPUTS
            if topic.name not in SHARED
        ]
        self._told = ""
        self._types = {topic.name: topic.ros_type for topic in topics.INPUTS}
        self._subscriptions = {topic.name: subscribe(topic) for topic in topics.INPUTS}
        self.status = Status("publishers", OK, "the graph has not been looked at yet", {})
        # not the node's clock, which stands still without /clock
        self._timer = node.create_timer(PERIOD_S, self.look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def look(self) -> None:
        """Look at the graph, and follow the types in which the inputs are published."""
        publishers = {topic: self._publishers(name) for topic, name in self.names.items()}
        for topic, found in publishers.items():
            kind = wanted_type(topic, found)
            if topic not in self._subscriptions:
                self._subscribe_as(topic, kind)
            elif found and kind != self._types[topic] and self._known(topic, kind):
                # the executor lets go of it later, and DDS knows the topic in its old type until then
                self._node.destroy_subscription(self._subscriptions.pop(topic))
        needed = any(not found for topic, found in publishers.items() if topic != topics.TIP_LOAD)
        others = dict(self._node.get_topic_names_and_types()) if needed else {}
        outputs = {
            name: self._publishers(name) for name in self._outputs if self._node.count_publishers(name) > 1
        }
        self.status = publishers_status(publishers, self.names, others, outputs)
        self._tell(shared_outputs(outputs))

    def _tell(self, text: str) -> None:
        """Log that others publish the outputs, once each time it begins."""
        if text and not self._told:
            self._node.get_logger().warning(text)
        self._told = text

    def _publishers(self, name: str) -> list[Endpoint]:
        return [
            Endpoint(
                "a node without a name yet"
                if info.node_name == _NAMELESS
                else f"{info.node_namespace.rstrip('/')}/{info.node_name}",
                info.topic_type,
            )
            for info in self._node.get_publishers_info_by_topic(name)
        ]

    def _known(self, topic: str, kind: str) -> bool:
        """Whether messages of that type can be received."""
        try:
            message_class(kind)
        except ImportError as error:
            self._node.get_logger().error(f"{self.names[topic]} is published as {kind}: {error}", once=True)
            return False
        return True

    def _subscribe_as(self, topic: str, kind: str) -> None:
        try:
            self._subscriptions[topic] = self._subscribe(replace(topics.TOPIC[topic], ros_type=kind))
        except RCLError:  # DDS still knows the topic in another type: at the next look
            return
        self._types[topic] = kind
        self._node.get_logger().info(f"{self.names[topic]} is published as {kind} and read so")

    def close(self) -> None:
        """Listen no longer."""
        self._node.destroy_timer(self._timer)
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
