"""How large three things are that no robot file can tell: the unknown tip force, the tracker's shift and its noise (docs/filter.md).

Each of them makes innovations larger, but in another way. A force moves the tip, with its rotation and in the time that the robot takes. A
shift moves the measured position alone, and stays. Noise is new with every measurement. So the sizes are inferred together: an innovation
that noise explains does not raise the force.

With the gains that the filter has used, its covariance is affine in the three variances: Pi = F + c D_force + d D_shift + n D_noise. F comes from
the prior and the other noise, each D from the randomness of one of the three. The D go through the filter beside Pi. So the covariance of an
innovation is known for all other variances, and with it their likelihood. Each variance is taken from a grid and changes now and then to one
drawn from its prior: a filter for a hidden Markov chain (Rabiner 1989). The filter has their mean values. Where one grows, Pi is at once what it
would be had it been that all along. Where the force's becomes less, its past randomness stays in Pi until measurements have removed it: a force
that has ended did move the robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dsygv

from ctr_dynamics.kernels.kinds import SIMD_WIDTH
from ctr_dynamics.kernels.variance_likelihood import (
    DensityBuffers,
    densities,
    new_randomness,
    quadratic_forms,
    update_probabilities,
)
from ctr_dynamics.sensing.tracker import SHIFT, STATES

Floats = NDArray[np.float64]
FORCE_PART, SHIFT_PART, NOISE_PART = 0, 1, 2  # in the order of the kernels
LARGEST = 2.0  # variance of a constant, by that of its tolerance, to which faults of the tracker raise it. Above 1: what is not measured has 1.


@dataclass(frozen=True)
class AdaptationOptions:
    """How the variances are adapted.

    Attributes:
        largest_change: times the force's variance, at one measurement, up or down. A force takes time to move the robot, so one measurement
            says little of it.
        largest_inflation: times the same, at one measurement, where several in a row have been outside the gate.
        shortest_interval: s between two measurements, or a late one and its predecessor. Above 0, so that no variance is ever ruled out.
        force_spacing: of the force's grid, in the logarithm of the variance. Less than one innovation can tell apart.
        fault_spacing: the same of shift and noise, of which only the size counts.
        memory_s: for how long randomness of the past counts as that of a shift or of noise of another size.
        sound_s: mean time after which a sound tracker shifts or becomes noisy. fault_s: mean time after which such a fault ends or changes.
        sound: probability that it ends.
        established: probability from which on the tracker counts as noisy.
        least_shift: by the stated deviation of the position's noise, the smallest jump of a shift. Less is not told from noise.
        least_noise: the smallest noise that is a fault, by the stated variance.
    """

    largest_change: float = 10.0
    largest_inflation: float = 1000.0
    shortest_interval: float = 1e-3
    force_spacing: float = 0.5
    fault_spacing: float = 1.8
    memory_s: float = 0.3
    sound_s: float = 1000.0
    fault_s: float = 1.0
    sound: float = 0.5
    established: float = 0.9
    least_shift: float = 1.0
    least_noise: float = 2.5


class AdaptedState(NamedTuple):
    """What a checkpoint stores of :class:`AdaptedVariances`; nothing in it is written to later."""

    parts: Floats
    waiting: tuple[tuple[Floats, Floats, Floats], ...]
    weights: Floats
    steady: float
    quiet: float
    sigma: float
    shift: float
    noise: float
    fraction: float
    stamp: float


class ForceRange(NamedTuple):
    """The unknown tip force: deviations ``least`` and ``most`` between which its own lies, N per axis, and the mean time between two changes, s."""

    least: float
    most: float
    change_s: float


class Constants(NamedTuple):
    """What does not change with time and has a tolerance: the robot's parameters, registration, lever arm and delay.

    Attributes:
        rows: (p, n) of which each, times the error of the filter's states, gives that of a constant by its tolerance.
        pi: (n, n) covariance of the filter's states.
    """

    rows: Floats
    pi: Floats

    def most(self, added: Floats) -> float:
        """The part, up to 1, of what is ``added`` (n, n) to the covariance that leaves every variance at ``LARGEST`` times its tolerance."""
        now, change = (((self.rows @ m) * self.rows).sum(axis=1) for m in (self.pi, added))
        room = np.maximum(LARGEST - now, 0.0)
        excess = change > room
        return float((room[excess] / change[excess]).min()) if excess.any() else 1.0


class AdaptedVariances:
    """Joint distribution of the variances of tip force, tracker shift and tracker noise.

    Args:
        force: the range of the tip force.
        position_noise: m per axis, deviation that the robot file states for a measured position.
        reach: m, length of the robot: a shift or an error of a position is not larger.
        options: how they are adapted.

    Attributes:
        sigma: deviation that the process noise of the force has now, N per axis.
        shift: deviation of the shift's jump between two measurements, m per axis. noise: the tracker's variance by the stated one.
        fraction: largest part of an innovation's variance that the force had at the last measurement, 0 to 1, along any direction.
        reach: m. grids: of each variance, as it is: N^2, m^2, and by the stated one. priors: probabilities of their values.
        weights: (a, b, c) their joint probabilities. steady, quiet: probabilities that the tracker does not shift, and has the stated noise.
    """

    def __init__(
        self, force: ForceRange, position_noise: float, reach: float, options: AdaptationOptions | None = None
    ) -> None:
        self.options = options = options or AdaptationOptions()
        self.reach = reach
        low, high = 2.0 * math.log(force.least), 2.0 * math.log(force.most)
        grid = np.linspace(low, high, max(1, math.ceil((high - low) / options.force_spacing) + 1))
        # a variance ten times as large is a tenth as likely before anything is measured
        likely = np.exp(low - grid)
        jump, largest = (options.least_shift * position_noise) ** 2, max(reach, 2.0 * position_noise) ** 2
        none = 1e-6 * jump
        shift = np.r_[none, self._faults(jump, largest)]
        noise = np.r_[1.0, self._faults(options.least_noise, largest / position_noise**2)]
        self.grids = (np.exp(grid), shift, noise)
        self.priors = (likely / likely.sum(), self._prior(len(shift)), self._prior(len(noise)))
        # 1/s, rate at which each value is left
        self._rates = (
            np.full(len(grid), 1.0 / force.change_s),
            *(1.0 / np.r_[options.sound_s, np.full(len(g) - 1, options.fault_s)] for g in (shift, noise)),
        )
        # rows: probabilities that a value is left before the next measurement, and that it is the one that is taken
        self._changes = tuple(
            np.stack([rate, prior]) for rate, prior in zip(self._rates, self.priors, strict=True)
        )
        # whole batches of forces; those beyond the last are not read
        self._forces = np.full(SIMD_WIDTH * -(-len(grid) // SIMD_WIDTH), self.grids[0][-1])
        self._forces[: len(grid)] = self.grids[0]
        self._buffers: dict[int, DensityBuffers] = {}  # by the size of an innovation
        self._parts = np.zeros((3, 0, 0))
        self._clear()

    def _faults(self, least: float, most: float) -> Floats:
        """Variances of a fault, evenly spaced in their logarithms."""
        return np.geomspace(
            least, most, max(2, math.ceil(math.log(most / least) / self.options.fault_spacing) + 1)
        )

    def _prior(self, count: int) -> Floats:
        """Probabilities of no fault and of all its sizes: one is as likely as the other."""
        return np.r_[self.options.sound, np.full(count - 1, (1.0 - self.options.sound) / (count - 1))]

    def _clear(self) -> None:
        force, shift, noise = self.grids
        self.sigma, self.shift, self.noise = math.sqrt(force[0]), math.sqrt(shift[0]), float(noise[0])
        weights = np.zeros((len(shift), len(noise), len(force)))  # in the order of the kernels
        self.weights = weights.transpose(2, 0, 1)
        self.weights[:, 0, 0] = self.priors[0]
        self.steady = self.quiet = 1.0
        self.fraction, self._stamp = 0.0, -math.inf
        # corrections that the parts have not followed yet: gain, derivative, noise
        self._waiting: list[tuple[Floats, Floats, Floats]] = []

    @property
    def parts(self) -> Floats:
        """(3, n, n) D: what of the filter's covariance is in proportion to the variances of force, shift and noise."""
        if self._waiting:
            self.settle()
        return self._parts

    @parts.setter
    def parts(self, parts: Floats) -> None:
        self._parts = parts

    @property
    def noisy(self) -> bool:
        """Whether it is established that the tracker has more noise than stated; the gate goes by it then."""
        return self.quiet < 1.0 - self.options.established

    @property
    def sound(self) -> bool:
        """Whether the tracker is more likely than not to be steady, and not established to be noisy."""
        return not self.noisy and self.steady > 0.5

    def start(self, pi: Floats, force: slice) -> None:
        """Begin with the least force, which the coefficients ``force`` of the covariance ``pi`` (n, n) hold, and a sound tracker."""
        self._clear()
        self.parts = np.zeros((3, *pi.shape))
        self.parts[FORCE_PART][force, force] = pi[force, force]

    def append(self, at: int, count: int, variance: float) -> None:
        """New randomness of the force: ``count`` coefficients of ``variance`` before the coefficient ``at``."""
        n = self.parts.shape[1]
        old = np.r_[:at, at + count : n + count]
        parts = np.zeros((3, n + count, n + count))
        parts[np.ix_(range(3), old, old)] = self.parts
        np.fill_diagonal(parts[FORCE_PART, at : at + count, at : at + count], variance)
        self.parts = parts

    def decay(self, rows: slice, factor: float) -> None:
        """The states ``rows`` have decayed by ``factor``."""
        self.parts[:, rows, :] *= factor
        self.parts[:, :, rows] *= factor

    def project(self, projection: Floats) -> None:
        """The first r coefficients a have become ``projection`` (k, r) a."""
        k, r = projection.shape
        old, n = self.parts, k + self.parts.shape[1] - r
        parts = np.empty((3, n, n))
        parts[:, :k, :k] = projection @ old[:, :r, :r] @ projection.T
        parts[:, :k, k:] = projection @ old[:, :r, r:]
        parts[:, k:, :k] = parts[:, :k, k:].transpose(0, 2, 1)
        parts[:, k:, k:] = old[:, r:, r:]
        self.parts = parts

    def _elapsed(self, stamp: float) -> float:
        """s since the last measurement; the least where there is none."""
        least = self.options.shortest_interval
        return max(least, stamp - self._stamp) if math.isfinite(self._stamp) else least

    def jump(self, stamp: float, pi: Floats) -> None:
        """The shift may have jumped since the last measurement, before one of the time ``stamp`` (s); ``pi`` (n, n) changes in place."""
        # what the filter has fused while the tracker was sound is no error of a fault that begins now
        remains = math.exp(-self._elapsed(stamp) / self.options.memory_s)
        left = remains * (1.0 - self.steady), remains * (1.0 - self.quiet)
        new_randomness(pi, self.parts, len(pi) - STATES + SHIFT.start, self.shift**2, left)

    def adapt(
        self, stamp: float, nu: Floats, H: Floats, S: Floats, R: Floats, constants: Constants | None = None
    ) -> Floats:
        """Take in an innovation of the time ``stamp`` (s).

        Args:
            stamp: s from the first step.
            nu, H, S: (k,), its derivative (k, n) and its covariance (k, k) by the present variances.
            R: (k, k) the measurement noise that the robot file states.
            constants: what has a tolerance; None for nothing.

        Returns:
            The change (n, n) of the filter's covariance that the new variances make.
        """
        options = self.options
        # 1. Likelihood of all variances.
        k = len(nu)
        parts = np.empty((3, k, k))
        quadratic_forms(H, self.parts, parts)
        parts[NOISE_PART] += self.noise * R
        present = (self.sigma**2, self.shift**2, self.noise)
        force, shift, noise = (
            grid / value for grid, value in zip((self._forces, *self.grids[1:]), present, strict=True)
        )
        if k not in self._buffers:
            self._buffers[k] = DensityBuffers.of((len(shift), len(noise), len(force)), k)
        likelihood = densities(nu, S, parts, (force - 1.0, shift - 1.0, noise - 1.0), self._buffers[k])
        if likelihood is None:
            return np.zeros_like(self._parts[0])
        # 2. Hidden Markov chain: each may have changed since the last innovation, then Bayes' rule.
        elapsed = self._elapsed(stamp)
        self._stamp = max(stamp, self._stamp)
        for left, rate in zip(self._changes, self._rates, strict=True):
            left[0] = -np.expm1(-elapsed * rate)
        marginals = [np.empty_like(grid) for grid in self.grids]
        weights = self.weights.transpose(1, 2, 0).copy()  # in the order of the kernels
        update_probabilities(weights, likelihood, _rolled(self._changes), _rolled(marginals))
        self.weights = weights.transpose(2, 0, 1)
        self.steady, self.quiet = float(marginals[1][0]), float(marginals[2][0])
        # 3. The filter goes over to the mean variances.
        force, shift, noise = (
            float(marginal @ grid) / value
            for marginal, grid, value in zip(marginals, self.grids, present, strict=True)
        )
        force = min(max(force, 1.0 / options.largest_change), options.largest_change)
        # a force that has become less has left its trace in Pi
        change = np.array([max(force, 1.0), shift, noise]) - 1.0
        larger = S + (change @ parts.reshape(3, -1)).reshape(S.shape)
        fraction = force * largest_variance_fraction(parts[FORCE_PART], larger)
        self.fraction = min(max(fraction, 0.0), 1.0)
        growth = self._grown(change, np.array([force, shift, noise]), constants)
        self.sigma *= math.sqrt(force)
        self.shift *= math.sqrt(shift)
        self.noise *= noise
        return growth

    def _grown(self, change: Floats, ratios: Floats, constants: Constants | None) -> Floats:
        """The change (n, n) of Pi by the ``change`` (3,) of the parts, which become ``ratios`` (3,) times what they are.

        Of what faults of the tracker would add, the ``constants`` and the fields, which depend on them, get no more than the tolerances allow.
        What the parts were is then no part of these variances any more.
        """
        n = self.parts.shape[1]
        fault = np.maximum(change, 0.0)
        fault[FORCE_PART] = 0.0
        if constants is not None and fault.any():
            part = constants.most((fault @ self.parts.reshape(3, -1)).reshape(n, n))
            if part < 1.0:
                deviations = np.full(n, math.sqrt(part))
                deviations[n - STATES :][SHIFT] = 1.0
                limited = fault > 0.0
                self.parts[limited] *= fault[limited, None, None] * np.multiply.outer(deviations, deviations)
                change, ratios = np.where(limited, 1.0, change), np.where(limited, 1.0, ratios)
        growth: Floats = (change @ self.parts.reshape(3, -1)).reshape(n, n)
        self.parts *= ratios[:, None, None]
        return growth

    @property
    def headroom(self) -> float:
        """By how much the force's variance may grow where the filter has lost the robot."""
        return float(min(self.options.largest_inflation, self.grids[0][-1] / self.sigma**2))

    def scale(self, c: float, deviations: Floats) -> None:
        """Have ``c`` times the force's variance, in the past too; ``deviations`` (n,): of the coefficients, by what they were."""
        self.sigma *= math.sqrt(c)
        self.parts[FORCE_PART] *= c
        self.parts *= np.multiply.outer(deviations, deviations)

    def correct(self, K: Floats, H: Floats, R: Floats) -> None:
        """A measurement of noise ``R`` (k, k) by the robot file has been fused with gain ``K`` (n, k) and derivative ``H`` (k, n).

        The parts follow it when they are asked for, or in :meth:`settle` before: no output waits for them.
        """
        self._waiting.append((K, H, self.noise * R))

    def settle(self) -> None:
        """Have the parts follow all corrections. Each (I - K H) D (I - K H)^T is made symmetric, as rounding errors would grow."""
        for K, H, R in self._waiting:
            noise = np.zeros((3, *R.shape))
            noise[NOISE_PART] = R
            self._parts = joseph(self._parts, K, H, noise)
        self._waiting.clear()

    def checkpoint(self) -> AdaptedState:
        """What :meth:`restore` returns to."""
        return AdaptedState(
            self._parts.copy(),
            tuple(self._waiting),
            self.weights,
            self.steady,
            self.quiet,
            self.sigma,
            self.shift,
            self.noise,
            self.fraction,
            self._stamp,
        )

    def restore(self, state: AdaptedState) -> None:
        """Return to a checkpoint."""
        (
            parts, waiting, self.weights, self.steady, self.quiet, self.sigma, self.shift, self.noise, self.fraction, self._stamp,
        ) = state  # fmt: skip
        self._parts, self._waiting = parts.copy(), list(waiting)


def joseph(P: Floats, K: Floats, H: Floats, R: Floats) -> Floats:
    """(I - K H) P (I - K H)^T + K R K^T of one or several ``P`` (.., n, n) with ``R`` (.., k, k), for a gain ``K`` (n, k) and ``H`` (k, n).

    Multiplied from the left, then from the right, with products of few rows only.
    """
    left = P - K @ (H @ P)
    left -= (left @ H.T - K @ R) @ K.T
    symmetric: Floats = 0.5 * (left + left.swapaxes(-1, -2))
    return symmetric


def _rolled(values: Sequence[Floats]) -> tuple[Floats, Floats, Floats]:
    """Of force, shift and noise, in the order of the kernels."""
    force, shift, noise = values
    return shift, noise, force


def largest_variance_fraction(part: Floats, whole: Floats) -> float:
    """Largest fraction of the variance by ``whole`` (k, k) that ``part`` (k, k) has, along any direction: the largest x of part v = x whole v."""
    values, _, failed = dsygv(part, whole, jobz="N")
    return 1.0 if failed else float(values[-1])
