"""A bag as live topics, its stamps moved to now: ros2 launch ctr_dynamics demo.launch.py bag:=FILE.mcap"""

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
        DeclareLaunchArgument("policy", default_value="predict"),
        DeclareLaunchArgument("timing_report", default_value=""),
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
                "timing_report": LaunchConfiguration("timing_report"),
            }
        ],
    )
    driver = Node(
        package="ctr_dynamics",
        executable="driver",
        namespace="ctr",
        name="driver",
        output="screen",
        parameters=[{"bag": LaunchConfiguration("bag"), "wait_s": 900.0}],
    )
    end = RegisterEventHandler(
        OnProcessExit(target_action=driver, on_exit=[EmitEvent(event=Shutdown(reason="the bag has ended"))])
    )
    return LaunchDescription([*arguments, estimator, driver, end])
