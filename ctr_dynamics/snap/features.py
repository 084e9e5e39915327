"""What is read off a snap: crossing, peaks and troughs, frequencies. Pure functions of sampled angles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import find_peaks

LEVEL = 4.0
"""rad, at which a snap is timed, as in the authors' example. No equilibrium of their robots is stable there, so that only a snap passes it, and fast:
the folds of their S-curves lie at 1.88 to 2.15 rad and, as far beyond pi, at 4.13 to 4.40 rad."""
PROMINENCE = 0.02  # rad, of a peak or trough that is listed


@dataclass(frozen=True)
class Extremum:
    """A peak or trough of theta_f: kind, t_s in s, theta_f in rad."""

    kind: str
    t_s: float
    theta_f: float


def crossing(t: np.ndarray, theta: np.ndarray, level: float = LEVEL) -> float | None:
    """First time (s) at which ``theta`` (rad) rises through ``level`` (rad), by cubic splines; None when it never does."""
    above = np.flatnonzero((theta[:-1] < level) & (theta[1:] >= level))
    if not len(above):
        return None
    i = int(above[0])
    window = slice(max(0, i - 3), i + 5)
    roots = CubicSpline(t[window], theta[window] - level).roots(extrapolate=False)
    inside = [r for r in roots if t[i] - 1e-15 <= r <= t[i + 1] + 1e-15]
    return float(inside[0]) if inside else float(t[i])


def extrema(t: np.ndarray, theta: np.ndarray, prominence: float = PROMINENCE) -> list[Extremum]:
    """Peaks and troughs of ``theta`` (rad) over ``t`` (s) in the order of time, between samples by a cubic spline."""
    if len(t) < 5:
        return []
    spline = CubicSpline(t, theta)
    slope = spline.derivative()
    found = []
    for kind, sign in (("peak", 1.0), ("trough", -1.0)):
        for i in find_peaks(sign * theta, prominence=prominence)[0]:
            low, high = max(0, i - 1), min(len(t) - 1, i + 1)
            roots = [r for r in slope.roots(extrapolate=False) if t[low] <= r <= t[high]]
            at = max(roots, key=lambda r: sign * float(spline(r)), default=t[i])
            found.append(Extremum(kind, float(at), float(spline(at))))
    return sorted(found, key=lambda e: e.t_s)


def after_snap(found: list[Extremum], snap_time: float | None) -> list[Extremum]:
    """The extrema from ``snap_time`` on; none without a snap."""
    return [] if snap_time is None else [e for e in found if e.t_s >= snap_time]


def frequencies(t: np.ndarray, theta: np.ndarray, since: float, count: int = 3) -> list[tuple[float, float]]:
    """(Hz, relative height) of the highest spectral peaks of ``theta`` (rad) from ``since`` (s) on, highest first.

    Samples are made equally spaced, and the line through the last half is taken off, about which the motion settles. Only the last
    quarter is tapered: the vibration decays, and a window over all of it would weigh its end most. Lines closer to 0 than two periods of
    the record are not resolved and left out.
    """
    kept = t >= since
    if kept.sum() < 32:
        return []
    x, y = t[kept], theta[kept]
    samples = len(x)
    grid = np.linspace(x[0], x[-1], samples)
    signal = np.interp(grid, x, y)
    half, quarter = samples // 2, samples // 4
    signal -= np.polyval(np.polyfit(grid[half:] - grid[0], signal[half:], 1), grid - grid[0])
    signal[-quarter:] *= 0.5 + 0.5 * np.cos(np.linspace(0.0, np.pi, quarter))
    size = 2 ** math.ceil(math.log2(16 * samples))
    spectrum = np.abs(np.fft.rfft(signal, size))
    hz = np.fft.rfftfreq(size, (grid[-1] - grid[0]) / (samples - 1))
    spectrum[hz < 2.0 / (grid[-1] - grid[0])] = 0.0
    peaks = find_peaks(spectrum)[0]
    best = sorted(peaks, key=lambda i: -spectrum[i])[:count]
    return [(float(hz[i]), float(spectrum[i] / spectrum[best[0]])) for i in best]
