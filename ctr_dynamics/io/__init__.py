"""Bags and messages: MCAP recordings are found, read (also cut ones), described and written; topics and their encoding."""

from ctr_dynamics.io.bag_reader import Bag, InputMessage, RawMessage, open_bag, sha256_of
from ctr_dynamics.io.bag_writer import BagWriter, LiveRecorder, write_bag

__all__ = [
    "Bag",
    "BagWriter",
    "InputMessage",
    "LiveRecorder",
    "RawMessage",
    "open_bag",
    "sha256_of",
    "write_bag",
]
