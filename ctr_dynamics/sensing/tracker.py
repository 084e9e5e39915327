"""The tip tracker: from the tip to a measurement, back, and how both change (docs/filter.md).

A measurement of stamp t shows the time t / (1 + skew) - delay, averaged over a window before it or smoothed:

    position = R_reg scale (p + R lever) + t_reg + drift t,        rotation = R_reg R,

and then passes the corrections. The estimator carries errors of registration, lever arm, delay, drift and shift as states of its own
(``STATE_NAMES``). Its kernels know registration and lever arm alone; the rest is taken off a measurement before
(:meth:`TrackerModel.undistorted`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.rotations import (
    conjugate_rows,
    from_vector,
    matrix,
    multiply,
    multiply_rows,
    rotate_rows,
    to_vector_rows,
)
from ctr_dynamics.kernels.tracker_measurement import innovation_rows, pose_in_base, registered_pose
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.measurement import SENSORS, At, Tip

Floats = NDArray[np.float64]

STATE_NAMES = (
    ("registration_rotation", 3),
    ("registration_translation", 3),
    ("lever_arm", 3),
    ("model_error_position", 3),
    ("model_error_rotation", 3),
    ("delay", 1),
    ("drift", 3),
    ("shift", 3),
)
"""Errors of the tracker that the estimator carries: name and number of axes, in their order.

