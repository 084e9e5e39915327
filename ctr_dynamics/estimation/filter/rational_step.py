"""With which rational function, and over how many steps at once, the columns of the covariance follow the model.

Candidates are the stability functions R of Radau IIA with two and three stages (orders 3 and 5, L-stable), in partial fractions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.vibration_modes import modal_basis
from ctr_dynamics.kernels.structures import PartialFractions
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.segments import growth
from ctr_dynamics.model.simulator import State
from ctr_dynamics.model.statics import Equilibrium

Complexes = NDArray[np.complexfloating]
MODES = 8  # slowest ones: those beyond have next to no part in what a load does to the tip
MOST_STEPS = 4  # tips in between get interpolated columns; nothing is gained beyond, as measurements come every eighth step or sooner
FOLLOWED_S = 0.5  # s: what older columns have said of a vibration has been corrected by measurements since
# Of a column. An update moves the fields by columns: they keep this part of a correction, which may be several times the fused deviation.
LARGEST_ERROR = 0.04
LARGEST_GROWTH = 9.0  # exponent of the growth along the robot: rounding and differences are multiplied by its exponential, 8000
LENGTH_STEP = 0.05  # relative change of the exposed length at which strides are chosen anew
COST = {
    2: 1.0,
    3: 1.35,
}  # of one propagation with two and three stages: lanes of its sweeps (tissue robot: 150 and 200 us)

# Butcher matrices of Radau IIA with two and three stages (Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.5)
ROOT = np.sqrt(6.0)
RADAU = {
    2: np.array([[5 / 12, -1 / 12], [3 / 4, 1 / 4]]),
    3: np.array(
        [
            [(88 - 7 * ROOT) / 360, (296 - 169 * ROOT) / 1800, (-2 + 3 * ROOT) / 225],
            [(296 + 169 * ROOT) / 1800, (88 + 7 * ROOT) / 360, (-2 - 3 * ROOT) / 225],
            [(16 - ROOT) / 36, (16 + ROOT) / 36, 1 / 9],
        ]
    ),
}


def partial_fractions(matrix: NDArray[np.float64]) -> PartialFractions:
    """Poles and weights of the stability function of the stiffly accurate method with the Butcher ``matrix`` (s, s), s = 2 or 3.

    With A^-1 = T diag(poles) T^-1 the last stage is R(z) = e_s^T (1 - z A)^-1 1 = sum of (T)_sk (T^-1 1)_k pole_k / (pole_k - z).
    """
    poles, T = np.linalg.eig(np.linalg.inv(matrix))
    weights = T[-1] * np.linalg.solve(T, np.ones(len(poles)))
    upper = int(np.argmax(poles.imag))
    real = np.flatnonzero(np.abs(poles.imag) < 1e-9 * np.abs(poles))
    pole, weight = (poles[real[0]].real, weights[real[0]].real) if len(real) else (0.0, 0.0)
    return PartialFractions(float(pole), float(weight), complex(poles[upper]), complex(2.0 * weights[upper]))


def stability(fraction: PartialFractions, z: Complexes) -> Complexes:
    """R(z) of ``z`` (k,)."""
    pair, weight = fraction.complex_pole, 0.5 * fraction.complex_weight
    total = weight * pair / (pair - z) + np.conj(weight) * np.conj(pair) / (np.conj(pair) - z)
    if fraction.real_pole:
        total = total + fraction.real_weight * fraction.real_pole / (fraction.real_pole - z)
    return total


FRACTIONS = {stages: partial_fractions(matrix) for stages, matrix in RADAU.items()}


def error_rates(
    fraction: PartialFractions, frequency_hz: NDArray[np.float64], over_s: float
) -> NDArray[np.float64]:
    """(m,) 1/s, relative error of a column's vibration at each frequency, when it follows in steps of ``over_s``."""
    z = 2j * np.pi * frequency_hz * over_s
    rates: NDArray[np.float64] = np.abs(stability(fraction, z) * np.exp(-z) - 1.0) / over_s
    return rates


