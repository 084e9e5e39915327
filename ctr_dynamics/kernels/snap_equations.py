"""Equations of the finite-difference solver: slopes along s, and the maps that hold the boundary conditions strongly.

Every kernel takes real or complex states alike: a complex step of 1e-30 in one component gives the exact column of a Jacobian from the same
lines that give the residual. The equations and decisions are those of :mod:`ctr_dynamics.kernels.plain_physics` (docs/model.md) with one
difference: n is in the base frame here, as the paper prints it, so that (25) is taken of the paper's own state.

The state ``y`` of a cross-section with ``m`` tubes has the rows of :data:`ctr_dynamics.kernels.layout.STATE`; fields and their histories, of all
``n`` tubes, those of :data:`~ctr_dynamics.kernels.layout.FIELDS`. Behind the plate every tube has (psi, psi_t, m_z). ``par`` is the
parameter block with one more row: the share of the derivative of R_z(theta_i)^T that omega_i,t holds, 1 as derived, 0 as (12) and (20) are
printed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import field_rows, parameter_rows, state_rows


class Side(NamedTuple):
    """One side of a point: precurvature ``ust`` (3N,) in each tube's own frame, 1/m; histories ``hist`` (F,); fields ``out`` (F,), written to."""

    ust: np.ndarray
    hist: np.ndarray
    out: np.ndarray


class Scratch(NamedTuple):
    """Intermediate results: ``w`` (2N,) turned precurvature; bending moments ``near`` and ``far`` (2N,) on both sides of a transition; ``torque``
    (N,) of friction; ``wrench`` (6,) of a body."""

    w: np.ndarray
    near: np.ndarray
    far: np.ndarray
    torque: np.ndarray
    wrench: np.ndarray


@njit(nogil=True, error_model="numpy")
def strain(y, m, n, par, side, c0, w):
    """Curvature from moments, (16), (17), into the fields; ``w`` (2N,) gets R_z(theta_i) u*_i."""
    ust, hist, out = side
    rows, state, field = parameter_rows(n), state_rows(m), field_rows(n)
    P, Q, M = state.position, state.velocity, state.moment_xy
    FU = field.curvature_xy
    a = 0.0 * y[P]
    b, rx, ry = a, y[M], y[M + 1]
    for i in range(m):
        ks = par[rows.precurvature + i]
        vx, vy = ks * ust[3 * i], ks * ust[3 * i + 1]
        gamma = 0.0 * y[P]
        if i == 0:
            w[0], w[1] = vx, vy
        else:
            theta = y[state.theta + i - 1]
            gamma = y[state.gamma + i - 1]
            c, s = np.cos(theta), np.sin(theta)
            w[2 * i], w[2 * i + 1] = c * vx - s * vy, s * vx + c * vy
            out[field.gamma + i - 1] = gamma
        ei, bb, gj, bt = (
            par[rows.bending_stiffness + i],
            par[rows.bending_damping + i],
            par[rows.torsional_stiffness + i],
            par[rows.torsion_damping + i],
        )
        a += ei + c0 * bb
        b += bb * gamma
        rx += ei * w[2 * i] - bb * hist[FU]
        ry += ei * w[2 * i + 1] - bb * hist[FU + 1]
        out[field.curvature_z + i] = (
            y[state.moment_z + i] + gj * ks * ust[3 * i + 2] - bt * hist[field.curvature_z + i]
        ) / (gj + c0 * bt)
    d = 1.0 / (a * a + b * b)
    out[FU] = (a * rx - b * ry) * d
    out[FU + 1] = (a * ry + b * rx) * d
    for k in range(6):  # velocity and angular velocity
        out[field.velocity + k] = y[Q + k]


