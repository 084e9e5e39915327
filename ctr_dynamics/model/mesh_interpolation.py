"""Interpolation of fields and node states between two meshes of the same sections, as sparse matrices that hold while the sections last."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.sparse import block_diag, csr_array, eye_array, kron

from ctr_dynamics.kernels.layout import base_field_count, field_rows
from ctr_dynamics.model.mesh import STAGES, Key, Mesh

_STAGE_XI = np.array([0.0, 0.5, 0.5, 1.0])


class MeshInterpolation(NamedTuple):
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


def mesh_interpolation(n: int, fine: Mesh, coarse: Mesh) -> MeshInterpolation:
    """Cubic interpolation inside each section, between the points that are nodes; fields behind the plate are the same on both meshes."""
    F = field_rows(n).size
    base = base_field_count(n, fine.base_cells)
    return MeshInterpolation(
        _fields(fine.sec_cells, coarse.sec_cells, F, base),
        _fields(coarse.sec_cells, fine.sec_cells, F, base),
        _nodes(coarse.sec_cells, fine.sec_cells),
    )


def _weights(cells: int, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Node numbers (points, 4) and Lagrange weights that give the values at ``xi`` (points,) in [0, 1] from a section's ``cells`` + 1 nodes.

    Sections of fewer than three cells have as many columns as nodes.
    """
    count = min(4, cells + 1)
    first = np.clip(np.floor(xi * cells).astype(int) - (count // 2 - 1), 0, cells + 1 - count)
    at = first[:, None] + np.arange(count)
    x = at / cells
    weights = np.ones(at.shape)
    for i in range(count):
        for j in range(count):
            if i != j:
                weights[:, i] *= (xi - x[:, j]) / (x[:, i] - x[:, j])
    return at, weights


def _sections(
    source: np.ndarray, target: np.ndarray, xi_of: Callable[[int], np.ndarray], stride: int
) -> csr_array:
    """Interpolation from the nodes of sections with ``source`` cells, ``stride`` points apart, to the points ``xi_of(cells)`` of those with
    ``target`` cells."""
    rows, columns, values = [], [], []
    row = start = 0
    for old, new in zip(source.tolist(), target.tolist(), strict=True):
        xi = xi_of(new)
        at, weights = _weights(old, xi)
        rows.append(np.repeat(np.arange(row, row + len(xi)), at.shape[1]))
        columns.append((start + stride * at).ravel())
        values.append(weights.ravel())
        row += len(xi)
        start += stride * old + 1
    where = np.concatenate(rows), np.concatenate(columns)
    return csr_array((np.concatenate(values), where), shape=(row, start))


def _fields(source: np.ndarray, target: np.ndarray, F: int, base: int) -> csr_array:
    def points(cells: int) -> np.ndarray:
        return np.append((np.arange(cells)[:, None] + _STAGE_XI) / cells, 1.0)

    main = kron(_sections(source, target, points, STAGES), eye_array(F), format="csr")
    return csr_array(block_diag([main, eye_array(base)], format="csr"))


def _nodes(source: np.ndarray, target: np.ndarray) -> csr_array:
    return _sections(source, target, lambda cells: np.arange(cells + 1) / cells, 1)
