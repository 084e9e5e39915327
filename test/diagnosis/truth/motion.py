"""What the robot is told to do: encoder readings (before noise) of every tube, and the known load on the tip."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

HUNG_KG = 0.060
HUNG_BELOW_TIP_M = 0.0336
GRAVITY = 9.81  # m/s^2, of the hung weight
CUT_S = 1.0
CUT_LASTS_S = 0.010


def smooth_step(x: np.ndarray) -> np.ndarray:
    """0 below 0, 1 above 1, twice continuously differentiable."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x * x)


def _window(t: np.ndarray, begin: float, end: float, fade: float) -> np.ndarray:
    return smooth_step((t - begin) / fade) * smooth_step((end - t) / fade)


@dataclass
class Sines:
    """Sum of sines of one tube between two times, faded at both ends."""

    begin: float
    end: float
    fade: float
    amplitudes: np.ndarray
    frequencies: np.ndarray
    phases: np.ndarray

    def __call__(self, t: np.ndarray) -> np.ndarray:
        angles = 2 * math.pi * self.frequencies * (t[..., None] - self.begin) + self.phases
        return _window(t, self.begin, self.end, self.fade) * (self.amplitudes * np.sin(angles)).sum(-1)


@dataclass
class Triangle:
    """One period of a triangle of one tube, up first."""

    begin: float
    end: float
    fade: float
    amplitude: float

    def __call__(self, t: np.ndarray) -> np.ndarray:
        phase = 2 * math.pi * (t - self.begin) / (self.end - self.begin)
        triangle = 2 / math.pi * np.arcsin(np.sin(phase))
        return self.amplitude * _window(t, self.begin, self.end, self.fade) * triangle


@dataclass
class Motion:
    """Angles of every tube over time and the hung mass that is cut off at `CUT_S`."""

    name: str
    duration_s: float
    center: np.ndarray  # (N,) rad
    parts: list[list[Sines | Triangle]] = field(default_factory=list)  # per tube
    hung_kg: float = 0.0

    def angles(self, t: np.ndarray) -> np.ndarray:
        """(..., N) readings without noise, rad; held before 0."""
        t = np.maximum(np.asarray(t, dtype=float), 0.0)
        moved = [sum((part(t) for part in parts), np.zeros_like(t)) for parts in self.parts]
        return self.center + np.stack(moved, axis=-1)

    def load_share(self, t: np.ndarray) -> np.ndarray:
        """(...) share of the hung load that is still on, linear through the cut."""
        if not self.hung_kg:
            return np.zeros_like(np.asarray(t, dtype=float))
        return np.clip((CUT_S + CUT_LASTS_S - np.asarray(t)) / CUT_LASTS_S, 0.0, 1.0)


def _sines(rng: np.random.Generator, begin: float, end: float, peak: float) -> Sines:
    count = int(rng.integers(2, 5))
    amplitudes = rng.uniform(0.3, 1.0, count)
    amplitudes *= peak / amplitudes.sum()
    frequencies = rng.uniform(0.4, 2.7, count)
    return Sines(begin, end, 0.5, amplitudes, frequencies, rng.uniform(0, 2 * math.pi, count))


def protocol(rng: np.random.Generator, center: np.ndarray) -> Motion:
    """14 s: a hung weight cut at 1 s, a slow triangular sweep of all tubes, a multisine, rest."""
    parts: list[list[Sines | Triangle]] = []
    sign = 1.0
    for _ in center:
        size = rng.uniform(0.3, 0.55)
        peak = rng.uniform(0.4, 0.65)
        parts.append([Triangle(4.0, 8.5, 0.3, sign * size), _sines(rng, 8.5, 12.5, peak)])
        sign = -sign
    return Motion("protocol", 14.0, center, parts, HUNG_KG)


def sweep(rng: np.random.Generator, center: np.ndarray) -> Motion:
    """10 s: a multisine of all tubes about another angle, no load."""
    center = center + rng.uniform(-0.45, 0.45, len(center))
    return Motion("sweep", 10.0, center, [[_sines(rng, 0.5, 9.5, rng.uniform(0.6, 0.95))] for _ in center])


def still(name: str, duration_s: float, center: np.ndarray) -> Motion:
    """Nothing moves and nothing is cut."""
    return Motion(name, duration_s, center, [[] for _ in center])


def play(angles: np.ndarray, width: float) -> np.ndarray:
    """Output of a gear with a dead zone of `width` between the directions, from the middle of the zone."""
    out = np.empty_like(angles)
    at, half = angles[0], 0.5 * width
    for k, x in enumerate(angles):
        at = min(max(at, x - half), x + half)
        out[k] = at
    return out
