"""What innovations say: the likelihood of one whose covariance depends linearly on three variances, on a grid, and their joint probabilities; how
well a position has been foretold; and whether a state has come back to zero.

The grid's axes are shift, noise and force here, the longest last: its points are computed a SIMD batch at a time.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.kinds import ONE_BATCH, SIMD_WIDTH
from ctr_dynamics.kernels.simd import fma, largest, view, where_above

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def quadratic_forms(H, D, forms):
    """H D H^T into ``forms`` (p, k, k), for ``H`` (k, n) and symmetric ``D`` (p, n, n)."""
    k, n = H.shape
    half = np.empty(n)
    for part in range(len(D)):
        for a in range(k):
            half[:] = 0.0
            for i in range(n):
                factor = H[a, i]
                if factor != 0.0:
                    for j in range(n):
                        half[j] += factor * D[part, i, j]
            for b in range(a + 1):
                total = 0.0
                for j in range(n):
                    total += half[j] * H[b, j]
                forms[part, a, b] = forms[part, b, a] = total


@compiled
def normal_density(nu, S, parts, changes, work, determinant, square):
    """What makes up the normal density of ``nu`` (k,), exp(-square / 2) / sqrt(determinant) but for a constant; returns the least square.

    Its covariance is S + first[i] parts[0] + second[j] parts[1] + third[m] parts[2], with ``S`` (k, k), ``parts`` (3, k, k) and ``changes`` (first,
    second, third). Written: ``determinant`` and ``square`` (b, c, a), flat; a, the length of ``first``, is a multiple of 8. Where the covariance is
    not positive definite they are 1 and infinity. ``work`` (2k (k + 1) 8,) is scratch, as views hold no array. The Cholesky decomposition is the
    one without roots, L D L^T.
    """
    first, second, third = changes
    k, batches = len(nu), len(first) // SIMD_WIDTH
    rows = k * SIMD_WIDTH
    # L D and L; D^-1 and L^-1 nu
    scaled, lower = view(ONE_BATCH, work, 0, SIMD_WIDTH), view(ONE_BATCH, work[k * rows :], 0, SIMD_WIDTH)
    inverse, rest = (
        view(ONE_BATCH, work[2 * k * rows :], 0, SIMD_WIDTH),
        view(ONE_BATCH, work[(2 * k + 1) * rows :], 0, SIMD_WIDTH),
    )
    forces = view(ONE_BATCH, first, 0, SIMD_WIDTH)
    determinants, squares = (
        view(ONE_BATCH, determinant, 0, SIMD_WIDTH),
        view(ONE_BATCH, square, 0, SIMD_WIDTH),
    )
    base = np.empty((k, k))
    smallest = 0.0 * forces[0] + np.inf
    at = 0
    for j in range(len(second)):
        for m in range(len(third)):
            for p in range(k):
                for q in range(p + 1):
                    base[p, q] = S[p, q] + second[j] * parts[1, p, q] + third[m] * parts[2, p, q]
            for batch in range(batches):
                change = forces[batch]
                zero = 0.0 * change
                product, total, least = zero + 1.0, zero, zero + 1.0
                for p in range(k):
                    value, entry = zero + nu[p], zero
                    for q in range(p + 1):
                        entry = fma(change, parts[0, p, q], zero + base[p, q])
                        for t in range(q):
                            entry = entry - scaled[p * k + t] * lower[q * k + t]
                        if q < p:
                            ratio = entry * inverse[q]
                            scaled[p * k + q] = entry
                            lower[p * k + q] = ratio
                            value = value - ratio * rest[q]
                    least = where_above(entry, 0.0, least, zero)
                    product = product * entry
                    inverted = 1.0 / entry
                    inverse[p] = inverted
                    rest[p] = value
                    total = fma(value * value, inverted, total)
                total = where_above(least, 0.0, total, zero + np.inf)
                determinants[at] = where_above(least, 0.0, product, zero + 1.0)
                squares[at] = total
                smallest = where_above(smallest, total, total, smallest)
                at += 1
    return -largest(-smallest)


class DensityBuffers(NamedTuple):
    """For normal densities of k dimensions on a grid: ``determinant`` and ``density`` (b, c, a), and ``work``, scratch of :func:`normal_density`."""

    determinant: np.ndarray
    density: np.ndarray
    work: np.ndarray

    @classmethod
    def of(cls, shape: tuple[int, ...], k: int) -> DensityBuffers:
        """Buffers for a grid of the ``shape`` (b, c, a)."""
        return cls(np.empty(shape), np.empty(shape), np.empty(2 * k * (k + 1) * SIMD_WIDTH))


def densities(nu, S, parts, changes, buffers):
    """(b, c, a) normal densities of ``nu``, but for a constant, in the ``buffers``; arguments as of :func:`normal_density`.

    None where no covariance is one. The densities are by an exponential that is 1 at its largest, so that they do not all vanish.
    """
    determinant, density, work = buffers
    least = normal_density(nu, S, parts, changes, work, determinant.reshape(-1), density.reshape(-1))
    if not math.isfinite(least):
        return None
    np.subtract(least, density, out=density)
    np.multiply(density, 0.5, out=density)
    np.exp(density, out=density)
    np.sqrt(determinant, out=determinant)
    return np.divide(density, determinant, out=density)


@compiled
def update_probabilities(weights, likelihood, changes, marginals):
    """A step of a hidden Markov chain: each variance may have changed independently, then Bayes' rule. In place.

    ``weights`` (b, c, a): joint probabilities; ``likelihood`` (b, c, a or more): by a constant. ``changes``, of shift, noise and force: each (2,
    length), the probability that a value is left, and that it is the one that is taken then. ``marginals``: written, of shift, noise and force.
    """
    (shift, noise, force), (B, C, A) = changes, weights.shape
    left = np.empty(A)
    for m in range(C):
        left[:] = 0.0
        for j in range(B):
            for i in range(A):
                left[i] += shift[0, j] * weights[j, m, i]
        for j in range(B):
            for i in range(A):
                weights[j, m, i] += shift[1, j] * left[i] - shift[0, j] * weights[j, m, i]
    for j in range(B):
        left[:] = 0.0
        for m in range(C):
            for i in range(A):
                left[i] += noise[0, m] * weights[j, m, i]
        for m in range(C):
            for i in range(A):
                weights[j, m, i] += noise[1, m] * left[i] - noise[0, m] * weights[j, m, i]
    by_shift, by_noise, by_force = marginals
    by_shift[:], by_noise[:], by_force[:] = 0.0, 0.0, 0.0
    whole = 0.0
    for j in range(B):
        for m in range(C):
            leaving, total = 0.0, 0.0
            for i in range(A):
                leaving += force[0, i] * weights[j, m, i]
            for i in range(A):
                value = weights[j, m, i] * (1.0 - force[0, i]) + force[1, i] * leaving
                value *= likelihood[j, m, i]
                weights[j, m, i] = value
                by_force[i] += value
                total += value
            by_shift[j] += total
            by_noise[m] += total
            whole += total
    for j in range(B):
        by_shift[j] /= whole
        for m in range(C):
            for i in range(A):
                weights[j, m, i] /= whole
    for m in range(C):
        by_noise[m] /= whole
    for i in range(A):
        by_force[i] /= whole


@compiled
def position_density(nu, S, R):
    """How well a filter foretells a measured position: logarithm of the normal density of the first three rows of an innovation ``nu`` (k,) with
    covariance ``S`` (k, k), by that of the stated noise ``R`` (k, k), diagonal, at its middle. Minus infinity where that is no covariance."""
    root, white = np.empty((3, 3)), np.empty(3)
    total = 0.0
    for p in range(3):
        value = nu[p]
        for q in range(p + 1):
            entry = S[p, q]
            for t in range(q):
                entry -= root[p, t] * root[q, t]
            if q < p:
                root[p, q] = entry / root[q, q]
                value -= root[p, q] * white[q]
            elif entry > 0.0:
                root[p, p] = math.sqrt(entry)
            else:
                return -math.inf
        white[p] = value / root[p, p]
        total += white[p] ** 2 + 2.0 * math.log(root[p, p]) - math.log(R[p, p])
    return -0.5 * total


@compiled
def pull_to_zero(pi, first, noise, most, x, gain):
    """The measurement that three states from ``first`` on are zero, of variance ``noise``, where it is plausible; returns whether it is.

    ``pi`` (n, n): covariance, updated in place in Joseph form; ``x`` (n,): the estimate, corrected in place; ``gain`` (n, 3): written. Plausible: the
    states' squared distance from zero, by their covariance V, is at most -log det V of V by the variance ``most``.
    """
    n = len(pi)
    V, states = pi[first : first + 3, first : first + 3].copy(), x[first : first + 3].copy()
    _, size, square = _inverse(V, states)
    if square > 3.0 * math.log(most) - size:
        return False
    for i in range(3):
        V[i, i] += noise
    inverse, _, _ = _inverse(V, states)
    rows = pi[first : first + 3].copy()
    for i in range(n):
        for a in range(3):
            gain[i, a] = 0.0
            for b in range(3):
                gain[i, a] += rows[b, i] * inverse[b, a]
    columns = np.empty(3)
    for i in range(n):
        for a in range(3):
            x[i] -= gain[i, a] * states[a]
            for j in range(n):
                pi[i, j] -= gain[i, a] * rows[a, j]
    for i in range(n):
        for a in range(3):
            columns[a] = pi[i, first + a] - gain[i, a] * noise
        for a in range(3):
            for j in range(n):
                pi[i, j] -= columns[a] * gain[j, a]
    for i in range(n):
        for j in range(i):
            pi[i, j] = pi[j, i] = 0.5 * (pi[i, j] + pi[j, i])
    return True


@compiled
def _inverse(V, x):
    """Inverse and logarithm of the determinant of ``V`` (3, 3), positive definite, and x^T V^-1 x; infinity for both where it is not."""
    cofactors = np.empty((3, 3))
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            cofactors[i, j] = V[a, c] * V[b, d] - V[a, d] * V[b, c]
    determinant = V[0, 0] * cofactors[0, 0] + V[0, 1] * cofactors[0, 1] + V[0, 2] * cofactors[0, 2]
    if not determinant > 0.0:
        return cofactors, math.inf, math.inf
    inverse = cofactors.T / determinant
    square = 0.0
    for i in range(3):
        for j in range(3):
            square += x[i] * inverse[i, j] * x[j]
    return inverse, math.log(determinant), square


@compiled
def new_randomness(pi, parts, first, variance, remains):
    """Three states from ``first`` on have moved at random by ``variance``; ``pi`` (n, n) and ``parts`` (3, n, n) change in place.

    That belongs to the second of the parts. Of what the second and the third hold from before, the shares ``remains`` are left.
    """
    for part in (1, 2):
        share = remains[part - 1]
        for i in range(len(pi)):
            for j in range(len(pi)):
                parts[part, i, j] *= share
    for i in range(first, first + 3):
        pi[i, i] += variance
        parts[1, i, i] += variance
