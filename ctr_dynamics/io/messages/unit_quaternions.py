"""How far from one the norm of a quaternion may be, for messages and for files."""

from __future__ import annotations

import math
from collections.abc import Iterable

MEASURED_WITHIN = 0.1  # a message's quaternion beyond this is no orientation
WRITTEN_WITHIN = 0.05  # a file's; more is another order of columns, or no quaternion
ROUNDED_WITHIN = 1e-3  # the rounding of a driver, of which nothing is said
MEASURED_NORMS = f"{1.0 - MEASURED_WITHIN:g} to {1.0 + MEASURED_WITHIN:g}"


def norm(quaternion: Iterable[float]) -> float:
    """Norm of a quaternion (4,); nan or inf where a component is."""
    return math.sqrt(sum(v * v for v in quaternion))


def is_unit(size: float, within: float = MEASURED_WITHIN) -> bool:
    """Whether a quaternion of that norm is a unit quaternion but for rounding; not where the norm is nan or infinite."""
    return abs(size - 1.0) <= within
