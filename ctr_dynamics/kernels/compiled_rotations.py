"""The functions of :mod:`ctr_dynamics.kernels.rotations` for one rotation, compiled, and a product that numba needs spelled out."""

import numpy as np

from ctr_dynamics.kernels import rotations
from ctr_dynamics.kernels.compiler import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")
matrix, multiply, conjugate = map(compiled, (rotations.matrix, rotations.multiply, rotations.conjugate))
from_vector, to_vector = map(compiled, (rotations.from_vector, rotations.to_vector))


@compiled
def applied(A, v):
    """Product (3,) of a matrix (3, 3) and a vector (3,)."""
    result = np.empty(3)
    for i in range(3):
        result[i] = A[i, 0] * v[0] + A[i, 1] * v[1] + A[i, 2] * v[2]
    return result
