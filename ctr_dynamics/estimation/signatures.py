"""Which cause of the catalogue would leave the present residual: recursive regression of the model alone's residual on the causes' signatures.

A signature is the direction and course that a small departure gives to the tip, to first order and without running the model: enough to say
where to look first, not to name a cause; that takes `ctr-dynamics diagnose`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .kernels import matrix
from .outputs import Moment

Floats = NDArray[np.float64]

GRAVITY = 9.81  # m/s^2, along -y of ctr_base
# rad/s (and m/s times 100) beyond which an actuator counts as moving: five times what the encoders' noise looks like
MOVING = 0.2
INDEPENDENT = (
    10.0  # 1/s: residuals closer than a tenth of a second count as one; the tip swings at a few hertz
)
CLOSE = 0.4 / INDEPENDENT  # s: a few samples for each independent residual are enough
LEAST = 0.3  # part of the residual above the tracker's noise that a cause must explain to be listed
RIVAL = 0.9  # a cause that alone explains this part of what the best does is its rival
MOST = 3  # causes listed


def _turn(m: Moment) -> Floats:
    """Displacement per rad of turn about the base's axis."""
    return np.array([-m.position[1], m.position[0], 0.0])


def _moving(m: Moment) -> float:
    rate = math.hypot(*m.alpha_rate) + 100.0 * math.hypot(*m.beta_rate)
    return rate * rate / (rate * rate + MOVING * MOVING)


def _swinging(m: Moment) -> Floats:
    """Velocity while the actuators stand still: a wrong frequency shows as a phase that runs away."""
    return (1.0 - _moving(m)) * m.velocity


def _cross(m: Moment) -> Floats:
    x, y, z = m.position
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])


@dataclass(frozen=True)
class Signature:
    """What a small ``effect`` adds to the reading: ``columns(moment, held)`` (3, m), one column per unknown; ``held`` (n,) is the sign of each
    tube's last motion. ``text`` says what it looks for."""

    effect: str
    columns: Callable[[Moment, Floats], Floats]
    text: str


SIGNATURES: tuple[Signature, ...] = (
    Signature("tracker_latency", lambda m, held: m.velocity[:, None], "along the tip's velocity"),
    Signature(
        "actuator_latency",
        lambda m, held: _moving(m) * m.velocity[:, None],
        "along the tip's velocity, only while actuators move",
    ),
    Signature("tracker_averaging", lambda m, held: m.acceleration[:, None], "along the tip's acceleration"),
    Signature("registration_translation", lambda m, held: np.eye(3), "constant"),
    Signature("tip_force", lambda m, held: np.eye(3)[:, :2], "constant, across the base's axis"),
    Signature("gravity_direction", lambda m, held: np.eye(3)[:, [0]], "constant, across gravity"),
    Signature("registration_rotation", lambda m, held: _cross(m), "turn about the base"),
    Signature("tracker_scale", lambda m, held: m.position[:, None], "grows with the distance from the base"),
    Signature("tracker_lever_arm", lambda m, held: matrix(m.quaternion), "constant in the tip's frame"),
    Signature(
        "exposed_length", lambda m, held: matrix(m.quaternion)[:, 2:], "constant, along the tip's tangent"
    ),
    Signature(
        "youngs_modulus",
        lambda m, held: np.column_stack([m.position * [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], _swinging(m)]),
        "along the deflection from the base's axis, sag, and the lag of a swing",
    ),
    Signature(
        "payload_mass",
        lambda m, held: np.column_stack([m.acceleration + [0.0, GRAVITY, 0.0], _swinging(m)]),
        "along gravity and the tip's acceleration together, and the lag of a swing",
    ),
    Signature(
        "precurvature",
        lambda m, held: (m.position * [1.0, 1.0, 0.0])[:, None],
        "radial, turning with the tubes",
    ),
    Signature("encoder_offset", lambda m, held: _turn(m)[:, None], "turn about the base's axis"),
    Signature(
        "encoder_gain", lambda m, held: np.outer(_turn(m), m.alpha), "turn that grows with each tube's angle"
    ),
    Signature(
        "shear_modulus",
        lambda m, held: np.outer(_turn(m), m.alpha[:-1] - m.alpha[1:]),
        "turn that grows with the angle between the tubes",
    ),
    Signature(
        "backlash", lambda m, held: np.outer(_turn(m), held), "turn by the sign of each tube's last motion"
    ),
    Signature(
        "base_coulomb",
        lambda m, held: np.outer(_turn(m), held * _moving(m)),
        "turn by the sign of each tube's rate, while it moves",
    ),
    Signature(
        "tube_coulomb",
        lambda m, held: np.outer(_turn(m), np.tanh((m.alpha_rate[:-1] - m.alpha_rate[1:]) / MOVING)),
        "turn by the sign of the tubes' relative rate",
    ),
    Signature(
        "insertion_velocity",
        lambda m, held: m.beta_rate[0] * matrix(m.quaternion)[:, 2:],
        "along the tangent, with the rate of insertion",
    ),
)


