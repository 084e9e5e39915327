"""The Kalman update of a departure that is measured with jitter of several sizes.

See :mod:`ctr_dynamics.estimation.monitoring.stamp_jitter`.
"""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def sum_root(P, factor, N, L):
    """Fill the lower root ``L`` (3, 3) of ``P`` + ``factor`` ``N``."""
    for i in range(3):
        for j in range(i + 1):
            total = P[i, j] + factor * N[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(total) if i == j else total / L[j, j]


@compiled
def solve_lower(L, values, solved):
    """Fill ``solved`` (3,) with L^-1 ``values``."""
    for i in range(3):
        total = values[i]
        for k in range(i):
            total -= L[i, k] * solved[k]
        solved[i] = total / L[i, i]


@compiled
def correct_departures(level, covariance, sizes, motion, noise, freedom, density):
    """Correct every row of ``level`` (s, 3) and ``covariance`` (s, 3, 3), in place, by a measured departure.

    ``motion`` (3, 3): the departure (m), and velocity and acceleration of the tip. It is measured with noise of the variance ``noise`` (m^2) and
    jitter of the deviation ``sizes`` (s,), which adds -v tau + a tau^2 / 2, with Student's distribution of ``freedom`` degrees.
    ``density`` (s,): logarithm of that of the departure, by that of the noise at zero and without the constant of the distribution, is set.
    """
    N, L, K = np.empty((3, 3)), np.zeros((3, 3)), np.empty((3, 3))
    change, white = np.empty(3), np.empty(3)
    for s in range(len(sizes)):
        variance = sizes[s] ** 2
        for i in range(3):
            change[i] = motion[0, i] - level[s, i] - 0.5 * variance * motion[2, i]
            for j in range(3):
                way = motion[1, i] * motion[1, j] + 0.5 * variance * motion[2, i] * motion[2, j]
                N[i, j] = variance * way + (noise if i == j else 0.0)
        # 1. The density, by P + N = L L^T
        sum_root(covariance[s], 1.0, N, L)
        solve_lower(L, change, white)
        square = log_det = 0.0
        for i in range(3):
            square += white[i] * white[i]
            log_det += math.log(L[i, i] * L[i, i] / noise)
        density[s] = -0.5 * (log_det + (freedom + 3.0) * math.log1p(square / freedom))
        # 2. The gain, with noise that is larger for what lies far out: P + N / w = L L^T, K = P L^-T
        sum_root(covariance[s], (freedom + square) / (freedom + 3.0), N, L)
        solve_lower(L, change, white)
        for i in range(3):
            solve_lower(L, covariance[s, i], K[i])
        for i in range(3):
            for j in range(3):
                level[s, i] += K[i, j] * white[j]
        for i in range(3):
            for j in range(i + 1):
                covariance[s, i, j] -= K[i, 0] * K[j, 0] + K[i, 1] * K[j, 1] + K[i, 2] * K[j, 2]
                covariance[s, j, i] = covariance[s, i, j]
