"""Subscribes to the estimator's topics over DDS and keeps every message as it came."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ctr_dynamics.io.messages import topics
from ctr_dynamics.ros import qos
from ctr_dynamics.ros.node_runner import make_executor, serve_callbacks
from ctr_dynamics.ros.topic_names import NAMESPACE, message_class
from ctr_dynamics.runtime.live_report import Received


class Listener:
    """A node of its own context, spinning in a thread while the context manager is open.

    Args:
        domain_id: ROS domain.
        names: topics of the table to listen to.
        reliability, depth: quality of service that is requested.
        name: of the node.
    """

    def __init__(
        self,
        domain_id: int,
        names: Iterable[str],
        reliability: str = "reliable",
        depth: int = 1000,
        name: str = "listener",
    ) -> None:
        self.received: dict[str, list[Received]] = defaultdict(list)
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain_id, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node(name, namespace=NAMESPACE, context=self.context, start_parameter_services=False)
        self._executor = make_executor(self.context)
        self._executor.add_node(self.node)
        profile = qos.profile(reliability, depth)
        self.subscriptions = {
            topic: self.node.create_subscription(
                message_class(topics.TOPIC[topic].ros_type), topic, self._keep(topic), profile, raw=True
            )
            for topic in names
        }
        self._thread = threading.Thread(target=self._spin, name="listener", daemon=True)

    def _keep(self, topic: str) -> Callable[[Any], None]:
        messages = self.received[topic]

        def keep(data: bytes) -> None:
            messages.append(Received(time.time_ns(), data))

        return keep

    def _spin(self) -> None:
        try:
            while self.context.ok():
                serve_callbacks(self._executor)
        except ExternalShutdownException:
            pass

    def matched(self) -> bool:
        """Whether every topic has a publisher."""
        return all(subscription.get_publisher_count() for subscription in self.subscriptions.values())

    def count(self, topic: str) -> int:
        return len(self.received[topic])

    def wait_for(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until `condition` holds; False when it does not in time."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.01)
        return True

    def __enter__(self) -> Listener:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.context.try_shutdown()
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
