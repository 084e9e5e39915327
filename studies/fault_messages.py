"""Faults of the inputs: each changes the messages of a recording. No ROS."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ctr_dynamics.io.bag_reader import RawMessage
from ctr_dynamics.io.messages import cdr, topics
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped
from ctr_dynamics.runtime.playback import shifted

BEGIN_S, END_S = 2.0, 3.0
Messages = list[RawMessage]
Change = Callable[[RawMessage], list[RawMessage]]


def during(
    topic: str | None, change: Change, begin_s: float = BEGIN_S, end_s: float = END_S
) -> Callable[[Messages], Messages]:
    """A fault that changes the messages of `topic` (None: of all) in that time."""

    def apply(messages: Messages) -> Messages:
        first = messages[0].log_ns
        result: Messages = []
        for m in messages:
            hit = begin_s <= (m.log_ns - first) * 1e-9 < end_s and topic in (None, m.topic)
            result += change(m) if hit else [m]
        return sorted(result, key=lambda m: m.log_ns)

    return apply


def pose(edit: Callable[[cdr.PoseIn], cdr.PoseIn]) -> Change:
    """Change what a pose holds."""

    def change(m: RawMessage) -> list[RawMessage]:
        p = edit(cdr.decode_pose_stamped(m.data))
        return [m._replace(data=encode_pose_stamped(p.stamp_ns, p.frame_id, p.position, p.quaternion_xyzw))]

    return change


def joints(edit: Callable[[cdr.JointStateIn], cdr.JointStateIn]) -> Change:
    """Change what a joint state holds."""

    def change(m: RawMessage) -> list[RawMessage]:
        j = edit(cdr.decode_joint_state(m.data))
        return [m._replace(data=encode_joint_state(j.stamp_ns, j.names, j.positions))]

    return change


def stamps(shift_s: float) -> Change:
    return lambda m: [m._replace(data=shifted(m.data, round(shift_s * 1e9)))]


def third(m: RawMessage) -> bool:
    return (m.log_ns // 25_000_000) % 3 == 0


def tenfold(messages: Messages) -> Messages:
    """Ten messages for each, linear in between: joints at 1 kHz, tracker at 400 Hz."""
    result: Messages = []
    last: dict[str, RawMessage] = {}
    decoders = {topics.JOINT_STATES: cdr.decode_joint_state, topics.TRACKER_TIP: cdr.decode_pose_stamped}
    for m in messages:
        before = last.get(m.topic)
        last[m.topic] = m
        if before is None or m.topic not in decoders:
            result.append(m)
            continue
        a, b = decoders[m.topic](before.data), decoders[m.topic](m.data)
        for k in range(1, 11):
            share = k / 10
            stamp = a.stamp_ns + round(share * (b.stamp_ns - a.stamp_ns))
            log = before.log_ns + round(share * (m.log_ns - before.log_ns))

            def mix(x: Any, y: Any, share: float = share) -> list[float]:
                return [(1 - share) * u + share * v for u, v in zip(x, y, strict=True)]

            if isinstance(a, cdr.JointStateIn) and isinstance(b, cdr.JointStateIn):
                data = encode_joint_state(stamp, a.names, mix(a.positions, b.positions))
            elif isinstance(a, cdr.PoseIn) and isinstance(b, cdr.PoseIn):
                q = np.array(mix(a.quaternion_xyzw, b.quaternion_xyzw))
                data = encode_pose_stamped(
                    stamp, a.frame_id, mix(a.position, b.position), (q / np.linalg.norm(q)).tolist()
                )
            result.append(RawMessage(m.topic, log, data))
    return sorted(result, key=lambda m: m.log_ns)


def late(m: RawMessage) -> list[RawMessage]:
    """Every other pose 150 ms late, so that the order is broken."""
    return [m._replace(log_ns=m.log_ns + (150_000_000 if (m.log_ns // 25_000_000) % 2 else 0))]


NAN = float("nan")
J, T = topics.JOINT_STATES, topics.TRACKER_TIP
FAULTS: dict[str, Callable[[Messages], Messages]] = {
    "none": lambda messages: messages,
    "tracker silent for 1 s": during(T, lambda m: []),
    "joints silent for 1 s": during(J, lambda m: []),
    "everything silent for 1 s": during(None, lambda m: []),
    "tracker holds NaN": during(T, pose(lambda p: p._replace(position=(NAN, 0.0, NAN)))),
    "tracker in another frame": during(T, pose(lambda p: p._replace(frame_id="camera"))),
    "tracker in millimetres": during(
        T, pose(lambda p: p._replace(position=tuple(1e3 * x for x in p.position)))
    ),
    "tracker quaternion zero": during(T, pose(lambda p: p._replace(quaternion_xyzw=(0.0, 0.0, 0.0, 0.0)))),
    "tracker outliers of 100 mm, one in three": during(
        T,
        lambda m: (
            pose(lambda p: p._replace(position=(p.position[0] + 0.1, *p.position[1:])))(m)
            if third(m)
            else [m]
        ),
    ),
    "tracker 150 ms late, out of order": during(T, late),
    "joints hold NaN": during(J, joints(lambda j: j._replace(positions=(NAN,) * len(j.positions)))),
    "a joint is missing": during(
        J, joints(lambda j: j._replace(names=j.names[1:], positions=j.positions[1:]))
    ),
    "joints in degrees and millimetres": during(
        J, joints(lambda j: j._replace(positions=tuple(57.3 * x for x in j.positions)))
    ),
    "messages cut in half": during(None, lambda m: [m._replace(data=m.data[: len(m.data) // 2])]),
    "every message three times": during(None, lambda m: [m, m, m]),
    "clock jumps 1 h ahead and back": during(None, stamps(3600.0)),
    "clock jumps 0.5 s back and forth": during(None, stamps(-0.5)),
    "clock jumps 10 s back for good": during(None, stamps(-10.0), BEGIN_S, math.inf),
    "10 times the message rate": tenfold,
    "CPU load of twice the cores": lambda messages: messages,
    "disk full": lambda messages: messages,
    "kill -9 while recording": lambda messages: messages,
}
WHOLE_RUN = {
    "none",
    "10 times the message rate",
    "CPU load of twice the cores",
    "disk full",
    "kill -9 while recording",
}
# Stamps that stay behind what was published: nothing more goes out until ~/reset is called, and /diagnostics says so.
NEEDS_RESET = {"clock jumps 10 s back for good"}
