"""Small operations on the covariance factor and on what is corrected by it."""

import numpy as np

from ctr_dynamics.kernels.compiler import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def decay(by, theta, rows):
    """Multiply ``theta`` (p,) and its ``rows`` (p, r) of the factor by ``by``, in place."""
    for i in range(len(theta)):
        theta[i] *= by
        for k in range(rows.shape[1]):
            rows[i, k] *= by


@compiled
def sparse_product(indptr, indices, data, columns):
    """Product (rows, k) of a matrix in compressed rows with ``columns`` (columns, k)."""
    result = np.zeros((len(indptr) - 1, columns.shape[1]))
    for row in range(len(result)):
        for place in range(indptr[row], indptr[row + 1]):
            for k in range(columns.shape[1]):
                result[row, k] += data[place] * columns[indices[place], k]
    return result


@compiled
def leaves_range(theta, rows, a, lowest, highest):
    """Whether ``theta`` (n,) moved by ``rows`` (n, r) times ``a`` (r,) leaves its range anywhere."""
    for i in range(len(theta)):
        moved = theta[i]
        for k in range(len(a)):
            moved += rows[i, k] * a[k]
        if not lowest[i] <= moved <= highest[i]:
            return True
    return False


@compiled
def move_unknowns(dx, a, unknowns, earlier):
    """Add ``dx`` (m, r) times ``a`` (r,) to the ``unknowns`` (stages, m) and the ``earlier`` (steps, stages, m)."""
    for i in range(len(dx)):
        shift = 0.0
        for k in range(len(a)):
            shift += dx[i, k] * a[k]
        for stage in range(len(unknowns)):
            unknowns[stage, i] += shift
            for step in range(len(earlier)):
                earlier[step, stage, i] += shift
