"""Tip kinematics: pose and twist of tube 1's end in ``ctr_base``, and how they follow from node states and their columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .kernels import shift_tips, tip_between, tip_rows

Floats = NDArray[np.float64]


@dataclass
class Tip:
    """Pose and twist in ``ctr_base`` at one time, with columns of their first variation.

    Attributes:
        mean: (13,) position, quaternion, velocity and rate in one vector, of which these are parts:
        position (3,) m, quaternion (4,) wxyz, velocity (3,) m/s (insertion included), rate (3,) rad/s (base axes).
        columns: (12, r): position, rotation vector (base axes), velocity, angular velocity for every column of the covariance.
    """

    stamp: float
    mean: Floats
    columns: Floats

    @property
    def position(self) -> Floats:
        return self.mean[0:3]

    @property
    def quaternion(self) -> Floats:
        return self.mean[3:7]

    @property
    def velocity(self) -> Floats:
        return self.mean[7:10]

    @property
    def rate(self) -> Floats:
        return self.mean[10:13]


class TipWindow:
    """The tips of the last steps with their columns, so that a late sample is compared with the tip of its own time."""

    def __init__(self, steps: int) -> None:
        self.size = steps
        self.clear(1)

    def clear(self, columns: int) -> None:
        """Forget all tips; further ones have ``columns`` columns."""
        self.count = 0
        self.stamps = np.zeros(self.size)
        self.means = np.zeros((self.size, 13))  # position, quaternion, velocity, rate
        self.columns = np.zeros((self.size, 12, columns))

    def append(self, stamp: float, node: Floats, dnode: Floats, insertion_rate: float) -> None:
        """Add the tip of the last node's state (S,) with columns (S, r); the oldest goes when the window is full. Rate d beta_1 / dt in m/s."""
        i = self.count % self.size
        self.stamps[i] = stamp
        tip_rows(node, dnode, insertion_rate, self.means[i], self.columns[i])
        self.count += 1

    @property
    def last(self) -> Tip:
        """The newest tip."""
        i = (self.count - 1) % self.size
        return Tip(self.stamps[i], self.means[i], self.columns[i])

    def at(self, time: float, dt: float, columns: bool = True) -> Tip | None:
        """Tip at ``time`` (s), at most one step ``dt`` ahead of the newest, if asked for with its columns; None outside the window."""
        if not self.count:
            return None
        first = max(0, self.count - self.size)
        start = self.stamps[first % self.size]
        if time < start - 1e-6 or time > self.stamps[(self.count - 1) % self.size] + dt:
            return None
        if self.count - first == 1:
            return self.last
        i = min(max(int((time - start) / dt), 0), self.count - first - 2) + first
        while (
            i > first and self.stamps[i % self.size] > time
        ):  # steps that failed are missing from the window
            i -= 1
        a, b = i % self.size, (i + 1) % self.size
        step = self.stamps[b] - self.stamps[a]
        tip = Tip(time, np.empty(13), np.empty((12, self.columns.shape[2] if columns else 0)))
        tip_between(
            self.means[a], self.means[b], self.columns[a], self.columns[b], (time - self.stamps[a]) / step, step, tip.mean, tip.columns
        )  # fmt: skip
        return tip

    def interpolate(self) -> None:
        """Give the tip before the newest the mean of its neighbours' columns."""
        if self.count > 2:
            before, at, after = ((self.count - back) % self.size for back in (3, 2, 1))
            self.columns[at] = 0.5 * (self.columns[before] + self.columns[after])

    def transform(self, T: Floats) -> None:
        """Replace all columns V by V T; columns that have been appended since do not move the past."""
        size, rows, r = self.columns.shape
        self.columns = (self.columns.reshape(size * rows, r) @ T[:r]).reshape(size, rows, -1)

    def shift(self, a: Floats) -> None:
        """Move every kept tip by the columns times ``a`` (r,)."""
        shift_tips(self.columns, a, self.means)

    def replace_means(self, means: Floats, node: Floats, insertion_rate: float) -> None:
        """Put ``means`` (size, 13) in place of the kept tips, and the last node's state (S,) in that of the newest; columns stay."""
        self.means = means
        tip_rows(
            node,
            np.zeros((len(node), 1)),
            insertion_rate,
            means[(self.count - 1) % self.size],
            np.empty((12, 1)),
        )

    def snapshot(self) -> tuple:
        """What :meth:`restore` needs."""
        return self.count, self.stamps.copy(), self.means.copy(), self.columns.copy()

    def restore(self, snapshot: tuple) -> None:
        """Go back to an earlier snapshot."""
        self.count = snapshot[0]
        self.stamps, self.means, self.columns = (x.copy() for x in snapshot[1:])
