"""Workspace of the arc-length kernels: where each number lies, for any tube and lane count.

A *lane* is one complete copy of the problem (its own history, parameters, loads and unknowns). The plain sweep has one lane; the
Jacobian, the tangents of a step and batches of simulations are the same code with 8 to 64 lanes. Lanes are innermost, and
every number that the equations touch lies in one flat workspace ``W`` at offsets that are constant once the tube and lane counts are known,
which is what lets LLVM vectorise over the lanes without run-time alias checks. For the same reason loops over the tubes count to the tubes
of the robot and ask which are present: the offsets of each tube are then constants too.

``tubes`` and ``lanes`` are tuples whose *lengths* carry the counts into the compiler (one entry a tube; one entry for eight lanes, none for
a single lane); their contents are not read.

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
``PAR``     NP         parameters (:mod:`ctr_dynamics.model.layout`)
``MA``      2N         bending moment of every tube on the near side of a transition
``MB``      2N         the same on its far side
``EX``      2N + 7     grid motion of the extended model (:mod:`ctr_dynamics.model.extended`)
==========  =========  =================================================================

State rows (S = 16 + 3N): p 0-2, quaternion h 3-6, q 7-9, omega 10-12, n 13-15, m_xy 16-17, m_z of every tube, then theta and gamma of
tubes 2..N. p and h are in the base frame; q, omega, n and m are components in the frame of tube 1 (n is R_1^T times the paper's n).
Field rows (F = 7 + 2N): q 0-2, omega 3-5, u of tube 1 6-8, then u_z and gamma of tubes 2..N.
"""

import math

from numba import njit

# Rows of the state that every robot has.
P0, H0, Q0, O0, N0, M0, Z0 = 0, 3, 7, 10, 13, 16, 18

# No fast-math flags: which copy of a kernel runs depends on what was compiled before, and copies would round differently. Plain IEEE arithmetic
# makes every result the same, first run or cached, and NaN stays visible to the solver.

_TWO_OVER_PI = 2.0 / math.pi
_PIO2_HI = 1.57079632679489655800e00
_PIO2_LO = 6.12323399573676603587e-17


@njit(cache=True, inline="always")
def state_rows(n):
    """Rows of the state of ``n`` tubes."""
    return 16 + 3 * n


@njit(cache=True, inline="always")
def field_rows(n):
    """Rows of the fields that carry history, for ``n`` tubes."""
    return 7 + 2 * n


@njit(cache=True, inline="always")
def parameter_rows(n):
    """Rows of the parameters of ``n`` tubes; those from ``14 n + 14`` on are read by the extended model only."""
    return 20 * n + 33


@njit(cache=True, inline="always")
def input_row(tubes, i):
    """Row of the parameters that holds input ``i``: alpha, its rate and beta of every tube, force and torque on the tip, beta rates."""
    n = len(tubes)
    if i < 3 * n:
        return 11 * n + i
    return 11 * n + 3 + i if i < 3 * n + 6 else 16 * n + 27 + i


@njit(cache=True, inline="always")
def base_rows(n, cells):
    """Rows of the base part of the fields: psi_t and u_z at every point behind the plate, then per tube what its drive gives way (rad), the tilt
    (x, y) at its end, and beta's rate (the last four move in the extended model only).
    """
    return n * (4 * cells + 1) * 2 + 4 * n


@njit(cache=True, inline="always")
def extra(tubes, lanes):
    """First index of the block EX of the workspace."""
    n = len(tubes)
    L = lane_count(lanes)
    S = state_rows(n) * L
    F = field_rows(n) * L
    return 4 * S + 2 * F + (13 + 7 * n) * L + parameter_rows(n) * L + 4 * n * L


@njit(cache=True, inline="always")
def lane_count(lanes):
    """Lanes that a lane tuple stands for: none for one, else eight for each entry."""
    return max(1, 8 * len(lanes))


@njit(cache=True, inline="always")
def lane_trips(n, lanes, W):
    """Turns of a loop over the lanes: the lane count, told to the compiler for one lane only.

    Short loops of known length are unrolled before they can be vectorised, and then run on scalars.
    """
    return 1 if len(lanes) == 0 else len(W) // workspace_rows(n)


@njit(cache=True, inline="always")
def offsets(tubes, lanes):
    """First index of each block of the workspace: Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB."""
    n = len(tubes)
    L = lane_count(lanes)
    S = state_rows(n) * L
    F = field_rows(n) * L
    tmp = 4 * S + 2 * F
    par = tmp + (13 + 7 * n) * L
    near = par + parameter_rows(n) * L
    return 0, S, 2 * S, 3 * S, 4 * S, 4 * S + F, tmp, par, near, near + 2 * n * L


@njit(cache=True, inline="always")
def workspace_rows(n):
    """Rows of the workspace of ``n`` tubes."""
    return 4 * state_rows(n) + 2 * field_rows(n) + (13 + 7 * n) + parameter_rows(n) + 6 * n + 7


@njit(cache=True, inline="always", error_model="numpy")
def sincos(x):
    """(sin x, cos x) by polynomials, without library calls, so that lane loops vectorise; error below 1e-12 for abs(x) < 1e4."""
    k = math.floor(x * _TWO_OVER_PI + 0.5)
    r = (x - k * _PIO2_HI) - k * _PIO2_LO
    z = r * r
    s = r + r * z * (
        -1.66666666666666307295e-1
        + z
        * (
            8.33333333332211858878e-3
            + z
            * (
                -1.98412698295895385996e-4
                + z
                * (
                    2.75573136213857245213e-6
                    + z * (-2.50507477628578072866e-8 + z * 1.58962301576546568060e-10)
                )
            )
        )
    )
    c = (
        1.0
        - 0.5 * z
        + z
        * z
        * (
            4.16666666666665929218e-2
            + z
            * (
                -1.38888888888730564116e-3
                + z
                * (
                    2.48015872888517045348e-5
                    + z
                    * (
                        -2.75573141792967388112e-7
                        + z * (2.08757008419747316778e-9 - z * 1.13585365213876817300e-11)
                    )
                )
            )
        )
    )
    half = math.floor(0.5 * k)
    odd = k - 2.0 * half  # 0 or 1
    sign = 1.0 - 2.0 * (half - 2.0 * math.floor(0.5 * half))  # cos sign changes every two quadrants
    # quadrant k: odd quadrants swap sine and cosine
    sin_x = sign * (s * (1.0 - odd) + c * odd)
    cos_x = sign * (c * (1.0 - odd) - s * odd)
    return sin_x, cos_x
