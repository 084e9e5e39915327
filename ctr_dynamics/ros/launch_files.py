"""What the launch files have in common.

`launch` and `launch_ros` come with a sourced ROS 2 and not from PyPI: they are imported when a launch file asks for its description.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

# Name -> what it is; a launch file gives each of its own a default.
ARGUMENTS = {
    "bag": "An .mcap file or a folder with one.",
    "robot": "Shipped robot or path of a robot file.",
    "policy": "output.policy: predict or wait.",
    "params": "Parameter file of the estimator.",
    "record": "MCAP file that the estimator records to; empty: none.",
    "timing_report": "JSON file for the punctuality of the steps; empty: none.",
    "use_sim_time": "Follow /clock.",
    "view": "Start the node that draws the tubes for RViz.",
}
ESTIMATOR_PARAMETERS = {
    "robot": "robot",
    "policy": "output.policy",
    "record": "record.path",
    "timing_report": "timing_report",
    "use_sim_time": "use_sim_time",
}
DEFAULTS: dict[str, Any] = {
    "robot": "till2020_tissue",
    "policy": "predict",
    "record": "",
    "view": "false",
}


def description(
    defaults: Mapping[str, Any],
    fixed: Mapping[str, Any] | None = None,
    driver: Mapping[str, Any] | None = None,
) -> Any:
    """Estimator and view, and with `driver` a driver that plays the bag of argument `bag` and ends everything at its end.

    Args:
        defaults: arguments of this launch file beside those of `DEFAULTS`, or in their stead.
        fixed: parameters of the estimator that are no arguments.
        driver: parameters of the driver; None starts none.

    Returns:
        A `launch.LaunchDescription`.
    """
    from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
    from launch.conditions import IfCondition
    from launch.event_handlers import OnProcessExit
    from launch.events import Shutdown
    from launch.substitutions import LaunchConfiguration
    from launch_ros.substitutions import FindPackageShare

    from launch import LaunchDescription  # type: ignore[attr-defined]  # a folder of that name is here too

    params = [FindPackageShare("ctr_dynamics"), "/config/estimator.yaml"]
    given = {**DEFAULTS, "params": params, **defaults}
    entities: list[Any] = [
        DeclareLaunchArgument(name, default_value=value, description=ARGUMENTS[name])
        for name, value in given.items()
    ]
    values = {
        parameter: LaunchConfiguration(name)
        for name, parameter in ESTIMATOR_PARAMETERS.items()
        if name in given
    }
    entities.append(_node("estimator", [LaunchConfiguration("params"), {**values, **(fixed or {})}]))
    drawn = {"robot": LaunchConfiguration("robot")}
    entities.append(
        _node("tube_markers", [drawn], name="view", condition=IfCondition(LaunchConfiguration("view")))
    )
    if driver is not None:
        entities.insert(0, DeclareLaunchArgument("bag", description=ARGUMENTS["bag"]))
        player = _node("driver", [{"bag": LaunchConfiguration("bag"), **driver}])
        end = OnProcessExit(
            target_action=player, on_exit=[EmitEvent(event=Shutdown(reason="the bag has ended"))]
        )
        entities += [player, RegisterEventHandler(end)]
    return LaunchDescription(entities)


def _node(executable: str, parameters: Sequence[Any], name: str = "", **options: Any) -> Any:
    from launch_ros.actions import Node

    return Node(
        package="ctr_dynamics",
        executable=executable,
        namespace="ctr",
        name=name or executable,
        output="screen",
        parameters=list(parameters),
        **options,
    )
