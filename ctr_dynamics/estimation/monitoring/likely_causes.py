"""Which cause of the catalogue would leave the present residual: recursive regression of the model alone's residual on the causes' signatures.

A signature is the direction and course that a small departure gives to the tip, to first order and without running the model: enough to say
where to look first, not to name a cause; that takes `ctr-dynamics diagnose`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctr_dynamics.estimation.step_output import MotionPoint
from ctr_dynamics.kernels.filter_steps import matrix

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
TOGETHER = 32  # moments taken in at once


class Course(NamedTuple):
    """Points one after another, arrays of them (k, ...) as in :class:`~ctr_dynamics.estimation.step_output.MotionPoint`, and what signatures share:
    ``frame`` (k, 3, 3) of the tip, ``moving`` (k,) from 0 at rest to 1, and the sign of each tube's last motion ``held`` (k, n)."""

    residual: Floats
    position: Floats
    velocity: Floats
    acceleration: Floats
    alpha: Floats
    alpha_rate: Floats
    beta_rate: Floats
    frame: Floats
    moving: Floats
    held: Floats


def course(moments: Sequence[MotionPoint], held: Floats) -> Course:
    """The ``moments`` as a course; ``held`` (n,): sign of each tube's motion before them."""
    every = [np.array(values) for values in zip(*moments, strict=True)]
    residual, position, quaternion, velocity, acceleration, alpha, alpha_rate, beta_rate = every
    size = np.hypot.reduce(alpha_rate, axis=1) + 100.0 * np.hypot.reduce(beta_rate, axis=1)
    signs = np.empty_like(alpha_rate)
    for sign, rate in zip(signs, alpha_rate, strict=True):
        sign[:] = held = np.where(np.abs(rate) > MOVING, np.sign(rate), held)
    return Course(
        residual, position, velocity, acceleration, alpha, alpha_rate, beta_rate, np.array([matrix(q) for q in quaternion]),
        size**2 / (size**2 + MOVING**2), signs,
    )  # fmt: skip


def _always(c: Course, vectors: ArrayLike) -> Floats:
    """The same columns (3, m) in every moment."""
    vectors = np.asarray(vectors, float)
    return np.broadcast_to(vectors, (len(c.residual), *vectors.shape))


def _turn(c: Course, sizes: Floats) -> Floats:
    """Columns for turns by ``sizes`` (k, m) rad about the base's axis."""
    per_rad = np.stack([-c.position[:, 1], c.position[:, 0], np.zeros(len(c.position))], axis=1)
    return per_rad[:, :, None] * sizes[:, None, :]


def _swinging(c: Course) -> Floats:
    """Velocity while the actuators stand still: a wrong frequency shows as a phase that runs away."""
    return ((1.0 - c.moving)[:, None] * c.velocity)[:, :, None]


def _cross(c: Course) -> Floats:
    x, y, z = c.position.T
    nil = np.zeros_like(x)
    return np.stack(
        [np.stack([nil, z, -y], axis=1), np.stack([-z, nil, x], axis=1), np.stack([y, -x, nil], axis=1)],
        axis=1,
    )


@dataclass(frozen=True)
class Signature:
    """What a small ``effect`` adds to the readings of a course of k moments: ``columns(course)`` (k, 3, m), one column per unknown. ``text`` says
    what it looks for."""

    effect: str
    columns: Callable[[Course], Floats]
    text: str


