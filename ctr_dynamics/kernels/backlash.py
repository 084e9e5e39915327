"""The play operator: what a shaft with a dead zone passes on."""

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.compiler import njit


@njit(cache=True)
def play(values: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Output (k,) for inputs ``values`` (k,) with dead zone ``width``: it moves only when the input has crossed it. Starts in its middle."""
    out = np.empty_like(values)
    state = values[0]
    half = 0.5 * width
    for i in range(len(values)):
        state = min(max(state, values[i] - half), values[i] + half)
        out[i] = state
    return out
