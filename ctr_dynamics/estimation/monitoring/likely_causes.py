"""Which cause of the catalogue would leave the present residual: a recursive regression of the open-loop residual on the causes' sensitivities.

A sensitivity is how a small change of a cause moves the tip, to first order and without running the model. That is enough to say where to look
first, but not to name a cause. For this there is `ctr-dynamics diagnose`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctr_dynamics.estimation.step_output import MotionPoint
from ctr_dynamics.kernels.compiled_rotations import matrix

Floats = NDArray[np.float64]

# rad/s (and m/s times 100) above which an actuator counts as moving: five times what the encoders' noise looks like
MOVING = 0.2
UPRIGHT = 0.1  # part of gravity across the base's axis, below which a robot does not sag to one side


@dataclass(frozen=True)
class RegressionOptions:
    """What counts as a cause.

    Attributes:
        independent: 1/s. Residuals closer than a tenth of a second count as one, as the tip swings at a few hertz.
        closest: s between two points that are taken in. A few measurements for each independent residual are enough.
        least: part of the residual above the tracker's noise that a cause must explain to be listed.
        rival: a cause that explains by itself this part of what the best does is its rival.
        most: causes listed.
        together: points taken in at once, which costs hardly more than taking in one.
        fewest: independent residuals below which nothing is said.
    """

    independent: float = 10.0
    closest: float = 0.04
    least: float = 0.3
    rival: float = 0.9
    most: int = 3
    together: int = 32
    fewest: float = 6.0


class MotionWindow(NamedTuple):
    """Points of the motion one after another, and what the sensitivities share.

    Attributes:
        residual, position, velocity, acceleration, alpha, alpha_rate, beta_rate: arrays (k, ...) of
            :class:`ctr_dynamics.estimation.step_output.MotionPoint`.
        frame: (k, 3, 3) of the tip. moving: (k,) from 0 at rest to 1. held: (k, n) sign of each tube's last motion.
        gravity: (3,) m/s^2, ``ctr_base``.
    """

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
    gravity: Floats


def motion_window(points: Sequence[MotionPoint], held: Floats, gravity: Floats) -> MotionWindow:
    """The ``points`` as one window; ``held`` (n,): sign of each tube's motion before them. ``gravity``: (3,) m/s^2."""
    every = [np.array(values) for values in zip(*points, strict=True)]
    residual, position, quaternion, velocity, acceleration, alpha, alpha_rate, beta_rate = every
    size = np.hypot.reduce(alpha_rate, axis=1) + 100.0 * np.hypot.reduce(beta_rate, axis=1)
    signs = np.empty_like(alpha_rate)
    for sign, rate in zip(signs, alpha_rate, strict=True):
        sign[:] = held = np.where(np.abs(rate) > MOVING, np.sign(rate), held)
    return MotionWindow(
        residual, position, velocity, acceleration, alpha, alpha_rate, beta_rate, np.array([matrix(q) for q in quaternion]),
        size**2 / (size**2 + MOVING**2), signs, gravity,
    )  # fmt: skip


def _always(c: MotionWindow, vectors: ArrayLike) -> Floats:
    """The same columns (3, m) at every point."""
    vectors = np.asarray(vectors, float)
    return np.broadcast_to(vectors, (len(c.residual), *vectors.shape))


def _turn(c: MotionWindow, sizes: Floats) -> Floats:
    """Columns for turns by ``sizes`` (k, m) rad about the base's axis."""
    per_rad = np.stack([-c.position[:, 1], c.position[:, 0], np.zeros(len(c.position))], axis=1)
    return per_rad[:, :, None] * sizes[:, None, :]


def _across_base(c: MotionWindow) -> Floats:
    """Direction (3, 1) of gravity across the base's axis, in which a robot sags; none, (3, 0), where gravity is along it."""
    across = c.gravity * [1.0, 1.0, 0.0]
    size = float(np.linalg.norm(across))
    return across[:, None] / size if size > UPRIGHT * float(np.linalg.norm(c.gravity)) else np.zeros((3, 0))


def _turned_gravity(c: MotionWindow) -> Floats:
    """Directions (3, m) across gravity and the base's axis, in which a tip moves when gravity turns."""
    sag = _across_base(c)
    return np.cross(sag[:, 0], [0.0, 0.0, 1.0])[:, None] if sag.shape[1] else np.eye(3)[:, :2]


