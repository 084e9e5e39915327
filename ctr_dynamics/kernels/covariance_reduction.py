"""Numba kernels of the reduction: directions taken out of a covariance and its columns by eliminating a column for each."""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def solved_for(constraints, spread):
    """Solve ``constraints`` (d, r) a = 0 for d of the coefficients a (r,), in place: a[places] = -constraints[:, others] a[others].

    Gauss-Jordan elimination; each is solved for the coefficient that has, at its deviation ``spread`` (r,), the largest part. Returns the
    places (d,).
    """
    d, r = constraints.shape
    places = np.arange(d)
    free = spread.copy()
    for step in range(d):
        largest, row = -1.0, step
        for i in range(step, d):
            for k in range(r):
                part = abs(constraints[i, k]) * free[k]
                if part > largest:
                    largest, row, places[step] = part, i, k
        free[places[step]] = -1.0
        for k in range(r):
            constraints[step, k], constraints[row, k] = constraints[row, k], constraints[step, k]
        pivot = constraints[step, places[step]]
        for k in range(r):
            constraints[step, k] /= pivot
        for i in range(d):
            if i != step:
                part = constraints[i, places[step]]
                for k in range(r):
                    constraints[i, k] -= part * constraints[step, k]
    return places


@compiled
def without(pi, root, weakest):
    """Take directions out of a covariance: the ``weakest`` (r, d), orthonormal, of the coefficients whitened by ``root`` (r, r), lower, with
    root root^T = pi[:r, :r].

    Without them the r coefficients have r - d that are free. Returns:

    - the covariance of those, each by its deviation, and of all that follows them in ``pi``;
    - the (r - d, r) by which the r coefficients give them;
    - the change of the columns for :func:`eliminate`: sources (r - d,), places (d,), parts (d, r - d) and deviations (r - d,).
    """
    r, d = weakest.shape
    size, k = len(pi), r - d
    moved = np.zeros((r, d))  # root weakest
    constraints = np.zeros((d, r))  # weakest^T root^-1
    for m in range(d):
        for i in range(r):
            for j in range(i + 1):
                moved[i, m] += root[i, j] * weakest[j, m]
        for i in range(r - 1, -1, -1):
            entry = weakest[i, m]
            for j in range(i + 1, r):
                entry -= root[j, i] * constraints[m, j]
            constraints[m, i] = entry / root[i, i]
    left = pi.copy()
    for m in range(d):
        for column in range(r, size):
            shown = 0.0
            for i in range(r):
                shown += constraints[m, i] * pi[i, column]
            for i in range(r):
                left[i, column] -= moved[i, m] * shown
        for i in range(r):
            for j in range(i + 1):
                left[i, j] -= moved[i, m] * moved[j, m]
    spread = np.empty(r)
    for i in range(r):
        spread[i] = math.sqrt(pi[i, i])
    shown_by = constraints.copy()
    places = solved_for(constraints, spread)
    sources = np.arange(k)  # coefficients behind the first k go to places that have become free
    behind = k
    for i in range(k):
        if (places == i).any():
            while (places == behind).any():
                behind += 1
            sources[i] = behind
            behind += 1
    parts, deviation, kept = np.empty((d, k)), np.empty(k), np.zeros((k, r))
    for i in range(k):
        deviation[i] = math.sqrt(left[sources[i], sources[i]])
        kept[i, sources[i]] = 1.0 / deviation[i]
        for m in range(d):
            part = moved[sources[i], m] / deviation[i]
            for j in range(r):
                kept[i, j] -= part * shown_by[m, j]
        for m in range(d):
            parts[m, i] = constraints[m, sources[i]] * deviation[i]
    after = np.empty((size - d, size - d))
    for i in range(k):
        for j in range(i + 1):
            first, second = max(sources[i], sources[j]), min(sources[i], sources[j])
            after[i, j] = after[j, i] = left[first, second] / (deviation[i] * deviation[j])
        for j in range(r, size):
            after[i, j - d] = after[j - d, i] = left[sources[i], j] / deviation[i]
    after[k:, k:] = pi[r:, r:]
    return after, kept, sources, places, parts, deviation


@compiled
def eliminate(columns, sources, places, parts, deviation, result):
    """Fill ``result`` (rows, k) with the columns of the coefficients that :func:`without` has left of k + 3, from ``columns`` (rows, at most k + 3);
    those that are missing are zero."""
    r, k = columns.shape[1], len(sources)
    first, second, third = parts[0], parts[1], parts[2]
    moved = [(i, sources[i]) for i in range(k) if sources[i] != i]
    taken = np.zeros(3)
    for row in range(len(columns)):
        old, new = columns[row], result[row]
        for m in range(3):
            if places[m] < r:
                taken[m] = old[places[m]]
        a, b, c = taken[0], taken[1], taken[2]
        for i in range(k):
            new[i] = deviation[i] * old[i] - a * first[i] - b * second[i] - c * third[i]
        for i, source in moved:
            value = deviation[i] * old[source] if source < r else 0.0
            new[i] = value - a * first[i] - b * second[i] - c * third[i]
