"""Names and types of topics as the nodes open them, and what tells two nodes apart."""

from __future__ import annotations

import importlib
from typing import Any

NAMESPACE = "/ctr"
NAME = "estimator"


def message_class(ros_type: str) -> Any:
    """Class of a message type such as ``sensor_msgs/msg/JointState``."""
    package, kind, name = ros_type.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def node_topic(topic: str) -> str:
    """The name a node in `NAMESPACE` gives a topic of the table: relative, so that remapping works."""
    own, common = f"{NAMESPACE}/{NAME}/", f"{NAMESPACE}/"
    if topic.startswith(own):
        return "~/" + topic.removeprefix(own)
    return topic.removeprefix(common) if topic.startswith(common) else topic


def hardware_id(robot: str, node: str) -> str:
    """What the diagnostics are about: the ``robot``, with the fully qualified name of its ``node`` where that is not the usual one."""
    return robot if node == f"{NAMESPACE}/{NAME}" else f"{robot} ({node})"
