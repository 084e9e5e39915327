"""SIMD batches of lanes against NumPy arrays of as many numbers."""

import math

import numpy as np
import pytest
from numba import njit

from ctr_dynamics.kernels.kinds import (
    ONE_BATCH,
    ONE_LANE,
    SIMD_WIDTH,
    Lanes,
    Physics,
    RobotKind,
    by_physics,
    lanes_for,
    unknown_lanes,
)
from ctr_dynamics.kernels.layout import workspace_rows
from ctr_dynamics.kernels.shooting import aligned_zeros
from ctr_dynamics.kernels.simd import column_view, fma, largest, local_copy, view, where_above


@njit
def _formulas(lanes, a, b, out):
    """Each operation once, row by row."""
    L = lanes.count
    x, y, z = view(lanes, a, 0, L), view(lanes, b, 0, L), view(lanes, out, 0, L)
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


@pytest.mark.parametrize("lanes", [ONE_BATCH, Lanes(2, 2), Lanes(4, 4)], ids=["eight", "two", "four"])
def test_arithmetic_on_batches_is_that_of_every_lane(lanes):
    rng, L = np.random.default_rng(0), lanes.count
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
    source, target = column_view(table, first), view(ONE_BATCH, out, 0, 8)
    for r in range(len(source)):
        target[0] += source[r]


@pytest.mark.parametrize("first", [0, 3])
def test_columns_of_a_table_as_batches(first):
    table = np.random.default_rng(1).standard_normal((6, 13))
    out = np.zeros(SIMD_WIDTH)
    _column_sums(table, first, out)
    np.testing.assert_allclose(out, table[:, first : first + SIMD_WIDTH].sum(axis=0), rtol=1e-14)


@njit
def _copied(kind, values):
    W = view(ONE_BATCH, values, 0, 8)
    V = local_copy(kind, W)
    V[0] = V[1] + V[2]
    W[3] = V[0]


def test_a_local_copy_leaves_the_workspace_alone():
    values = np.random.default_rng(2).standard_normal((workspace_rows(2).size, SIMD_WIDTH))
    before = values.copy()
    _copied(RobotKind(2), values.reshape(-1))
    np.testing.assert_array_equal(values[3], before[1] + before[2])
    np.testing.assert_array_equal(np.delete(values, 3, axis=0), np.delete(before, 3, axis=0))


@njit
def _known(kind, lanes):
    return kind.tubes, lanes.count, lanes.width, unknown_lanes(kind).count


@pytest.mark.parametrize("lanes", [ONE_LANE, ONE_BATCH, lanes_for(17), Lanes(2, 2), Lanes(4, 4)], ids=str)
@pytest.mark.parametrize(("tubes", "unknowns"), [(1, 8), (2, 8), (3, 16)])
def test_kinds_are_the_same_compiled_or_not(lanes, tubes, unknowns):
    kind = RobotKind(tubes)
    assert _known(kind, lanes) == _known.py_func(kind, lanes) == (tubes, lanes.count, lanes.width, unknowns)


def test_lanes_come_in_whole_batches():
    assert lanes_for(17).count == 24
    with pytest.raises(ValueError, match="no multiple"):
        Lanes(6, 4)


@njit
def _plain_answer(kind, x):
    return x


@njit
def _extended_answer(kind, x):
    return -x


_answer = by_physics(_plain_answer, _extended_answer)


@njit
def _chosen(kind, x):
    return _answer(kind, x)


def test_the_physics_is_chosen_when_a_kernel_is_compiled():
    assert _chosen(RobotKind(2, Physics.PLAIN), 1.0) == 1.0
    assert _chosen(RobotKind(2, Physics.EXTENDED), 1.0) == -1.0


def test_buffers_begin_with_a_line_of_the_cache():
    for size in (1, 7, 1000):
        assert aligned_zeros(size).ctypes.data % 64 == 0
        assert aligned_zeros(size).shape == (size,)
