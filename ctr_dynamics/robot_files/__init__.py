"""Robot files: reading and writing them, making one from data sheets, and what a file says in a workshop's units."""

from ctr_dynamics.robot_files.loader import (
    load_robot,
    robot_from_dict,
    robot_names,
    robot_quantities,
    robot_to_dict,
    robot_to_yaml,
    robot_with,
)

__all__ = [
    "load_robot",
    "robot_from_dict",
    "robot_names",
    "robot_quantities",
    "robot_to_dict",
    "robot_to_yaml",
    "robot_with",
]
