"""Damped Newton on (25)."""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.snap_jacobian import back_solve, factorise
from ctr_dynamics.kernels.snap_residual import residual

CONVERGED, NOT_CONVERGED, NOT_FINITE = 0, 1, 2
SLOW = 0.1  # a reused Jacobian that reduces ||E|| by less is renewed


@njit(nogil=True, error_model="numpy")
def solve(g, x, par, c0, work, D, G, fresh, tolerance, limit):
    """Solve E(x) = 0 in place. Returns (outcome, iterations, Jacobians, ||E||^2).

    The factors at hand serve while each step reduces ||E|| by the factor SLOW; a step of a fresh Jacobian that does not reduce it is
    halved, up to ten times. ``fresh``: the factors do not belong to this problem.
    """
    norm = residual(g, x, par, c0, work)
    if not np.isfinite(norm):
        return NOT_FINITE, 0, 0, norm
    jacobians = 0
    renew = fresh
    for iteration in range(limit):
        if norm < tolerance:
            return CONVERGED, iteration, jacobians, norm
        current = renew
        if renew:
            if not factorise(g, x, par, c0, work, D, G):
                return NOT_CONVERGED, iteration, jacobians, norm
            jacobians += 1
        back_solve(g, work, work.error, work.step)
        length = 1.0
        found = np.inf
        for _ in range(10 if current else 1):
            for i in range(len(x)):
                work.trial[i] = x[i] - length * work.step[i]
            found = residual(g, work.trial, par, c0, work)
            if found < norm or found < tolerance:
                break
            length *= 0.5
        if found < norm or found < tolerance:
            for i in range(len(x)):
                x[i] = work.trial[i]
            renew = found > SLOW * SLOW * norm
            norm = found
        elif current:
            return (NOT_CONVERGED if np.isfinite(found) else NOT_FINITE), iteration, jacobians, norm
        else:
            renew = True
            norm = residual(g, x, par, c0, work)
    return (CONVERGED if norm < tolerance else NOT_CONVERGED), limit, jacobians, norm
