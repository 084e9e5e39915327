"""Quality of service by name, and the account of publishers and subscribers that do not fit."""

from __future__ import annotations

from typing import Any

from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)

RELIABILITY = {
    "best_effort": ReliabilityPolicy.BEST_EFFORT,
    "reliable": ReliabilityPolicy.RELIABLE,
}


DURABILITY = {
    "volatile": DurabilityPolicy.VOLATILE,
    "transient_local": DurabilityPolicy.TRANSIENT_LOCAL,
}


def profile(reliability: str, depth: int, durability: str = "volatile") -> QoSProfile:
    """Keep-last profile; `reliability` is a key of RELIABILITY, `durability` of DURABILITY."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=RELIABILITY[reliability],
        durability=DURABILITY[durability],
    )


class QosFaults:
    """Which topics have met an endpoint with an incompatible profile, for the diagnostics."""

    def __init__(self) -> None:
        self.by_topic: dict[str, str] = {}

    def subscription(self, topic: str) -> Any:
        """Callback for the incompatible-QoS event of the subscription to `topic`."""

        def note(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind)
            self.by_topic[topic] = (
                f"a publisher of {topic} offers an incompatible {policy} ({event.total_count} so far): "
                "nothing is received from it; change its profile or qos.subscription_reliability"
            )

        return note

    def publisher(self, topic: str) -> Any:
        """Callback for the incompatible-QoS event of the publisher of `topic`."""

        def note(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind)
            self.by_topic[topic] = (
                f"a subscriber of {topic} requests an incompatible {policy} ({event.total_count} so far): it "
                "receives nothing; change its profile or qos.publisher_reliability"
            )

        return note
