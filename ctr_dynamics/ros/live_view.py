"""Subscribes to every topic of the table over DDS and passes the bytes on."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from types import TracebackType

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ctr_dynamics.io.messages import topics
from ctr_dynamics.ros import qos
from ctr_dynamics.ros.node_runner import make_executor, serve_callbacks
from ctr_dynamics.ros.topic_names import NAMESPACE, message_class


class LiveTopics:
    """A node that listens while the context manager is open.

    Args:
        put: called with topic, time of arrival (ns) and bytes.
    """

    def __init__(self, put: Callable[[str, int, bytes], None]) -> None:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = Node(
            "foxglove", namespace=NAMESPACE, context=self._context, start_parameter_services=False
        )
        self._executor = make_executor(self._context)
        self._executor.add_node(self._node)
        for topic in topics.TOPICS:
            self._node.create_subscription(
                message_class(topic.ros_type),
                topic.name,
                self._heard(topic.name, put),
                qos.profile("best_effort", 50),
                raw=True,
            )
        self._thread = threading.Thread(target=self._spin, name="view", daemon=True)

    @staticmethod
    def _heard(name: str, put: Callable[[str, int, bytes], None]) -> Callable[[bytes], None]:
        return lambda data: put(name, time.time_ns(), data)

    def _spin(self) -> None:
        try:
            while self._context.ok():
                serve_callbacks(self._executor)
        except ExternalShutdownException:
            pass

    def __enter__(self) -> LiveTopics:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._context.try_shutdown()
        self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
