"""Estimator beside a running driver: ros2 launch ctr_dynamics live.launch.py robot:=till2020_tissue"""

from ctr_dynamics.ros.launch_files import description


def generate_launch_description():
    return description({"use_sim_time": "false"})