@njit(nogil=True, error_model="numpy")
def slope(y, m, n, par, side, c0, w, f):
    """Arc-length derivative ``f`` of the state, (13), and the fields at this point."""
    hist, out = side.hist, side.out
    rows, state, field = parameter_rows(n), state_rows(m), field_rows(n)
    P, H, N, M = state.position, state.quaternion, state.force, state.moment_xy
    Q, O = state.velocity, state.angular_velocity  # noqa: E741
    FQ, FO, FU = field.velocity, field.angular_velocity, field.curvature_xy
    strain(y, m, n, par, side, c0, w)
    ux, uy, uz = out[FU], out[FU + 1], out[FU + 2]
    uxt, uyt, uzt = c0 * ux + hist[FU], c0 * uy + hist[FU + 1], c0 * uz + hist[FU + 2]
    qx, qy, qz, ox, oy, oz = y[Q], y[Q + 1], y[Q + 2], y[O], y[O + 1], y[O + 2]
    oxt, oyt, ozt = c0 * ox + hist[FO], c0 * oy + hist[FO + 1], c0 * oz + hist[FO + 2]
    ra, ri, gyro, mz = 0.0, 0.0, 0.0 * ox, 0.0 * ox
    for i in range(m):
        gamma, gt = 0.0 * ox, 0.0 * ox
        if i > 0:
            gamma = out[field.gamma + i - 1]
            gt = c0 * gamma + hist[field.gamma + i - 1]
            f[state.theta + i - 1] = out[field.curvature_z + i] - uz
            f[state.gamma + i - 1] = c0 * out[field.curvature_z + i] + hist[field.curvature_z + i] - uzt
        inertia = par[rows.inertia_per_length + i]
        f[state.moment_z + i] = (
            par[rows.bending_stiffness + i] * (ux * w[2 * i + 1] - uy * w[2 * i])
            - par[rows.bending_damping + i] * (ux * (uyt - gamma * ux) - uy * (uxt + gamma * uy))
            + 2.0 * inertia * (ozt + gt)
        )
        if i > 0 and par[rows.overlap_friction] != 0.0:
            rate = gamma if i == 1 else gamma - out[field.gamma + i - 2]
            rub = par[rows.overlap_friction] * rate / np.sqrt(rate * rate + par[rows.epsilon] ** 2)
            f[state.moment_z + i - 1] -= rub
            f[state.moment_z + i] += rub
        ra += par[rows.mass_per_length + i]
        ri += inertia
        gyro += inertia * (oz + (1.0 + par[rows.size]) * gamma)
        mz += y[state.moment_z + i]
    a, b, c, d = y[H], y[H + 1], y[H + 2], y[H + 3]
    k = 2.0 / (a * a + b * b + c * c + d * d)
    r00, r01, r02 = 1.0 - k * (c * c + d * d), k * (b * c - a * d), k * (b * d + a * c)
    r10, r11, r12 = k * (b * c + a * d), 1.0 - k * (b * b + d * d), k * (c * d - a * b)
    r20, r21, r22 = k * (b * d - a * c), k * (c * d + a * b), 1.0 - k * (b * b + c * c)
    f[P], f[P + 1], f[P + 2] = r02, r12, r22
    f[H] = -0.5 * (ux * b + uy * c + uz * d)
    f[H + 1] = 0.5 * (ux * a + uz * c - uy * d)
    f[H + 2] = 0.5 * (uy * a - uz * b + ux * d)
    f[H + 3] = 0.5 * (uz * a + uy * b - ux * c)
    f[Q] = oy - (uy * qz - uz * qy)
    f[Q + 1] = -ox - (uz * qx - ux * qz)
    f[Q + 2] = -(ux * qy - uy * qx)
    f[O] = uxt - (uy * oz - uz * oy)
    f[O + 1] = uyt - (uz * ox - ux * oz)
    f[O + 2] = uzt - (ux * oy - uy * ox)
    ax = oy * qz - oz * qy + c0 * qx + hist[FQ]
    ay = oz * qx - ox * qz + c0 * qy + hist[FQ + 1]
    az = ox * qy - oy * qx + c0 * qz + hist[FQ + 2]
    f[N] = ra * (r00 * ax + r01 * ay + r02 * az - par[rows.gravity])
    f[N + 1] = ra * (r10 * ax + r11 * ay + r12 * az - par[rows.gravity + 1])
    f[N + 2] = ra * (r20 * ax + r21 * ay + r22 * az - par[rows.gravity + 2])
    nx = r00 * y[N] + r10 * y[N + 1] + r20 * y[N + 2]
    ny = r01 * y[N] + r11 * y[N + 1] + r21 * y[N + 2]
    f[M] = ny - (uy * mz - uz * y[M + 1]) + ri * oxt + oy * gyro
    f[M + 1] = -nx - (uz * y[M] - ux * mz) + ri * oyt - ox * gyro


