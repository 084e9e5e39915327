"""Lengths of the sections of a mesh at the present translations."""

from __future__ import annotations

import numpy as np

from ctr_dynamics.kernels.compiler import njit


@njit()
def section_lengths(bp_tube: np.ndarray, bp_offset: np.ndarray, beta: np.ndarray, seclen: np.ndarray) -> None:
    """Lengths (m) of the sections at the translations ``beta`` (N,), never negative, into ``seclen`` (sections,)."""
    start = 0.0
    for k in range(len(bp_tube)):
        end = max(start, beta[bp_tube[k]] + bp_offset[k])
        seclen[k] = end - start
        start = end
