"""The tips of the last steps: pose and twist of tube 1's end in ``ctr_base``, with their rows of the covariance factor.

A delayed measurement is compared with the tip of its own time. All stored tips are in the same coefficients, so that its innovation also corrects
the present.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.factor_reduction import BasisChange
from ctr_dynamics.estimation.filter.rational_step import MOST_STEPS
from ctr_dynamics.kernels.tip_kinematics import interpolate_columns, shift_tips, tip_between, tip_from_node
from ctr_dynamics.model.model import Model
from ctr_dynamics.sensing import Tip

Floats = NDArray[np.float64]


class TipWindowState(NamedTuple):
    """What a checkpoint stores of a :class:`TipWindow`.

    Attributes:
        end: number of rows. stamps, means: of the window, copies. columns: the array itself, ``recent``: a copy of its last rows.
    """

    end: int
    stamps: Floats
    means: Floats
    columns: Floats
    recent: Floats


class TipWindow:
    """The tips of the last ``steps`` steps.

    Rows lie one after the other in arrays with room for more, so that a checkpoint holds references and not copies: later steps write behind
    what it sees. Where the room ends, the window moves to new arrays.
    """

    MORE = 64  # rows of room: the window is then moved every 0.2 s
    OPEN = MOST_STEPS  # newest rows whose columns may change yet: the factor skips one step less at most

    def __init__(self, steps: int) -> None:
        self.size = steps
        self.clear(1)

    def clear(self, columns: int) -> None:
        """Forget all tips; further ones have ``columns`` columns."""
        self.end = 0
        self._allocate(columns)

    def _allocate(self, columns: int) -> None:
        room = self.size + self.MORE
        self.stamps = np.zeros(room)
        self.means = np.zeros((room, 13))  # position, quaternion, velocity, rate
        self.columns = np.empty((room, 12, columns))

    @property
    def begin(self) -> int:
        """The oldest row."""
        return max(0, self.end - self.size)

    def append(self, stamp: float, node: Floats, dnode: Floats, insertion_rate: float) -> None:
        """Add the tip of the time ``stamp`` (s); the oldest is dropped when the window is full.

        Args:
            stamp: s from the first step.
            node, dnode: the last node's state (S,) and its rows (S, r) of the covariance factor.
            insertion_rate: m/s, what of d beta_1 / dt the state's velocity does not hold.
        """
        if self.end == len(self.stamps):
            window = slice(self.end - self.size, self.end)
            old = self.stamps[window], self.means[window], self.columns[window]
            self._allocate(self.columns.shape[2])
            self.end = self.size
            self.stamps[: self.end], self.means[: self.end], self.columns[: self.end] = old
        i = self.end
        self.stamps[i] = stamp
        tip_from_node(node, dnode, insertion_rate, self.means[i], self.columns[i])
        self.end += 1

    @property
    def last(self) -> Tip:
        """The newest tip."""
        i = self.end - 1
        return Tip(self.stamps[i], self.means[i], self.columns[i])

    def positions(self) -> tuple[Floats, Floats]:
        """Stamps (k,) s and positions (k, 3) m of all tips."""
        rows = slice(self.begin, self.end)
        return self.stamps[rows], self.means[rows, :3]

    def at(self, time: float, dt: float, columns: bool = True) -> Tip | None:
        """Tip at ``time`` (s), at most one step ``dt`` (s) ahead of the newest; with its columns if asked for. None outside the window."""
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

    def change_basis(self, change: BasisChange, size: int) -> None:
        """Go over to ``size`` other coefficients; columns that have been appended since do not move the past."""
        old = self.columns
        self.columns = np.empty((len(self.stamps), 12, size))
        rows = slice(12 * self.begin, 12 * self.end)
        change(old.reshape(-1, old.shape[2])[rows], self.columns.reshape(-1, size)[rows])

    def shift(self, a: Floats) -> None:
        """Move every tip by its columns times the coefficients ``a`` (r,)."""
        shift_tips(self.columns[self.begin : self.end], a, self.means[self.begin : self.end])

    def checkpoint(self) -> TipWindowState:
        """What :meth:`restore` returns to. The last rows of columns may change yet (:meth:`interpolate`), the means with every correction."""
        recent = self.columns[max(0, self.end - self.OPEN) : self.end].copy()
        rows = slice(self.begin, self.end)
        return TipWindowState(
            self.end, self.stamps[rows].copy(), self.means[rows].copy(), self.columns, recent
        )

    def restore(self, state: TipWindowState) -> None:
        """Return to a checkpoint."""
        self.end, self.columns = state.end, state.columns
        rows = slice(self.begin, self.end)
        self.stamps[rows], self.means[rows] = state.stamps, state.means
        self.columns[self.end - len(state.recent) : self.end] = state.recent

    def reuse_covariance(self, state: TipWindowState, node: Floats, insertion_rate: float) -> None:
        """Take the columns of ``state``, which is one step ahead, and keep the own means.

        The newest tip is that of the last node's state ``node`` (S,); see :meth:`append`.
        """
        own = self.means[self.begin : self.end].copy()
        self.restore(state)
        i = self.end - 1
        count = min(len(own), i - self.begin)
        if count:
            self.means[i - count : i] = own[-count:]
        tip_from_node(node, np.zeros((len(node), 1)), insertion_rate, self.means[i], np.empty((12, 1)))


def insertion_fraction(model: Model) -> float:
    """Of d beta_1 / dt, what the velocities of ``model`` hold already: 0 without the extension `insertion_velocity`."""
    return float(model.plant.block[model.layout["insertion_velocity"]][0]) if model.extended else 0.0
