"""Equations with a complex c0 in pairs of lanes, against the same equations in complex numbers."""

import numba
import numpy as np
import pytest

from ctr_dynamics.kernels.complex_rates import COMPLEX, complex_rate, damped, oval_curvature, plane_curvature
from ctr_dynamics.kernels.simd import view

C0 = 20.0 + 30.0j


@numba.njit(error_model="numpy")
def solved(real, imag, rows, result):
    """c0 x, a damped equation, and the strains of both kinds of cross-sections."""
    c0, r, out = complex_rate(real, imag), view(COMPLEX, rows, 0, 16), view(COMPLEX, result, 0, 16)
    out[0] = c0 * r[0]
    out[1] = damped(c0, 0, r[2], r[3], r[0])
    out[2], out[3] = plane_curvature(c0, 0, r[2], r[3], r[4], r[0], r[1])
    out[4], out[5] = oval_curvature(c0, 0, r[2], r[2], r[5], r[6], r[3], r[4], r[0], r[1])


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(3)
    load = rng.normal(size=(2, 16))
    stiffness = 1.0 + 1e-3 * rng.normal(size=16)  # lanes differ, as perturbed parameters do
    damping = 0.02 * stiffness
    turning = 0.005 * rng.normal(size=16)
    rows = np.vstack([load, stiffness, damping, turning, 0.1 * stiffness, 1.1 * stiffness])
    result = np.zeros(6 * 16)
    solved(C0.real, C0.imag, rows.ravel(), result)
    eye = np.eye(8)
    c0 = np.block([[C0.real * eye, -C0.imag * eye], [C0.imag * eye, C0.real * eye]])
    return rows, result.reshape(6, 16), c0


def test_the_product_is_that_of_complex_numbers(case):
    rows, result, _ = case
    product = C0 * (rows[0, :8] + 1j * rows[0, 8:])
    np.testing.assert_allclose(result[0], np.r_[product.real, product.imag], rtol=1e-14)


def test_a_damped_equation_is_solved_where_lanes_differ(case):
    (load, _, stiffness, damping, *_), result, c0 = case
    np.testing.assert_allclose((np.diag(stiffness) + np.diag(damping) @ c0) @ result[1], load, atol=1e-14)


def test_strains_fulfil_their_equations(case):
    (mx, my, stiffness, damping, turning, coupling, other), result, c0 = case

    def missed(ux, uy, k11, k12, k22):
        return np.r_[
            k11 * ux + damping * (c0 @ ux) + (k12 + turning) * uy - mx,
            k22 * uy + damping * (c0 @ uy) + (k12 - turning) * ux - my,
        ]

    assert np.abs(missed(*result[2:4], stiffness, 0.0, stiffness)).max() < 1e-7
    assert np.abs(missed(*result[4:6], stiffness, coupling, other)).max() < 1e-12
