"""Transfer of fields and node states between two meshes of the same sections, as sparse matrices that hold while the sections last."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from ctr_dynamics.model.mesh import STAGES, Key, Mesh
from ctr_dynamics.model.workspace import base_rows

_STAGE_XI = (0.0, 0.5, 0.5, 1.0)


class Transfer(NamedTuple):
    """Matrices between a fine and a coarse mesh.

    ``restrict`` (coarse fields, fine fields), ``prolong`` (fine fields, coarse fields), ``nodes`` (fine nodes, coarse nodes).
    """

    restrict: csr_array
    prolong: csr_array
    nodes: csr_array


def coarse_key(key: Key, nodes: int) -> Key:
    """Sections of ``key`` with about ``nodes`` nodes in all, never more than it has."""
    order, cells = key
    ratio = min(1.0, (nodes - 1) / sum(cells))
    return order, tuple(max(1, round(c * ratio)) for c in cells)


def transfer(n: int, fine: Mesh, coarse: Mesh) -> Transfer:
    """Cubic interpolation inside each section, between the points that are nodes; fields behind the plate are the same on both meshes."""
    F = 7 + 2 * n
    base = base_rows(n, fine.base_cells)
    return Transfer(
        _fields(fine.sec_cells, coarse.sec_cells, F, base),
        _fields(coarse.sec_cells, fine.sec_cells, F, base),
        _nodes(coarse.sec_cells, fine.sec_cells),
    )


def _weights(cells: int, xi: float) -> tuple[np.ndarray, np.ndarray]:
    """Node numbers and Lagrange weights that give the value at ``xi`` in [0, 1] from a section's ``cells`` + 1 nodes."""
    count = min(4, cells + 1)
    first = int(np.clip(np.floor(xi * cells) - (count // 2 - 1), 0, cells + 1 - count))
    at = np.arange(first, first + count)
    x = at / cells
    weights = np.ones(count)
    for i in range(count):
        for j in range(count):
            if i != j:
                weights[i] *= (xi - x[j]) / (x[i] - x[j])
    return at, weights


def _fields(source: np.ndarray, target: np.ndarray, F: int, base: int) -> csr_array:
    rows: list[int] = []
    columns: list[int] = []
    values: list[float] = []
    row = start = 0
    for old, new in zip(source, target, strict=True):
        xi = [(cell + x) / new for cell in range(new) for x in _STAGE_XI] + [1.0]
        for x in xi:
            at, weights = _weights(int(old), x)
            for f in range(F):
                rows.extend([row * F + f] * len(at))
                columns.extend((start + STAGES * at) * F + f)
                values.extend(weights)
            row += 1
        start += STAGES * int(old) + 1
    rows.extend(range(row * F, row * F + base))
    columns.extend(range(start * F, start * F + base))
    values.extend([1.0] * base)
    return csr_array((values, (rows, columns)), shape=(row * F + base, start * F + base))


def _nodes(source: np.ndarray, target: np.ndarray) -> csr_array:
    rows: list[int] = []
    columns: list[int] = []
    values: list[float] = []
    row = start = 0
    for old, new in zip(source, target, strict=True):
        for node in range(new + 1):
            at, weights = _weights(int(old), node / new)
            rows.extend([row] * len(at))
            columns.extend(start + at)
            values.extend(weights)
            row += 1
        start += int(old) + 1
    return csr_array((values, (rows, columns)), shape=(row, start))