SIGNATURES: tuple[Signature, ...] = (
    Signature("tracker_latency", lambda c: c.velocity[:, :, None], "along the tip's velocity"),
    Signature(
        "actuator_latency",
        lambda c: (c.moving[:, None] * c.velocity)[:, :, None],
        "along the tip's velocity, only while actuators move",
    ),
    Signature("tracker_averaging", lambda c: c.acceleration[:, :, None], "along the tip's acceleration"),
    Signature("registration_translation", lambda c: _always(c, np.eye(3)), "constant"),
    Signature("tip_force", lambda c: _always(c, np.eye(3)[:, :2]), "constant, across the base's axis"),
    Signature("gravity_direction", lambda c: _always(c, np.eye(3)[:, [0]]), "constant, across gravity"),
    Signature("registration_rotation", _cross, "turn about the base"),
    Signature("tracker_scale", lambda c: c.position[:, :, None], "grows with the distance from the base"),
    Signature("tracker_lever_arm", lambda c: c.frame, "constant in the tip's frame"),
    Signature("exposed_length", lambda c: c.frame[:, :, 2:], "constant, along the tip's tangent"),
    Signature(
        "youngs_modulus",
        lambda c: np.concatenate(
            [(c.position * [1.0, 1.0, 0.0])[:, :, None], _always(c, [[0.0], [1.0], [0.0]]), _swinging(c)],
            axis=2,
        ),
        "along the deflection from the base's axis, sag, and the lag of a swing",
    ),
    Signature(
        "payload_mass",
        lambda c: np.concatenate([(c.acceleration + [0.0, GRAVITY, 0.0])[:, :, None], _swinging(c)], axis=2),
        "along gravity and the tip's acceleration together, and the lag of a swing",
    ),
    Signature(
        "precurvature",
        lambda c: (c.position * [1.0, 1.0, 0.0])[:, :, None],
        "radial, turning with the tubes",
    ),
    Signature("encoder_offset", lambda c: _turn(c, np.ones((len(c.alpha), 1))), "turn about the base's axis"),
    Signature("encoder_gain", lambda c: _turn(c, c.alpha), "turn that grows with each tube's angle"),
    Signature(
        "shear_modulus",
        lambda c: _turn(c, c.alpha[:, :-1] - c.alpha[:, 1:]),
        "turn that grows with the angle between the tubes",
    ),
    Signature("backlash", lambda c: _turn(c, c.held), "turn by the sign of each tube's last motion"),
    Signature(
        "base_coulomb",
        lambda c: _turn(c, c.held * c.moving[:, None]),
        "turn by the sign of each tube's rate, while it moves",
    ),
    Signature(
        "tube_coulomb",
        lambda c: _turn(c, np.tanh((c.alpha_rate[:, :-1] - c.alpha_rate[:, 1:]) / MOVING)),
        "turn by the sign of the tubes' relative rate",
    ),
    Signature(
        "insertion_velocity",
        lambda c: c.beta_rate[:, :1, None] * c.frame[:, :, 2:],
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

    Moments are collected and taken in ``TOGETHER``, which costs hardly more than taking in one.
    ``noise``: standard deviation of the tracker's position, m per axis.
    """

    def __init__(self, memory: float, noise: float) -> None:
        self.memory, self.noise = memory, noise
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._waiting: list[tuple[float, MotionPoint]] = []
        self._time: float | None = None  # of the newest moment
        self._last: float | None = None  # of the newest that has been taken in
        self._held: Floats | None = None
        self.seconds = 0.0
        self.samples = 0.0

    def add(self, time: float, moment: MotionPoint) -> None:
        """Take in the moment of a sample of ``time`` (s), unless it follows the last one too closely to say anything new."""
        if self._time is not None and abs(time - self._time) < CLOSE:
            return
        self._time = time
        self._waiting.append((time, moment))
        if len(self._waiting) >= TOGETHER:
            self._take_in()

    def _take_in(self) -> None:
        """The moments that wait, each worth less the older it is."""
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        times = np.array([time for time, _ in waiting])
        c = course([moment for _, moment in waiting], np.zeros(1) if self._held is None else self._held)
        self._held = c.held[-1]
        blocks = [s.columns(c) for s in SIGNATURES]
        X, y = np.concatenate(blocks, axis=2), c.residual
        finite = np.isfinite(X.sum(axis=(1, 2)) + y.sum(axis=1))
        times, X, y = times[finite], X[finite], y[finite]
        if not len(times):
            return
        if self._last is None:
            ends = np.cumsum([0, *(b.shape[2] for b in blocks)])
            self._slices = [
                np.arange(a, b) for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)
            ]
            self._gram, self._moment = np.zeros((ends[-1], ends[-1])), np.zeros(ends[-1])
            self._square = 0.0
        steps = np.clip(
            np.diff(times, prepend=times[0] if self._last is None else self._last), 0.0, self.memory
        )
        fades = np.exp((np.cumsum(steps) - steps.sum()) / self.memory)
        fade = math.exp(-steps.sum() / self.memory)
        weighted = (fades[:, None, None] * X).reshape(-1, X.shape[2])
        self._gram = fade * self._gram + weighted.T @ X.reshape(-1, X.shape[2])
        self._moment = fade * self._moment + weighted.T @ y.ravel()
        self._square = fade * self._square + float(fades @ np.einsum("ki,ki->k", y, y))
        self.samples = fade * self.samples + float(fades.sum())
        self.seconds = fade * self.seconds + float(fades @ steps)
        self._last = float(times[-1])

    def _left(self, sets: list[list[int]]) -> list[float]:
        """Sums of squares that each of ``sets`` of signatures leaves, at least the noise; all at once, for these are many small problems."""
        chosen = [np.concatenate([self._slices[i] for i in one]) for one in sets]
        # sets of fewer columns are filled up with one of zeros, which explains nothing
        empty = len(self._gram)
        columns = np.full((len(sets), max(map(len, chosen))), empty)
        for row, one in zip(columns, chosen, strict=True):
            row[: len(one)] = one
        size = np.append(np.sqrt(np.maximum(self._gram.diagonal(), 1e-300)), 1.0)
        gram, moment = np.pad(self._gram, (0, 1)) / np.outer(size, size), np.append(self._moment, 0.0) / size
        lam, E = np.linalg.eigh(gram[columns[:, :, None], columns[:, None, :]])
        inverse = np.where(lam > 1e-8, 1.0 / np.maximum(lam, 1e-8), 0.0)
        along = np.einsum("kij,ki->kj", E, moment[columns])
        explained = np.einsum("kj,kj->k", along**2, inverse)
        return [max(self._square - part, self._floor) for part in explained.tolist()]

    @property
    def _floor(self) -> float:
        return 3.0 * self.samples * self.noise**2

    def causes(self) -> list[Cause]:
        """At most ``MOST``, likeliest first; none where no cause explains ``LEAST`` of what lies above the noise.

        A cause is worth the logarithm of what it leaves, times the number of independent residuals, less a penalty for each unknown (the
        Bayesian information criterion): the best one, its rivals, then what explains most of the rest.
        """
        self._take_in()
        excess = self._square - self._floor if self._last is not None else 0.0
        count = 3.0 * INDEPENDENT * self.seconds
        if excess <= 0.0 or count < 6.0:
            return []
        every = range(len(SIGNATURES))

        def worth(chosen: list[int], left: float) -> float:
            unknowns = sum(len(self._slices[i]) for i in chosen)
            return -count * math.log(left) - unknowns * math.log(count)

        alone = self._left([[i] for i in every])
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
            after = dict(zip(rest, self._left([[*chosen, i] for i in rest]), strict=True))
            nxt = max(rest, key=lambda i: worth([*chosen, i], after[i]))
            if worth([*chosen, nxt], after[nxt]) <= worth(chosen, left):
                break
            found.append(Cause(SIGNATURES[nxt].effect, (left - after[nxt]) / excess, True))
            chosen, left = [*chosen, nxt], after[nxt]
        return found
