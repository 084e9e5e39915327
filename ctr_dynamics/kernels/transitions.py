"""Where tubes end or change curvature: friction between neighbours, bodies at the tubes' ends, balance at the tip."""

import math

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import field_rows, residual_rows, state_rows, workspace_rows
from ctr_dynamics.kernels.physics import coulomb, tip_forces
from ctr_dynamics.kernels.sincos import sincos


@njit(forceinline=True, error_model="numpy")
def tube_friction(kind, W, present):
    """Friction between neighbouring tubes at a transition, (22), (23): proportional to the jump of the inner tube's moment."""
    n = kind.tubes
    at, state = workspace_rows(n), state_rows(n)
    gamma = at.state + state.gamma - 1
    for i in range(n - 1):
        if i < present - 1:
            A, B = at.near_moments + 2 * i, at.far_moments + 2 * i
            MZ = at.state + state.moment_z + i
            G1, G2 = gamma + i, gamma + i + 1
            first = i == 0
            dx, dy = W[B] - W[A], W[B + 1] - W[A + 1]
            rate = W[G2] if first else W[G2] - W[G1]
            eps = W[at.epsilon]
            tau = (
                coulomb(kind, W, rate)
                * W[at.tube_coulomb]
                * math.sqrt(dx * dx + dy * dy)
                * rate
                / math.sqrt(rate * rate + eps * eps)
                + W[at.tube_viscous] * rate
            )
            W[MZ] -= tau
            W[MZ + 1] += tau


@njit(nogil=True, error_model="numpy")
def end_body(kind, W, i, c0):
    """Inertial wrench and weight of the rigid body at the end of tube ``i``, (20), (21), in the frame of tube 1.

    Into the rows from ``curvature`` on: m (p_tt - g), then H omega_t + omega x H omega with the tube's own angular velocity. Needs gravity in the
    frame of tube 1 in ``weight``.
    """
    n = kind.tubes
    at, state, field = workspace_rows(n), state_rows(n), field_rows(n)
    Y, HI, wrench, g1 = at.state, at.history, at.curvature, at.weight
    Q, O = Y + state.velocity, Y + state.angular_velocity  # noqa: E741
    HQ, HO = HI + field.velocity, HI + field.angular_velocity
    TH, GA, HG = Y + state.theta + i - 1, Y + state.gamma + i - 1, HI + field.gamma + i - 1
    qx, qy, qz = W[Q], W[Q + 1], W[Q + 2]
    wx, wy, wz = W[O], W[O + 1], W[O + 2]
    atx, aty, atz = c0 * wx + W[HO], c0 * wy + W[HO + 1], c0 * wz + W[HO + 2]
    mass = W[at.body_mass + i]
    W[wrench] = mass * (wy * qz - wz * qy + c0 * qx + W[HQ] - W[g1])
    W[wrench + 1] = mass * (wz * qx - wx * qz + c0 * qy + W[HQ + 1] - W[g1 + 1])
    W[wrench + 2] = mass * (wx * qy - wy * qx + c0 * qz + W[HQ + 2] - W[g1 + 2])
    hx, hy, hz = W[at.body_inertia_x + i], W[at.body_inertia_y + i], W[at.body_inertia_z + i]
    if i == 0:
        W[wrench + 3] = hx * atx + (hz - hy) * wy * wz
        W[wrench + 4] = hy * aty + (hx - hz) * wz * wx
        W[wrench + 5] = hz * atz + (hy - hx) * wx * wy
    else:
        s, c = sincos(W[TH])
        g = W[GA]
        ox, oy, oz = c * wx + s * wy, c * wy - s * wx, wz + g
        tx = c * atx + s * aty + g * oy
        ty = c * aty - s * atx - g * ox
        tz = atz + c0 * g + W[HG]
        bx = hx * tx + (hz - hy) * oy * oz
        by = hy * ty + (hx - hz) * oz * ox
        W[wrench + 3] = c * bx - s * by
        W[wrench + 4] = s * bx + c * by
        W[wrench + 5] = hz * tz + (hy - hx) * ox * oy


@njit(forceinline=True, error_model="numpy")
def carry_end_body(kind, W, i):
    """The wrench of :func:`end_body` at the end of tube ``i``, onto the tubes that run on; its z part belongs to tube ``i`` alone."""
    n = kind.tubes
    at, state = workspace_rows(n), state_rows(n)
    N, M, wrench = at.state + state.force, at.state + state.moment_xy, at.curvature
    W[N] += W[wrench]
    W[N + 1] += W[wrench + 1]
    W[N + 2] += W[wrench + 2]
    W[M] += W[wrench + 3]
    W[M + 1] += W[wrench + 4]
    W[at.state + state.moment_z + i] += W[wrench + 5]


@njit(forceinline=True, error_model="numpy")
def tip_residual(kind, W, residual, c0, base_history, base_fields):
    """Balance at the tip of tube 1, (21): the external wrench (base axes) against the internal one and that of :func:`end_body`."""
    n = kind.tubes
    at, state, given = workspace_rows(n), state_rows(n), residual_rows(n)
    N, M, MZ, wrench = (
        at.state + state.force,
        at.state + state.moment_xy,
        at.state + state.moment_z,
        at.curvature,
    )
    F, T = at.sums, at.torque  # the force on the tip takes the rows of the sums
    for r in range(3):
        W[F + r] = W[at.force + r]
    tip_forces(kind, W, F, c0, base_history, base_fields)
    H = at.state + state.quaternion
    a, b, c, d = W[H], W[H + 1], W[H + 2], W[H + 3]
    k2 = 2.0 / (a * a + b * b + c * c + d * d)
    r00, r01, r02 = 1.0 - k2 * (c * c + d * d), k2 * (b * c - a * d), k2 * (b * d + a * c)
    r10, r11, r12 = k2 * (b * c + a * d), 1.0 - k2 * (b * b + d * d), k2 * (c * d - a * b)
    r20, r21, r22 = k2 * (b * d - a * c), k2 * (c * d + a * b), 1.0 - k2 * (b * b + c * c)
    fx, fy, fz = W[F], W[F + 1], W[F + 2]
    tx, ty, tz = W[T], W[T + 1], W[T + 2]
    force, moment = given.force, given.moment_xy
    residual[force] = r00 * fx + r10 * fy + r20 * fz - W[N] - W[wrench]
    residual[force + 1] = r01 * fx + r11 * fy + r21 * fz - W[N + 1] - W[wrench + 1]
    residual[force + 2] = r02 * fx + r12 * fy + r22 * fz - W[N + 2] - W[wrench + 2]
    residual[moment] = r00 * tx + r10 * ty + r20 * tz - W[M] - W[wrench + 3]
    residual[moment + 1] = r01 * tx + r11 * ty + r21 * tz - W[M + 1] - W[wrench + 4]
    residual[given.moment_z] = r02 * tx + r12 * ty + r22 * tz - W[MZ] - W[wrench + 5]
