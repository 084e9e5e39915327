"""Packs of lanes against NumPy arrays of as many numbers."""

import math

import numpy as np
import pytest
from numba import njit

from ctr_dynamics.kernels.lanes import PACK, columns, fma, largest, local_copy, rows, where_above
from ctr_dynamics.kernels.shooting import aligned_zeros
from ctr_dynamics.kernels.workspace import lane_count, workspace_rows


@njit
def _formulas(lanes, a, b, out):
    """Each operation once, row by row."""
    L = lane_count(lanes)
    x, y, z = rows(lanes, a, 0, L), rows(lanes, b, 0, L), rows(lanes, out, 0, L)
    for r in range(len(x)):
        total = 0.0
        total += x[r]
        z[7 * r] = (total - 2.0 * y[r]) / (1.0 + y[r] * y[r])
        z[7 * r + 1] = fma(x[r], 3.0, -y[r])
        z[7 * r + 2] = math.sqrt(x[r] * x[r]) + math.floor(y[r])
        z[7 * r + 3] = where_above(x[r], y[r], x[r], 0.25)
        z[7 * r + 4] = math.exp(y[r])
        z[7 * r + 5] = largest(x[r])
        z[7 * r + 6] = 1.5


@pytest.mark.parametrize("lanes", [(0,), (False,) * 2, (False,) * 4], ids=["eight", "two", "four"])
def test_arithmetic_on_packs_is_that_of_every_lane(lanes):
    rng, L = np.random.default_rng(0), lane_count(lanes)
    a, b = rng.standard_normal((5, L)), rng.standard_normal((5, L))
    out = np.zeros((35, L))
    _formulas(lanes, a.ravel(), b.ravel(), out.reshape(-1))
    expected = np.stack(
        [
            (a - 2.0 * b) / (1.0 + b * b), 3.0 * a - b, np.abs(a) + np.floor(b), np.where(a > b, a, 0.25), np.exp(b),
            np.repeat(a.max(axis=1, keepdims=True), L, axis=1), np.full_like(a, 1.5),
        ],
        axis=1,
    )  # fmt: skip
    np.testing.assert_allclose(out.reshape(5, 7, L), expected, rtol=1e-14, atol=1e-15)


@njit
def _fused(a, b, c):
    return fma(a, b, c)


def test_a_fused_multiplication_rounds_once():
    a = 1.0 + 2.0**-30
    assert _fused(a, a, -1.0) == 2.0**-29 + 2.0**-60
    assert a * a - 1.0 != 2.0**-29 + 2.0**-60


@njit
def _column_sums(table, first, out):
    source, target = columns(table, first), rows((0,), out, 0, 8)
    for r in range(len(source)):
        target[0] += source[r]


@pytest.mark.parametrize("first", [0, 3])
def test_columns_of_a_table_as_packs(first):
    table = np.random.default_rng(1).standard_normal((6, 13))
    out = np.zeros(PACK)
    _column_sums(table, first, out)
    np.testing.assert_allclose(out, table[:, first : first + PACK].sum(axis=0), rtol=1e-14)


@njit
def _copied(tubes, lanes, values):
    W = rows(lanes, values, 0, 8)
    V = local_copy(tubes, W)
    V[0] = V[1] + V[2]
    W[3] = V[0]


def test_a_local_copy_leaves_the_workspace_alone():
    values = np.random.default_rng(2).standard_normal((workspace_rows(2), PACK))
    before = values.copy()
    _copied((0, 0), (0,), values.reshape(-1))
    np.testing.assert_array_equal(values[3], before[1] + before[2])
    np.testing.assert_array_equal(np.delete(values, 3, axis=0), np.delete(before, 3, axis=0))


@njit
def _count(lanes):
    return lane_count(lanes)


@pytest.mark.parametrize(
    ("lanes", "count"), [((), 1), ((0,), 8), ((0,) * 3, 24), ((False,) * 2, 2), ((False,) * 4, 4)]
)
def test_lane_tuples_stand_for_the_same_lanes_compiled_or_not(lanes, count):
    assert lane_count(lanes) == _count(lanes) == count


def test_buffers_begin_with_a_line_of_the_cache():
    for size in (1, 7, 1000):
        assert aligned_zeros(size).ctypes.data % 64 == 0
        assert aligned_zeros(size).shape == (size,)
