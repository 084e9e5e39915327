"""Running a node until it is told to stop: executor, signals and exit code."""

from __future__ import annotations

import concurrent.futures
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from ctr_dynamics.errors import InputError

AnyNode = TypeVar("AnyNode", bound=Node)
Result = TypeVar("Result")
POLL_S = 0.1
# rclpy.subscription has it as well, but not before ROS 2 Kilted
RCLError = rclpy_implementation.RCLError


def make_executor(context: Context) -> Executor:
    """The event-driven executor, which takes half the processor time, where this rclpy has it."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:  # before ROS 2 Kilted
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


class Stopped(Exception):
    """SIGINT or SIGTERM came before the node was ready."""


@contextlib.contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """The event that SIGINT and SIGTERM set; the former handlers come back at the end.

    rclpy's own handlers shut the context down at once, under the feet of whoever is publishing. For an
    orderly end call `rclpy.init(..., signal_handler_options=SignalHandlerOptions.NO)` and use this.
    Nothing is raised: an exception in the midst of compiling leaves the compiler's memory in pieces.
    """
    stop = threading.Event()

    def handler(number: int, frame: FrameType | None) -> None:
        stop.set()

    former = [(number, signal.signal(number, handler)) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        yield stop
    finally:
        for number, value in former:
            signal.signal(number, value)


def run_in_thread(work: Callable[[], Result], stop: threading.Event) -> Result:
    """The result of long work, done in a thread of its own. What the work raises is raised here.

    Raises:
        Stopped: `stop` was set first. The work goes on: end the process by `exit_at_once`.
    """
    future: concurrent.futures.Future[Result] = concurrent.futures.Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    while not stop.is_set():
        if concurrent.futures.wait([future], POLL_S).done:
            return future.result()
    raise Stopped


def exit_at_once() -> NoReturn:
    """End the process with code 0 at once: taking the interpreter down under work that goes on would crash."""
    rclpy.try_shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def serve_callbacks(executor: Executor) -> None:
    """Serve callbacks for a moment."""
    executor.spin_until_future_complete(Future(executor=executor), POLL_S)


def spin_until_stopped(node: Node, stop: threading.Event) -> None:
    """Serve the node's callbacks until `stop` is set or the context is shut down."""
    executor = make_executor(node.context)
    executor.add_node(node)
    try:
        # The plain spin() of the event-driven executor does not look at signals; short turns do.
        while not stop.is_set() and rclpy.ok(context=node.context):
            serve_callbacks(executor)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        executor.remove_node(node)
        executor.shutdown()


def run_node(
    name: str,
    make: Callable[[threading.Event], AnyNode],
    close: Callable[[AnyNode], object],
    args: list[str] | None,
) -> int:
    """Make a node, which may end its start by `Stopped`, serve it until SIGINT or SIGTERM, close it.

    Returns 0, or 2 when it cannot start with what it was given.
    """
    with stop_on_signals() as stop:
        try:
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
            node = make(stop)
        except Stopped:
            exit_at_once()
        except (InputError, ParameterException, RCLError) as error:
            print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
            rclpy.try_shutdown()
            return 2
        try:
            spin_until_stopped(node, stop)
        finally:
            try:
                close(node)
            finally:
                rclpy.try_shutdown()
    return 0
