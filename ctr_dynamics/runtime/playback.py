"""A bag as live messages: order, pace and stamps, without ROS."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import RawMessage, open_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import CdrError, decode_stamp, split_stamp


def load(bag: Path, start_s: float = 0.0, duration_s: float = 0.0) -> list[RawMessage]:
    """The estimator's inputs in a bag, in order of arrival, ties by topic name.

    Args:
        bag: an .mcap file or a folder with one.
        start_s: left out at the beginning, but for the load that acts on there.
        duration_s: taken from there on; 0 takes all.

    Raises:
        InputError: not readable, not such a bag, or no joint states in that part.
    """
    opened = open_bag(bag)
    opened.check_inputs()
    messages = list(opened.standard_messages())
    if messages:
        begin = messages[0].log_ns + round(start_s * 1e9)
        end = begin + round(duration_s * 1e9) if duration_s > 0 else messages[-1].log_ns
        before = [m for m in messages if m.log_ns < begin and m.topic == topics.TIP_LOAD]
        # a load is held after its stamp: the last one before the beginning is the load there
        held = [m._replace(log_ns=begin) for m in before[-1:]]
        messages = held + [m for m in messages if begin <= m.log_ns <= end]
    if not any(m.topic == topics.JOINT_STATES for m in messages):
        raise InputError(
            f"no message on {topics.JOINT_STATES} in {duration_s or 'all'} s from {start_s:g} s on",
            do="see what is in it with ctr-dynamics info",
            where=str(bag),
        )
    return messages


def shifted(data: bytes, shift_ns: int) -> bytes:
    """The serialised message with its header's stamp moved by `shift_ns`.

    Raises:
        CdrError: too short to hold a header, or moved to a time that no stamp can hold.
    """
    order = "<" if data[1:2] == b"\x01" else ">"
    moved_ns = decode_stamp(data) + shift_ns
    try:
        stamp = struct.pack(order + "iI", *split_stamp(moved_ns))
    except struct.error:
        raise CdrError(f"a stamp of {moved_ns * 1e-9:.0f} s is beyond 32 bits") from None
    return data[:4] + stamp + data[12:]


def pace(
    times_ns: Sequence[int],
    start_ns: int,
    stopped: Callable[[], bool],
    now_ns: Callable[[], int] = time.monotonic_ns,
) -> Iterator[tuple[int, int]]:
    """Yield index and lateness (ns) of each of the rising `times_ns` when its moment has come.

    Args:
        times_ns: moments on the recording's clock.
        start_ns: when the first of them is due on the clock of `now_ns`.
        stopped: asked between two moments; True ends the iteration.
    """
    for index, moment in enumerate(times_ns):
        due = start_ns + moment - times_ns[0]
        while (wait := due - now_ns()) > 0:
            if stopped():
                return
            time.sleep(min(wait * 1e-9, 0.1))
        if stopped():
            return
        yield index, max(now_ns() - due, 0)
