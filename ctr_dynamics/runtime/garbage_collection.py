"""Rare garbage collection while kernels are compiled and steps are taken."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

OBJECTS_BETWEEN_COLLECTIONS = 100_000  # made and kept


@contextmanager
def rare_garbage_collection() -> Iterator[None]:
    """Inside, existing objects are never searched for cycles, and new ones rarely: steps leave hardly any, and a search takes milliseconds."""
    before = gc.get_threshold()
    outermost = gc.get_freeze_count() == 0
    gc.collect()
    if outermost:
        gc.freeze()
    gc.set_threshold(max(OBJECTS_BETWEEN_COLLECTIONS, before[0]) if before[0] else 0, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
        if outermost:
            gc.unfreeze()
