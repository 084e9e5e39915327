"""The covariance with fewer columns, against dense matrices."""

import numpy as np
import pytest

from ctr_dynamics.estimation.filter import factor_reduction
from ctr_dynamics.estimation.filter.factor_reduction import APPENDED, principal, reduced
from ctr_dynamics.kernels import covariance_reduction as reduction_kernels

RANK, OTHERS, ROWS = 9, 4, 40
WIDE = RANK + APPENDED


def case(seed, spread=1.0):
    """Columns of deviations up to e^spread, their covariance with that of other states, and weights of the energy norm."""
    rng = np.random.default_rng(seed)
    V = rng.normal(size=(ROWS, WIDE)) * np.exp(rng.uniform(-spread, spread, WIDE))
    root = rng.normal(size=(WIDE + OTHERS, WIDE + OTHERS)) * np.exp(
        rng.uniform(-spread, spread, WIDE + OTHERS)
    )
    return V, root @ root.T, rng.uniform(0.5, 2.0, ROWS)


def of_columns(V, pi):
    """Covariance of V a, and of V a with the other states."""
    r = V.shape[1]
    return V @ pi[:r, :r] @ V.T, V @ pi[:r, r:]


def by_hand(V, pi, weights):
    """The same without the directions that are weakest in the norm, by a projection of the whitened coefficients."""
    lam, E = np.linalg.eigh(pi[:WIDE, :WIDE])
    root = E * np.sqrt(lam)
    _, U = np.linalg.eigh(root.T @ V.T @ np.diag(weights) @ V @ root)
    projection = root @ U[:, APPENDED:] @ U[:, APPENDED:].T @ np.linalg.inv(root)
    return of_columns(V @ projection, pi)


@pytest.mark.parametrize("way", [reduced, principal])
@pytest.mark.parametrize("seed", range(12))
def test_what_is_left_is_the_covariance_of_the_principal_columns(way, seed):
    V, pi, weights = case(seed, 0.3 * seed)
    after, change, projection = way(pi, V.T @ (weights[:, None] * V), RANK)
    fewer = change(V)
    assert fewer.shape == (ROWS, RANK)
    np.testing.assert_array_equal(after, after.T)
    np.testing.assert_allclose(after.diagonal()[:RANK], 1.0, rtol=1e-9)
    np.testing.assert_array_equal(after[RANK:, RANK:], pi[WIDE:, WIDE:])
    np.testing.assert_allclose(projection @ change(np.eye(WIDE)), np.eye(RANK), atol=1e-9)
    np.testing.assert_allclose(projection @ pi[:WIDE, :WIDE] @ projection.T, after[:RANK, :RANK], atol=1e-9)
    np.testing.assert_allclose(
        projection @ pi[:WIDE, WIDE:], after[:RANK, RANK:], atol=1e-9 * np.abs(after).max()
    )
    for found, wanted in zip(of_columns(fewer, after), by_hand(V, pi, weights), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-9 * np.abs(wanted).max())


def test_columns_are_eliminated_where_the_covariance_is_regular_and_principal_where_not(monkeypatch):
    used = []
    monkeypatch.setattr(
        factor_reduction, "without", lambda *a: used.append(1) or reduction_kernels.without.py_func(*a)
    )
    V, pi, weights = case(1)
    gram = V.T @ (weights[:, None] * V)
    reduced(pi, gram, RANK)
    assert used == [1]
    pi[2, :] = pi[:, 2] = 0.0  # a coefficient without spread
    after, change, _ = reduced(pi, gram, RANK)
    assert used == [1]
    assert np.all(np.isfinite(after))
    full, _ = of_columns(V, pi)
    left, _ = of_columns(change(V), after)
    excess = np.linalg.eigvalsh(full - left)
    assert excess[0] > -1e-9 * excess[-1]  # nothing is added to the covariance


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_stays_so_and_goes_no_further(bad):
    V, pi, weights = case(3)
    gram = V.T @ (weights[:, None] * V)
    gram[4, 4] = bad
    after, change, _ = reduced(pi, gram, RANK)
    assert after.shape == (RANK + OTHERS,) * 2
    assert change(V).shape == (ROWS, RANK)
    solved = np.full((APPENDED, WIDE), np.nan)
    places = reduction_kernels.solved_for(solved, np.ones(WIDE))
    assert sorted(places) == list(range(APPENDED))  # no place outside the columns


def test_nothing_is_dropped_of_columns_that_are_few():
    V, pi, weights = case(5)
    after, change, _ = reduced(pi, V.T @ (weights[:, None] * V), WIDE)
    for found, wanted in zip(of_columns(change(V), after), of_columns(V, pi), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("seed", range(8))
def test_columns_that_are_missing_at_the_end_are_zero(seed):
    V, pi, weights = case(seed, 0.2 * seed)
    _, change, _ = reduced(pi, V.T @ (weights[:, None] * V), RANK)
    short = V[:, :RANK]
    out = np.full((ROWS, RANK), np.nan)
    assert change(short, out) is out
    padded = np.c_[short, np.zeros((ROWS, APPENDED))]
    np.testing.assert_allclose(out, change(padded), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("seed", range(20))
def test_constraints_are_solved_for_the_coefficients_with_the_largest_part(seed):
    rng = np.random.default_rng(seed)
    constraints, spread = rng.normal(size=(APPENDED, WIDE)), np.exp(rng.uniform(-2.0, 2.0, WIDE))
    solved = constraints.copy()
    places = reduction_kernels.solved_for(solved, spread)
    assert len(set(places)) == APPENDED
    others = np.setdiff1d(np.arange(WIDE), places)
    a = np.zeros(WIDE)
    a[others] = rng.normal(size=len(others))
    a[places] = -solved[:, others] @ a[others]
    np.testing.assert_allclose(constraints @ a, 0.0, atol=1e-10 * np.abs(a).max())
    assert np.argmax(np.abs(constraints * spread).max(axis=0)) == places[0]


@pytest.mark.parametrize("seed", range(6))
def test_kernels_against_plain_python(seed):
    V, pi, _ = case(seed)
    root = np.linalg.cholesky(pi[:WIDE, :WIDE])
    weakest = np.linalg.qr(np.random.default_rng(seed).normal(size=(WIDE, APPENDED)))[0]
    compiled = reduction_kernels.without(pi, root, weakest)
    K = np.eye(WIDE) - (root @ weakest) @ (
        weakest.T @ np.linalg.inv(root)
    )  # of the coefficients that are left
    after, projection, sources, places, parts, deviation = compiled
    np.testing.assert_allclose(projection, K[sources] / deviation[:, None], rtol=1e-9, atol=1e-11)
    projected = np.block(
        [
            [K @ pi[:WIDE, :WIDE] @ K.T, K @ pi[:WIDE, WIDE:]],
            [pi[WIDE:, :WIDE] @ K.T, pi[WIDE:, WIDE:]],
        ]
    )
    scale = np.r_[deviation, np.ones(OTHERS)]
    index = np.r_[sources, WIDE : WIDE + OTHERS]
    np.testing.assert_allclose(
        after, projected[np.ix_(index, index)] / np.outer(scale, scale), rtol=1e-9, atol=1e-11
    )
    assert sorted([*sources, *places]) == list(range(WIDE))
    T = np.zeros((WIDE, RANK))
    T[sources, np.arange(RANK)] = deviation
    T[places] = -parts
    found = np.empty((ROWS, RANK))
    reduction_kernels.eliminate(V, sources, places, parts, deviation, found)
    np.testing.assert_allclose(found, V @ T, rtol=1e-12, atol=1e-13)
