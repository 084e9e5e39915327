"""Reduction of the covariance V Pi V^T to fewer columns: the directions that are weakest in an energy norm are dropped.

In whitened coefficients u, a = L u with L L^T = Pi, these are the eigenvectors N of L^T V^T W V L with the least eigenvalues. That they are
dropped says N^T L^-1 a = 0. This is solved for as many coefficients as there are such directions; the other columns take over what those
carried. The span and the covariance are those of the principal columns V L U (Verlaan and Heemink 1997), but only a few columns are
multiplied. Where Pi is too near to singular for that, the principal columns are taken.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dsyevd, dsyevr

from ctr_dynamics.kernels.covariance_reduction import eliminate, without

Floats = NDArray[np.float64]
APPENDED = (
    3  # columns that process noise has appended since the last reduction: one for each axis of the force
)
# Least entry of the root's diagonal, by the largest, with which columns are eliminated: solving with the root then keeps some ten digits.
REGULAR = 1e-5


class BasisChange(Protocol):
    """From columns (rows, r) of the old coefficients to those (rows, k) of the new ones, in ``out`` if given.

    Fewer than r columns may be given where the last are zero.
    """

    def __call__(self, columns: Floats, out: Floats | None = None) -> Floats: ...


def through(T: Floats) -> BasisChange:
    """Columns V to V T."""
    return lambda columns, out=None: np.matmul(columns, T[: columns.shape[1]], out=out)


def reduced(pi: Floats, gram: Floats, rank: int) -> tuple[Floats, BasisChange, Floats]:
    """The covariance with ``rank`` = k coefficients at most.

    Args:
        pi: (r + n, r + n) covariance of the coefficients and of n further states.
        gram: (r, r) V^T W V.
        rank: k.

    Returns:
        The new (k + n, k + n) covariance, how columns change, and the (k, r) by which the old coefficients give the new ones.
    """
    r = len(gram)
    root, failed = dpotrf(pi[:r, :r], lower=1, clean=1)
    diagonal = root.diagonal()
    energy = root.T @ gram @ root
    regular = not failed and diagonal.min() > REGULAR * diagonal.max()
    if r == rank + APPENDED and regular and math.isfinite(energy.sum()):
        _, weakest, _, _, failed = dsyevr(energy, range="I", il=1, iu=APPENDED)
        if not failed:
            after, projection, *parts = without(pi, root, weakest)

            def change(columns: Floats, out: Floats | None = None) -> Floats:
                out = np.empty((len(columns), rank)) if out is None else out
                eliminate(columns, *parts, out)
                return out

            return after, change, projection
    return principal(pi, gram, rank)


def principal(pi: Floats, gram: Floats, rank: int) -> tuple[Floats, BasisChange, Floats]:
    """As :func:`reduced`, with principal columns: the coefficients are uncorrelated and of deviation 1."""
    r = len(gram)
    lam, E = np.linalg.eigh(0.5 * (pi[:r, :r] + pi[:r, :r].T))
    lam = np.maximum(lam, 0.0)
    root = E * np.sqrt(lam)
    inverse = np.where(lam > 1e-14 * lam.max(), 1.0 / np.sqrt(np.maximum(lam, 1e-300)), 0.0)[:, None] * E.T
    _, U, _ = dsyevd(root.T @ gram @ root)  # ascending
    U = U[:, : -rank - 1 : -1]
    T = root @ U  # old coefficients = T new coefficients
    k = U.shape[1]
    after = np.zeros((k + len(pi) - r,) * 2)
    after[:k, :k] = np.eye(k)
    projection = U.T @ inverse
    after[:k, k:] = projection @ pi[:r, r:]
    after[k:, :k] = after[:k, k:].T
    after[k:, k:] = pi[r:, r:]
    return after, through(T), projection
