"""The tracker's delay after a start in motion: the model starts at rest, and its open-loop run lacks the vibration that the robot has.

A vibration and its phase are not known, so measurements of it tell nothing of a delay. The rest of the motion does. For every delay, residuals are
explained by a level and by free vibrations of the slowest modes, whose amplitudes and phases are estimated beside it by a Kalman filter. Gains are
the same for all delays. How strongly the robot vibrates is not known either, so several amplitudes compete.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.discretisation import VibrationErrors
from ctr_dynamics.estimation.monitoring.delay_search import (
    DelaySearch,
    DelaySearchOptions,
    Evidence,
    Vibrations,
    Waiting,
)
from ctr_dynamics.estimation.monitoring.densities import density_of_filter
from ctr_dynamics.estimation.monitoring.moved_tracker import Moved
from ctr_dynamics.kernels.delay_evidence import weigh_vibrating

Floats = NDArray[np.float64]
MODES = 4  # slowest ones: those that the filter may begin with
AMPLITUDES = 0.5 * 2.0 ** np.arange(7)  # by the noise, of one axis: up to 32 times
MISTUNED = 0.03  # relative error of a frequency, at least: poses and insertions change it by that
UNLIKELY = math.log(0.1)  # odds of another delay, from which on measurements have shown the present one
SETTLED_S = 0.2  # for which amplitudes are compared before any is believed to be over
# A vibration beside a delay makes up for what lies between two delays. Of what is remembered, corrections reach back 2 s, 80 measurements at 40 Hz;
# each takes 450 kB.
MOVING_START = replace(DelaySearchOptions(), spacing_s=0.001, changes=False, remembered=100)


class MovingStart(DelaySearch):
    """Evidence for every delay of the tracker since a start in motion.

    Args:
        noise, change_s, length, registered: see :class:`DelaySearch`.
        modes: how the robot vibrates at rest.
    """

    def __init__(
        self, noise: float, change_s: float, length: float, registered: float, modes: VibrationErrors
    ) -> None:
        exponent = modes.exponent[:MODES]
        self._omega, self._damping = exponent.imag, -exponent.real
        self._astray = max(modes.tolerance, MISTUNED) * self._omega  # 1/s, by which phases go astray
        self._amplitudes = noise * AMPLITUDES
        self._seen = np.r_[1.0, np.tile([1.0, 0.0], len(exponent))]  # of level and both phases of every mode
        super().__init__(noise, change_s, length, registered, MOVING_START)

    def clear(self) -> None:
        """Forget all measurements."""
        super().clear()
        self._first_ns = 0

    def _decayed(self, elapsed: float) -> Floats:
        """(m,) part of its amplitude that every mode has left ``elapsed`` s after the first measurement."""
        left: Floats = np.exp(-self._damping * elapsed)
        return left

    def _step(self, elapsed: float) -> tuple[Floats, Floats]:
        """Transition (n, n) over ``elapsed`` s, and the parts (2 m,) of the modes' variances whose phase it loses: they come back with another."""
        transition = np.eye(len(self._seen))
        turned = np.exp((-self._damping - self._astray + 1j * self._omega) * elapsed)
        for i, z in zip(range(1, len(transition), 2), turned, strict=True):
            transition[i : i + 2, i : i + 2] = [[z.real, -z.imag], [z.imag, z.real]]
        return transition, np.repeat(-np.expm1(-2.0 * self._astray * elapsed), 2)

    def _count(self, measured: Waiting, residual: Floats) -> None:
        """Evidence with a measurement that lies ``residual`` (d, 3) m from the open-loop run with every delay."""
        stamp_ns, last = measured.stamp_ns, self._evidence[-1] if self._evidence else None
        none, of_filter = np.zeros(len(residual)), 0.0
        if last is None or last.vibrations is None:
            self._first_ns = stamp_ns
            known, level, delays = self._begin(residual), residual, none
        else:
            elapsed = (stamp_ns - last.stamp_ns) * 1e-9
            decay, since = math.exp(-elapsed / self.options.memory_s), (stamp_ns - self._first_ns) * 1e-9
            known = self._go_on(last.vibrations, residual, elapsed, decay, since)
            delays = np.logaddexp.reduce(known.evidence, axis=0) - math.log(len(known.evidence))
            of_filter = density_of_filter(measured.predictive, elapsed / self._change_s) + decay * last.filter
            level = np.ascontiguousarray(known.states[int(known.evidence.max(axis=1).argmax()), :, :, 0])
        # neither a latency that changes nor a tracker that is moved is looked for
        began, nothing = np.full(len(residual), stamp_ns), Moved(np.zeros(3), 0.0, -math.inf)
        self._evidence.append(
            Evidence(stamp_ns, level, self._noise**2, delays, of_filter, none, began, level, nothing, known)
        )

    def _begin(self, residual: Floats) -> Vibrations:
        """With the first measurement: anything may be its level, beside vibrations of each amplitude."""
        each = self._amplitudes[:, None, None] ** 2 / max(len(self._omega), 1)  # of the variance, a mode
        covariance = each * np.diag(np.r_[0.0, np.ones(2 * len(self._omega))])
        covariance[:, 0] = covariance[:, :, 0] = -each[:, 0] * np.r_[0.0, self._seen[1:]]
        covariance[:, 0, 0] = self._noise**2 + self._amplitudes**2 * bool(len(self._omega))
        states = np.zeros((len(each), *residual.shape, len(self._seen)))
        states[..., 0] = residual
        return Vibrations(states, covariance, np.zeros((len(each), len(residual))))

    def _go_on(
        self, last: Vibrations, residual: Floats, elapsed: float, decay: float, since: float
    ) -> Vibrations:
        """With another measurement, ``elapsed`` s after the last one and ``since`` s after the first."""
        noise, seen = self._noise**2, self._seen
        transition, renewed = self._step(elapsed)
        before = transition @ last.covariance @ transition.T
        before[:, 0, 0] += noise * elapsed / self.options.drift_s
        modes = range(1, len(seen))
        left = np.repeat(self._decayed(since) ** 2, 2) / max(len(self._omega), 1)
        before[:, modes, modes] += self._amplitudes[:, None] ** 2 * (left * renewed)
        along = before @ seen
        totals = along @ seen + noise
        gains = along / totals[:, None]
        covariance = before - gains[:, :, None] * along[:, None]
        states, evidence = last.states.copy(), last.evidence.copy()
        weigh_vibrating(residual, transition, seen, gains, totals, noise, decay, states, evidence)
        return Vibrations(states, covariance, evidence)

    def shows(self, present_s: float) -> bool:
        """Whether measurements show that the tracker has the delay ``present_s`` (s).

        All others together are unlikely then, were they as likely before. The filter is not asked: it foretells well with a late tracker, too.
        """
        if len(self._evidence) < 2:
            return False
        known, near = self._evidence[-1].delays, np.abs(self.delays - present_s) <= self.options.least_s
        if not near.any() or near.all():
            return True
        present, other = (
            np.logaddexp.reduce(part) - math.log(len(part)) for part in (known[near], known[~near])
        )
        return bool(other - present < UNLIKELY)

    @property
    def vibrates_m(self) -> float:
        """m, deviation of the tip by the vibration that the open-loop run still lacks; 0 where it is less than is measured, infinite until that is
        known."""
        known = self._evidence[-1].vibrations if self._evidence else None
        since = (self._evidence[-1].stamp_ns - self._first_ns) * 1e-9 if self._evidence else 0.0
        if known is None or since < SETTLED_S:
            return math.inf
        likeliest = int(np.logaddexp.reduce(known.evidence, axis=0).argmax())
        of_amplitudes = known.evidence[:, likeliest]
        weights = np.exp(of_amplitudes - of_amplitudes.max())
        left = self._decayed(since) ** 2
        square = weights @ self._amplitudes**2 / weights.sum() * (left.mean() if len(left) else 0.0)
        size = math.sqrt(3.0 * square)
        return size if size > self._noise else 0.0
