"""Maximum a posteriori fit of a robot and its tracker to tips in slow motion.

The static model stands for the robot. What it leaves beyond the tracker's noise, and how long that lasts, is measured on the fit and
weights it: a real robot differs from any rod model by more than its tracker's noise, and for seconds on end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.calibration.static_tips import NODES, StaticTips, Tips
from ctr_dynamics.calibration.tip_samples import TipSamples
from ctr_dynamics.effects import EffectQuantity, Plant, make_plant
from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.rotations import conjugate, from_vector, multiply, multiply_rows
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.tracker import free_axis, pose_differences

Floats = NDArray[np.float64]
Key = tuple[str, str]
DELAY: Key = ("tracker_latency", "delay_s")
MOUNT: tuple[Key, ...] = tuple(("mount_rotation", f"r{a}_rad") for a in "xyz")
_TRACKER = (
    "registration_rotation",
    "registration_translation",
    "tracker_lever_arm",
    *{key[0] for key in MOUNT},
)
DIFFERENCE = 0.02  # of the prior deviation or of the plausible size, whichever is smaller
STEPS = 30
SETTLED = 1e-3  # of the cost, which is a number of squared deviations
WEIGHTINGS = 4  # fits, each with the weights that the one before has measured


@dataclass(frozen=True)
class Coordinate:
    """One number that is fitted: a quantity of an effect, or an angle of the mount.

    Attributes:
        key: (effect, name). off: value at which it changes nothing. prior: 1-sigma. difference: step of its derivative. low: bound.
    """

    key: Key
    off: float
    prior: float
    difference: float
    low: float = -np.inf

    @classmethod
    def of(cls, quantity: EffectQuantity, prior: float | None = None) -> Coordinate:
        """A quantity of the catalogue, with the robot file's tolerance or another ``prior``."""
        sigma = quantity.tolerance if prior is None else prior
        step = DIFFERENCE * min(sigma, quantity.scale)
        return cls(quantity.key, quantity.off, sigma, step, quantity.low)


def mount_coordinates() -> list[Coordinate]:
    """Rotation vector of a mount, of which nothing is known."""
    return [Coordinate(key, 0.0, np.pi, 1e-4) for key in MOUNT]


