"""The consistency monitor: do the innovations still have the size and the whiteness that the filter expects?

Three statistics over a window: mean NIS, CUSUM of the NIS, and autocorrelation. Their limits are set by simulated white innovations
(studies/monitor_limits.py): a consistent filter at 40 Hz alarms less than once in ten hours. Its status and parameters are called `misfit`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.monitoring.likely_causes import Cause, CauseRegression
from ctr_dynamics.estimation.step_output import OK, WARN, Innovation, Status
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]

LAGS = 8  # of the autocorrelation, in measurements: 0.2 s at 40 Hz, about a period of a slow vibration


@dataclass(frozen=True)
class ConsistencyLimits:
    """When to alarm, and what is judged.

    Attributes:
        window: s. nis: mean NIS per degree of freedom over the window. slack: excess NIS per degree of freedom that the CUSUM lets pass.
        cusum: its limit, in units of NIS. whiteness: Ljung-Box statistic over the window per degree of freedom.
        every: measurements between looks at the autocorrelation, which takes longer than all else.
        fewest: measurements in the window before anything but the CUSUM is judged, 2 s: fewer scatter too much.
        largest_nis: a NIS counts as that at most, so that one wild measurement does not stay in the sums' rounding.
    """

    window: float = 10.0
    nis: float = 1.3
    slack: float = 0.5
    cusum: float = 60.0
    whiteness: float = 2.5
    every: int = 20
    fewest: int = 80
    largest_nis: float = 1e6


def ljung_box(white: Floats, lags: int = LAGS) -> float:
    """Ljung-Box statistic of ``white`` (k, axes) over ``lags``, per degree of freedom: near 1 for white innovations.

    Ljung and Box, Biometrika 65 (1978), without removing the mean, for a bias is inconsistent too. Innovations smaller than predicted are related
    to what was predicted: however they are correlated, they do not alarm.
    """
    k, axes = white.shape
    size = np.maximum(np.einsum("ij,ij->j", white, white), k)
    rho = np.array([np.einsum("ij,ij->j", white[lag:], white[:-lag]) for lag in range(1, lags + 1)])
    rho /= size
    weight = k * (k + 2.0) / (k - np.arange(1, lags + 1))
    return float(weight @ np.sum(rho**2, axis=1)) / (lags * axes)


class ConsistencyMonitor:
    """Fed once for every measurement that reached the gate.

    Args:
        limits: when to alarm.
        noise: standard deviation of the tracker's position, m per axis.
        gravity: (3,) m/s^2, ``ctr_base``; how a robot sags tells causes apart.

    Attributes:
        nis, cusum, whiteness: present values; NaN while there are too few measurements.
        alarm: whether one of them was above its limit within the last window. alarms: how often it rose.
    """

    def __init__(
        self,
        limits: ConsistencyLimits | None = None,
        noise: float = 0.0,
        gravity: Sequence[float] = (0.0, -9.81, 0.0),
    ) -> None:
        self.limits = limits or ConsistencyLimits()
        self.alarms = 0
        self._regression = CauseRegression(self.limits.window, noise, gravity)
        self.clear()

    def clear(self) -> None:
        """Forget all measurements; the count of alarms stays."""
        self.nis = self.whiteness = math.nan
        self.cusum = 0.0
        self.alarm = False
        self._exceeded: tuple[float, str] | None = None  # time and words of the last value above its limit
        self._window: deque[tuple[float, float, int, Floats]] = deque()  # time, NIS, dof, whitened
        self._nis, self._dof, self._count = 0.0, 0, 0
        self._regression.clear()
        self._causes: tuple[int, list[Cause]] | None = None

    def add(self, innovation: Innovation) -> None:
        """Take in a measurement's innovation; one without degrees of freedom is passed over."""
        if not innovation.dof or innovation.white is None:
            return
        time = innovation.stamp_ns * 1e-9
        if self._window and abs(time - self._window[-1][0]) > self.limits.window:
            self.clear()  # nothing links what was before such a gap
        nis = min(innovation.nis, self.limits.largest_nis)
        self._window.append((time, nis, innovation.dof, innovation.white))
        self._nis += nis
        self._dof += innovation.dof
        while time - self._window[0][0] > self.limits.window:
            _, old, dof, _ = self._window.popleft()
            self._nis -= old
            self._dof -= dof
        self._count += 1
        if innovation.motion is not None:
            self._regression.add(time, innovation.motion)
        self._judge(time, nis, innovation.dof)

    def _judge(self, time: float, nis: float, dof: int) -> None:
        limits = self.limits
        # held below twice the limit, so that it comes back within seconds once the filter is consistent again
        self.cusum = min(max(0.0, self.cusum + nis - dof * (1.0 + limits.slack)), 2.0 * limits.cusum)
        words = []
        if self.cusum > limits.cusum:
            words.append(f"CUSUM of NIS {self.cusum:.0f}, limit {limits.cusum:g}")
        if len(self._window) >= limits.fewest:
            if self._count % limits.every == 0:
                self._nis = sum(nis for _, nis, _, _ in self._window)  # no rounding piles up
                measured = np.array([white for _, _, _, white in self._window])
                self.whiteness = ljung_box(measured[:, np.isfinite(measured).all(axis=0)])
            self.nis = self._nis / self._dof
            # a window that is not full yet scatters more
            limit = max(limits.nis, 1.0 + 6.0 * math.sqrt(2.0 / self._dof))
            if self.nis > limit:
                words.append(
                    f"mean NIS {self.nis:.2f} per degree of freedom over {limits.window:g} s, limit {limit:.2f}"
                )
            if self.whiteness > limits.whiteness:
                words.append(
                    f"autocorrelation of the innovations {self.whiteness:.1f}, limit {limits.whiteness:g}"
                )
        if words:
            self._exceeded = (time, "; ".join(words))
        was, self.alarm = (
            self.alarm,
            self._exceeded is not None and time - self._exceeded[0] <= limits.window,
        )
        self.alarms += self.alarm and not was

    def causes(self) -> list[Cause]:
        """Likeliest causes of the present open-loop residual, likeliest first."""
        if self._causes is None or self._causes[0] != self._count:
            self._causes = (self._count, self._regression.causes())
        return self._causes[1]

    def status(self) -> Status:
        """The monitor's line of diagnostics."""
        limits = self.limits

        def shown(value: float) -> str:
            return f"{value:.2f}" if math.isfinite(value) else "too few samples"

        values = {
            f"nis per dof, last {limits.window:g} s": shown(self.nis),
            "cusum of nis": f"{self.cusum:.1f}",
            "autocorrelation": shown(self.whiteness),
            "alarms": str(self.alarms),
        }
        if not self.alarm:
            return Status(
                "misfit", OK, "innovations as expected" if self._window else "no samples yet", values
            )
        assert self._exceeded is not None
        causes = self.causes()
        for number, cause in enumerate(causes, 1):
            added = ", on top of the first" if cause.added else ""
            values[f"cause {number}"] = f"{cause.effect} ({100 * cause.explained:.0f} % explained{added})"
        if causes:
            which = "likeliest causes: " + ", ".join(cause.effect for cause in causes)
        else:
            which = "no cause of the list explains it"
        return Status("misfit", WARN, f"{self._exceeded[1]}; {which}", values)


def consistency_monitor(settings: Mapping[str, Any], robot: Robot) -> ConsistencyMonitor:
    """The monitor of ``robot`` with the parameter table's limits."""
    limits = ConsistencyLimits(
        window=float(settings["misfit.window_s"]),
        nis=float(settings["misfit.nis_limit"]),
        slack=float(settings["misfit.cusum_slack"]),
        cusum=float(settings["misfit.cusum_limit"]),
        whiteness=float(settings["misfit.whiteness_limit"]),
    )
    return ConsistencyMonitor(limits, robot.tracker.noise.position.value, robot.gravity.value)
