"""Estimator beside a running driver: ros2 launch ctr_dynamics live.launch.py robot:=till2020_tissue"""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description():
    arguments = {
        "params": [FindPackageShare("ctr_dynamics"), "/config/estimator.yaml"],
        "robot": "till2020_tissue",
        "policy": "predict",
        "record": "",
        "use_sim_time": "false",
    }
    estimator = Node(
        package="ctr_dynamics",
        executable="estimator",
        namespace="ctr",
        name="estimator",
        output="screen",
        parameters=[
            LaunchConfiguration("params"),
            {
                "robot": LaunchConfiguration("robot"),
                "output.policy": LaunchConfiguration("policy"),
                "record.path": LaunchConfiguration("record"),
                "use_sim_time": LaunchConfiguration("use_sim_time"),
            },
        ],
    )
    return LaunchDescription(
        [DeclareLaunchArgument(name, default_value=value) for name, value in arguments.items()] + [estimator]
    )
