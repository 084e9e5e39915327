"""End angles of the tubes from the fields and states of a sweep."""

from __future__ import annotations

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit


@njit(cache=True, nogil=True)
def end_angles(
    sec_cells: np.ndarray,
    sec_tubes: np.ndarray,
    seclen: np.ndarray,
    out: np.ndarray,
    states: np.ndarray,
    angles: np.ndarray,
) -> None:
    """Fill ``angles`` (N, lanes) with psi_L (rad): base angle plus the integral of u_1z, by the weights of the Runge-Kutta stages, plus theta.

    ``out`` (points * F, lanes) are the fields of a sweep, ``states`` (nodes, S, lanes) its states at the nodes.
    """
    n, lanes = angles.shape
    psi = np.empty(lanes)
    for j in range(lanes):
        psi[j] = 2.0 * math.atan2(states[0, 6, j], states[0, 3, j])
    row, node = 8, 0  # of u_1z at the section's first point; the section's first node
    for k in range(len(sec_cells)):
        weight = seclen[k] / sec_cells[k] / 6.0
        for _ in range(sec_cells[k]):
            for stage in range(4):
                share = 2.0 * weight if stage in (1, 2) else weight
                for j in range(lanes):
                    psi[j] += share * out[row, j]
                row += 7 + 2 * n
        row += 7 + 2 * n
        node += sec_cells[k] + 1
        after = sec_tubes[k + 1] if k + 1 < len(sec_cells) else 0
        if after < sec_tubes[k]:
            i = sec_tubes[k] - 1
            for j in range(lanes):
                angles[i, j] = psi[j] + (states[node - 1, 17 + n + i, j] if i else 0.0)