@njit(nogil=True, error_model="numpy")
def base_slope(y, i, n, par, uz_ref, hist, c0, out, f):
    """(18) of tube ``i`` behind the plate: y, f (3,) are psi, psi_t, m_z; ``hist``, ``out`` (2,) belong to psi_t and u_z."""
    rows = parameter_rows(n)
    gj, bt = par[rows.torsional_stiffness + i], par[rows.torsion_damping + i]
    u = (y[2] + gj * par[rows.precurvature + i] * uz_ref - bt * hist[1]) / (gj + c0 * bt)
    out[0], out[1] = y[1], u
    f[0] = u
    f[1] = c0 * u + hist[1]
    f[2] = 2.0 * par[rows.inertia_per_length + i] * (c0 * y[1] + hist[0])


@njit(nogil=True, error_model="numpy")
def drive(i, n, par, moment, hist, c0, out):
    """(psi, psi_t) of tube ``i`` at its actuator under the internal ``moment`` there: the drive gives way by (moment - J psi_tt) / k.

    ``hist``, ``out`` (2N,) belong to what each drive gives way, rad, and to psi_t.
    """
    rows = parameter_rows(n)
    compliance, inertia = par[rows.drive_compliance + i], par[rows.drive_inertia + i]
    rate, h = par[rows.alpha_rate + i], hist[2 * i]
    give = (
        compliance
        * (moment - inertia * (c0 * (rate + h) + hist[2 * i + 1]))
        / (1.0 + compliance * inertia * c0 * c0)
    )
    out[2 * i], out[2 * i + 1] = give, rate + c0 * give + h
    return par[rows.alpha + i] + give, rate + c0 * give + h


@njit(nogil=True, error_model="numpy")
def coulomb(n, par, rate):
    """Smoothed sign of a relative ``rate``, with the Stribeck peak near rest."""
    rows = parameter_rows(n)
    eps, slow = par[rows.epsilon], rate * par[rows.stribeck_inverse_speed]
    return (1.0 + par[rows.stribeck_excess] * np.exp(-slow * slow)) * rate / np.sqrt(rate * rate + eps * eps)


@njit(nogil=True, error_model="numpy")
def bending(y, m, n, par, side, c0, w, moments):
    """Bending moment of every tube, (14), in the frame of tube 1, from the fields of :func:`strain`; zero for tubes that have ended."""
    hist, out = side.hist, side.out
    rows, state, field = parameter_rows(n), state_rows(m), field_rows(n)
    FU = field.curvature_xy
    ux, uy = out[FU], out[FU + 1]
    uxt, uyt = c0 * ux + hist[FU], c0 * uy + hist[FU + 1]
    for i in range(n):
        moments[2 * i] = moments[2 * i + 1] = 0.0
        if i < m:
            gamma = 0.0 * ux
            if i > 0:
                gamma = y[state.gamma + i - 1]
            ei, bb = par[rows.bending_stiffness + i], par[rows.bending_damping + i]
            moments[2 * i] = ei * (ux - w[2 * i]) + bb * (uxt + gamma * uy)
            moments[2 * i + 1] = ei * (uy - w[2 * i + 1]) + bb * (uyt - gamma * ux)


@njit(nogil=True, error_model="numpy")
def friction(y, m, n, par, scratch):
    """Torque on each of ``m`` tubes from its neighbours at a transition, (22), (23): (N,) added to m_z on the far side."""
    near, far, torque = scratch.near, scratch.far, scratch.torque
    rows, state = parameter_rows(n), state_rows(m)
    for i in range(n):
        torque[i] = 0.0
    for i in range(m - 1):
        dx, dy = far[2 * i] - near[2 * i], far[2 * i + 1] - near[2 * i + 1]
        rate = y[state.gamma + i]
        if i > 0:
            rate = rate - y[state.gamma + i - 1]
        tau = (
            par[rows.tube_coulomb] * np.sqrt(dx * dx + dy * dy) * coulomb(n, par, rate)
            + par[rows.tube_viscous] * rate
        )
        torque[i] -= tau
        torque[i + 1] += tau


