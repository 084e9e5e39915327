"""Measurements whose step is taken again."""

from __future__ import annotations

from collections import deque
from typing import Protocol, TypeVar

REMEMBERED = (
    200  # measurements; corrections reach back over a window of 0.2 s by default and 2 s at most: 80 at 40 Hz
)


class Stamped(Protocol):
    """What is known up to a measurement."""

    @property
    def stamp_ns(self) -> int:
        """Of its header."""


T = TypeVar("T", bound=Stamped)


def drop_from(known: deque[T], stamp_ns: int) -> None:
    """Forget of ``known``, oldest first, what a measurement of ``stamp_ns`` takes the place of."""
    while known and known[-1].stamp_ns >= stamp_ns:
        known.pop()
