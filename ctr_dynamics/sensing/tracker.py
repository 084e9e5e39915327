"""The tracker's measurement: registration, lever arm, delay and drift between the model's tip and a reported pose (docs/filter.md).

reading = R_reg (p + R lever) + t_reg + drift, R_reading = R_reg R, both of the time stamp - delay. What effects add (a scale, a steady drift, a
clock of another rate) is taken off the readings first, an average over a window counts as a delay by half of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.effects import Setup
from ctr_dynamics.estimation.filter.tip_window import Tip
from ctr_dynamics.kernels.filter_steps import from_vector, matrix, multiply
from ctr_dynamics.kernels.tracker_measurement import innovation_rows, pose_in_base, registered_pose

Floats = NDArray[np.float64]

ROTATION, TRANSLATION, LEVER, DELAY, DRIFT = slice(0, 3), slice(3, 6), slice(6, 9), 9, slice(10, 13)
STATES = 13


@dataclass(frozen=True)
class TrackerModel:
    """Nominal geometry and noise of the tracker.

    Attributes:
        rotation: (4,) wxyz of R_reg; translation: (3,) m; lever: (3,) m in the tip frame; delay: s, > 0 when a pose is older than its stamp.
        mask: (6,) measured axes: position x, y, z in the tracker's frame, then rotation about the sensor's x, y, z.
        variance: (6,) white noise.
        scale: reported over true distance; drift: (3,) m/s; skew: s/s, stamp = true time (1 + skew).
    """

    rotation: Floats
    translation: Floats
    lever: Floats
    delay: float
    mask: NDArray[np.bool_]
    variance: Floats
    scale: float = 1.0
    drift: Floats = field(default_factory=lambda: np.zeros(3))
    skew: float = 0.0

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
        return 1 + int(np.argmin(self.mask[3:])) if self.mask[3:].sum() == 2 else 0

    def reading(self, time_s: float, position: Floats) -> tuple[float, Floats]:
        """Time (s) and position (m) of a reading of stamp ``time_s`` without the clock's rate, the steady drift and the scale."""
        shift = self.translation
        return time_s / (1.0 + self.skew), (position - shift - self.drift * time_s) / self.scale + shift

    def to_base(
        self, position: Floats, quaternion: Floats, tip: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Reading as a tip pose in ``ctr_base`` with the nominal geometry.

        Where not all of the rotation is measured, that of the ``tip`` (4,) wxyz turns the lever arm, if it is given.
        """
        if tip is not None and not self.mask[3:].all():
            quaternion = multiply(self.rotation, tip)
        pose = pose_in_base(position, quaternion, self.rotation, self.translation, self.lever)
        return pose[:3], pose[3:]


def tracker_model(
    setup: Setup,
    *,
    delay: float = 0.0,
    lever: Floats | None = None,
    rotation: Floats | None = None,
    translation: Floats | None = None,
    mask: tuple[bool, ...] = (True,) * 6,
) -> TrackerModel:
    """Tracker of a robot file and its extensions with corrections.

    ``delay`` (s) and ``lever`` (3,) m are added, ``rotation`` (3,) rad and ``translation`` (3,) m composed.
    """
    noise = setup.robot.tracker.noise
    extra = from_vector(np.zeros(3) if rotation is None else np.asarray(rotation, float))
    shift = np.zeros(3) if translation is None else np.asarray(translation, float)
    return TrackerModel(
        rotation=multiply(extra, setup.rotation),
        translation=matrix(extra) @ setup.translation + shift,
        lever=setup.lever + (np.zeros(3) if lever is None else np.asarray(lever, float)),
        delay=setup.delay + 0.5 * setup.averaging + delay,
        mask=np.array(mask, dtype=bool),
        variance=np.array([noise.position.value**2] * 3 + [noise.rotation.value**2] * 3),
        scale=setup.tracker_scale,
        drift=setup.drift,
        skew=setup.skew,
    )


def innovation(
    model: TrackerModel, bias: Floats, tip: Tip, pi: Floats, position: Floats, quaternion: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """A reading (position (3,) m, quaternion (4,) wxyz) against what the ``tip`` and the tracker states ``bias`` (13,) predict.

    Returns:
        On the k measured axes: innovation (k,), position in the tracker's axes, rotation vector in the sensor's; H (k, r + 13), the derivative of
        the expected reading by the columns' coefficients and the tracker states; its covariance S (k, k) under ``pi`` (r + 13, r + 13); and the
        innovation whitened by the Cholesky root of S.

    Where one rotation axis is not measured, the sensor's turn about it is arbitrary and often large. It is taken off first, or it would turn the
    other two components.
    """
    axes = model.axes
    nu, H, S = np.empty(len(axes)), np.empty((len(axes), len(pi))), np.empty((len(axes), len(axes)))
    white = innovation_rows(
        position, quaternion, tip.mean, tip.columns, model.rotation, model.translation, model.lever, bias, model.free, axes, model.variance,
        pi, nu, H, S,
    )  # fmt: skip
    return nu, H, S, white


def registered(model: TrackerModel, bias: Floats, tip: Tip) -> Floats:
    """(7,) tip pose in ``ctr_base`` as the tracker realises it: position in m, quaternion wxyz.

    The base frame of a real robot is known through its registration only, so the estimated registration and lever-arm errors are part of the
    pose: it is where a perfect tracker with the nominal geometry would see the tip. Drift and delay are left out.
    """
    pose = np.empty(7)
    registered_pose(tip.mean, model.rotation, model.lever, bias, pose)
    return pose
