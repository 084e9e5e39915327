"""Transforms in the nodes. `tf2_msgs` comes with every ROS 2, but is not on PyPI: without it there are none."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.messages import topics
from ctr_dynamics.ros import qos
from ctr_dynamics.ros.topic_names import message_class
from ctr_dynamics.runtime.transform_encoder import TransformEncoder

OUT_DEPTH = 100  # as other publishers of /tf have it


def available() -> bool:
    """Whether messages with transforms can be sent and received."""
    return importlib.util.find_spec("tf2_msgs") is not None


def subscribe(node: Node, arrived: Callable[[topics.Topic], Callable[[bytes], None]]) -> list[Any]:
    """Subscriptions to the transforms that others publish, none without `tf2_msgs`.

    Args:
        arrived: makes the callback of a topic.
    """
    if not available():
        return []
    return [
        node.create_subscription(
            message_class(topic.ros_type),
            topic.name,
            arrived(topic),
            qos.profile(topic.qos.reliability, topic.qos.depth, topic.qos.durability),
            raw=True,
        )
        for topic in topics.TRANSFORM_TOPICS
    ]


def publisher(node: Node, encoder: TransformEncoder | None) -> Publisher[Any] | None:
    """Publisher for the messages of ``encoder``; None where there is none.

    Raises:
        InputError: `tf2_msgs` is missing.
    """
    if encoder is None:
        return None
    if not available():
        raise InputError(
            "output.publish_tf is true, and the package tf2_msgs is not installed",
            do="source a ROS 2 installation, or leave output.publish_tf false",
        )
    kind = message_class(topics.TOPIC[topics.TF].ros_type)
    return node.create_publisher(kind, topics.TF, qos.profile("reliable", OUT_DEPTH))
