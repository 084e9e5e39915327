"""Robots: tubes, bodies, friction, sensors and tolerances, read from validated YAML files."""

from ctr_dynamics.robot.loader import (
    load_robot,
    quantities,
    robot_from_dict,
    robot_names,
    robot_to_dict,
    robot_to_yaml,
    robot_with,
)
from ctr_dynamics.robot.quantity import Quantity, VectorQuantity
from ctr_dynamics.robot.schema import Robot, Tracker
from ctr_dynamics.robot.tube import EndBody, Segment, Tube

__all__ = [
    "EndBody",
    "Quantity",
    "Robot",
    "Segment",
    "Tracker",
    "Tube",
    "VectorQuantity",
    "load_robot",
    "quantities",
    "robot_from_dict",
    "robot_names",
    "robot_to_dict",
    "robot_to_yaml",
    "robot_with",
]
