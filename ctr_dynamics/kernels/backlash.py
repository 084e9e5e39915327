"""Backlash: what a shaft with a dead zone passes on (the play operator, Nordin and Gutman 2002)."""

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.compiler import njit


@njit(cache=True)
def behind_backlash(drive: NDArray[np.float64], width: float, before: float) -> NDArray[np.float64]:
    """Positions (k,) behind a dead zone ``width`` while the drive takes the positions ``drive`` (k,); ``before``: the position before the first.

    The shaft moves only when the drive has crossed the zone.
    """
    out = np.empty_like(drive)
    position = before
    half = 0.5 * width
    for i in range(len(drive)):
        position = min(max(position, drive[i] - half), drive[i] + half)
        out[i] = position
    return out
