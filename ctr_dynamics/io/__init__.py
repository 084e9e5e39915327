"""Bags: finding and reading MCAP recordings (also cut ones), writing them, what is in them, and replay."""

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
