"""Workspace of the arc-length kernels: where each number lies, for any tube count.

A *lane* is one complete copy of the problem (its own history, parameters, loads and unknowns). The plain sweep has one lane; the
Jacobian, the tangents of a step and batches of simulations are the same code with 4 to 64 lanes, in packs
(:mod:`ctr_dynamics.kernels.lanes`). Arrays have the lane as their last index. Every number that the equations touch lies in one workspace
``W`` at rows that are constant once the tube count is known, so that the compiler can keep them in registers. For the same reason loops over
the tubes count to the tubes of the robot and ask which are present: the rows of each tube are then constants too.

``tubes`` and ``lanes`` are tuples whose *lengths* carry the counts into the compiler (one entry a tube; one number for eight lanes, none for
a single lane, or truth values for a short pack with one lane each); their contents are not read.

Layout of the workspace, in rows of one number a lane (see :func:`offsets` and :func:`extra`):

==========  =========  =================================================================
rows        count      content
==========  =========  =================================================================
``Y``       S          state at the current node
``YS``      S          state at the current Runge-Kutta stage
``K``       S          its arc-length derivative
``ACC``     S          accumulated Runge-Kutta increment
``HI``      F          history part of the time derivatives at the current point
``OU``      F          fields at the current point
``TMP``     T          intermediate results
``PAR``     NP         parameters (:mod:`ctr_dynamics.kernels.layout`)
``MA``      2N         bending moment of every tube on the near side of a transition
``MB``      2N         the same on its far side
``EX``      2N + 7     grid motion of the extended model (:mod:`ctr_dynamics.kernels.extended_rod`)
==========  =========  =================================================================

State rows (S = 16 + 3N): p 0-2, quaternion h 3-6, q 7-9, omega 10-12, n 13-15, m_xy 16-17, m_z of every tube, then theta and gamma of
tubes 2..N. p and h are in the base frame; q, omega, n and m are components in the frame of tube 1 (n is R_1^T times the paper's n).
Field rows (F = 7 + 2N): q 0-2, omega 3-5, u of tube 1 6-8, then u_z and gamma of tubes 2..N.
"""

import math

from numba import types
from numba.extending import overload

from ctr_dynamics.kernels.compiler import njit

# Rows of the state that every robot has.
P0, H0, Q0, O0, N0, M0, Z0 = 0, 3, 7, 10, 13, 16, 18


@njit(cache=True, forceinline=True)
def state_rows(n):
    """Rows of the state of ``n`` tubes."""
    return 16 + 3 * n


@njit(cache=True, forceinline=True)
def field_rows(n):
    """Rows of the fields that carry history, for ``n`` tubes."""
    return 7 + 2 * n


@njit(cache=True, forceinline=True)
def parameter_rows(n):
    """Rows of the parameters of ``n`` tubes; those from ``14 n + 14`` on are read by the extended model only."""
    return 20 * n + 33


@njit(cache=True, forceinline=True)
def input_row(tubes, i):
    """Row of the parameters that holds input ``i``: alpha, its rate and beta of every tube, force and torque on the tip, beta rates."""
    n = len(tubes)
    if i < 3 * n:
        return 11 * n + i
    return 11 * n + 3 + i if i < 3 * n + 6 else 16 * n + 27 + i


@njit(cache=True, forceinline=True)
def base_rows(n, cells):
    """Rows of the base part of the fields: psi_t and u_z at every point behind the plate, then per tube what its drive gives way (rad), the tilt
    (x, y) at its end, and beta's rate (the last four move in the extended model only).
    """
    return n * (4 * cells + 1) * 2 + 4 * n


@njit(cache=True, forceinline=True)
def extra(tubes):
    """First row of the block EX of the workspace."""
    n = len(tubes)
    return 4 * state_rows(n) + 2 * field_rows(n) + (13 + 7 * n) + parameter_rows(n) + 4 * n


def lane_count(lanes):
    """Lanes that a lane tuple stands for: none for one; numbers for eight each; truth values for one each, side by side in one short pack."""
    return len(lanes) if lanes and isinstance(lanes[0], bool) else max(1, 8 * len(lanes))


@overload(lane_count, jit_options={"forceinline": True})
def _lane_count(lanes):
    count = len(lanes) if isinstance(getattr(lanes, "dtype", None), types.Boolean) else max(1, 8 * len(lanes))
    return lambda lanes: count


def unknown_lanes(tubes):
    """Lane tuple with room for a base case and one lane for each unknown of the shooting problem; for compiled code."""
    raise NotImplementedError("for compiled code only")


@overload(unknown_lanes)
def _unknown_lanes(tubes):
    lanes = (0,) * math.ceil((6 + len(tubes)) / 8)
    return lambda tubes: lanes


@njit(cache=True, forceinline=True)
def offsets(tubes):
    """First row of each block of the workspace: Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB."""
    n = len(tubes)
    S = state_rows(n)
    F = field_rows(n)
    tmp = 4 * S + 2 * F
    par = tmp + (13 + 7 * n)
    near = par + parameter_rows(n)
    return 0, S, 2 * S, 3 * S, 4 * S, 4 * S + F, tmp, par, near, near + 2 * n


@njit(cache=True, forceinline=True)
def workspace_rows(n):
    """Rows of the workspace of ``n`` tubes."""
    return 4 * state_rows(n) + 2 * field_rows(n) + (13 + 7 * n) + parameter_rows(n) + 6 * n + 7
