"""Draws the robot for RViz: backbone, joints and covariance in, `/ctr/view/tubes` (MarkerArray) out."""

from __future__ import annotations

import sys
from typing import Any

from ctr_dynamics.io.messages import topics
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.ros import qos
from ctr_dynamics.ros.node_runner import run_node
from ctr_dynamics.ros.parameter_declaration import TableNode, declare_table
from ctr_dynamics.ros.topic_names import NAMESPACE, message_class
from ctr_dynamics.runtime.node_parameters import VIEW
from ctr_dynamics.view.markers import MARKER_ARRAY, TUBES_TOPIC
from ctr_dynamics.view.scene import Scene


class ViewNode(TableNode):
    """Node `/ctr/view`.

    Raises:
        InputError: a parameter or the robot file cannot be used.
    """

    def __init__(self) -> None:
        super().__init__("view", NAMESPACE)
        values = declare_table(self, VIEW)
        self.scene = Scene(
            load_robot(values["robot"]),
            values["rate_hz"],
            values["diameter_scale"],
            values["ellipsoid_scale"],
        )
        self._output = self.create_publisher(
            message_class(MARKER_ARRAY), TUBES_TOPIC, qos.profile("reliable", 5)
        )
        self._inputs = [
            self.create_subscription(
                message_class(topics.TOPIC[name].ros_type),
                name,
                self._taker(name),
                qos.profile("best_effort", 10),
                raw=True,
            )
            for name in (topics.JOINT_STATES, topics.TIP_POSE, topics.BACKBONE_STATE)
        ]

    def _taker(self, topic: str) -> Any:
        def take(data: bytes) -> None:
            picture = self.scene.take(topic, data)
            if picture is not None:
                self._output.publish(picture[1])

        return take


def main(args: list[str] | None = None) -> int:
    """Run the node; returns 0 after SIGINT or SIGTERM, 2 when it cannot start."""
    return run_node("view", lambda stop: ViewNode(), ViewNode.destroy_node, args)


if __name__ == "__main__":
    sys.exit(main())