def _swinging(c: MotionWindow) -> Floats:
    """Velocity while the actuators stand still: a wrong frequency shows as a phase that runs away."""
    return ((1.0 - c.moving)[:, None] * c.velocity)[:, :, None]


def _cross(c: MotionWindow) -> Floats:
    x, y, z = c.position.T
    nil = np.zeros_like(x)
    return np.stack(
        [np.stack([nil, z, -y], axis=1), np.stack([-z, nil, x], axis=1), np.stack([y, -x, nil], axis=1)],
        axis=1,
    )


@dataclass(frozen=True)
class Sensitivity:
    """What a small ``effect`` adds to k measured positions: ``columns(window)`` (k, 3, m), one column per unknown.

    ``text`` says what it looks for.
    """

    effect: str
    columns: Callable[[MotionWindow], Floats]
    text: str


SENSITIVITIES: tuple[Sensitivity, ...] = (
    Sensitivity("tracker_latency", lambda c: c.velocity[:, :, None], "along the tip's velocity"),
    Sensitivity(
        "actuator_latency",
        lambda c: (c.moving[:, None] * c.velocity)[:, :, None],
        "along the tip's velocity, only while actuators move",
    ),
    Sensitivity("tracker_averaging", lambda c: c.acceleration[:, :, None], "along the tip's acceleration"),
    Sensitivity("registration_translation", lambda c: _always(c, np.eye(3)), "constant"),
    Sensitivity("tip_force", lambda c: _always(c, np.eye(3)[:, :2]), "constant, across the base's axis"),
    Sensitivity("gravity_direction", lambda c: _always(c, _turned_gravity(c)), "constant, across gravity"),
    Sensitivity("registration_rotation", _cross, "turn about the base"),
    Sensitivity("tracker_scale", lambda c: c.position[:, :, None], "grows with the distance from the base"),
    Sensitivity("tracker_lever_arm", lambda c: c.frame, "constant in the tip's frame"),
    Sensitivity("exposed_length", lambda c: c.frame[:, :, 2:], "constant, along the tip's tangent"),
    Sensitivity(
        "youngs_modulus",
        lambda c: np.concatenate(
            [(c.position * [1.0, 1.0, 0.0])[:, :, None], _always(c, _across_base(c)), _swinging(c)],
            axis=2,
        ),
        "along the deflection from the base's axis, sag, and the lag of a swing",
    ),
    Sensitivity(
        "payload_mass",
        lambda c: np.concatenate([(c.acceleration - c.gravity)[:, :, None], _swinging(c)], axis=2),
        "along gravity and the tip's acceleration together, and the lag of a swing",
    ),
    Sensitivity(
        "precurvature",
        lambda c: (c.position * [1.0, 1.0, 0.0])[:, :, None],
        "radial, turning with the tubes",
    ),
    Sensitivity(
        "encoder_offset", lambda c: _turn(c, np.ones((len(c.alpha), 1))), "turn about the base's axis"
    ),
    Sensitivity("encoder_gain", lambda c: _turn(c, c.alpha), "turn that grows with each tube's angle"),
    Sensitivity(
        "shear_modulus",
        lambda c: _turn(c, c.alpha[:, :-1] - c.alpha[:, 1:]),
        "turn that grows with the angle between the tubes",
    ),
    Sensitivity("backlash", lambda c: _turn(c, c.held), "turn by the sign of each tube's last motion"),
    Sensitivity(
        "base_coulomb",
        lambda c: _turn(c, c.held * c.moving[:, None]),
        "turn by the sign of each tube's rate, while it moves",
    ),
    Sensitivity(
        "tube_coulomb",
        lambda c: _turn(c, np.tanh((c.alpha_rate[:, :-1] - c.alpha_rate[:, 1:]) / MOVING)),
        "turn by the sign of the tubes' relative rate",
    ),
    Sensitivity(
        "insertion_velocity",
        lambda c: c.beta_rate[:, :1, None] * c.frame[:, :, 2:],
        "along the tangent, with the rate of insertion",
    ),
)


@dataclass(frozen=True)
class Cause:
    """An effect of the catalogue and the part (0 to 1) of the residual above the tracker's noise that it explains: by itself, or on top of
    those listed before it where ``added``."""

    effect: str
    explained: float
    added: bool


