"""Choice of the steps in time: as long as the data can tell no difference.

In: a forward model, its whitener and a point. Out: the model with steps of its own. Steps are doubled, and doubled again, in as many windows of time
as the data allow: first in those in which longer steps throughout make least difference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_options import StepOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel, Key
from ctr_dynamics.diagnosis.time_steps import TimeSteps
from ctr_dynamics.diagnosis.whitening import Whitener

Floats = NDArray[np.float64]


def with_chosen_steps(
    model: ForwardModel, whiten: Whitener, point: Mapping[Key, float], options: StepOptions
) -> ForwardModel:
    """``model`` with the steps that it needs at ``point``: the shortest everywhere, where these fail or longer ones are of no use.

    Steps that have been chosen elsewhere stay where they make no more than twice the difference that is allowed.
    """
    even = model.with_steps(None)
    fine = even.residual_at(point)
    if fine is None or not whiten.size:
        return even
    window_s = options.window * even.scheme.dt
    count = max(int(np.ceil(even.recording.duration / window_s)), 1)
    window = np.minimum((even.recording.stamps[whiten.used] / window_s).astype(int), count - 1)

    def squares(level: NDArray[np.int64]) -> Floats:
        """(windows,) of the whitened difference that steps doubled ``level`` times in each window make; infinity where they fail."""
        steps = TimeSteps(window_s, tuple((even.scheme.dt * 2.0**level).tolist()))
        found = even.with_steps(steps).residual_at(point)
        if found is None:
            return np.full(count, np.inf)
        difference = whiten(found - fine).reshape(-1, len(window))
        return np.bincount(window, np.sum(difference**2, axis=0), minlength=count).astype(float)

    if model.steps is not None:
        known = model.residual_at(point)
        if known is not None and float(np.linalg.norm(whiten(known - fine))) <= 2.0 * options.limit:
            return model
    level = np.zeros(count, np.int64)
    for doubled in range(1, int(np.log2(options.window)) + 1):
        longer = _doubled_where_allowed(level, doubled, squares, options)
        if np.array_equal(longer, level):
            break
        level = longer
    if not level.any():
        return even
    return even.with_steps(TimeSteps(window_s, tuple((even.scheme.dt * 2.0**level).tolist())))


def _doubled_where_allowed(
    level: NDArray[np.int64],
    doubled: int,
    squares: Callable[[NDArray[np.int64]], Floats],
    options: StepOptions,
) -> NDArray[np.int64]:
    """``level`` with the last doubling once more in as many windows as the limit allows, to an eighth of them."""
    everywhere = np.where(level == doubled - 1, doubled, level)
    made = squares(everywhere)
    if made.sum() <= options.limit**2:
        return everywhere
    # what is excited in a window shows in the next one
    made = np.maximum(made, np.append(made[1:], 0.0))
    order = np.argsort(made, kind="stable")
    order = order[level[order] == doubled - 1]
    few, many, best = 0, len(order), level
    while many - few > max(len(level) // 8, 1):
        middle = (few + many) // 2
        trial = level.copy()
        trial[order[:middle]] = doubled
        if squares(trial).sum() <= options.limit**2:
            few, best = middle, trial
        else:
            many = middle
    return best
