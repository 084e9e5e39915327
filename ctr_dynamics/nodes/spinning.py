"""Running a node until it is told to stop: executor, signals and exit code."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import TypeVar

import rclpy
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import RCLError
from rclpy.task import Future

from ctr_dynamics.errors import InputError

AnyNode = TypeVar("AnyNode", bound=Node)
POLL_S = 0.1


def make_executor(context: Context) -> Executor:
    """The event-driven executor, which takes half the processor time, where this rclpy has it."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:  # before ROS 2 Kilted
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


class Stop(threading.Event):
    """Set by SIGINT and SIGTERM. While `starting`, these also raise KeyboardInterrupt: nothing waits yet."""

    def __init__(self) -> None:
        super().__init__()
        self.starting = True


@contextlib.contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """The event that SIGINT and SIGTERM set; the former handlers come back at the end.

    rclpy's own handlers shut the context down at once, under the feet of whoever is publishing. For an
    orderly end call `rclpy.init(..., signal_handler_options=SignalHandlerOptions.NO)` and use this.
    """
    stop = Stop()

    def handler(number: int, frame: FrameType | None) -> None:
        stop.set()
        if stop.starting:
            stop.starting = False
            raise KeyboardInterrupt

    former = [(number, signal.signal(number, handler)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        yield stop
    finally:
        for number, value in former:
            signal.signal(number, value)


def turn(executor: Executor) -> None:
    """Serve callbacks for a moment."""
    executor.spin_until_future_complete(Future(executor=executor), POLL_S)


def spin_until(node: Node, stop: threading.Event) -> None:
    """Serve the node's callbacks until `stop` is set or the context is shut down."""
    executor = make_executor(node.context)
    executor.add_node(node)
    try:
        # The plain spin() of the event-driven executor does not look at signals; short turns do.
        while not stop.is_set() and rclpy.ok(context=node.context):
            turn(executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        executor.remove_node(node)
        executor.shutdown()


def run_node(
    name: str, make: Callable[[], AnyNode], close: Callable[[AnyNode], object], args: list[str] | None
) -> int:
    """Make a node, serve it until SIGINT or SIGTERM, close it; returns 0, or 2 when it cannot start with what it was given."""
    with stop_on_signals() as stop:
        try:
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
            node = make()
            stop.starting = False
        except KeyboardInterrupt:
            rclpy.try_shutdown()
            return 0
        except (InputError, ParameterException, RCLError) as error:
            print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
            rclpy.try_shutdown()
            return 2
        try:
            spin_until(node, stop)
        finally:
            try:
                close(node)
            finally:
                rclpy.try_shutdown()
    return 0