@dataclass
class TipFit:
    """A fit.

    Attributes:
        coordinates: what was free. values, sigma: (a,) and posterior deviations. covariance: (a, a).
        residual: (s, 6) measured minus expected position m and rotation vector rad, 0 on axes that are not measured.
        deviation: (2,) what is left per axis, m and rad. lasting: how many samples in a row say the same.
        tips: of the samples.
    """

    coordinates: tuple[Coordinate, ...]
    values: Floats
    covariance: Floats
    residual: Floats
    deviation: Floats
    lasting: float
    tips: Tips = field(repr=False)

    @property
    def sigma(self) -> Floats:
        """(a,) posterior deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def point(self) -> dict[Key, float]:
        """Values by key."""
        return {c.key: float(v) for c, v in zip(self.coordinates, self.values, strict=True)}

    def deviations(self) -> dict[Key, float]:
        """Posterior deviations by key."""
        return {c.key: float(s) for c, s in zip(self.coordinates, self.sigma, strict=True)}


class TipModel:
    """What a tracker should report of samples, for values of coordinates.

    Args:
        robot: with the tracker's nominal registration. samples: all that are looked at.
        mount: (4,) wxyz orientation of the sensor in the tip frame, beside the one that the bag was read with.
    """

    def __init__(
        self, robot: Robot, samples: TipSamples, mount: Floats | None = None, nodes: int = NODES
    ) -> None:
        self.robot, self.samples = robot, samples
        self.mount = np.array([1.0, 0.0, 0.0, 0.0]) if mount is None else mount
        self._solver = StaticTips(robot, samples, nodes)

    def plant(self, point: Mapping[Key, float]) -> Plant:
        """The robot at ``point``."""
        grouped: dict[str, dict[str, float]] = {}
        for (effect, name), value in point.items():
            if effect != MOUNT[0][0]:
                grouped.setdefault(effect, {})[name] = value
        return make_plant(self.robot, grouped)

    def tips(self, point: Mapping[Key, float], start: Tips | None = None) -> Tips:
        """Static tips at ``point``."""
        plant = self.plant(point)
        return self._solver.solve(plant, plant.tracker.age, start)

    def mount_at(self, point: Mapping[Key, float]) -> Floats:
        """Orientation (4,) wxyz of the sensor in the tip frame at ``point``, beside the one that the bag was read with."""
        return multiply(from_vector(np.array([point.get(key, 0.0) for key in MOUNT])), self.mount)

    def residual(self, point: Mapping[Key, float], tips: Tips) -> Floats:
        """(s, 6) measured minus expected, see :class:`TipFit`; NaN where there is no tip."""
        samples, tracker = self.samples, self.plant(point).tracker
        position, quaternion = tracker.reported(samples.stamps, tips.pose[:, :3], tips.pose[:, 3:])
        back = np.tile(conjugate(self.mount_at(point)), (len(quaternion), 1))
        turned = multiply_rows(samples.quaternion, back)
        out = pose_differences(samples.position, turned, position, quaternion, free_axis(samples.axes))
        out *= samples.axes
        out[~tips.found] = np.nan
        return out


def fit_tips(
    model: TipModel, coordinates: Sequence[Coordinate], start: Mapping[Key, float] | None = None
) -> TipFit:
    """The best values of ``coordinates``, from ``start`` or from where nothing is changed.

    Raises:
        InputError: the static model has no solution at too many samples.
    """
    search = _Search(model, coordinates, start or {})
    for _ in range(WEIGHTINGS):
        search.descend()
        if not search.weigh():
            break
    return search.result()


class _Search:
    """Gauss-Newton steps with Levenberg's damping, in units of the priors."""

    def __init__(
        self, model: TipModel, coordinates: Sequence[Coordinate], start: Mapping[Key, float]
    ) -> None:
        self.model = model
        self.coordinates = tuple(coordinates)
        self.off = np.array([c.off for c in self.coordinates])
        self.prior = np.array([c.prior for c in self.coordinates])
        self.low = np.array([c.low for c in self.coordinates])
        self.values = np.array([start.get(c.key, c.off) for c in self.coordinates])
        self.tips = model.tips(self.point(self.values))
        self.used = self.tips.found
        if self.used.mean() < 0.5:
            raise InputError(
                f"the static model has no solution at {int((~self.used).sum())} of {len(self.used)} tips",
                do="check the robot file, and the units and order of the joints",
            )
        noise = model.robot.tracker.noise
        self.noise = np.array([noise.position.value, noise.rotation.value])
        self.residual = model.residual(self.point(self.values), self.tips)
        self.deviation, self.lasting = self.noise.copy(), 1.0
        self.weigh()

    def point(self, values: Floats) -> dict[Key, float]:
        return {c.key: float(v) for c, v in zip(self.coordinates, values, strict=True)}

    def weigh(self) -> bool:
        """Measure what is left, per axis and in time; whether that has changed by more than a tenth."""
        axes, left = self.model.samples.axes, self.residual[self.used]
        spread = np.array(
            [
                np.sqrt(np.mean(left[:, part][:, axes[part]] ** 2)) if axes[part].any() else 0.0
                for part in (slice(0, 3), slice(3, 6))
            ]
        )
        before = np.append(self.deviation, self.lasting)
        self.deviation = np.maximum(self.noise, spread)
        self.lasting = lasting_of(left[:, :3]) if self.model.samples.timed else 1.0
        now = np.append(self.deviation, self.lasting)
        return bool(np.any(np.abs(now - before) > 0.1 * before))

    def white(self, residual: Floats) -> Floats:
        """Residuals of the samples that are used in deviations, (m,)."""
        scale = np.repeat(np.where(self.deviation > 0.0, self.deviation, 1.0), 3) * np.sqrt(self.lasting)
        return np.asarray((residual[self.used] / scale)[:, self.model.samples.axes].ravel())

    def cost(self, residual: Floats, values: Floats) -> float:
        white = self.white(residual)
        if not np.isfinite(white).all():
            return np.inf
        return float(white @ white + np.sum(((values - self.off) / self.prior) ** 2))

    def columns(self) -> Floats:
        """(m, a) derivatives of the whitened expected measurements by coordinates in units of the priors."""
        here = self.white(self.residual)
        found = np.zeros((len(here), len(self.coordinates)))
        for i, c in enumerate(self.coordinates):
            trial = self.values.copy()
            trial[i] += c.difference
            point = self.point(trial)
            tips = self.tips if c.key[0] in _TRACKER else self.model.tips(point, self.tips)
            column = (here - self.white(self.model.residual(point, tips))) / c.difference
            found[:, i] = np.where(np.isfinite(column), column, 0.0) * c.prior
        return found

    def descend(self) -> None:
        """Steps until nothing is gained."""
        cost, damping = self.cost(self.residual, self.values), 0.0
        for _ in range(STEPS):
            J, white = self.columns(), self.white(self.residual)
            departure = (self.values - self.off) / self.prior
            information = J.T @ J + np.eye(len(departure))
            gradient = J.T @ white - departure
            gain = 0.0
            for _ in range(8):
                step = np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
                trial = np.maximum(self.values + step * self.prior, self.low)
                tips = self.model.tips(self.point(trial), self.tips)
                residual = self.model.residual(self.point(trial), tips)
                there = self.cost(residual, trial)
                if there < cost:
                    gain = cost - there
                    self.values, self.tips, self.residual, cost = trial, tips, residual, there
                    damping *= 0.1
                    break
                damping = max(10.0 * damping, 1e-3)
            if gain < SETTLED * max(cost, 1.0):
                return

    def result(self) -> TipFit:
        J = self.columns()
        covariance = np.linalg.inv(J.T @ J + np.eye(len(self.values)))
        return TipFit(
            self.coordinates,
            self.values,
            np.asarray(covariance * np.outer(self.prior, self.prior), dtype=float),
            self.residual,
            self.deviation,
            self.lasting,
            self.tips,
        )


def lasting_of(residual: Floats) -> float:
    """Variance of a mean over that of independent residuals (s, 3): 1 + 2 sum rho_k, up to the first k without correlation."""
    count = len(residual)
    centred = residual - residual.mean(axis=0)
    power = float(np.sum(centred**2))
    total = 1.0
    for k in range(1, count // 2):
        rho = float(np.sum(centred[k:] * centred[:-k])) / max(power, 1e-300)
        if rho <= 0.0:
            break
        total += 2.0 * rho
    return min(total, max(count / 4.0, 1.0))  # an estimate from fewer than four independent parts is none
