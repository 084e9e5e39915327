"""A bag on its own clock: ros2 launch ctr_dynamics replay.launch.py bag:=FILE.mcap

The driver publishes /clock with the bag's time and leaves the stamps as they are; the estimator follows it
with use_sim_time and takes a step when the joints that cover it are in. For figures that repeat byte by byte
use `ctr-dynamics replay`, which needs no ROS graph.
"""

from ctr_dynamics.ros.launch_files import description


def generate_launch_description():
    return description(
        {"policy": "wait"}, {"use_sim_time": True}, driver={"clock_hz": 500.0, "wait_s": 900.0}
    )