The model error is how far the tip is shifted and turned from where the model has it, in base axes; unlike the others it is the robot's. The drift
is the slow one of the tracker that the robot file states. The shift is a fault: it is 0 until the innovations show one."""
STATES = 22
ROTATION, TRANSLATION, LEVER = slice(0, 3), slice(3, 6), slice(6, 9)
MODEL_POSITION, MODEL_ROTATION = slice(9, 12), slice(12, 15)
DELAY, DRIFT, SHIFT = 15, slice(16, 19), slice(19, 22)

# Gauss and Legendre's rule of five points on [0, 1]
AVERAGE_POINTS = np.array([0.04691008, 0.23076534, 0.5, 0.76923466, 0.95308992])
AVERAGE_WEIGHTS = np.array([0.11846344, 0.23931434, 0.28444444, 0.23931434, 0.11846344])
SMOOTHED = 4.0  # time constants of a low-pass filter that are looked back; the older 2 % of its response count at their mean age, one more
PART_S = 0.015  # s, over which the rule is good for vibrations that a model follows in steps of 3 ms


def _points(length: float) -> tuple[Floats, Floats]:
    """Points (k,) s and weights (k,) of the mean over a ``length`` (s), part by part."""
    parts = math.ceil(length / PART_S)
    points = (np.arange(parts)[:, None] + AVERAGE_POINTS).ravel() * (length / parts)
    return points, np.tile(AVERAGE_WEIGHTS, parts) / parts


def window_of(averaging: float, smoothing: float) -> tuple[Floats, Floats]:
    """Ages (k,) s, newest first, and weights (k,) of the poses that a measurement shows the mean of: of a window, a low-pass filter, or both (s)."""
    ages, weights = np.zeros(1), np.ones(1)
    if averaging > 0.0:
        ages, weights = _points(averaging)
    if smoothing > 0.0:
        older, less = _points(SMOOTHED * smoothing)
        less = less * np.exp(-older / smoothing)
        tail = math.exp(-SMOOTHED)
        older = np.append(older, (SMOOTHED + 1.0) * smoothing)
        less = np.append(less * ((1.0 - tail) / less.sum()), tail)
        ages = np.add.outer(older, ages).ravel()
        weights = np.multiply.outer(less, weights).ravel()
    return ages, weights


def free_axis(mask: NDArray[np.bool_]) -> int:
    """1 to 3: the one rotation axis that the ``mask`` (6,) of measured axes leaves out; 0 where it leaves out none or several."""
    return 1 + int(np.argmin(mask[3:])) if np.sum(mask[3:]) == 2 else 0


def pose_differences(
    position: Floats, quaternion: Floats, expected_position: Floats, expected_quaternion: Floats, free: int
) -> Floats:
    """(s, 6) measured poses minus expected ones: positions (s, 3) m, then rotation vectors in the sensor's axes of the quaternions (s, 4) wxyz.

    The turn about the axis ``free`` (:func:`free_axis`) is taken off first, as for one measurement (:meth:`TrackerModel.innovation`).
    """
    error = multiply_rows(conjugate_rows(expected_quaternion), quaternion)
    if free:
        twist = np.zeros_like(error)
        twist[:, 0], twist[:, free] = error[:, 0], error[:, free]
        size = np.linalg.norm(twist, axis=1, keepdims=True)
        whole = size[:, 0] < 1e-6  # half a turn about another axis: no turn about this one is defined
        twist[whole], size[whole] = [1.0, 0.0, 0.0, 0.0], 1.0
        error = multiply_rows(error, conjugate_rows(twist / size))
    return np.hstack([position - expected_position, to_vector_rows(error)])


class TrackerCorrection(Protocol):
    """A further link between tip and measurement, behind the registration; it must be equal (``==``) to another one that does the same.

    ``stamps`` (s,) in s, ``position`` (s, 3) in m and ``quaternion`` (s, 4) wxyz are in the tracker's frame.
    """

    def forward(self, stamps: Floats, position: Floats, quaternion: Floats) -> tuple[Floats, Floats]:
        """What the tracker reports instead of a position and quaternion."""
        ...

    def inverse(self, stamps: Floats, position: Floats, quaternion: Floats) -> tuple[Floats, Floats]:
        """Inverse of :meth:`forward`."""
        ...

    def derivative(self, stamps: Floats, position: Floats, quaternion: Floats, columns: Floats) -> Floats:
        """Small changes of what :meth:`forward` returns, from those of its arguments.

        Both (s, 6, r): of the position in m, and the rotation vector about the sensor's axes in rad, for each of r parameters.
        """
        ...


@dataclass(frozen=True, eq=False)
class TrackerModel:
    """Geometry, timing and noise of a tracker.

    Attributes:
        rotation: (4,) wxyz of R_reg; translation: (3,) m; lever: (3,) m in the tip frame; delay: s, > 0 when a pose is older than its stamp.
        mask: (6,) measured axes: position x, y, z in the tracker's frame, then rotation about the sensor's x, y, z.
        variance: (6,) white noise. state_sigma: (22,) prior deviations of ``STATE_NAMES``; those of
            the robot itself are 0.
        scale: reported over true distance; drift: (3,) m/s; skew: s/s, stamp = true time (1 + skew).
        averaging: s, length of the window over which poses are averaged. smoothing: s, time constant of a low-pass filter of first order that they
            pass. corrections: further links, in order.
    """

    rotation: Floats
    translation: Floats
    lever: Floats
    delay: float
    mask: NDArray[np.bool_]
    variance: Floats
    state_sigma: Floats = field(default_factory=lambda: np.zeros(STATES))
    scale: float = 1.0
    drift: Floats = field(default_factory=lambda: np.zeros(3))
    skew: float = 0.0
    averaging: float = 0.0
    smoothing: float = 0.0
    corrections: tuple[TrackerCorrection, ...] = ()

    @classmethod
    def of_robot(cls, robot: Robot) -> TrackerModel:
        """The tracker that a robot file describes, without the file's extensions."""
        file = robot.tracker
        noise = file.noise
        return cls(
            rotation=from_vector(np.array(file.registration_rotation.value)),
            translation=np.array(file.registration_translation.value),
            lever=np.array(file.lever_arm.value),
            delay=file.delay.value,
            mask=np.ones(6, dtype=bool),
            variance=np.array([noise.position.value**2] * 3 + [noise.rotation.value**2] * 3),
            state_sigma=np.concatenate(
                [
                    file.registration_rotation.tolerance,
                    file.registration_translation.tolerance,
                    file.lever_arm.tolerance,
                    np.zeros(6),
                    [file.delay.tolerance],
                    np.full(3, noise.drift.value),
                    np.zeros(3),
                ]
            ),
        )

    def changed(self, **values: Any) -> TrackerModel:
        """A copy with other attributes."""
        return replace(self, **values)

    def corrected(
        self,
        *,
        delay: float = 0.0,
        lever: Floats | None = None,
        rotation: Floats | None = None,
        translation: Floats | None = None,
        mask: tuple[bool, ...] = (True,) * 6,
    ) -> TrackerModel:
        """A copy with ``delay`` (s) and ``lever`` (3,) m added, ``rotation`` (3,) rad and ``translation`` (3,) m composed on top, and another
        ``mask``."""
        extra = from_vector(np.zeros(3) if rotation is None else np.asarray(rotation, float))
        shift = np.zeros(3) if translation is None else np.asarray(translation, float)
        return replace(
            self,
            rotation=multiply(extra, self.rotation),
            translation=matrix(extra) @ self.translation + shift,
            lever=self.lever + (np.zeros(3) if lever is None else np.asarray(lever, float)),
            delay=self.delay + delay,
            mask=np.array(mask, dtype=bool),
        )

    @cached_property
    def axes(self) -> NDArray[np.int64]:
        """(k,) measured axes, 0 to 5."""
        return np.flatnonzero(self.mask)

    @cached_property
    def noise(self) -> Floats:
        """(k, k) covariance of the white noise on the measured axes."""
        return np.diag(self.variance[self.axes])

    @cached_property
    def free(self) -> int:
        """1 to 3: the one rotation axis of the sensor that is not measured; 0 where none or several are not."""
        return free_axis(self.mask)

    # -- time --

    @cached_property
    def window(self) -> tuple[tuple[float, float], ...]:
        """(age in s, weight) of the poses that a measurement shows the mean of."""
        ages, weights = window_of(self.averaging, self.smoothing)
        return tuple(zip(ages.tolist(), weights.tolist(), strict=True))

    @property
    def age(self) -> float:
        """How much older than its stamp a measurement is in the mean, s."""
        return self.delay + 0.5 * self.averaging + self.smoothing

    def observed_times(self, stamps: Floats) -> Floats:
        """Newest times (s,) of the robot that measurements of ``stamps`` (s,) show."""
        return stamps / (1.0 + self.skew) - self.delay

    def averaged(self, at: At, times: Floats) -> Floats:
        """Means (s, c) of what ``at`` gives over the windows that end at ``times`` (s,)."""
        total = np.zeros(())
        for age, weight in self.window:
            total = total + weight * at(times - age)
        return total

    def observed_tip(self, at: Callable[[float], Tip | None], time: float) -> Tip | None:
        """The tip that the tracker sees over the window that ends at ``time`` (s), when ``at`` gives that of one time; None where that does."""
        if len(self.window) == 1:
            return at(time)
        tips = [at(time - age) for age, _ in self.window]
        seen = [tip for tip in tips if tip is not None]
        if len(seen) < len(tips):
            return None
        mean = sum((w * tip.mean for (_, w), tip in zip(self.window, seen, strict=True)), np.zeros(13))
        mean[3:7] /= np.linalg.norm(mean[3:7])
        columns = sum(
            (w * tip.columns for (_, w), tip in zip(self.window, seen, strict=True)),
            np.zeros_like(seen[0].columns),
        )
        return Tip(time, mean, columns)

    # -- arrays of measurements --

    def forward(self, stamps: Floats, tip_at: At) -> tuple[Floats, Floats]:
        """Positions (s, 3) m and quaternions (s, 4) wxyz that the tracker reports at ``stamps`` (s,), without noise.

        ``tip_at`` gives the tip at times (s,): (s, 7) position and unit quaternion.
        """
        rows = self.averaged(tip_at, self.observed_times(stamps))
        h = rows[:, 3:]
        if len(self.window) > 1:
            h = h / np.linalg.norm(h, axis=1, keepdims=True)
        return self.reported(stamps, rows[:, :3], h)

    def reported(self, stamps: Floats, position: Floats, quaternion: Floats) -> tuple[Floats, Floats]:
        """Positions (s, 3) and quaternions (s, 4) that the tracker reports at ``stamps`` (s,) of tips ``position`` and unit ``quaternion``."""
        position, quaternion = self._without_corrections(stamps, position, quaternion)
        for correction in self.corrections:
            position, quaternion = correction.forward(stamps, position, quaternion)
        return position, quaternion

    def _without_corrections(self, stamps: Floats, p: Floats, h: Floats) -> tuple[Floats, Floats]:
        point = self.scale * (p + rotate_rows(h, self.lever))
        position = rotate_rows(self.rotation, point) + self.translation + self.drift * stamps[:, None]
        return position, multiply_rows(self.rotation, h)

    def derivative(self, stamps: Floats, tip_at: At, columns_at: At) -> Floats:
        """Derivatives (s, 6, r) of the measurements at ``stamps`` (s,) by r parameters: of the position in m, of the rotation vector about the
        sensor's axes in rad.

        ``tip_at`` as for :meth:`forward`, with quaternions of any length; ``columns_at`` gives their derivatives at times (s,): (s, 7 r).
        """
        times = self.observed_times(stamps)
        rows = self.averaged(columns_at, times)
        rows = rows.reshape(len(times), 7, rows.shape[1] // 7)
        tip = self.averaged(tip_at, times)
        h = tip[:, 3:]
        norm2 = np.sum(h * h, axis=1)[:, None]
        r = rows.shape[2]
        back = conjugate_rows(h)
        # body rotation vector of a change of a quaternion of any length: 2 vec(h^-1 dh) / |h|^2
        dh = rows[:, 3:].transpose(0, 2, 1)
        turn = (
            2.0 * multiply_rows(back[:, None, :].repeat(r, axis=1).reshape(-1, 4), dh.reshape(-1, 4))[:, 1:]
        )
        turn = turn.reshape(len(times), r, 3) / norm2[:, :, None]
        swing = np.cross(turn, self.lever)
        unit = h / np.sqrt(norm2)
        swing = rotate_rows(unit[:, None, :].repeat(r, axis=1).reshape(-1, 4), swing.reshape(-1, 3))
        shift = self.scale * (rows[:, :3].transpose(0, 2, 1) + swing.reshape(len(times), r, 3))
        shift = rotate_rows(self.rotation, shift.reshape(-1, 3)).reshape(len(times), r, 3)
        columns = np.concatenate([shift, turn], axis=2).transpose(0, 2, 1)
        position, quaternion = self._without_corrections(stamps, tip[:, :3], unit)
        for correction in self.corrections:
            columns = correction.derivative(stamps, position, quaternion, columns)
            position, quaternion = correction.forward(stamps, position, quaternion)
        return columns

    # -- one measurement --

    def undistorted(self, stamp: float, position: Floats, quaternion: Floats) -> tuple[float, Floats, Floats]:
        """Stamp (s), position (3,) m and quaternion (4,) of a measurement as registration and lever arm alone would give them: the corrections, the
        clock's rate, the steady drift and the scale are taken off."""
        if self.corrections:
            stamps = np.array([stamp])
            p, q = position[None], quaternion[None]
            for correction in reversed(self.corrections):
                p, q = correction.inverse(stamps, p, q)
            position, quaternion = p[0], q[0]
        shift = self.translation
        position = (position - shift - self.drift * stamp) / self.scale + shift
        return self.own_time(stamp), position, quaternion

    def own_time(self, stamp: float) -> float:
        """Time (s) of a ``stamp`` (s) without the error of the clock's rate."""
        return stamp / (1.0 + self.skew)

    def to_base(
        self, position: Floats, quaternion: Floats, tip: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Undistorted measurement as a tip pose in ``ctr_base`` with the nominal geometry.

        Where not all of the rotation is measured, that of the ``tip`` (4,) wxyz turns the lever arm, if it is given.
        """
        if tip is not None and not self.mask[3:].all():
            quaternion = multiply(self.rotation, tip)
        pose = pose_in_base(position, quaternion, self.rotation, self.translation, self.lever)
        return pose[:3], pose[3:]

    def inverse(
        self, stamp: float, position: Floats, quaternion: Floats, tip: Floats | None = None
    ) -> tuple[float, Floats, Floats]:
        """Time (s), position (3,) m and quaternion (4,) of the tip in ``ctr_base`` that a measurement shows; ``tip`` as for :meth:`to_base`."""
        time, position, quaternion = self.undistorted(stamp, position, quaternion)
        return time - self.age, *self.to_base(position, quaternion, tip)

    def innovation(
        self, bias: Floats, tip: Tip, pi: Floats, *measurement: Floats
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """An undistorted ``measurement`` (position (3,) m, quaternion (4,) wxyz) against what the ``tip`` and the states ``bias`` (22,) predict.

        Returns:
            On the k measured axes: innovation (k,), position in the tracker's axes, rotation vector in the sensor's; H (k, r + 22), the
            derivative of the expected measurement by the columns' coefficients and the tracker states; its covariance S (k, k) under ``pi``
            (r + 22, r + 22); and the innovation whitened by the Cholesky root of S.

        Where one rotation axis is not measured, the sensor's turn about it is arbitrary and often large. It is taken off first, or it would turn
        the other two components.
        """
        position, quaternion = measurement
        axes = self.axes
        nu, H, S = np.empty(len(axes)), np.empty((len(axes), len(pi))), np.empty((len(axes), len(axes)))
        white = innovation_rows(
            position, quaternion, tip.mean, tip.columns, self.rotation, self.translation, self.lever, bias, self.free, axes, self.variance,
            pi, nu, H, S,
        )  # fmt: skip
        return nu, H, S, white

    def registered(self, bias: Floats, tip: Tip) -> Floats:
        """(7,) tip pose in ``ctr_base`` as the tracker realises it: position in m, quaternion wxyz.

        The base frame of a real robot is known through its registration only, so the estimated registration and lever-arm errors are part of the
        pose, and so is that of the model: it is where a perfect tracker with the nominal geometry would see the tip. Drift, shift and delay are left
        out.
        """
        pose = np.empty(7)
        registered_pose(tip.mean, self.rotation, self.lever, bias, pose)
        return pose


SENSORS["tracker"] = TrackerModel
