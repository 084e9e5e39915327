"""A bag on its own clock: ros2 launch ctr_dynamics replay.launch.py bag:=FILE.mcap

The driver publishes /clock with the bag's time and leaves the stamps as they are; the estimator follows it
with use_sim_time and takes a step when the joints that cover it are in. For figures that repeat byte by byte
use `ctr-dynamics replay`, which needs no ROS graph.
"""

from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description():
    arguments = [
        DeclareLaunchArgument("bag", description="An .mcap file or a folder with one."),
        DeclareLaunchArgument("robot", default_value="till2020_tissue"),
        DeclareLaunchArgument("policy", default_value="wait"),
        DeclareLaunchArgument("record", default_value=""),
    ]
    estimator = Node(
        package="ctr_dynamics",
        executable="estimator",
        namespace="ctr",
        name="estimator",
        output="screen",
        parameters=[
            {
                "robot": LaunchConfiguration("robot"),
                "output.policy": LaunchConfiguration("policy"),
                "record.path": LaunchConfiguration("record"),
                "use_sim_time": True,
            }
        ],
    )
    driver = Node(
        package="ctr_dynamics",
        executable="driver",
        namespace="ctr",
        name="driver",
        output="screen",
        parameters=[{"bag": LaunchConfiguration("bag"), "clock_hz": 500.0, "wait_s": 900.0}],
    )
    end = RegisterEventHandler(
        OnProcessExit(target_action=driver, on_exit=[EmitEvent(event=Shutdown(reason="the bag has ended"))])
    )
    return LaunchDescription([*arguments, estimator, driver, end])
