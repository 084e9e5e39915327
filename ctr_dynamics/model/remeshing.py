"""Stored fields carried over to another set of sections."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from ctr_dynamics.kernels.layout import field_rows
from ctr_dynamics.model.mesh import Mesh, point_positions


def remap_fields(
    n: int, bank: np.ndarray, old: Mesh, old_beta: np.ndarray, new: Mesh, new_beta: np.ndarray
) -> np.ndarray:
    """Fields (rows, fields) of the sections ``old`` at ``old_beta`` as fields of the sections ``new`` at ``new_beta``.

    By interpolation inside each old section, never across one. Sections that are the same but for their cells keep their reference coordinate.
    The Runge-Kutta stages of a cell are not the field at their abscissa: at the middle they miss it by -e and +e with e of second order in the
    cell's length, at the end by an error of third order. These offsets belong to the history as well, or the change of cells would be a kick.
    """
    old_s, old_section = point_positions(old, old_beta)
    new_s, new_section = point_positions(new, new_beta)
    F = field_rows(n).size
    main = len(old_s) * F
    ends = [old_s[old_section == k][-1] for k in range(len(old.sec_cells))]
    result = np.zeros((len(bank), len(new_s) * F + bank.shape[1] - main))
    result[:, len(new_s) * F :] = bank[:, main:]
    fields = bank[:, :main].reshape(len(bank), -1, F).swapaxes(0, 1)
    target = result[:, : len(new_s) * F].reshape(len(bank), -1, F).swapaxes(0, 1)
    same = np.array_equal(old.bp_tube, new.bp_tube) and np.array_equal(old.bp_offset, new.bp_offset)
    for k in range(len(new.sec_cells)):
        where = np.flatnonzero(new_section == k)
        s = new_s[where] * old_s[-1] / new_s[-1]
        middle = 0.5 * (s[0] + s[-1])
        source = (
            k if same else next((j for j, end in enumerate(ends) if middle <= end + 1e-12), len(ends) - 1)
        )
        points = np.flatnonzero(old_section == source)
        x = old_s[points]
        if same:
            s = x[0] + (new_s[where] - new_s[where][0]) / max(np.ptp(new_s[where]), 1e-15) * (x[-1] - x[0])
        target[where] = _resample(x, fields[points], s)
    return result


def _resample(x: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Stage values (points, ...) of one section's cells at ``x`` as those of other cells at ``at``; both hold four stages a cell and the end."""
    if x[-1] - x[0] < 1e-12:
        return np.repeat(values[-1:], len(at), axis=0)
    at = np.clip(at, x[0], x[-1])
    first, second, last = values[1:-1:4], values[2:-1:4], values[3:-1:4]
    nodes = np.concatenate([values[0:-1:4], values[-1:]])
    knots = np.concatenate([x[0:-1:4], x[-1:]])
    centres = 0.5 * (knots[:-1] + knots[1:])
    grid = np.empty(2 * len(centres) + 1)
    grid[0::2], grid[1::2] = knots, centres
    known = np.empty((len(grid), *values.shape[1:]))
    known[0::2], known[1::2] = nodes, 0.5 * (first + second)
    result = CubicSpline(grid, known)(at) if len(grid) > 3 else _quadratic(grid, known, at)
    ratio = (at[-1] - at[0]) / ((len(at) - 1) // 4) / (x[-1] - x[0]) * len(centres)
    half, end = 0.5 * (second - first) * ratio**2, (last - nodes[1:]) * ratio**3
    for stage, offset in ((1, -half), (2, half), (3, end)):
        result[stage:-1:4] += _linear(centres, offset, 0.5 * (at[0:-1:4] + at[3:-1:4]))
    return result


def _linear(x: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Linear interpolation of values (points, ...), held outside the range of ``x``."""
    if len(x) == 1:
        return np.repeat(values, len(at), axis=0)
    left = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    w = np.clip((at - x[left]) / (x[left + 1] - x[left]), 0.0, 1.0).reshape(-1, *[1] * (values.ndim - 1))
    return (1.0 - w) * values[left] + w * values[left + 1]


def _quadratic(x: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Parabola through three values (3, ...)."""
    w0 = (at - x[1]) * (at - x[2]) / ((x[0] - x[1]) * (x[0] - x[2]))
    w1 = (at - x[0]) * (at - x[2]) / ((x[1] - x[0]) * (x[1] - x[2]))
    w2 = (at - x[0]) * (at - x[1]) / ((x[2] - x[0]) * (x[2] - x[1]))
    return np.tensordot(np.stack([w0, w1, w2], axis=1), values, axes=1)


def remap_columns(
    n: int, columns: np.ndarray, old: Mesh, old_beta: np.ndarray, new: Mesh, new_beta: np.ndarray
) -> np.ndarray:
    """Columns (slots, fields, r) of stored fields carried over like the fields themselves."""
    slots, _, r = columns.shape
    rows = np.ascontiguousarray(columns.transpose(0, 2, 1)).reshape(slots * r, -1)
    moved = remap_fields(n, rows, old, old_beta, new, new_beta)
    return np.ascontiguousarray(moved.reshape(slots, r, -1).transpose(0, 2, 1))
