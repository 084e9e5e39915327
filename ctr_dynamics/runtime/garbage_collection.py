"""Python's search for cyclic garbage, out of the way of a loop of steps."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

SELDOM = 100_000  # objects made and kept, between two searches


@contextmanager
def seldom_collected() -> Iterator[None]:
    """Inside, what there is already is never searched, and the rest seldom: a step leaves hardly any cycles behind, and a search takes
    milliseconds."""
    before = gc.get_threshold()
    outermost = gc.get_freeze_count() == 0
    gc.collect()
    if outermost:
        gc.freeze()
    gc.set_threshold(max(SELDOM, before[0]) if before[0] else 0, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
        if outermost:
            gc.unfreeze()
