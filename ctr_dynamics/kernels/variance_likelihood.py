"""Likelihood of an innovation for every combination of three variances on which its covariance depends linearly."""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit

compiled = njit(cache=True, nogil=True, error_model="numpy")


@compiled
def log_likelihood(nu, S, parts, first, second, third, result):
    """Logarithm of the normal density of ``nu`` (k,), but for a constant, into ``result`` (a, b, c).

    Its covariance is S + first[i] parts[0] + second[j] parts[1] + third[l] parts[2], with ``S`` (k, k) and ``parts`` (3, k, k).
    Minus infinity where that is not positive definite.
    """
    k = len(nu)
    outer, middle, root = np.empty((k, k)), np.empty((k, k)), np.empty((k, k))
    inverse, white = np.empty(k), np.empty(k)  # of the root's diagonal; the whitened innovation
    for i in range(len(first)):
        for p in range(k):
            for q in range(p + 1):
                outer[p, q] = S[p, q] + first[i] * parts[0, p, q]
        for j in range(len(second)):
            for p in range(k):
                for q in range(p + 1):
                    middle[p, q] = outer[p, q] + second[j] * parts[1, p, q]
            for m in range(len(third)):
                determinant, square = 1.0, 0.0
                for p in range(k):
                    value = nu[p]
                    for q in range(p + 1):
                        entry = middle[p, q] + third[m] * parts[2, p, q]
                        for t in range(q):
                            entry -= root[p, t] * root[q, t]
                        if q < p:
                            root[p, q] = entry * inverse[q]
                            value -= root[p, q] * white[q]
                    if not entry > 0.0:
                        determinant = 0.0
                        break
                    determinant *= entry
                    inverse[p] = 1.0 / math.sqrt(entry)
                    white[p] = value * inverse[p]
                    square += white[p] * white[p]
                if determinant > 0.0:
                    result[i, j, m] = -0.5 * (math.log(determinant) + square)
                else:
                    result[i, j, m] = -math.inf
