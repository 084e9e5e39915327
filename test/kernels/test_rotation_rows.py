"""Rotations of arrays of poses, row by row."""

import math

import numpy as np

from ctr_dynamics.kernels.rotations import multiply_rows, rotate_rows, to_vector_rows


def test_rotations_by_rows():
    h = np.array([[math.cos(0.2), 0.0, 0.0, math.sin(0.2)], [1.0, 0.0, 0.0, 0.0]])
    v = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    np.testing.assert_allclose(
        rotate_rows(h, v), [[math.cos(0.4), math.sin(0.4), 0.0], [0.0, 2.0, 0.0]], atol=1e-15
    )
    np.testing.assert_allclose(
        to_vector_rows(multiply_rows(h, h)), [[0.0, 0.0, 0.8], [0.0, 0.0, 0.0]], atol=1e-15
    )
