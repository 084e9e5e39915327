"""The estimator as a managed node: others configure it, set it going and stop it (ROS 2 lifecycle)."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin

from ctr_dynamics.errors import InputError
from ctr_dynamics.ros.estimator_node import EstimatorNode
from ctr_dynamics.ros.estimator_node import main as run_estimator
from ctr_dynamics.ros.node_runner import RCLError, Stopped, exit_at_once
from ctr_dynamics.ros.parameter_declaration import declared


class ManagedEstimatorNode(LifecycleNodeMixin, EstimatorNode):
    """Node `/ctr/estimator`, which does nothing until it is told to.

    `configure` reads the robot file, compiles and opens the outputs. `activate` listens to the inputs and steps. `deactivate` stops that, and the
    next activation reinitialises from the joints of that time. `cleanup` gives everything back.

    Raises:
        InputError: a parameter cannot be used.
    """

    def __init__(self, stop: threading.Event) -> None:
        self._stage = 0  # 1: set up, 2: begun
        EstimatorNode.__init__(self, stop)

    def start_up(self) -> None:
        LifecycleNodeMixin.__init__(self)
        change = self._service_change_state.callback

        def change_state(request: Any, response: Any) -> Any:
            try:
                return change(request, response)
            except RCLError as error:  # before ROS 2 Kilted, of a transition that the state does not allow
                self.get_logger().error(" ".join(str(error).split()))
                response.success = False
                return response

        self._service_change_state.callback = change_state
        self.get_logger().info("waiting to be configured")

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        def work() -> None:
            self.settings = declared(self)
            self.set_up()
            self._stage = 1

        return self._try(work)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        def work() -> None:
            self.begin()
            self._stage = 2

        return self._try(work)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._to_stage(1)
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._to_stage(0)
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._to_stage(0)
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._to_stage(0)
        return TransitionCallbackReturn.SUCCESS

    def _try(self, work: Callable[[], None]) -> TransitionCallbackReturn:
        """Whether the work could be done; why not goes to the log."""
        try:
            work()
        except Stopped:
            exit_at_once()
        except (InputError, RCLError) as error:
            self.get_logger().error(" ".join(str(error).split()))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _to_stage(self, stage: int) -> None:
        if self._stage > 1 >= stage:
            self.end()
            self._stage = 1
            self.loop = self._new_loop()
            self.loop.reset()
        if self._stage > stage:
            self.take_down()
            self._stage = 0

    def close(self) -> None:
        """End everything and destroy the node."""
        self._to_stage(0)
        self.destroy_node()


def main(args: list[str] | None = None) -> int:
    """Run the node; returns 0 after SIGINT or SIGTERM, 2 when it cannot start with what it was given."""
    return run_estimator(args, ManagedEstimatorNode)


if __name__ == "__main__":
    sys.exit(main())
