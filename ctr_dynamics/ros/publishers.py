"""The node's publishers: one per output topic, fed with serialised bytes, each stamp once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from ctr_dynamics.estimation.step_output import StepOutput
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.encode import Encoded, encode_diagnostics
from ctr_dynamics.ros.qos import QosFaults
from ctr_dynamics.ros.topic_names import message_class, node_topic
from ctr_dynamics.runtime.clock_offset import RisingStamps
from ctr_dynamics.runtime.recorder import Recorded
from ctr_dynamics.runtime.step_encoder import StepEncoder


class Outputs:
    """Publishes the messages of steps. No stamp goes out twice, not even after a reset of the estimator.

    Args:
        node: makes the publishers.
        profile: their quality of service.
        faults: told about subscribers that do not fit.
        encoder: makes the messages.
        record: also given every message of the table.
        transforms: publisher on /tf, which is taken over; None where the encoder makes none.
    """

    def __init__(
        self,
        node: Node,
        profile: QoSProfile,
        faults: QosFaults,
        encoder: StepEncoder,
        record: Callable[[Recorded], None] | None = None,
        transforms: Publisher[Any] | None = None,
    ) -> None:
        self._node, self._transforms = node, transforms
        self.stamps = RisingStamps()
        self._last: StepOutput | None = None  # the last step that was published, as it went out
        self._encoder = encoder
        self._record = record
        self._publishers = {
            topic.name: node.create_publisher(
                message_class(topic.ros_type),
                node_topic(topic.name),
                profile,
                event_callbacks=PublisherEventCallbacks(incompatible_qos=faults.publisher(topic.name)),
            )
            for topic in topics.OUTPUTS
        }

    def step(self, out: StepOutput, by_now: Callable[[StepOutput], StepOutput]) -> bool:
        """Publish one step; False when its stamp is not later than all that were published.

        Args:
            out: the step.
            by_now: gives it as it is at the time of the call, invalid once it is too old. Asked before every message: a process may be held up
                between any two of them.
        """
        if not self.stamps.passes(out.stamp_ns):
            return False
        out = self._last = by_now(out)
        for message in self._encoder.encode(out):
            self._last = by_now(out)
            if self._last.valid != out.valid:
                self._publish(self._encoder.encode(self._last)[-1])
                break
            self._publish(message)
        return True

    def _publish(self, message: Encoded) -> None:
        if message.topic in self._publishers:
            self._send(*message)
        elif self._transforms is not None:
            self._transforms.publish(message.data)  # not recorded here: the node hears it as well

    @property
    def valid(self) -> bool | None:
        """Whether the last step that was published is valid; None before the first."""
        return None if self._last is None else bool(self._last.valid)

    @property
    def reason(self) -> str:
        """Why it is not; empty when it is."""
        if self._last is None:
            return "no step has been taken yet: waiting for the first complete joint state"
        return str(self._last.reason)

    def prefetch(self) -> None:
        """Make the last step's messages again, for nobody, so that the next ones are made sooner."""
        if self._last is not None:
            self._encoder.encode(self._last)

    def close(self) -> None:
        """Take the publishers away."""
        for publisher in (*self._publishers.values(), self._transforms):
            if publisher is not None:
                self._node.destroy_publisher(publisher)

    def diagnostics(self, stamp_ns: int, statuses: list[Any]) -> None:
        """Publish /diagnostics."""
        data = encode_diagnostics(stamp_ns, statuses, self._encoder.hardware_id)
        self._send(topics.DIAGNOSTICS, stamp_ns, data)

    def _send(self, topic: str, stamp_ns: int, data: bytes) -> None:
        self._publishers[topic].publish(data)
        if self._record is not None:
            self._record(Recorded(topic, stamp_ns, data))