def column_error(fraction: PartialFractions, frequency_hz: NDArray[np.float64], over_s: float) -> float:
    """Relative error of a column ``FOLLOWED_S`` after an abrupt load, when it follows in steps of ``over_s``.

    A load on the tip excites a mode by its part of the compliance, which falls as the inverse square of the frequency.
    """
    errors = FOLLOWED_S * error_rates(fraction, frequency_hz, over_s)
    weights = (frequency_hz.min() / frequency_hz) ** 2
    return float((weights * np.minimum(errors, 1.0)).sum() / weights.sum())


def exposed(length: float, state: State) -> float:
    """Length (m) in front of the plate of tube 1 of that ``length`` (m)."""
    return length + float(state.inputs.beta[0])


class Stride(NamedTuple):
    """Over how many steps at once columns are followed, and by which rational function."""

    steps: int
    fraction: PartialFractions


class ColumnStrides:
    """The cheapest way to follow the columns that keeps their error small.

    Args:
        frequency_hz: (m,) of the slowest vibration modes at the exposed length ``length`` (m); empty where there are none.
        growth: sqrt(s), how fast the linearised equations grow along the robot: like exp(growth sqrt(c0)) (docs/model.md).
        dt: s, one step.
    """

    def __init__(self, frequency_hz: NDArray[np.float64], length: float, growth: float, dt: float) -> None:
        self._frequency, self._length, self._growth, self._dt = frequency_hz, length, growth, dt
        self._known: dict[int, Stride] = {}

    @classmethod
    def of(cls, model: Model, state: State, par: NDArray[np.float64], dt: float) -> ColumnStrides:
        """From the modes about the equilibrium ``state`` with the parameter block ``par`` (NP,)."""
        rest = Equilibrium(
            True, state.unknowns_at_base, state.fields, state.nodes, state.mesh, state.key, np.zeros(model.n)
        )
        basis = modal_basis(model, rest, par, state.inputs.beta, count=MODES)
        frequency = np.zeros(0) if basis is None else basis.frequency_hz
        # at the rate 1/s, of whose root the growth is a multiple
        by_root = float(growth(model, state.mesh, state.inputs.beta, 1.0).sum())
        return cls(frequency, exposed(float(model.robot.lengths[0]), state), by_root, dt)

    def at(self, length: float) -> Stride:
        """For the exposed ``length`` (m). Frequencies go as its inverse square, as those of bending do."""
        relative = max(length, 1e-3 * self._length) / self._length
        bucket = round(math.log(relative) / LENGTH_STEP)
        if bucket not in self._known:
            self._known[bucket] = self._choose(math.exp(bucket * LENGTH_STEP))
        return self._known[bucket]

    def _choose(self, relative: float) -> Stride:
        found = [
            (self._error(fraction, steps, relative), COST[stages] / steps, Stride(steps, fraction))
            for stages, fraction in FRACTIONS.items()
            for steps in range(1, MOST_STEPS + 1)
        ]
        good = [(cost, error, stride) for error, cost, stride in found if error <= LARGEST_ERROR]
        return min(good, key=lambda row: row[:2])[2] if good else min(found, key=lambda row: row[:2])[2]

    def _error(self, fraction: PartialFractions, steps: int, relative: float) -> float:
        over_s = steps * self._dt
        # of the fastest growing solution of w_ssss + c0^2 w = 0 with a complex c0, by that with c0 = 1
        pole = fraction.complex_pole
        factor = math.sqrt(2.0 * abs(pole)) * math.cos(math.pi / 4 - abs(np.angle(pole)) / 2)
        if self._growth * relative * factor / math.sqrt(over_s) > LARGEST_GROWTH:
            return math.inf
        if not len(self._frequency):
            return 0.0
        return column_error(fraction, self._frequency / relative**2, over_s)
