"""The managed node: configured, set going, stopped and cleaned up by others."""

from __future__ import annotations

import os
from itertools import pairwise

import pytest

pytest.importorskip("rclpy")

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState

from ctr_dynamics.io.messages import topics
from ctr_dynamics.ros.node_processes import MANAGED_ESTIMATOR, NodeProcess

PATIENCE_S = 120.0
LEADS_TO = {
    Transition.TRANSITION_CONFIGURE: "inactive",
    Transition.TRANSITION_ACTIVATE: "active",
    Transition.TRANSITION_DEACTIVATE: "inactive",
    Transition.TRANSITION_CLEANUP: "unconfigured",
}
pytestmark = pytest.mark.ros


class Manager:
    """Tells the node what to do, as `ros2 lifecycle set` does."""

    def __init__(self, live) -> None:
        self.live = live

    def call(self, kind, name, request):
        client = self.live.listener.node.create_client(kind, f"/ctr/estimator/{name}")
        self.live.wait(client.service_is_ready, f"service {name}")
        return self.live.answer(lambda: client.call_async(request))

    def change(self, transition: int) -> bool:
        """Whether it succeeded. Asked again after an answer was lost, the node says that it cannot be done twice: then the state tells."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.call(ChangeState, "change_state", request).success or self.state == LEADS_TO[transition]

    @property
    def state(self) -> str:
        return self.call(GetState, "get_state", GetState.Request()).current_state.label


def test_from_configured_to_cleaned_up_and_again(start, tmp_path):
    record = tmp_path / "record.mcap"
    parameters = {"input_timeout_s": 4.0, "record.path": str(record)}
    with start(parameters, module=MANAGED_ESTIMATOR) as live:
        manager = Manager(live)
        assert manager.state == "unconfigured"
        assert live.set_parameter("filter.window_s", 0.25).successful
        assert not manager.change(Transition.TRANSITION_ACTIVATE)

        assert manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.state == "inactive"
        live.wait(live.listener.matched, "the outputs")
        live.resting_robot(matched=False)
        assert live.count(topics.VALID) == 0

        assert manager.change(Transition.TRANSITION_ACTIVATE)
        live.wait_for_more(topics.TIP_POSE, 20)
        assert live.trigger("reset").success

        assert manager.change(Transition.TRANSITION_DEACTIVATE)
        assert manager.state == "inactive"
        live.wait(
            lambda: not live.listener.node.count_services("/ctr/estimator/reset"), "the end of the services"
        )
        stopped = live.count(topics.VALID)
        last = live.stamps(topics.TIP_POSE)[-1]

        assert manager.change(Transition.TRANSITION_ACTIVATE)
        live.wait_for_more(topics.TIP_POSE, 20)
        assert live.count(topics.VALID) > stopped
        # the same node goes on: no stamp twice, and the first new one is that of a fresh start
        stamps = live.stamps(topics.TIP_POSE)
        assert all(b > a for a, b in pairwise(stamps))
        assert stamps[-1] > last
        assert any((b - a) % topics.STEP_NS for a, b in pairwise(stamps))

        assert manager.change(Transition.TRANSITION_DEACTIVATE)
        assert manager.change(Transition.TRANSITION_CLEANUP)
        assert manager.state == "unconfigured"
        live.wait(lambda: not live.listener.node.count_publishers(topics.TIP_POSE), "the end of the outputs")
        # what cannot be used is said, and the node waits for better
        assert not manager.change(Transition.TRANSITION_CONFIGURE)
        assert "the file exists" in live.process.output()
        assert manager.state == "unconfigured"
        record.rename(tmp_path / "first.mcap")
        assert manager.change(Transition.TRANSITION_CONFIGURE)
        assert manager.change(Transition.TRANSITION_ACTIVATE)
        live.wait_for_more(topics.TIP_POSE, 20)


def test_a_wrong_parameter_ends_it_at_once(tmp_path):
    domain = int(os.environ["ROS_DOMAIN_ID"])
    with NodeProcess(MANAGED_ESTIMATOR, {"no.such": 1}, domain, tmp_path / "log") as process:
        assert process.wait(PATIENCE_S) == 2
        assert "no.such is unknown" in process.output()
