"""End angles of the tubes from the fields and states of a sweep."""

from __future__ import annotations

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import field_rows, state_rows


@njit(nogil=True)
def end_angles(
    sec_cells: np.ndarray,
    sec_tubes: np.ndarray,
    section_lengths: np.ndarray,
    fields: np.ndarray,
    states: np.ndarray,
    angles: np.ndarray,
) -> None:
    """Fill ``angles`` (N, lanes) with psi_L (rad): base angle plus the integral of u_1z, by the weights of the Runge-Kutta stages, plus theta.

    ``fields`` (points * F, lanes) are those of a sweep, ``states`` (nodes, S, lanes) its states at the nodes.
    """
    n, lanes = angles.shape
    state, F = state_rows(n), field_rows(n).size
    h = state.quaternion
    psi = np.empty(lanes)
    for j in range(lanes):
        psi[j] = 2.0 * math.atan2(states[0, h + 3, j], states[0, h, j])
    row, node = field_rows(n).curvature_z, 0  # of u_1z at the section's first point; the section's first node
    for k in range(len(sec_cells)):
        weight = section_lengths[k] / sec_cells[k] / 6.0
        for _ in range(sec_cells[k]):
            for stage in range(4):
                share = 2.0 * weight if stage in (1, 2) else weight
                for j in range(lanes):
                    psi[j] += share * fields[row, j]
                row += F
        row += F
        node += sec_cells[k] + 1
        after = sec_tubes[k + 1] if k + 1 < len(sec_cells) else 0
        if after < sec_tubes[k]:
            i = sec_tubes[k] - 1
            for j in range(lanes):
                angles[i, j] = psi[j] + (states[node - 1, state.theta + i - 1, j] if i else 0.0)
