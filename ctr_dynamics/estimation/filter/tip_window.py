"""Tip kinematics: pose and twist of tube 1's end in ``ctr_base``, and how they follow from node states and their columns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.reduction import Change
from ctr_dynamics.kernels.filter_steps import interpolate_columns, shift_tips, tip_between, tip_rows

Floats = NDArray[np.float64]


class Tip(NamedTuple):
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
    """The tips of the last steps with their columns, so that a late sample is compared with the tip of its own time.

    Rows lie one after the other in arrays with room for more, so that a snapshot holds references and not copies: later steps write behind what
    it sees. Where room ends, the window moves to new arrays.
    """

    MORE = 64  # rows of room
    OPEN = 3  # newest rows whose columns may change yet

    def __init__(self, steps: int) -> None:
        self.size = steps
        self.clear(1)

    def clear(self, columns: int) -> None:
        """Forget all tips; further ones have ``columns`` columns."""
        self.end = 0
        self._rooms(columns)

    def _rooms(self, columns: int) -> None:
        room = self.size + self.MORE
        self.stamps = np.zeros(room)
        self.means = np.zeros((room, 13))  # position, quaternion, velocity, rate
        self.columns = np.empty((room, 12, columns))

    @property
    def begin(self) -> int:
        """The oldest row."""
        return max(0, self.end - self.size)

    def append(self, stamp: float, node: Floats, dnode: Floats, insertion_rate: float) -> None:
        """Add the tip of the last node's state (S,) with columns (S, r); the oldest goes when the window is full. Rate d beta_1 / dt in m/s."""
        if self.end == len(self.stamps):
            keep = slice(self.end - self.size, self.end)
            old = self.stamps[keep], self.means[keep], self.columns[keep]
            self._rooms(self.columns.shape[2])
            self.end = self.size
            self.stamps[: self.end], self.means[: self.end], self.columns[: self.end] = old
        i = self.end
        self.stamps[i] = stamp
        tip_rows(node, dnode, insertion_rate, self.means[i], self.columns[i])
        self.end += 1

    @property
    def last(self) -> Tip:
        """The newest tip."""
        i = self.end - 1
        return Tip(self.stamps[i], self.means[i], self.columns[i])

    def at(self, time: float, dt: float, columns: bool = True) -> Tip | None:
        """Tip at ``time`` (s), at most one step ``dt`` ahead of the newest, if asked for with its columns; None outside the window."""
        if not self.end:
            return None
        begin = self.begin
        start = self.stamps[begin]
        if time < start - 1e-6 or time > self.stamps[self.end - 1] + dt:
            return None
        if self.end - begin == 1:
            return self.last
        i = min(max(int((time - start) / dt), 0), self.end - begin - 2) + begin
        while i > begin and self.stamps[i] > time:  # steps that failed are missing from the window
            i -= 1
        step = self.stamps[i + 1] - self.stamps[i]
        tip = Tip(time, np.empty(13), np.empty((12, self.columns.shape[2] if columns else 0)))
        tip_between(
            self.means[i], self.means[i + 1], self.columns[i], self.columns[i + 1], (time - self.stamps[i]) / step, step, tip.mean, tip.columns
        )  # fmt: skip
        return tip

    def interpolate(self, count: int) -> None:
        """Give the ``count`` tips before the newest, fewer than ``OPEN``, columns between those of their neighbours."""
        if self.end >= count + 2:
            interpolate_columns(self.columns[self.end - 2 - count : self.end], count)

    def change(self, change: Change, size: int) -> None:
        """Go over to ``size`` other coefficients; columns that have been appended since do not move the past."""
        old = self.columns
        self.columns = np.empty((len(self.stamps), 12, size))
        rows = slice(12 * self.begin, 12 * self.end)
        change(old.reshape(-1, old.shape[2])[rows], self.columns.reshape(-1, size)[rows])

    def shift(self, a: Floats) -> None:
        """Move every kept tip by the columns times ``a`` (r,)."""
        shift_tips(self.columns[self.begin : self.end], a, self.means[self.begin : self.end])

    def snapshot(self) -> tuple:
        """What :meth:`restore` needs. The last rows of columns may change yet (:meth:`interpolate`), the means with every correction."""
        recent = self.columns[max(0, self.end - self.OPEN) : self.end].copy()
        rows = slice(self.begin, self.end)
        return self.end, self.stamps[rows].copy(), self.means[rows].copy(), self.columns, recent

    def restore(self, snapshot: tuple) -> None:
        """Go back to an earlier snapshot."""
        self.end, stamps, means, self.columns, recent = snapshot
        rows = slice(self.begin, self.end)
        self.stamps[rows], self.means[rows] = stamps, means
        self.columns[self.end - len(recent) : self.end] = recent

    def follow(self, snapshot: tuple, node: Floats, insertion_rate: float) -> None:
        """Take the columns of ``snapshot``, which is one step ahead, with the own means, and as the newest tip the last node's state (S,)."""
        own = self.means[self.begin : self.end].copy()
        self.restore(snapshot)
        i = self.end - 1
        count = min(len(own), i - self.begin)
        if count:
            self.means[i - count : i] = own[-count:]
        tip_rows(node, np.zeros((len(node), 1)), insertion_rate, self.means[i], np.empty((12, 1)))