@dataclass(frozen=True)
class Cause:
    """An effect of the catalogue and the part (0 to 1) of the residual above the tracker's noise that it explains: alone, or on top of those
    listed before it where ``added``."""

    effect: str
    explained: float
    added: bool


class Regression:
    """Sums of the normal equations of all signatures together, with a memory that fades over ``memory`` (s).

    ``noise``: standard deviation of the tracker's position, m per axis.
    """

    def __init__(self, memory: float, noise: float) -> None:
        self.memory, self.noise = memory, noise
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._last: float | None = None
        self._held: Floats | None = None
        self.seconds = 0.0
        self.samples = 0.0

    def add(self, time: float, moment: Moment) -> None:
        """Take in the moment of a sample of ``time`` (s), unless it follows the last one too closely to say anything new."""
        if self._last is not None and abs(time - self._last) < CLOSE:
            return
        rates = moment.alpha_rate
        if self._held is None:
            self._held = np.zeros(len(rates))
        self._held = np.where(np.abs(rates) > MOVING, np.sign(rates), self._held)
        blocks = [s.columns(moment, self._held) for s in SIGNATURES]
        X = np.concatenate(blocks, axis=1)
        y = moment.residual
        if not np.isfinite(X.sum() + y.sum()):
            return
        if self._last is None:
            ends = np.cumsum([0, *(b.shape[1] for b in blocks)])
            self._slices = [
                np.arange(a, b) for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)
            ]
            self._gram, self._moment = np.zeros((ends[-1], ends[-1])), np.zeros(ends[-1])
            self._square = 0.0
        step = min(max(time - self._last, 0.0), self.memory) if self._last is not None else 0.0
        fade = math.exp(-step / self.memory)
        self._gram = fade * self._gram + X.T @ X
        self._moment = fade * self._moment + X.T @ y
        self._square = fade * self._square + float(y @ y)
        self.samples = fade * self.samples + 1.0
        self.seconds = fade * self.seconds + step
        self._last = time

    def _left(self, chosen: list[int]) -> float:
        """Sum of squares that the signatures ``chosen`` leave, at least the noise."""
        columns = np.concatenate([self._slices[i] for i in chosen])
        size = np.sqrt(np.maximum(self._gram[columns, columns], 1e-300))
        G = self._gram[np.ix_(columns, columns)] / np.outer(size, size)
        b = self._moment[columns] / size
        lam, E = np.linalg.eigh(G)
        inverse = np.where(lam > 1e-8, 1.0 / np.maximum(lam, 1e-8), 0.0)
        return max(self._square - float((E.T @ b) ** 2 @ inverse), self._floor)

    @property
    def _floor(self) -> float:
        return 3.0 * self.samples * self.noise**2

    def causes(self) -> list[Cause]:
        """At most ``MOST``, likeliest first; none where no cause explains ``LEAST`` of what lies above the noise.

        A cause is worth the logarithm of what it leaves, times the number of independent residuals, less a penalty for each unknown (the
        Bayesian information criterion): the best one, its rivals, then what explains most of the rest.
        """
        excess = self._square - self._floor if self._last is not None else 0.0
        count = 3.0 * INDEPENDENT * self.seconds
        if excess <= 0.0 or count < 6.0:
            return []
        every = range(len(SIGNATURES))

        def worth(chosen: list[int], left: float) -> float:
            unknowns = sum(len(self._slices[i]) for i in chosen)
            return -count * math.log(left) - unknowns * math.log(count)

        alone = [self._left([i]) for i in every]
        order = sorted(every, key=lambda i: -worth([i], alone[i]))
        best = order[0]
        nothing = -count * math.log(self._square)
        explained = (self._square - alone[best]) / excess
        if explained < LEAST or worth([best], alone[best]) <= nothing:
            return []
        found = [Cause(SIGNATURES[best].effect, explained, False)]
        for i in order[1:]:
            part = (self._square - alone[i]) / excess
            if part >= RIVAL * explained and worth([i], alone[i]) > nothing and len(found) < MOST:
                found.append(Cause(SIGNATURES[i].effect, part, False))
        chosen, left = [best], alone[best]
        while len(found) < MOST:
            listed = {cause.effect for cause in found}
            rest = [i for i in every if SIGNATURES[i].effect not in listed]
            after = {i: self._left([*chosen, i]) for i in rest}
            nxt = max(rest, key=lambda i: worth([*chosen, i], after[i]))
            if worth([*chosen, nxt], after[nxt]) <= worth(chosen, left):
                break
            found.append(Cause(SIGNATURES[nxt].effect, (left - after[nxt]) / excess, True))
            chosen, left = [*chosen, nxt], after[nxt]
        return found