class CauseRegression:
    """Sums of the normal equations of all sensitivities together.

    Args:
        memory: s, over which old residuals decay.
        noise: standard deviation of the tracker's position, m per axis.
        gravity: (3,) m/s^2, ``ctr_base``.

    Attributes:
        seconds, count: weighted length of the motion in the sums, and number of its points.
    """

    def __init__(self, memory: float, noise: float, gravity: ArrayLike) -> None:
        self.memory, self.noise, self.gravity = memory, noise, np.asarray(gravity, float)
        self.options = RegressionOptions()
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._waiting: list[tuple[float, MotionPoint]] = []
        self._time: float | None = None  # of the newest point
        self._last: float | None = None  # of the newest that has been taken in
        self._held: Floats | None = None
        self.seconds = 0.0
        self.count = 0.0

    def add(self, time: float, point: MotionPoint) -> None:
        """Take in a measurement of ``time`` (s), unless it follows the last one too closely to say anything new."""
        if self._time is not None and abs(time - self._time) < self.options.closest:
            return
        self._time = time
        self._waiting.append((time, point))
        if len(self._waiting) >= self.options.together:
            self._take_in()

    def _take_in(self) -> None:
        """Take in the points that wait, each worth less the older it is."""
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        times = np.array([time for time, _ in waiting])
        held = np.zeros(1) if self._held is None else self._held
        c = motion_window([point for _, point in waiting], held, self.gravity)
        self._held = c.held[-1]
        blocks = [s.columns(c) for s in SENSITIVITIES]
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
        decays = np.exp((np.cumsum(steps) - steps.sum()) / self.memory)
        decay = math.exp(-steps.sum() / self.memory)
        weighted = (decays[:, None, None] * X).reshape(-1, X.shape[2])
        self._gram = decay * self._gram + weighted.T @ X.reshape(-1, X.shape[2])
        self._moment = decay * self._moment + weighted.T @ y.ravel()
        self._square = decay * self._square + float(decays @ np.einsum("ki,ki->k", y, y))
        self.count = decay * self.count + float(decays.sum())
        self.seconds = decay * self.seconds + float(decays @ steps)
        self._last = float(times[-1])

    def _left(self, sets: list[list[int]]) -> list[float]:
        """Sums of squares that each of ``sets`` of sensitivities leaves, at least the noise; all at once, for these are many small problems."""
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
        return 3.0 * self.count * self.noise**2

    def causes(self) -> list[Cause]:
        """The likeliest causes, likeliest first; none where no cause explains enough of what lies above the noise.

        Listed are the best one, its rivals, then what explains most of the rest. A cause is worth the logarithm of what it leaves, times the
        number of independent residuals, less a penalty for each unknown (Bayesian information criterion).
        """
        options = self.options
        self._take_in()
        excess = self._square - self._floor if self._last is not None else 0.0
        count = 3.0 * options.independent * self.seconds
        if excess <= 0.0 or count < options.fewest:
            return []
        every = range(len(SENSITIVITIES))

        def worth(chosen: list[int], left: float) -> float:
            unknowns = sum(len(self._slices[i]) for i in chosen)
            return -count * math.log(left) - unknowns * math.log(count)

        single = self._left([[i] for i in every])
        order = sorted(every, key=lambda i: -worth([i], single[i]))
        best = order[0]
        nothing = -count * math.log(self._square)
        explained = (self._square - single[best]) / excess
        if explained < options.least or worth([best], single[best]) <= nothing:
            return []
        found = [Cause(SENSITIVITIES[best].effect, explained, False)]
        for i in order[1:]:
            part = (self._square - single[i]) / excess
            if (
                part >= options.rival * explained
                and worth([i], single[i]) > nothing
                and len(found) < options.most
            ):
                found.append(Cause(SENSITIVITIES[i].effect, part, False))
        chosen, left = [best], single[best]
        while len(found) < options.most:
            listed = {cause.effect for cause in found}
            rest = [i for i in every if SENSITIVITIES[i].effect not in listed]
            after = dict(zip(rest, self._left([[*chosen, i] for i in rest]), strict=True))
            nxt = max(rest, key=lambda i: worth([*chosen, i], after[i]))
            if worth([*chosen, nxt], after[nxt]) <= worth(chosen, left):
                break
            found.append(Cause(SENSITIVITIES[nxt].effect, (left - after[nxt]) / excess, True))
            chosen, left = [*chosen, nxt], after[nxt]
        return found
