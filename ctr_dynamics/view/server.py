"""A server for Foxglove on this machine: messages as they are, with their ROS definitions, and the tubes as markers."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.messages.schemas import schema
from ctr_dynamics.io.messages.topics import TOPIC
from ctr_dynamics.robot import Robot
from ctr_dynamics.view.markers import MARKER_ARRAY, TUBES_TOPIC
from ctr_dynamics.view.scene import Scene

if TYPE_CHECKING:
    import foxglove

CLOSE_S = 3.0


class ViewServer:
    """Serves messages to Foxglove (web or desktop, "Open connection", ws://127.0.0.1:PORT).

    Args:
        robot: drawn as markers on `/ctr/view/tubes`.
        host: address to listen at; only this machine unless told otherwise.
        port: 0 takes a free one.

    Raises:
        InputError: foxglove-sdk is not installed, or the port cannot be had.
    """

    def __init__(self, robot: Robot, host: str = "127.0.0.1", port: int = 8765) -> None:
        try:
            import foxglove
        except ImportError:
            raise InputError("the view needs foxglove-sdk", do="pip install foxglove-sdk") from None
        self.scene = Scene(robot)
        self.messages = 0
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name="ctr_dynamics", host=host, port=port, context=self._context, message_backlog_size=4096
            )
        except Exception as error:  # the SDK has no narrower one
            raise InputError(f"cannot listen at {host}:{port} ({error})", do="give another --port") from None
        self.port = int(self._server.port)
        self._channels: dict[str, foxglove.Channel] = {}
        for name in (*TOPIC, TUBES_TOPIC):  # known before the first message, so that a layout finds them
            self._channel(name)

    def _channel(self, topic: str) -> foxglove.Channel:
        import foxglove

        if topic not in self._channels:
            ros_type = MARKER_ARRAY if topic == TUBES_TOPIC else TOPIC[topic].ros_type
            definition = foxglove.Schema(
                name=ros_type, encoding="ros2msg", data=schema(ros_type).text.encode()
            )
            self._channels[topic] = foxglove.Channel(
                topic, message_encoding="cdr", schema=definition, context=self._context
            )
        return self._channels[topic]

    def put(self, topic: str, log_ns: int, data: bytes) -> None:
        """One message of the topic table."""
        self._channel(topic).log(data, log_time=log_ns)
        self.messages += 1
        picture = self.scene.take(topic, data)
        if picture is not None:
            self._channel(TUBES_TOPIC).log(picture[1], log_time=picture[0])

    def close(self) -> None:
        """End the server; a client that takes nothing any more does not hold it up."""
        ending = threading.Thread(target=self._server.stop, name="end of the view", daemon=True)
        ending.start()
        ending.join(CLOSE_S)


class Pace:
    """Waits so that stamps pass at `speed` times real time; 0 does not wait."""

    def __init__(self, speed: float) -> None:
        self.speed = speed
        self._start: tuple[int, float] | None = None

    def wait(self, stamp_ns: int) -> None:
        """Wait until `stamp_ns` is due."""
        if self.speed <= 0:
            return
        if self._start is None:
            self._start = (stamp_ns, time.monotonic())
        first_ns, begin = self._start
        delay = begin + (stamp_ns - first_ns) * 1e-9 / self.speed - time.monotonic()
        if delay > 0:
            time.sleep(delay)
