"""Definitions of the standard message types, as bags embed them (`ros2msg` text and RIHS01 hash)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore


class Schema(NamedTuple):
    """Definition of a message type: its `ros2msg` text with all nested types, and its type hash."""

    text: str
    type_hash: str


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """The definitions used. All types of this package are the same from ROS 2 Humble on."""
    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=64)
def schema(ros_type: str) -> Schema:
    """Definition of a standard type such as ``sensor_msgs/msg/JointState``.

    Raises:
        KeyError: the type is not a standard one.
    """
    store = typestore()
    if ros_type not in store.fielddefs:
        raise KeyError(f"{ros_type} is not a standard message type")
    text, _ = store.generate_msgdef(ros_type, ros_version=2)
    return Schema(text, store.hash_rihs01(ros_type))
