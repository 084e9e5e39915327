"""Tip kinematics: pose and twist of tube 1's end in ``ctr_base``, and how they follow from node states and their columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .kernels import blend_columns, tip_rows
from .rotations import conjugate, from_vector, multiply, to_vector

Floats = NDArray[np.float64]


@dataclass
class Tip:
    """Pose and twist in ``ctr_base`` at one time, with columns of their first variation.

    Attributes:
        position (3,) m, quaternion (4,) wxyz, velocity (3,) m/s (insertion included), rate (3,) rad/s (base axes).
        columns: (12, r): position, rotation vector (base axes), velocity, angular velocity for every column of the covariance.
    """

    stamp: float
    position: Floats
    quaternion: Floats
    velocity: Floats
    rate: Floats
    columns: Floats


def between(a: Tip, b: Tip, stamp: float) -> Tip:
    """Tip at a time between two steps (or a little outside): cubic Hermite in position, linear turn on top of the nearer end's rotation."""
    dt = b.stamp - a.stamp
    x = (stamp - a.stamp) / dt
    w = (1 + 2 * x) * (1 - x) ** 2, x * (1 - x) ** 2 * dt, x * x * (3 - 2 * x), x * x * (x - 1) * dt
    d = 6 * x * (x - 1) / dt, (1 - x) * (1 - 3 * x), 6 * x * (1 - x) / dt, x * (3 * x - 2)
    turn = to_vector(multiply(b.quaternion, conjugate(a.quaternion)))
    columns = np.empty_like(b.columns)
    blend_columns(a.columns, b.columns, w, d, x, columns)
    return Tip(
        stamp,
        w[0] * a.position + w[1] * a.velocity + w[2] * b.position + w[3] * b.velocity,
        multiply(from_vector(x * turn), a.quaternion),
        d[0] * a.position + d[1] * a.velocity + d[2] * b.position + d[3] * b.velocity,
        (1 - x) * a.rate + x * b.rate,
        columns,
    )


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

    def _tip(self, number: int) -> Tip:
        i = number % self.size
        mean = self.means[i]
        return Tip(self.stamps[i], mean[0:3], mean[3:7], mean[7:10], mean[10:13], self.columns[i])

    @property
    def last(self) -> Tip:
        """The newest tip."""
        return self._tip(self.count - 1)

    def at(self, time: float, dt: float) -> Tip | None:
        """Tip at ``time`` (s), at most one step ``dt`` ahead of the newest; None outside the window."""
        if not self.count:
            return None
        first = max(0, self.count - self.size)
        start = self.stamps[first % self.size]
        if time < start - 1e-6 or time > self.last.stamp + dt:
            return None
        if self.count - first == 1:
            return self.last
        i = min(max(int((time - start) / dt), 0), self.count - first - 2) + first
        while (
            i > first and self.stamps[i % self.size] > time
        ):  # steps that failed are missing from the window
            i -= 1
        return between(self._tip(i), self._tip(i + 1), time)

    def transform(self, T: Floats) -> None:
        """Replace all columns V by V T."""
        size, rows, r = self.columns.shape
        self.columns = (self.columns.reshape(size * rows, r) @ T).reshape(size, rows, -1)

    def widen(self, count: int) -> None:
        """Append ``count`` columns of zeros: what enters now does not move the past."""
        self.columns = np.concatenate([self.columns, np.zeros((*self.columns.shape[:2], count))], axis=2)

    def shift(self, a: Floats) -> None:
        """Move every kept tip by the columns times ``a`` (r,)."""
        d = (self.columns.reshape(-1, len(a)) @ a).reshape(self.size, 12)
        self.means[:, 0:3] += d[:, 0:3]
        self.means[:, 7:13] += d[:, 6:12]
        turn = d[:, 3:6]
        w, v = self.means[:, 3:4], self.means[:, 4:7]
        half = 0.5 * turn
        scalar = np.sqrt(np.maximum(0.0, 1.0 - np.sum(half * half, axis=1, keepdims=True)))
        new_w = scalar * w - np.sum(half * v, axis=1, keepdims=True)
        new_v = scalar * v + w * half + np.cross(half, v)
        self.means[:, 3:4], self.means[:, 4:7] = new_w, new_v

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
