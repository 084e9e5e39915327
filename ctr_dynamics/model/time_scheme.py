"""Time schemes. Each is a list of implicit stages y_t = c0 y + h with h a weighted sum of stored fields, so that one solver serves all.

BDF-alpha and its named members follow (15) and Celaya and Jos (2013); a stage of a singly diagonally implicit Runge-Kutta (SDIRK) scheme has
the same form with c0 = 1 / (a_ii dt). Runge-Kutta schemes here are stiffly accurate: the last stage is the step's result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import polynomial

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.coupling import STAGES
from ctr_dynamics.kernels.layout import RATES, Y_NOW
from ctr_dynamics.kernels.structures import CollocationCoefficients, StageCoefficients

COLLOCATION = "radau"


@dataclass(frozen=True)
class Scheme:
    """Coefficients for one step size.

    Attributes:
        name: as in the parameter table.
        dt: s.
        times: (stages,) stage times as fractions of the step.
        c0: (stages,) 1/s.
        weights: (stages, 3 + stages) of the stored fields y_{n}, y_{n-1}, y_t of step n, and the rates of the earlier stages, in h.
        one_step: whether the step needs y_n only, so that its size may change freely.
        order: of accuracy in time for smooth motions.
    """

    name: str
    dt: float
    times: np.ndarray
    c0: np.ndarray
    weights: np.ndarray
    one_step: bool
    order: int

    @property
    def stages(self) -> int:
        """Number of implicit solves a step."""
        return len(self.c0)

    @cached_property
    def coefficients(self) -> StageCoefficients:
        """``c0`` and ``weights`` for the kernels."""
        return StageCoefficients(self.c0, self.weights)


@dataclass(frozen=True)
class Collocation:
    """Radau IIA with four stages, of order seven, for one step size: all stages are solved together.

    Stiffly accurate and L-stable: the last stage is the step's result, and what is too fast for the step follows its load as if at rest.

    Attributes:
        name: as in the parameter table.
        dt: s.
        times: (stages,) stage times as fractions of the step.
        coefficients: for the kernels.
    """

    name: str
    dt: float
    times: np.ndarray
    coefficients: CollocationCoefficients
    one_step = True
    order = 7

    @property
    def stages(self) -> int:
        """Stages of a step."""
        return len(self.times)

    def parted(self, dt: float) -> Collocation:
        """The same for a step of ``dt`` (s)."""
        C, rates, to_modes, from_modes = self.coefficients
        ratio = self.dt / dt
        return Collocation(
            self.name, dt, self.times, CollocationCoefficients(C * ratio, rates * ratio, to_modes, from_modes)
        )

    @property
    def rate(self) -> float:
        """1/s, by which the rates of the fields are measured: that of the last stage."""
        return float(self.coefficients.C[-1, -1])


def radau_nodes(stages: int) -> tuple[np.ndarray, np.ndarray]:
    """Matrix A (stages, stages) and nodes c (stages,) of Radau IIA (Hairer and Wanner 1996, section IV.5).

    c are the roots of the derivative of order s - 1 of x^(s - 1) (x - 1)^s; A integrates polynomials of degree s - 1 exactly.
    """
    p = polynomial.polymul(polynomial.polypow([0, 1], stages - 1), polynomial.polypow([-1, 1], stages))
    c = np.sort(polynomial.polyroots(polynomial.polyder(p, stages - 1)).real)
    powers = np.arange(1, stages + 1)
    return c[:, None] ** powers / powers @ np.linalg.inv(np.vander(c, stages, increasing=True)), c


def collocation(dt: float) -> Collocation:
    """Radau IIA with four stages for the step ``dt`` (s)."""
    A, c = radau_nodes(STAGES)
    C = np.linalg.inv(A) / dt
    rates, vectors = np.linalg.eig(C)
    pairs = rates.imag > 0.0
    return Collocation(
        COLLOCATION,
        dt,
        c,
        CollocationCoefficients(
            np.ascontiguousarray(C),
            rates[pairs],
            np.ascontiguousarray(np.linalg.inv(vectors)[pairs]),
            np.ascontiguousarray(2.0 * vectors[:, pairs]),  # each stands for its conjugate too
        ),
    )


def _bdf_alpha(name: str, dt: float, alpha: float, order: int) -> Scheme:
    c0 = (1.5 + alpha) / ((1.0 + alpha) * dt)
    c1, c2, d1 = -2.0 / dt, (0.5 + alpha) / ((1.0 + alpha) * dt), alpha / (1.0 + alpha)
    # h_i = (c1 + d1 c0) y_{i-1} + c2 y_{i-2} + d1 h_{i-1}, and h_{i-1} = y_t,{i-1} - c0 y_{i-1}
    weights = np.array([[c1, c2, d1, 0.0]])
    return Scheme(name, dt, np.ones(1), np.array([c0]), weights, False, order)


def _sdirk(name: str, dt: float, a: np.ndarray, order: int) -> Scheme:
    s = len(a)
    c0 = 1.0 / (np.diag(a) * dt)
    weights = np.zeros((s, RATES + s))
    weights[:, Y_NOW] = -c0
    for i in range(s):
        weights[i, RATES : RATES + i] = -c0[i] * dt * a[i, :i]
    return Scheme(name, dt, a.sum(axis=1), c0, weights, True, order)


def make_scheme(name: str, dt: float, alpha: float = -0.45) -> Scheme:
    """The scheme ``name``, of those that solve one stage after the other, for step ``dt`` (s); ``alpha`` is read by ``bdf_alpha`` only.

    Raises:
        InputError: unknown name, dt not positive, or alpha outside [-0.5, 1].
    """
    if not (math.isfinite(dt) and dt > 0):
        raise InputError(f"time step {dt} s must be above 0 s", do="give a step in seconds, such as 0.003")
    if name == "backward_euler":
        return Scheme(name, dt, np.ones(1), np.array([1 / dt]), np.array([[-1 / dt, 0.0, 0.0, 0.0]]), True, 1)
    if name == "bdf2":
        return _bdf_alpha(name, dt, 0.0, 2)
    if name == "trapezoid":
        return _bdf_alpha(name, dt, -0.5, 2)
    if name == "bdf_alpha":
        if not -0.5 <= alpha <= 1.0:
            raise InputError(
                f"model.alpha {alpha:g} is outside [-0.5, 1]", do="-0.5 is the trapezoidal rule, 0 is BDF2"
            )
        return _bdf_alpha(name, dt, alpha, 2)
    if name == "sdirk2":
        g = 1.0 - math.sqrt(0.5)
        return _sdirk(name, dt, np.array([[g, 0.0], [1.0 - g, g]]), 2)
    if name == "sdirk3":
        # Alexander (1977): three stages, third order, L-stable; g is the root of g^3 - 3 g^2 + 3 g / 2 - 1/6 in (1/6, 1/2).
        g = 0.43586652150845899942
        b1, b2 = -1.5 * g * g + 4.0 * g - 0.25, 1.5 * g * g - 5.0 * g + 1.25
        return _sdirk(name, dt, np.array([[g, 0.0, 0.0], [0.5 * (1.0 - g), g, 0.0], [b1, b2, g]]), 3)
    raise InputError(
        f"time scheme '{name}' is not known",
        do="use backward_euler, bdf2, trapezoid, bdf_alpha, sdirk2 or sdirk3",
    )


def scheme_of(name: str, dt: float, alpha: float = -0.45) -> Scheme | Collocation:
    """Any time scheme by its name in the parameter table, as :func:`make_scheme`."""
    return collocation(dt) if name == COLLOCATION else make_scheme(name, dt, alpha)
