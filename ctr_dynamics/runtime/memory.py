"""Memory that stays with the process: the first touch of a page costs more than a step."""

from __future__ import annotations

import ctypes

M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -4, -8  # malloc.h of the GNU C library


def keep_memory() -> bool:
    """Have the C library keep freed memory, in one arena for all threads, so that the first steps reuse that of the warm-up.

    Returns:
        False where the C library has no ``mallopt``; nothing is changed then.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    settings = ((M_ARENA_MAX, 1), (M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 2**31 - 1))
    return all(mallopt(option, value) == 1 for option, value in settings)
