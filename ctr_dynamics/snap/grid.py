"""Grid of the finite-difference solver: cells behind the plate and in every section between breakpoints, and the unknowns at their ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.layout import state_rows
from ctr_dynamics.kernels.snap_residual import GridArrays
from ctr_dynamics.model.mesh import Tubes, breakpoints

SPACING = 0.001  # m, of cells on robots without a grid of their own
LEAST = 3  # cells of a section
BASE = 14  # cells of each tube behind the plate
SHORTEST = (
    1e-6  # m; a section between coinciding breakpoints gets this length, so that (25) has a step to divide by
)

# The grid of the authors' published program (15, 30, 10, 15, 10, 4 points), base to tip.
PUBLISHED = {"till2020_snap_example": (14, 29, 9, 14, 9, 3)}


@dataclass(frozen=True)
class Grid:
    """A grid at fixed translations.

    Attributes:
        arrays: for the kernels.
        cells: (1 + sections,) cells behind the plate and in each section.
        edges: (sections + 1,) m, arc lengths of the plate and the breakpoints.
        unknowns: their number.
    """

    arrays: GridArrays
    cells: tuple[int, ...]
    edges: np.ndarray
    unknowns: int

    @property
    def s(self) -> np.ndarray:
        """(nodes from the plate on,) m, arc length of each node."""
        parts = [
            np.linspace(self.edges[k], self.edges[k + 1], count + 1)[1:]
            for k, count in enumerate(self.cells[1:])
        ]
        return np.concatenate([[0.0], *parts])


def default_cells(name: str, tubes: Tubes, beta: np.ndarray) -> tuple[int, ...]:
    """Cells behind the plate and of every section: the published grid of the robot ``name``, else about 1 mm each, at least three."""
    edges = _edges(tubes, beta)
    published = PUBLISHED.get(name, ())
    if len(published) == len(edges):
        return published
    return (BASE, *(max(LEAST, round(length / SPACING)) for length in np.diff(edges)))


def _edges(tubes: Tubes, beta: np.ndarray) -> np.ndarray:
    edges = np.array([0.0] + [s for s, _, _ in breakpoints(tubes, beta)])
    for k in range(1, len(edges)):
        edges[k] = max(edges[k], edges[k - 1] + SHORTEST)
    return edges


def build_grid(tubes: Tubes, beta: np.ndarray, cells: tuple[int, ...]) -> Grid:
    """Grid of ``cells`` (:func:`default_cells`) for tubes at the translations ``beta`` (N,) m.

    Raises:
        InputError: a count is missing or below 1, or a tube ends behind the plate or beyond an inner one.
    """
    n = len(tubes)
    edges = _edges(tubes, beta)
    if len(cells) != len(edges) or min(cells) < 1:
        raise InputError(
            f"{len(cells)} counts of cells ({', '.join(map(str, cells))}) for {len(edges) - 1} sections",
            do="give one count of at least 1 for the lengths behind the plate and one for each section, base to tip",
        )
    points = breakpoints(tubes, beta)
    turning = int(np.sum(beta < -1e-9))
    base = cells[0] if turning else 0
    active = [next(j for j, g in enumerate(t) if beta[i] + g.end > 0.0) for i, t in enumerate(tubes)]
    present: list[int] = []
    middles: list[np.ndarray] = []
    starts, ends = [], []
    remaining = n

    def reference(s: float) -> np.ndarray:
        row = np.zeros((n, 3))
        for tube in range(remaining):
            row[tube] = tubes[tube][active[tube]].curvature(s - beta[tube])
        return row.ravel()

    for k, (_, i, j) in enumerate(points):
        present.append(remaining)
        x = np.linspace(edges[k], edges[k + 1], 2 * cells[k + 1] + 1)
        starts.append(reference(x[0]))
        ends.append(reference(x[-1]))
        middles.extend(reference(s) for s in x[1::2])
        if j == len(tubes[i]) - 1:
            remaining -= 1
        else:
            active[i] = j + 1
    behind = np.zeros((n, 3))
    uz_base = np.zeros((base, n))
    for i, segments in enumerate(tubes):
        if beta[i] < 0.0:
            for at, store in [(-beta[i], None)] + [
                (-beta[i] * (c + 0.5) / max(base, 1), c) for c in range(base)
            ]:
                here = next(g for g in segments if at <= g.end + 1e-15).curvature(at)
                if store is None:
                    behind[i] = here
                else:
                    uz_base[store, i] = here[2]
    sections = len(present)
    cell_section = np.concatenate([np.full(base, -1), np.repeat(np.arange(sections), cells[1:])]).astype(
        np.int64
    )
    first_cell = base + np.concatenate([[0], np.cumsum(cells[1:])]).astype(np.int64)
    lengths = np.diff(edges)
    ds = np.array([lengths[k] / cells[k + 1] if k >= 0 else 0.0 for k in cell_section])
    state = np.array([state_rows(m).size for m in present])
    rows = np.array([state[k] if k >= 0 else 3 * turning for k in cell_section], dtype=np.int64)
    size = np.concatenate([[turning if base else 0], rows]).astype(np.int64)
    size[base] = 3 * turning + 5 + n - turning
    for k in range(sections):
        after = present[k + 1] if k + 1 < sections else 0
        if after < present[k]:
            size[first_cell[k + 1]] -= 1 if after else 6
    start = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
    row_start = np.concatenate([[0], np.cumsum(rows)]).astype(np.int64)
    arrays = GridArrays(
        n=n,
        turning=turning,
        base=base,
        cell_section=cell_section,
        ds=ds,
        base_ds=-np.minimum(beta, 0.0) / max(base, 1),
        ust=np.concatenate([np.zeros((base, 3 * n)), np.array(middles)]),
        ust_start=np.array(starts),
        ust_end=np.array(ends),
        ust_behind=behind.ravel(),
        uz_base=uz_base,
        tubes=np.array(present, dtype=np.int64),
        first_cell=first_cell,
        size=size,
        start=start,
        rows=rows,
        row_start=row_start,
    )
    if start[-1] != row_start[-1]:
        raise AssertionError(f"{start[-1]} unknowns for {row_start[-1]} equations")
    return Grid(arrays, tuple(int(c) for c in cells), edges, int(start[-1]))
