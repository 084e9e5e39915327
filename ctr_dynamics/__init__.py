"""Dynamics, estimation and ROS 2 node for concentric tube robots."""

__version__ = "0.1.0"
