"""Reduction of the covariance V Pi V^T to fewer columns: the directions that are weakest in an energy norm are dropped.

In whitened coefficients u, a = L u with L L^T = Pi, these are the eigenvectors N of L^T V^T W V L with the least eigenvalues. That they are dropped
says N^T L^-1 a = 0, which is solved for as many coefficients as there are such directions; the columns of the others take what those carried. The
columns' span and covariance are those of the principal columns V L U (Verlaan and Heemink 1997), but few columns instead of all are multiplied.
Where Pi is too near to singular for that, the principal columns are taken.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dsyevd, dsyevr

from ctr_dynamics.kernels.covariance_reduction import eliminate, without

Floats = NDArray[np.float64]
APPENDED = 3  # columns that the tip force's new randomness has added since the last reduction
REGULAR = 1e-5  # least entry of the root's diagonal, by the largest, with which columns are eliminated


class Change(Protocol):
    """From columns (rows, r) of the old coefficients, or fewer where the last are zero, to those (rows, k) of the new ones, in ``out`` if given."""

    def __call__(self, columns: Floats, out: Floats | None = None) -> Floats: ...


def through(T: Floats) -> Change:
    """Columns V to V T."""
    return lambda columns, out=None: np.matmul(columns, T[: columns.shape[1]], out=out)


def reduced(pi: Floats, gram: Floats, rank: int) -> tuple[Floats, Change, Floats]:
    """Covariance of ``rank`` = k coefficients at most and of all that follows them in ``pi`` (r + n, r + n), how columns change, and the (k, r)
    by which the old coefficients give the new ones.

    ``gram`` (r, r): V^T W V.
    """
    r = len(gram)
    root, failed = dpotrf(pi[:r, :r], lower=1, clean=1)
    diagonal = root.diagonal()
    energy = root.T @ gram @ root
    regular = not failed and diagonal.min() > REGULAR * diagonal.max()
    if r == rank + APPENDED and regular and math.isfinite(energy.sum()):
        _, weakest, _, _, failed = dsyevr(energy, range="I", il=1, iu=APPENDED)
        if not failed:
            after, kept, *parts = without(pi, root, weakest)

            def change(columns: Floats, out: Floats | None = None) -> Floats:
                out = np.empty((len(columns), rank)) if out is None else out
                eliminate(columns, *parts, out)
                return out

            return after, change, kept
    return principal(pi, gram, rank)


def principal(pi: Floats, gram: Floats, rank: int) -> tuple[Floats, Change, Floats]:
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
    kept = U.T @ inverse
    after[:k, k:] = kept @ pi[:r, r:]
    after[k:, :k] = after[:k, k:].T
    after[k:, k:] = pi[r:, r:]
    return after, through(T), kept
