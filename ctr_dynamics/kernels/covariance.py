"""Variances: quadratic forms of rows under the covariance of the coefficients, eight rows side by side in the lanes of one vector."""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.kinds import ONE_BATCH, SIMD_WIDTH
from ctr_dynamics.kernels.simd import fma, view

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def side_by_side(rows, first, lanes):
    """Fill ``lanes`` (s * 8,) with rows ``first`` to ``first`` + 7 of ``rows`` (k, s), zero where there are none.

    Element p of all eight lies in one vector.
    """
    count = min(SIMD_WIDTH, len(rows) - first)
    for p in range(rows.shape[1]):
        for lane in range(count):
            lanes[p * SIMD_WIDTH + lane] = rows[first + lane, p]
        for lane in range(count, SIMD_WIDTH):
            lanes[p * SIMD_WIDTH + lane] = 0.0


@compiled
def products(pi, lanes, result):
    """``result`` (s * 8,) = pi times eight rows laid side by side by :func:`side_by_side`, of ``pi`` (at least s, s)."""
    row, product = view(ONE_BATCH, lanes, 0, SIMD_WIDTH), view(ONE_BATCH, result, 0, SIMD_WIDTH)
    size = len(row)
    whole = size - size % 4
    for p in range(0, whole, 4):  # four sums that do not wait for each other
        x = row[0]
        a, b, c, d = x * pi[p, 0], x * pi[p + 1, 0], x * pi[p + 2, 0], x * pi[p + 3, 0]
        for q in range(1, size):
            x = row[q]
            a, b = fma(x, pi[p, q], a), fma(x, pi[p + 1, q], b)
            c, d = fma(x, pi[p + 2, q], c), fma(x, pi[p + 3, q], d)
        product[p], product[p + 1], product[p + 2], product[p + 3] = a, b, c, d
    for p in range(whole, size):
        a = row[0] * pi[p, 0]
        for q in range(1, size):
            a = fma(row[q], pi[p, q], a)
        product[p] = a


@compiled
def variances(rows, pi):
    """(k,) diagonal of rows pi rows^T of ``rows`` (k, s) under ``pi`` (at least s, s)."""
    count, size = rows.shape
    result, sums = np.zeros(count), np.empty(SIMD_WIDTH)
    lanes, half = np.empty(size * SIMD_WIDTH), np.empty(size * SIMD_WIDTH)
    row, product, total = (
        view(ONE_BATCH, lanes, 0, SIMD_WIDTH),
        view(ONE_BATCH, half, 0, SIMD_WIDTH),
        view(ONE_BATCH, sums, 0, SIMD_WIDTH),
    )
    for first in range(0, count if size else 0, SIMD_WIDTH):
        side_by_side(rows, first, lanes)
        products(pi, lanes, half)
        form = row[0] * product[0]
        for p in range(1, size):
            form = fma(row[p], product[p], form)
        total[0] = form
        for lane in range(min(SIMD_WIDTH, count - first)):
            result[first + lane] = sums[lane]
    return result


@compiled
def covariance_of(rows, pi, covariance):
    """``covariance`` (k, k) = rows pi rows^T of ``rows`` (k, s), s at least 1, under ``pi`` (at least s, s)."""
    count, size = rows.shape
    sums, lanes, half = np.empty(SIMD_WIDTH), np.empty(size * SIMD_WIDTH), np.empty(size * SIMD_WIDTH)
    product, total = view(ONE_BATCH, half, 0, SIMD_WIDTH), view(ONE_BATCH, sums, 0, SIMD_WIDTH)
    for first in range(0, count, SIMD_WIDTH):
        side_by_side(rows, first, lanes)
        products(pi, lanes, half)
        last = min(first + SIMD_WIDTH, count)
        for i in range(last):
            form = product[0] * rows[i, 0]
            for p in range(1, size):
                form = fma(product[p], rows[i, p], form)
            total[0] = form
            for n in range(max(i, first), last):
                covariance[i, n] = covariance[n, i] = sums[n - first]


@compiled
def position_deviations(dnodes, size, pi):
    """(nodes,) deviation of the position per axis in m: root of a third of the trace of its covariance under ``pi`` (at least r, r).

    ``dnodes`` (nodes * size, r): columns of the node states, position first.
    """
    nodes = len(dnodes) // size
    positions = np.empty((3 * nodes, dnodes.shape[1]))
    for node in range(nodes):
        positions[3 * node : 3 * node + 3] = dnodes[node * size : node * size + 3]
    each = variances(positions, pi)
    result = np.empty(nodes)
    for node in range(nodes):
        trace = each[3 * node] + each[3 * node + 1] + each[3 * node + 2]
        result[node] = math.sqrt(max(trace, 0.0) / 3.0)
    return result
