"""Sections of a mesh as the kernels read them, and their lengths at the present translations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_dynamics.kernels.compiler import njit


class Mesh(NamedTuple):
    """Arrays that describe one set of sections; the kernels read them, nothing writes them.

    ``sec_cells``, ``sec_tubes`` (sections,): cells of a section and tubes present in it. ``bp_tube``, ``bp_offset`` (sections,): the
    section ends at s = beta[bp_tube] + bp_offset. ``ust`` (points * 3N,), ``ust0`` (3N,), ``ust_base`` (N * base points,):
    precurvature in each tube's own frame, 1/m, at the points of the main part, just behind the plate, and (z only) behind the base.
    """

    sec_cells: np.ndarray
    sec_tubes: np.ndarray
    bp_tube: np.ndarray
    bp_offset: np.ndarray
    ust: np.ndarray
    ust0: np.ndarray
    ust_base: np.ndarray
    base_cells: int


@njit(cache=True)
def section_lengths(bp_tube: np.ndarray, bp_offset: np.ndarray, beta: np.ndarray, seclen: np.ndarray) -> None:
    """Lengths (m) of the sections at the translations ``beta`` (N,), never negative, into ``seclen`` (sections,)."""
    start = 0.0
    for k in range(len(bp_tube)):
        end = max(start, beta[bp_tube[k]] + bp_offset[k])
        seclen[k] = end - start
        start = end
