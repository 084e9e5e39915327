"""The control law without ROS: damps one vibration mode by turning all tubes together.

With all tubes turned by delta, the tip's equilibrium moves by X delta along the mode's direction (X: the static Jacobian, m/rad). The mode's
absolute coordinate w = X delta + eta (eta: the published amplitude, which counts from the moving equilibrium) obeys

    w'' + 2 zeta omega (w' - X delta') + omega^2 (w - X delta) = 0,

so that delta = -(2 zeta_c / omega) w' / X adds the damping ratio zeta_c. What counts is w' when the drive acts, not when it was measured: the
oscillator is run on from the estimate's stamp to that time, with the commands that are under way.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

STEP_S = 0.002  # of the prediction; an eightieth of a period at 6 Hz
LEAST_AUTHORITY = 1e-4  # m/rad; with less, a vibration of a millimetre would take ten radians


@dataclass(frozen=True)
class Limits:
    """What the drives may be asked for.

    Attributes:
        angle: largest |delta|, rad. rate: largest speed, rad/s. Both are kept by every command.
        acceleration: rad/s^2; the gain is lowered so that the damping motion needs no more.
    """

    angle: float = 0.15
    rate: float = 2.5
    acceleration: float = 80.0


@dataclass(frozen=True)
class Tuning:
    """Choices of the controller.

    Attributes:
        damping: zeta_c, damping ratio that is added.
        latency_s: from sending a command to the drive's answer: dead time plus lag.
        stale_s: an estimate older than this is not used.
        settle_steps: valid estimates in a row before the loop is closed (again).
        fade_s: time constant with which delta goes back to zero while the loop is open.
        noise_gain: deviations of the rate below which there is nothing to damp. Most of the published deviation is of errors that move with the
            motion; only the rest would shake the drives.
    """

    damping: float = 0.12
    latency_s: float = 0.02
    stale_s: float = 0.06
    settle_steps: int = 20
    fade_s: float = 0.3
    noise_gain: float = 0.2


@dataclass(frozen=True)
class Estimate:
    """The estimator's word about the mode at `stamp_s`: amplitude (m) and rate (m/s) from the moving equilibrium, frequency (rad/s),
    damping ratio, deviation of the rate (m/s), and the drives' angle delta (rad) and rate (rad/s) at that time. `authority`: X (m/rad) along
    the direction that the mode has now; None leaves it as it was."""

    stamp_s: float
    amplitude: float
    rate: float
    omega: float
    damping: float
    rate_sigma: float
    delta: float
    delta_rate: float
    authority: float | None = None


class DriveHistory:
    """Where the drives were: readings of the last tenths of a second, linear in between and a little beyond."""

    def __init__(self) -> None:
        self._readings: deque[tuple[float, float]] = deque(maxlen=64)

    def add(self, t: float, delta: float) -> None:
        """A reading of delta (rad) at t (s); one that is not newer than the last begins a new history."""
        if self._readings and t <= self._readings[-1][0]:
            self._readings.clear()
        self._readings.append((t, delta))

    def at(self, t: float) -> tuple[float, float] | None:
        """delta (rad) and its rate (rad/s) at t (s); None while nothing is known about that time."""
        readings = list(self._readings)
        if len(readings) < 2 or not readings[0][0] <= t <= readings[-1][0] + 0.1:
            return None
        k = next((i for i in range(len(readings) - 2, -1, -1) if readings[i][0] <= t), 0)
        (t0, d0), (t1, d1) = readings[k], readings[k + 1]
        rate = (d1 - d0) / (t1 - t0)
        return d0 + rate * (min(t, t1 + 0.02) - t0), rate


class ModalDamper:
    """Closes the loop while estimates are valid and fresh, and opens it gently when they are not.

    Args:
        authority: X, m/rad, with the sign of the mode's direction.
        period_s: time between two commands.
    """

    def __init__(
        self, authority: float, period_s: float, tuning: Tuning | None = None, limits: Limits | None = None
    ) -> None:
        if abs(authority) < LEAST_AUTHORITY:
            raise ValueError(
                f"turning the tubes moves the tip by {authority:g} m/rad only: there is nothing to damp with"
            )
        self.authority, self.period_s = authority, period_s
        self.tuning, self.limits = tuning or Tuning(), limits or Limits()
        self.delta = 0.0
        self.closed = False
        self.counts = {"closed": 0, "too few estimates": 0, "stale": 0}  # commands by what was known
        self._estimate: Estimate | None = None
        self._good = 0
        self._sent: deque[tuple[float, float]] = deque(maxlen=256)  # (time s, delta)

    def take(self, estimate: Estimate) -> None:
        """A valid estimate; one with numbers that no robot of this size has counts as none."""
        sizes = (
            (estimate.amplitude, 1.0), (estimate.rate, 100.0), (estimate.damping, 1.0), (estimate.rate_sigma, 100.0),
            (estimate.delta, 10.0), (estimate.delta_rate, 1e3),
        )  # fmt: skip
        if not all(abs(value) <= most for value, most in sizes) or not 1.0 <= estimate.omega <= 1e3:
            self.invalid()  # NaN fails every comparison
            return
        if estimate.authority is not None:
            if not LEAST_AUTHORITY <= abs(estimate.authority) <= 10.0:
                self.invalid()  # the tubes do not reach this mode
                return
            self.authority = estimate.authority
        self._estimate = estimate
        self._good += 1

    def invalid(self) -> None:
        """The estimator has said that its outputs cannot be used."""
        self._estimate = None
        self._good = 0

    def command(self, now_s: float) -> float:
        """delta (rad) to be sent now, within the limits."""
        estimate = self._estimate
        age_s = 0.0 if estimate is None else now_s - estimate.stamp_s
        if not -0.005 <= age_s <= self.tuning.stale_s:
            state = "stale"
            if not 0.0 <= age_s <= 10.0 * self.tuning.stale_s:
                self.invalid()  # silence that long is a failure, not a hiccup
        else:
            state = "closed" if self._good >= self.tuning.settle_steps else "too few estimates"
        self.counts[state] += 1
        self.closed = state == "closed"
        if self.closed and estimate is not None:
            wanted = self._wanted(estimate, now_s)
        else:
            wanted = self.delta * math.exp(-self.period_s / self.tuning.fade_s)
        self._move_towards(wanted)
        self._sent.append((now_s, self.delta))
        return self.delta

    def _wanted(self, estimate: Estimate, now_s: float) -> float:
        """delta of the law at the time at which it will act."""
        rate, envelope = self.predict(estimate, now_s + self.tuning.latency_s + 0.5 * self.period_s)
        noise = self.tuning.noise_gain * estimate.rate_sigma
        share = envelope**2 / (envelope**2 + noise**2) if envelope else 0.0
        omega, limits = estimate.omega, self.limits
        amplitude = share * 2.0 * self.tuning.damping / omega * envelope / abs(self.authority)
        # less gain instead of clipped waves: a clipped wave lags, and lag takes the damping away
        largest = min(limits.angle, limits.rate / omega, limits.acceleration / omega**2)
        scale = min(1.0, largest / amplitude) if amplitude else 0.0
        return -scale * share * 2.0 * self.tuning.damping / omega * rate / self.authority

    def predict(self, estimate: Estimate, until_s: float) -> tuple[float, float]:
        """w' (m/s) at `until_s` and the envelope of the rate (m/s), with the commands that take effect until then."""
        X, omega, zeta = self.authority, estimate.omega, estimate.damping
        w = X * estimate.delta + estimate.amplitude
        rate = X * estimate.delta_rate + estimate.rate
        delta, t = estimate.delta, estimate.stamp_s
        pending = deque(item for item in self._sent if item[0] + self.tuning.latency_s > t)
        while t < until_s - 1e-9:
            h = min(STEP_S, until_s - t)
            delta_rate = 0.0
            while pending and pending[0][0] + self.tuning.latency_s <= t + h:
                target = pending.popleft()[1]
                delta_rate, delta = (target - delta) / max(h, self.period_s), target
            # symplectic Euler keeps the energy of an oscillator
            rate += h * (-2.0 * zeta * omega * (rate - X * delta_rate) - omega**2 * (w - X * delta))
            w += h * rate
            t += h
        return rate, math.hypot(rate, omega * (w - X * delta))

    def _move_towards(self, wanted: float) -> None:
        """One period of motion within angle and rate."""
        limits, h = self.limits, self.period_s
        step = limits.rate * h
        delta = self.delta + max(-step, min(step, wanted - self.delta))
        self.delta = max(-limits.angle, min(limits.angle, delta))
