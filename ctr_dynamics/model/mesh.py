"""Sections of the robot between curvature changes and tube ends, and the cells that carry the fields on them.

Every section keeps its own reference coordinate in [0, 1] with a fixed number of cells, so that fields are never interpolated across a
jump of curvature while the actuators move; only the section lengths follow the translations. When a breakpoint passes another one
or the base plate, or a section has grown or shrunk so far that its cells no longer suit it, the set of sections changes and
:func:`ctr_dynamics.model.remeshing.remap_fields` carries the fields over once.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.layout import unknown_rows
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.structures import Mesh

STAGES = 4  # Runge-Kutta stages a cell, each with its own history
_STAGE_XI = (0.0, 0.5, 0.5, 1.0)


class Segment(NamedTuple):
    """A length of tube with smooth precurvature: ``coefficients`` (3, K) of a polynomial in the arc length from ``start``, SI units."""

    start: float
    end: float
    coefficients: np.ndarray

    def curvature(self, arc_length: float) -> np.ndarray:
        """u* (3,) in 1/m at the tube's own arc length (m), held at the segment's ends."""
        x = min(max(arc_length, self.start), self.end) - self.start
        return self.coefficients @ x ** np.arange(self.coefficients.shape[1])


Tubes = tuple[tuple[Segment, ...], ...]


def breakpoints(tubes: Tubes, beta: np.ndarray) -> list[tuple[float, int, int]]:
    """(s, tube, segment) of every curvature change and tube end beyond the plate, base to tip; s in m.

    Raises InputError where a tube's end lies behind the plate or outside the next inner tube's.
    """
    ends = [beta[i] + segments[-1].end for i, segments in enumerate(tubes)]
    for i, end in enumerate(ends):
        if end <= 0.0:
            raise InputError(
                f"tube {i + 1} ends {-end:.4f} m behind the base plate (beta {beta[i]:.4f} m, length {tubes[i][-1].end:.4f} m)",
                do="insert it further: its end must lie beyond the plate",
            )
        if i and end > ends[i - 1] + 1e-12:
            raise InputError(
                f"tube {i + 1} ends at s = {end:.4f} m, beyond tube {i}, which ends at {ends[i - 1]:.4f} m",
                do="an inner tube must reach at least as far as the tubes around it",
            )
    points = [
        (beta[i] + segment.end, i, j)
        for i, segments in enumerate(tubes)
        for j, segment in enumerate(segments)
        if beta[i] + segment.end > 0.0
    ]
    # outer tubes first among equals, so that tubes end from the outside in
    return sorted(points, key=lambda item: (item[0], -item[1]))


Key = tuple[
    tuple[tuple[int, int], ...], tuple[int, ...]
]  # order of breakpoints as (tube, segment), cells of each section


def section_key(tubes: Tubes, beta: np.ndarray, nodes: int) -> Key:
    """Order of the breakpoints and cells of the sections between them, for about ``nodes`` nodes from plate to tip."""
    points = breakpoints(tubes, beta)
    lengths = np.diff([0.0] + [s for s, _, _ in points])
    cells = np.maximum(1, np.round((nodes - 1) * lengths / points[-1][0])).astype(int)
    return tuple((i, j) for _, i, j in points), tuple(cells.tolist())


def fits(key: Key, tubes: Tubes, beta: np.ndarray, nodes: int) -> bool:
    """Whether the sections ``key`` still serve at ``beta``: same order of breakpoints, and no section with far too few or too many cells.

    The bounds lie well outside the rounding of :func:`section_key`, so that a robot at a bound does not change its mesh to and fro.
    """
    points = breakpoints(tubes, beta)
    order, cells = key
    if order != tuple((i, j) for _, i, j in points):
        return False
    lengths = np.diff([0.0] + [s for s, _, _ in points])
    wanted = (nodes - 1) * lengths / points[-1][0]
    return all(w <= 1.8 * c and (c == 1 or w >= 0.5 * c) for w, c in zip(wanted, cells, strict=True))


def build_mesh(tubes: Tubes, beta: np.ndarray, key: Key, base_cells: int = 4) -> Mesh:
    """Sections ``key`` of :func:`section_key` for the actuator translations ``beta`` (N,) m."""
    n = len(tubes)
    points = breakpoints(tubes, beta)
    positions = np.array([0.0] + [s for s, _, _ in points])
    lengths = np.diff(positions)
    cells = np.array(key[1], dtype=np.int64)
    at_plate = [next(j for j, g in enumerate(t) if beta[i] + g.end > 0.0) for i, t in enumerate(tubes)]
    active = list(at_plate)
    present, ust, remaining = [], [], n
    for k, (_, i, j) in enumerate(points):
        present.append(remaining)
        for cell in range(cells[k]):
            xi = [(cell + x) / cells[k] for x in _STAGE_XI] + ([1.0] if cell == cells[k] - 1 else [])
            for x in xi:
                s = positions[k] + x * lengths[k]
                row = np.zeros((n, 3))
                for tube in range(remaining):
                    row[tube] = tubes[tube][active[tube]].curvature(s - beta[tube])
                ust.append(row)
        if j == len(tubes[i]) - 1:
            remaining -= 1
        else:
            active[i] = j + 1
    ust0 = np.zeros((n, 3))
    base_points = STAGES * base_cells + 1
    ust_base = np.zeros((n, base_points))
    for i, segments in enumerate(tubes):
        # of a breakpoint just at the plate the side in front, and of a tube that begins there its beginning: a mesh serves other translations too
        ust0[i] = segments[at_plate[i]].curvature(-beta[i])
        ust_base[i] = ust0[i, 2]
        if beta[i] < 0.0:
            edges = -beta[i] * np.arange(base_cells + 1) / base_cells
            means = [_mean_twist(segments, a, b) for a, b in itertools.pairwise(edges)]
            ust_base[i, :-1] = np.repeat(means, STAGES)
    return Mesh(
        sec_cells=cells,
        sec_tubes=np.array(present, dtype=np.int64),
        bp_tube=np.array([i for _, i, _ in points], dtype=np.int64),
        bp_offset=np.array([tubes[i][j].end for _, i, j in points]),
        ust=np.array(ust).ravel(),
        ust0=ust0.ravel(),
        ust_base=ust_base.ravel(),
        base_cells=base_cells,
        cut=-np.ones(int(cells.sum())),
        owner=np.zeros(unknown_rows(n).size, dtype=np.int64),
    )


def _mean_twist(segments: tuple[Segment, ...], start: float, end: float) -> float:
    """Mean of u*_z (1/m) between two arc lengths of a tube, exact across segments, so that the twist behind the plate is."""
    total = 0.0
    for g in segments:
        a, b = max(start, g.start) - g.start, min(end, g.end) - g.start
        if b > a:
            power = np.arange(1, g.coefficients.shape[1] + 1)
            total += float(g.coefficients[2] @ ((b**power - a**power) / power))
    return total / (end - start)


def point_count(mesh: Mesh) -> int:
    """Points of the main part: four stages a cell and one at the end of every section."""
    return int(STAGES * mesh.sec_cells.sum() + len(mesh.sec_cells))


def node_count(mesh: Mesh) -> int:
    """Nodes of the main part; the two sides of a breakpoint count as two."""
    return int(mesh.sec_cells.sum() + len(mesh.sec_cells))


def point_positions(mesh: Mesh, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(s in m, section index) of every point of the main part at ``beta``."""
    seclen = np.zeros(len(mesh.sec_cells))
    section_lengths(mesh.bp_tube, mesh.bp_offset, np.asarray(beta, float), seclen)
    starts = np.concatenate([[0.0], np.cumsum(seclen)[:-1]])
    s, section = [], []
    for k, cells in enumerate(mesh.sec_cells):
        xi = [(cell + x) / cells for cell in range(cells) for x in _STAGE_XI] + [1.0]
        s.append(starts[k] + np.array(xi) * seclen[k])
        section.append(np.full(len(xi), k))
    return np.concatenate(s), np.concatenate(section)


def node_positions(mesh: Mesh, beta: np.ndarray) -> np.ndarray:
    """Arc length (m) of every node at ``beta``."""
    seclen = np.zeros(len(mesh.sec_cells))
    section_lengths(mesh.bp_tube, mesh.bp_offset, np.asarray(beta, float), seclen)
    starts = np.concatenate([[0.0], np.cumsum(seclen)[:-1]])
    return np.concatenate(
        [starts[k] + np.linspace(0.0, 1.0, cells + 1) * seclen[k] for k, cells in enumerate(mesh.sec_cells)]
    )


def node_points(sec_cells: np.ndarray) -> np.ndarray:
    """(P,) number of the point at which each node's fields stand: a cell's first stage, and the section's end."""
    points: list[int] = []
    start = 0
    for cells in sec_cells:
        points.extend(start + 4 * np.arange(cells + 1))
        start += 4 * int(cells) + 1
    return np.array(points)
