"""Measured tips with the joints behind them, from a bag or from a table of poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.errors import InputError
from ctr_dynamics.model.pose_table import Pose

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TipSamples:
    """Tips as a tracker reports them.

    Attributes:
        joints: (k, 1 + 2N) t s, encoder readings alpha rad, beta m. In a table, t counts the rows.
        stamps: (s,) s on the same clock. position: (s, 3) m; quaternion: (s, 4) wxyz.
        load: (l, 7) t, force N, torque N m on the tip in ``ctr_base``, linear in between; may be empty.
        axes: (6,) measured axes: position, then rotation about the axes of the tip.
        timed: whether ``stamps`` are times, so that a delay means something.
    """

    joints: Floats
    stamps: Floats
    position: Floats
    quaternion: Floats
    load: Floats
    axes: NDArray[np.bool_]
    timed: bool = True

    def encoders_at(self, times: Floats) -> Floats:
        """Readings (s, 2N) at ``times`` (s,), linear between joint states and held outside."""
        t = self.joints[:, 0]
        return np.stack([np.interp(times, t, column) for column in self.joints[:, 1:].T], axis=1)

    def loads_at(self, times: Floats) -> Floats:
        """Wrench (s, 6) at ``times`` (s,)."""
        if not len(self.load):
            return np.zeros((len(times), 6))
        return np.stack([np.interp(times, self.load[:, 0], c) for c in self.load[:, 1:].T], axis=1)

    def chosen(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> TipSamples:
        """Some of the tips, with all joints."""
        return replace(
            self,
            stamps=self.stamps[which],
            position=self.position[which],
            quaternion=self.quaternion[which],
        )

    def thinned(self, count: int) -> TipSamples:
        """At most ``count`` of the tips, spread evenly."""
        if len(self.stamps) <= count:
            return self
        return self.chosen(np.unique(np.linspace(0, len(self.stamps) - 1, count).round().astype(np.int64)))


def samples_of_recording(recording: Recording, axes: NDArray[np.bool_]) -> TipSamples:
    """The tracker poses of a bag."""
    return TipSamples(
        recording.joints, recording.stamps, recording.position, recording.quaternion, recording.load, axes
    )


def samples_of_table(poses: list[Pose], where: str) -> TipSamples:
    """The measured tips of a table, without the rows that cannot be used.

    Raises:
        InputError: no row has a measured tip.
    """
    rows = [pose for pose in poses if not pose.problem and pose.tip_position is not None]
    if not rows:
        raise InputError(
            "no row with a measured tip", do="give columns tip_x, tip_y, tip_z in m", where=where
        )
    count = np.arange(len(rows), dtype=float)
    oriented = all(pose.tip_quaternion is not None for pose in rows)
    return TipSamples(
        joints=np.array([[i, *pose.alpha, *pose.beta] for i, pose in enumerate(rows)], dtype=float),
        stamps=count,
        position=np.array([pose.tip_position for pose in rows]),
        quaternion=np.array([pose.tip_quaternion if oriented else (1.0, 0.0, 0.0, 0.0) for pose in rows]),
        load=np.array([[i, *pose.force, 0.0, 0.0, 0.0] for i, pose in enumerate(rows)], dtype=float),
        axes=np.array([True] * 3 + [oriented] * 3),
        timed=False,
    )
