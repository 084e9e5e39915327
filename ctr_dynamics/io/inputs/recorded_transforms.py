"""Transforms of a bag, for poses that were recorded in another frame than that which is wanted."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ctr_dynamics.io.inputs.input_decoder import InputDecoder
from ctr_dynamics.io.messages.cdr import PoseIn
from ctr_dynamics.io.messages.topics import TF, TF_STATIC, TRACKER_TIP, TRANSFORMS, accepts_frame

if TYPE_CHECKING:
    from ctr_dynamics.io.bag_reader import Bag


def take_transforms(bag: Bag, decoder: InputDecoder) -> frozenset[str]:
    """Give a decoder the static transforms of a bag, which hold at all times; returns the topics whose messages it needs beside the inputs.

    None where the poses are in the frame that is wanted.
    """
    recorded = bag.topics.keys() & set(TRANSFORMS)
    if not bag.mapping.frame_id or not recorded or not _frame_differs(bag):
        return frozenset()
    for _, log_ns, data, ros_type, encoding in bag.typed_messages({TF_STATIC}):
        bag.values(decoder, TF_STATIC, log_ns, data, ros_type, encoding)
    return frozenset(recorded & {TF})


def _frame_differs(bag: Bag) -> bool:
    """Whether the first pose of a bag names another frame than that which is wanted."""
    counted = dict(bag.malformed)
    decoder = InputDecoder(replace(bag.mapping, frame_id=""))
    first = next(bag.as_recorded(decoder, {TRACKER_TIP}), None)
    bag.malformed = counted  # whoever reads on counts these messages
    return (
        first is not None
        and isinstance(first.message, PoseIn)
        and not accepts_frame(first.message.frame_id, bag.mapping.frame_id)
    )
