"""A bag as live topics, its stamps moved to now: ros2 launch ctr_dynamics demo.launch.py bag:=FILE.mcap"""

from ctr_dynamics.ros.launch_files import description


def generate_launch_description():
    return description({"timing_report": ""}, driver={"wait_s": 900.0})
