"""Small kernels of the filter against plain NumPy."""

import numpy as np
import pytest
from scipy.sparse import random_array

from ctr_dynamics.kernels import covariance as variance_kernels
from ctr_dynamics.kernels import factor_operations, output_rows, rotations, stage_inputs, tip_kinematics

RNG = np.random.default_rng(3)


def covariance(size):
    root = RNG.normal(size=(size, size))
    return root @ root.T


@pytest.mark.parametrize("r", [1, 5, 16])
@pytest.mark.parametrize("count", [3, 8, 15])
def test_variances_are_those_of_the_columns(r, count):
    """Rows fill packs of eight, or not; coefficients are summed four at a time, or not."""
    rows, pi = RNG.normal(size=(count, r)), covariance(r + 16)
    wanted, found = rows @ pi[:r, :r] @ rows.T, np.empty((count, count))
    variance_kernels.covariance_of(rows, pi, found)
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(variance_kernels.variances(rows, pi), np.diag(wanted), rtol=1e-12)
    rows[-1, -1] = np.nan
    assert np.isnan(variance_kernels.variances(rows, pi)[-1])
    variance_kernels.covariance_of(rows, pi, found)
    assert np.isnan(found[-1]).all()


def test_position_deviations_are_those_of_the_columns():
    r = 5
    states, pi = RNG.normal(size=(4, 22, r)), covariance(r + 16)
    wanted = [np.sqrt(np.trace(node[:3] @ pi[:r, :r] @ node[:3].T) / 3) for node in states]
    found = variance_kernels.position_deviations(states.reshape(-1, r), 22, pi)
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_columns_that_were_skipped_lie_between_their_neighbours():
    columns = RNG.normal(size=(5, 12, 3))
    filled = columns.copy()
    tip_kinematics.interpolate_columns(filled[1:], 2)
    for i, fraction in ((2, 1 / 3), (3, 2 / 3)):
        np.testing.assert_allclose(
            filled[i], (1 - fraction) * columns[1] + fraction * columns[4], rtol=1e-12, atol=1e-15
        )
    for i in (0, 1, 4):
        np.testing.assert_array_equal(filled[i], columns[i])


def test_a_product_with_compressed_rows():
    matrix = random_array((7, 5), density=0.5, rng=RNG).tocsr()
    columns = RNG.normal(size=(5, 3))
    found = factor_operations.sparse_product(matrix.indptr, matrix.indices, matrix.data, columns)
    np.testing.assert_allclose(found, matrix @ columns, rtol=1e-12, atol=1e-15)


def test_parameters_outside_their_range_are_noticed():
    theta, rows, a = np.zeros(4), RNG.normal(size=(4, 3)), RNG.normal(size=3)
    moved = rows @ a
    assert not factor_operations.leaves_range(theta, rows, a, moved - 1e-9, moved + 1e-9)
    for i in range(4):
        for side in (-1.0, 1.0):
            lowest, highest = moved - 1.0, moved + 1.0
            lowest[i] += 2.0 * (side > 0)
            highest[i] -= 2.0 * (side < 0)
            assert factor_operations.leaves_range(theta, rows, a, lowest, highest)
    assert factor_operations.leaves_range(theta, rows, a * np.nan, moved - 1.0, moved + 1.0)


def test_unknowns_of_all_stages_and_steps_move_together():
    dx, a, unknowns, earlier = (
        RNG.normal(size=(7, 3)),
        RNG.normal(size=3),
        RNG.normal(size=(3, 7)),
        RNG.normal(size=(4, 3, 7)),
    )
    now, before = unknowns.copy(), earlier.copy()
    factor_operations.move_unknowns(dx, a, now, before)
    np.testing.assert_allclose(now, unknowns + dx @ a, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(before, earlier + dx @ a, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("parameters", [0, 4])
def test_inputs_take_on_the_load_and_the_parameters(parameters):
    bare, load = RNG.normal(size=(3, 12)), RNG.normal(size=12)
    effect, theta = RNG.normal(size=(12, parameters)), RNG.normal(size=parameters)
    rows = np.empty_like(bare)
    stage_inputs.corrected_rows(bare, load, effect, theta, rows)
    np.testing.assert_allclose(rows, bare + load + effect @ theta, rtol=1e-12, atol=1e-14)


def test_a_force_decays_with_its_rows():
    theta, rows = RNG.normal(size=5), RNG.normal(size=(5, 3))
    decayed, columns = theta.copy(), rows.copy()
    factor_operations.decay(0.5, decayed[1:4], columns[1:4])
    fraction = np.array([1.0, 0.5, 0.5, 0.5, 1.0])
    np.testing.assert_array_equal(decayed, fraction * theta)
    np.testing.assert_array_equal(columns, fraction[:, None] * rows)


def test_backbone_rows_stand_in_the_registered_frame():
    """The estimated error of the registration turns and shifts positions and frames; velocities stay in base axes."""
    nodes, fields = RNG.normal(size=(4, 22)), RNG.normal(size=44)
    rotation = rotations.from_vector(np.array([0.3, -1.0, 0.4]))
    bias = np.r_[1e-3 * RNG.normal(size=3), 1e-3 * RNG.normal(size=3), np.zeros(7)]
    s, points, deviation = np.arange(4.0), np.array([0, 1, 2, 3]), RNG.random(4)
    rows = np.empty((4, 15), np.float32)
    output_rows.backbone_rows(s, nodes, fields, points, 2, 0.02, rotation, bias, deviation, rows)
    back = rotations.matrix(rotation).T
    turn, shift = rotations.matrix(rotations.from_vector(back @ bias[:3])), back @ bias[3:6]
    for node, row, own, point in zip(nodes, rows, deviation, points, strict=True):
        R = rotations.matrix(node[3:7] / np.linalg.norm(node[3:7]))
        np.testing.assert_allclose(row[1:4], turn @ node[:3] + shift, rtol=1e-5, atol=1e-6)
        turned = rotations.matrix(np.array([row[7], *row[4:7]], float))
        np.testing.assert_allclose(turned, turn @ R, atol=1e-5)
        np.testing.assert_allclose(row[8:11], R @ (node[7:10] + [0, 0, 0.02]), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(row[11:14], fields[11 * point + 6 : 11 * point + 9], rtol=1e-6)
        assert row[14] == np.float32(own)
