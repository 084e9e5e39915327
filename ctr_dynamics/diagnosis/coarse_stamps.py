"""Coarse stamps: times that a log has rounded, as even as the rounding allows.

In: stamps of one sensor. Out: the same, each moved by half of the log's resolution at most. Some logs round times to 10 ms. A device with a period
of 100.3 ms then has thirty intervals of 100 ms and one of 110 ms, in which its motion seems to falter; at 0.1 m/s that is a jump of 1 mm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_options import RecordingOptions

Floats = NDArray[np.float64]
AHEAD = 64  # stamps that are looked at first for the end of a straight piece


def resolution_of(stamps: NDArray[np.int64], options: RecordingOptions) -> int:
    """Resolution in ns of rising ``stamps`` (k,) in ns: the largest step that divides all intervals. 0 where it explains nothing.

    Rounding turns even intervals into two neighbouring multiples of the step. It explains nothing where intervals are even as they stand, where
    they are of other lengths too often, as by a device that is uneven itself, where the step is finer than what counts, and where intervals
    are few steps each, as where readings are missing of an even sequence.
    """
    intervals = np.diff(stamps)
    if len(intervals) < 2 or np.ptp(intervals) == 0:
        return 0
    step = int(np.gcd.reduce(intervals))
    if step < options.coarse_s * 1e9 or step * options.coarse_steps > np.median(intervals):
        return 0
    lengths, counts = np.unique(intervals // step, return_counts=True)
    beside = np.append(np.where(np.diff(lengths) == 1, counts[1:], 0), 0)
    return step if np.max(counts + beside) >= options.coarse_even * len(intervals) else 0


def evened(stamps: NDArray[np.int64], options: RecordingOptions) -> tuple[Floats, int]:
    """Times (k,) in ns of ``stamps`` (k,) in ns, which rise, and their resolution in ns; 0 where they stay as they are.

    The times are the shortest line over the readings' numbers that passes every stamp within half of the resolution (a taut string). It is straight
    as long as the device may have been even, and bends where it paused.
    """
    step = resolution_of(stamps, options)
    t = (stamps - stamps[0]).astype(float) if len(stamps) else np.zeros(0)
    if not step:
        return t, 0
    low, high = t - 0.5 * step, t + 0.5 * step
    low[[0, -1]] = high[[0, -1]] = t[[0, -1]]
    knots, heights = [0], [t[0]]
    while knots[-1] < len(t) - 1:
        k, y = _next_knot(low, high, knots[-1], heights[-1])
        knots.append(k)
        heights.append(y)
    return np.interp(np.arange(len(t)), knots, heights), step


def _next_knot(low: Floats, high: Floats, first: int, height: float) -> tuple[int, float]:
    """Where the string from ``height`` at ``first`` bends next: number and height."""
    ahead, last = AHEAD, len(low) - 1
    while True:
        end = min(first + ahead, last)
        span = np.arange(1, end - first + 1)
        steepest = (high[first + 1 : end + 1] - height) / span
        flattest = (low[first + 1 : end + 1] - height) / span
        stopped = np.flatnonzero(np.maximum.accumulate(flattest) > np.minimum.accumulate(steepest))
        if len(stopped):
            stop = int(stopped[0])
            if flattest[stop] > steepest[:stop].min():  # has to rise: it lies against the upper side before
                k = first + 1 + int(np.argmin(steepest[:stop]))
                return k, float(high[k])
            k = first + 1 + int(np.argmax(flattest[:stop]))
            return k, float(low[k])
        if end == last:
            return last, float(low[last])
        ahead *= 2
