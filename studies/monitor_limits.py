"""How often the misfit monitor's limits are passed by the innovations of a consistent filter: white and normal, 6 axes at 40 Hz.

    python -m studies.monitor_limits --hours 1000

For each statistic: alarms per ten hours at the default limit and the limit that is passed once in ten hours. Alarms are separated by at least
a window; the CUSUM begins at zero after each.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.monitoring.consistency_monitor import LAGS, ConsistencyLimits

RATE, AXES = 40.0, 6
TEN_HOURS = 36_000.0  # s


def peaks(hours: float, limits: ConsistencyLimits, seed: int) -> dict[str, NDArray[np.float64]]:
    """Largest value of each statistic in every stretch of a window's length."""
    rng = np.random.default_rng(seed)
    window = round(limits.window * RATE)
    found: dict[str, list[float]] = {"cusum": [], "nis": [], "whiteness": []}
    sum_before, tail = 0.0, rng.standard_normal((window + LAGS, AXES))
    for _ in range(max(1, round(hours * 3600 / limits.window / 360))):
        white = np.concatenate([tail, rng.standard_normal((360 * window, AXES))])
        tail = white[-window - LAGS :]
        nis = np.sum(white**2, axis=1)
        walk = np.concatenate([[sum_before], nis[window + LAGS :] - AXES * (1.0 + limits.slack)]).cumsum()
        cusum = (walk - np.minimum(np.minimum.accumulate(walk), 0.0))[1:]
        sum_before = float(cusum[-1])
        total = np.concatenate([[0.0], nis.cumsum()])
        mean = (total[window:] - total[:-window])[LAGS + 1 :] / (AXES * window)
        ends = np.arange(window + LAGS + limits.every, len(white) + 1, limits.every)
        size = np.maximum(_sums(white**2, window, ends), window)
        rho = sum(
            np.square(_sums(white[lag:] * white[:-lag], window - lag, ends - lag) / size) / (window - lag)
            for lag in range(1, LAGS + 1)
        )
        box = window * (window + 2.0) * rho.sum(axis=1) / (LAGS * AXES)
        for name, values in (("cusum", cusum), ("nis", mean), ("whiteness", box)):
            per = window // limits.every if name == "whiteness" else window
            found[name] += values[: 360 * per].reshape(360, per).max(axis=1).tolist()
    return {name: np.array(values) for name, values in found.items()}


def _sums(rows: NDArray[np.float64], count: int, ends: NDArray[np.int64]) -> NDArray[np.float64]:
    """Sums of ``count`` rows before each of ``ends``."""
    total = np.concatenate([np.zeros((1, rows.shape[1])), rows.cumsum(axis=0)])
    return total[ends] - total[ends - count]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=1000.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    limits = ConsistencyLimits()
    print(f"{options.hours:g} h, seed {options.seed}")
    for name, values in peaks(options.hours, limits, options.seed).items():
        tens = len(values) * limits.window / TEN_HOURS
        limit = getattr(limits, name)
        ordered = np.sort(values)[::-1]
        once = ordered[min(len(ordered) - 1, max(0, round(tens) - 1))]
        print(
            f"{name:10s} limit {limit:6.2f}: {np.sum(values > limit) / tens:.3f} per 10 h; once per 10 h at {once:.2f}; largest {ordered[0]:.2f}"
        )


if __name__ == "__main__":
    main()
