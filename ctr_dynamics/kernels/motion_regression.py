"""The Kalman update of a departure that grows at constant rates.

See :mod:`ctr_dynamics.estimation.monitoring.frame_motion`.
"""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def correct_motions(mean, covariance, since, arm, residual, noise, density):
    """Correct every row of ``mean`` (r, 9) and ``covariance`` (r, 9, 9), in place, by a departure ``residual`` (3,) m of variance ``noise`` (m^2).

    A row holds the departure at the begin, its velocity and a turn rate, ``since`` (r,) s ago, by which the departure at ``arm`` (r, 3) m from the
    place of the begin is expected. ``density`` (r,): logarithm of that of the departure, by that of the noise at zero, is set.
    """
    H, PH, L, white = np.empty((3, 9)), np.empty((9, 3)), np.zeros((3, 3)), np.empty(3)
    for r in range(mean.shape[0]):
        tau = since[r]
        x, y, z = tau * arm[r, 0], tau * arm[r, 1], tau * arm[r, 2]
        H[:] = 0.0
        for i in range(3):
            H[i, i], H[i, 3 + i] = 1.0, tau
        H[0, 7], H[0, 8], H[1, 6], H[1, 8], H[2, 6], H[2, 7] = z, -y, -z, x, y, -x
        for i in range(9):
            for j in range(3):
                total = 0.0
                for k in range(9):
                    total += covariance[r, i, k] * H[j, k]
                PH[i, j] = total
        # S = L L^T; white = L^-1 (residual - H mean)
        log_det = square = 0.0
        for i in range(3):
            innovation = residual[i]
            for k in range(9):
                innovation -= H[i, k] * mean[r, k]
            for j in range(i + 1):
                total = noise if i == j else 0.0
                for k in range(9):
                    total += H[i, k] * PH[k, j]
                for k in range(j):
                    total -= L[i, k] * L[j, k]
                L[i, j] = math.sqrt(total) if i == j else total / L[j, j]
            for k in range(i):
                innovation -= L[i, k] * white[k]
            white[i] = innovation / L[i, i]
            square += white[i] * white[i]
            log_det += math.log(L[i, i] * L[i, i] / noise)
        density[r] = -0.5 * (square + log_det)
        # PH becomes PH L^-T
        for i in range(9):
            for j in range(3):
                total = PH[i, j]
                for k in range(j):
                    total -= PH[i, k] * L[j, k]
                PH[i, j] = total / L[j, j]
                mean[r, i] += PH[i, j] * white[j]
        for i in range(9):
            for k in range(i + 1):
                less = PH[i, 0] * PH[k, 0] + PH[i, 1] * PH[k, 1] + PH[i, 2] * PH[k, 2]
                covariance[r, i, k] -= less
                covariance[r, k, i] = covariance[r, i, k]
