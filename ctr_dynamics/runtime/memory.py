"""Memory that stays with the process: pages that are touched for the first time while steps are due cost more than the steps."""

from __future__ import annotations

import ctypes

M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -4, -8  # malloc.h of the GNU C library


def keep_memory() -> bool:
    """Have the C library keep what is freed, in one place for all threads, so that what the warm-up has used serves the first steps too.

    Returns False where the C library has no ``mallopt``; nothing is changed then.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    settings = ((M_ARENA_MAX, 1), (M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 2**31 - 1))
    return all(mallopt(option, value) == 1 for option, value in settings)
