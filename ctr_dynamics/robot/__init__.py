"""What a robot is: tubes, bodies, friction, sensors and their tolerances. Files are read by :mod:`ctr_dynamics.robot_files`."""

from ctr_dynamics.robot.cantilever_beam import Cantilever, cantilever
from ctr_dynamics.robot.quantity import Quantity, VectorQuantity
from ctr_dynamics.robot.schema import Robot, Tracker
from ctr_dynamics.robot.tube import EndBody, Segment, Tube

__all__ = [
    "Cantilever",
    "EndBody",
    "Quantity",
    "Robot",
    "Segment",
    "Tracker",
    "Tube",
    "VectorQuantity",
    "cantilever",
]