@njit(nogil=True, error_model="numpy")
def body(y, m, i, n, par, hist, c0, wrench):
    """Inertia less weight of the body at the end of tube ``i``, (20), (21): force (base frame) and moment (frame of tube 1) in ``wrench``."""
    rows, state, field = parameter_rows(n), state_rows(m), field_rows(n)
    H, Q, O = state.quaternion, state.velocity, state.angular_velocity  # noqa: E741
    FQ, FO = field.velocity, field.angular_velocity
    qx, qy, qz, wx, wy, wz = y[Q], y[Q + 1], y[Q + 2], y[O], y[O + 1], y[O + 2]
    atx, aty, atz = c0 * wx + hist[FO], c0 * wy + hist[FO + 1], c0 * wz + hist[FO + 2]
    ax = wy * qz - wz * qy + c0 * qx + hist[FQ]
    ay = wz * qx - wx * qz + c0 * qy + hist[FQ + 1]
    az = wx * qy - wy * qx + c0 * qz + hist[FQ + 2]
    a, b, c, d = y[H], y[H + 1], y[H + 2], y[H + 3]
    k = 2.0 / (a * a + b * b + c * c + d * d)
    mass = par[rows.body_mass + i]
    wrench[0] = mass * (
        (1.0 - k * (c * c + d * d)) * ax
        + k * (b * c - a * d) * ay
        + k * (b * d + a * c) * az
        - par[rows.gravity]
    )
    wrench[1] = mass * (
        k * (b * c + a * d) * ax
        + (1.0 - k * (b * b + d * d)) * ay
        + k * (c * d - a * b) * az
        - par[rows.gravity + 1]
    )
    wrench[2] = mass * (
        k * (b * d - a * c) * ax
        + k * (c * d + a * b) * ay
        + (1.0 - k * (b * b + c * c)) * az
        - par[rows.gravity + 2]
    )
    hx, hy, hz = par[rows.body_inertia_x + i], par[rows.body_inertia_y + i], par[rows.body_inertia_z + i]
    if i == 0:
        wrench[3] = hx * atx + (hz - hy) * wy * wz
        wrench[4] = hy * aty + (hx - hz) * wz * wx
        wrench[5] = hz * atz + (hy - hx) * wx * wy
    else:
        theta, g = y[state.theta + i - 1], y[state.gamma + i - 1]
        co, s = np.cos(theta), np.sin(theta)
        ox, oy, oz = co * wx + s * wy, co * wy - s * wx, wz + g
        tx = co * atx + s * aty + par[rows.size] * g * oy
        ty = co * aty - s * atx - par[rows.size] * g * ox
        tz = atz + c0 * g + hist[field.gamma + i - 1]
        bx = hx * tx + (hz - hy) * oy * oz
        by = hy * ty + (hx - hz) * oz * ox
        wrench[3] = co * bx - s * by
        wrench[4] = s * bx + co * by
        wrench[5] = hz * tz + (hy - hx) * ox * oy


