"""Values between those of an even grid. See :mod:`ctr_dynamics.estimation.monitoring.delay_search`."""

import math

from ctr_dynamics.kernels.compiler import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def fill_between(values, offsets, least, dense):
    """Set ``dense`` (d, f) around every one of the ``values`` (d,), at ``offsets`` (f,) in steps of the grid: parabolas through neighbours.

    Between two points there are two, through the next point on either side; the lower one counts. Where none can reach ``least``, ``dense`` is minus
    infinity: no parabola rises higher above its points than by an eighth of their second difference.
    """
    last = len(values) - 2
    for i in range(len(values)):
        at = min(max(i, 1), last)
        before, middle, after = values[at - 1], values[at], values[at + 1]
        bent = before - 2.0 * middle + after
        if max(before, middle, after) + 0.125 * abs(bent) < least:
            dense[i] = -math.inf
            continue
        for k in range(len(offsets)):
            lower = math.inf
            for side in range(2):
                beside = 0 if side == 0 else (-1 if offsets[k] < 0.0 else 1)
                c = min(max(i + beside, 1), last)
                x = i - c + offsets[k]
                curve = values[c - 1] - 2.0 * values[c] + values[c + 1]
                lower = min(lower, values[c] + 0.5 * x * (values[c + 1] - values[c - 1] + x * curve))
            dense[i, k] = lower
