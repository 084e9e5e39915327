"""Isolation of every test run: its own ROS domain on this machine only, its own figures backend."""

import os

# Set before anything imports rclpy; child processes inherit both. 0 and the low ids are left to people.
os.environ["ROS_DOMAIN_ID"] = str(20 + os.getpid() % 200)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("MPLBACKEND", "Agg")

# Before anything imports NumPy: the package asks it for one thread, which counts only while it is loaded.
import ctr_dynamics  # noqa: F401