@njit(nogil=True, error_model="numpy")
def enter(x, turning, n, par, ust_behind, side, hist_drive, out_drive, c0, scratch, y):
    """State at s = 0+ from the unknowns there, (19) and (24): p, h, q, omega, theta, gamma are held by the tubes behind the plate.

    ``x``: (psi, psi_t, m_z) of the ``turning`` innermost tubes, which begin behind the plate, then n (3), m_xy (2), m_z of the others,
    which their drives hold here.
    """
    w, near, far = scratch.w, scratch.near, scratch.far
    rows, state = parameter_rows(n), state_rows(n)
    H, O, N, M = state.quaternion, state.angular_velocity, state.force, state.moment_xy  # noqa: E741
    first = 3 * turning
    for k in range(state.size):
        y[k] = 0.0
    for k in range(5):  # force and moment_xy
        y[N + k] = x[first + k]
    psi1, rate1, outer = 0.0 * x[0], 0.0 * x[0], 0.0 * x[0]
    for i in range(n):
        if i < turning:
            psi, rate, moment = x[3 * i], x[3 * i + 1], x[3 * i + 2]
        else:
            moment = x[first + 5 + i - turning]
            psi, rate = drive(i, n, par, moment, hist_drive, c0, out_drive)
        y[state.moment_z + i] = moment
        if i == 0:
            psi1, rate1 = psi, rate
        else:
            y[state.theta + i - 1] = psi - psi1
            y[state.gamma + i - 1] = rate - rate1
        outer = rate
    y[H], y[H + 3] = np.cos(0.5 * psi1), np.sin(0.5 * psi1)
    y[O + 2] = rate1
    mx, my = y[M], y[M + 1]
    y[state.moment_z + n - 1] += (
        par[rows.base_coulomb] * np.sqrt(mx * mx + my * my) * coulomb(n, par, outer)
        + par[rows.base_viscous] * outer
    )
    strain(y, n, n, par, Side(ust_behind, side.hist, side.out), c0, w)
    for i in range(n):
        ei = par[rows.bending_stiffness + i]
        near[2 * i], near[2 * i + 1] = -ei * w[2 * i], -ei * w[2 * i + 1]
    strain(y, n, n, par, side, c0, w)
    bending(y, n, n, par, side, c0, w, far)
    friction(y, n, n, par, scratch)
    for i in range(n):
        y[state.moment_z + i] += scratch.torque[i]


@njit(nogil=True, error_model="numpy")
def cross(y, m, after, n, par, side, beyond, c0, scratch, y2):
    """Across a curvature change or the end of a tube, from ``side`` to ``beyond`` it: the state ``y2`` of the ``after`` tubes that go on.

    Where tube m ends its m_z in ``y`` is set to what its body and friction need, (20) with (22).
    """
    state, state2 = state_rows(m), state_rows(after)
    N = state.force
    w, torque, wrench = scratch.w, scratch.torque, scratch.wrench
    strain(y, m, n, par, side, c0, w)
    bending(y, m, n, par, side, c0, w, scratch.near)
    for k in range(state.moment_z):
        y2[k] = y[k]
    for i in range(after):
        y2[state.moment_z + i] = y[state.moment_z + i]
        if i > 0:
            y2[state2.theta + i - 1] = y[state.theta + i - 1]
            y2[state2.gamma + i - 1] = y[state.gamma + i - 1]
    if after < m:
        body(y, m, m - 1, n, par, side.hist, c0, wrench)
        for k in range(5):
            y2[N + k] += wrench[k]
    strain(y2, after, n, par, beyond, c0, w)
    bending(y2, after, n, par, beyond, c0, w, scratch.far)
    friction(y, m, n, par, scratch)
    for i in range(after):
        y2[state.moment_z + i] += torque[i]
    if after < m:
        y[state.moment_z + m - 1] = -wrench[5] - torque[m - 1]


@njit(nogil=True, error_model="numpy")
def tip(y, n, par, side, c0, scratch):
    """Force and moment at the tip of tube 1, (21), into its state ``y``: the external wrench (base frame) less the body's inertia."""
    wrench = scratch.wrench
    rows, state = parameter_rows(n), state_rows(1)
    H, N, M = state.quaternion, state.force, state.moment_xy
    body(y, 1, 0, n, par, side.hist, c0, wrench)
    a, b, c, d = y[H], y[H + 1], y[H + 2], y[H + 3]
    k = 2.0 / (a * a + b * b + c * c + d * d)
    tx, ty, tz = par[rows.torque], par[rows.torque + 1], par[rows.torque + 2]
    for r in range(3):
        y[N + r] = par[rows.force + r] - wrench[r]
    y[M] = (1.0 - k * (c * c + d * d)) * tx + k * (b * c + a * d) * ty + k * (b * d - a * c) * tz - wrench[3]
    y[M + 1] = (
        k * (b * c - a * d) * tx + (1.0 - k * (b * b + d * d)) * ty + k * (c * d + a * b) * tz - wrench[4]
    )
    y[state.moment_z] = (
        k * (b * d + a * c) * tx + k * (c * d - a * b) * ty + (1.0 - k * (b * b + c * c)) * tz - wrench[5]
    )
    strain(y, 1, n, par, side, c0, scratch.w)
