"""Equations of the finite-difference solver: slopes along s, and the maps that hold the boundary conditions strongly.

Every kernel takes real or complex states alike: a complex step of 1e-30 in one component gives the exact column of a Jacobian from the same
lines that give the residual. The equations and decisions are those of :mod:`ctr_dynamics.kernels.rod` (docs/model.md) with one
difference: n is in the base frame here, as the paper prints it, so that (25) is taken of the paper's own state.

State of a cross-section with ``m`` tubes (16 + 3m): p 0-2, quaternion h 3-6, q 7-9, omega 10-12, n 13-15, m_xy 16-17, m_z of the tubes,
theta and gamma of tubes 2..m; q, omega and m are components in the frame of tube 1. Behind the plate every tube has (psi, psi_t, m_z).
Fields, whose history enters (7 + 2N): q 0-2, omega 3-5, u of tube 1 6-8, u_z of tubes 2..N, gamma of tubes 2..N. ``par`` is the
parameter block of :class:`ctr_dynamics.kernels.layout.Layout` with one more row, ``TURNING``; ``ust`` (3N,) the precurvature in each tube's own
frame, 1/m.
"""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.layout import EXTENDED, EXTENDED_TUBES

Q, O, N, M, Z = 7, 10, 13, 16, 18  # noqa: E741

# Rows of the extensions that are in use here: scalars k at 14n + k, groups of one row a tube k at 14n + TUBES + k n.
_FIRST = {name: 14 + sum(size for _, size in EXTENDED[:k]) for k, (name, _) in enumerate(EXTENDED)}
EXCESS, INVERSE_SPEED, OVERLAP = (
    _FIRST[name] for name in ("stribeck_excess", "stribeck_inverse_speed", "overlap_friction")
)
TUBES = 14 + sum(size for _, size in EXTENDED)
TURNING = -1  # share of the derivative of R_z(theta_i)^T that omega_i,t holds: 1 as derived, 0 as (12) and (20) are printed
COMPLIANCE, INERTIA = (EXTENDED_TUBES.index(name) for name in ("drive_compliance", "drive_inertia"))


@njit(cache=True, inline="always")
def state_size(m):
    """Length of the state of ``m`` tubes."""
    return 16 + 3 * m


@njit(cache=True, nogil=True, error_model="numpy")
def strain(y, m, n, par, ust, hist, c0, out, w):
    """Curvature from moments, (16), (17), into the fields ``out``; ``w`` (2N,) gets R_z(theta_i) u*_i."""
    a = 0.0 * y[0]
    b, rx, ry = a, y[M], y[M + 1]
    for i in range(m):
        ks = par[6 * n + i]
        vx, vy = ks * ust[3 * i], ks * ust[3 * i + 1]
        gamma = 0.0 * y[0]
        if i == 0:
            w[0], w[1] = vx, vy
        else:
            theta = y[17 + m + i]
            gamma = y[16 + 2 * m + i]
            c, s = np.cos(theta), np.sin(theta)
            w[2 * i], w[2 * i + 1] = c * vx - s * vy, s * vx + c * vy
            out[7 + n + i] = gamma
        ei, bb, gj, bt = par[i], par[4 * n + i], par[n + i], par[5 * n + i]
        a += ei + c0 * bb
        b += bb * gamma
        rx += ei * w[2 * i] - bb * hist[6]
        ry += ei * w[2 * i + 1] - bb * hist[7]
        out[8 + i] = (y[Z + i] + gj * ks * ust[3 * i + 2] - bt * hist[8 + i]) / (gj + c0 * bt)
    d = 1.0 / (a * a + b * b)
    out[6] = (a * rx - b * ry) * d
    out[7] = (a * ry + b * rx) * d
    for k in range(6):
        out[k] = y[Q + k]


@njit(cache=True, nogil=True, error_model="numpy")
def slope(y, m, n, par, ust, hist, c0, out, w, f):
    """Arc-length derivative of the state, (13), and the fields at this point."""
    strain(y, m, n, par, ust, hist, c0, out, w)
    ux, uy, uz = out[6], out[7], out[8]
    uxt, uyt, uzt = c0 * ux + hist[6], c0 * uy + hist[7], c0 * uz + hist[8]
    qx, qy, qz, ox, oy, oz = y[7], y[8], y[9], y[10], y[11], y[12]
    oxt, oyt, ozt = c0 * ox + hist[3], c0 * oy + hist[4], c0 * oz + hist[5]
    ra, ri, gyro, mz = 0.0, 0.0, 0.0 * ox, 0.0 * ox
    for i in range(m):
        gamma, gt = 0.0 * ox, 0.0 * ox
        if i > 0:
            gamma = out[7 + n + i]
            gt = c0 * gamma + hist[7 + n + i]
            f[17 + m + i] = out[8 + i] - uz
            f[16 + 2 * m + i] = c0 * out[8 + i] + hist[8 + i] - uzt
        inertia = par[3 * n + i]
        f[Z + i] = (
            par[i] * (ux * w[2 * i + 1] - uy * w[2 * i])
            - par[4 * n + i] * (ux * (uyt - gamma * ux) - uy * (uxt + gamma * uy))
            + 2.0 * inertia * (ozt + gt)
        )
        if i > 0 and par[14 * n + OVERLAP] != 0.0:
            rate = gamma if i == 1 else gamma - out[6 + n + i]
            rub = par[14 * n + OVERLAP] * rate / np.sqrt(rate * rate + par[14 * n + 11] ** 2)
            f[Z + i - 1] -= rub
            f[Z + i] += rub
        ra += par[2 * n + i]
        ri += inertia
        gyro += inertia * (oz + (1.0 + par[TURNING]) * gamma)
        mz += y[Z + i]
    a, b, c, d = y[3], y[4], y[5], y[6]
    k = 2.0 / (a * a + b * b + c * c + d * d)
    r00, r01, r02 = 1.0 - k * (c * c + d * d), k * (b * c - a * d), k * (b * d + a * c)
    r10, r11, r12 = k * (b * c + a * d), 1.0 - k * (b * b + d * d), k * (c * d - a * b)
    r20, r21, r22 = k * (b * d - a * c), k * (c * d + a * b), 1.0 - k * (b * b + c * c)
    f[0], f[1], f[2] = r02, r12, r22
    f[3] = -0.5 * (ux * b + uy * c + uz * d)
    f[4] = 0.5 * (ux * a + uz * c - uy * d)
    f[5] = 0.5 * (uy * a - uz * b + ux * d)
    f[6] = 0.5 * (uz * a + uy * b - ux * c)
    f[7] = oy - (uy * qz - uz * qy)
    f[8] = -ox - (uz * qx - ux * qz)
    f[9] = -(ux * qy - uy * qx)
    f[10] = uxt - (uy * oz - uz * oy)
    f[11] = uyt - (uz * ox - ux * oz)
    f[12] = uzt - (ux * oy - uy * ox)
    ax = oy * qz - oz * qy + c0 * qx + hist[0]
    ay = oz * qx - ox * qz + c0 * qy + hist[1]
    az = ox * qy - oy * qx + c0 * qz + hist[2]
    f[13] = ra * (r00 * ax + r01 * ay + r02 * az - par[14 * n])
    f[14] = ra * (r10 * ax + r11 * ay + r12 * az - par[14 * n + 1])
    f[15] = ra * (r20 * ax + r21 * ay + r22 * az - par[14 * n + 2])
    nx = r00 * y[13] + r10 * y[14] + r20 * y[15]
    ny = r01 * y[13] + r11 * y[14] + r21 * y[15]
    f[16] = ny - (uy * mz - uz * y[17]) + ri * oxt + oy * gyro
    f[17] = -nx - (uz * y[16] - ux * mz) + ri * oyt - ox * gyro


@njit(cache=True, nogil=True, error_model="numpy")
def base_slope(y, i, n, par, uz_ref, hist, c0, out, f):
    """(18) of tube ``i`` behind the plate: y, f (3,) are psi, psi_t, m_z; ``hist``, ``out`` (2,) belong to psi_t and u_z."""
    gj, bt = par[n + i], par[5 * n + i]
    u = (y[2] + gj * par[6 * n + i] * uz_ref - bt * hist[1]) / (gj + c0 * bt)
    out[0], out[1] = y[1], u
    f[0] = u
    f[1] = c0 * u + hist[1]
    f[2] = 2.0 * par[3 * n + i] * (c0 * y[1] + hist[0])


@njit(cache=True, nogil=True, error_model="numpy")
def drive(i, n, par, moment, hist, c0, out):
    """(psi, psi_t) of tube ``i`` at its actuator under the internal ``moment`` there: the drive gives way by (moment - J psi_tt) / k.

    ``hist``, ``out`` (2N,) belong to what each drive gives way, rad, and to psi_t.
    """
    at = 14 * n + TUBES + i
    compliance, inertia = par[at + COMPLIANCE * n], par[at + INERTIA * n]
    rate, h = par[12 * n + i], hist[2 * i]
    give = (
        compliance
        * (moment - inertia * (c0 * (rate + h) + hist[2 * i + 1]))
        / (1.0 + compliance * inertia * c0 * c0)
    )
    out[2 * i], out[2 * i + 1] = give, rate + c0 * give + h
    return par[11 * n + i] + give, rate + c0 * give + h


@njit(cache=True, nogil=True, error_model="numpy")
def coulomb(n, par, rate):
    """Smoothed sign of a relative ``rate``, with the Stribeck peak near rest."""
    eps, slow = par[14 * n + 11], rate * par[14 * n + INVERSE_SPEED]
    return (1.0 + par[14 * n + EXCESS] * np.exp(-slow * slow)) * rate / np.sqrt(rate * rate + eps * eps)


@njit(cache=True, nogil=True, error_model="numpy")
def bending(y, m, n, par, hist, c0, out, w, moments):
    """Bending moment of every tube, (14), in the frame of tube 1, from the fields of :func:`strain`; zero for tubes that have ended."""
    ux, uy = out[6], out[7]
    uxt, uyt = c0 * ux + hist[6], c0 * uy + hist[7]
    for i in range(n):
        moments[2 * i] = moments[2 * i + 1] = 0.0
        if i < m:
            gamma = 0.0 * ux
            if i > 0:
                gamma = y[16 + 2 * m + i]
            moments[2 * i] = par[i] * (ux - w[2 * i]) + par[4 * n + i] * (uxt + gamma * uy)
            moments[2 * i + 1] = par[i] * (uy - w[2 * i + 1]) + par[4 * n + i] * (uyt - gamma * ux)


@njit(cache=True, nogil=True, error_model="numpy")
def friction(y, m, n, par, near, far, torque):
    """Torque on each of ``m`` tubes from its neighbours at a transition, (22), (23): (N,) added to m_z on the far side."""
    for i in range(n):
        torque[i] = 0.0
    for i in range(m - 1):
        dx, dy = far[2 * i] - near[2 * i], far[2 * i + 1] - near[2 * i + 1]
        rate = y[17 + 2 * m + i]
        if i > 0:
            rate = rate - y[16 + 2 * m + i]
        tau = par[14 * n + 9] * np.sqrt(dx * dx + dy * dy) * coulomb(n, par, rate) + par[14 * n + 10] * rate
        torque[i] -= tau
        torque[i + 1] += tau


@njit(cache=True, nogil=True, error_model="numpy")
def body(y, m, i, n, par, hist, c0, wrench):
    """Inertia less weight of the body at the end of tube ``i``, (20), (21): force (base frame) and moment (frame of tube 1) in ``wrench``."""
    qx, qy, qz, wx, wy, wz = y[7], y[8], y[9], y[10], y[11], y[12]
    atx, aty, atz = c0 * wx + hist[3], c0 * wy + hist[4], c0 * wz + hist[5]
    ax = wy * qz - wz * qy + c0 * qx + hist[0]
    ay = wz * qx - wx * qz + c0 * qy + hist[1]
    az = wx * qy - wy * qx + c0 * qz + hist[2]
    a, b, c, d = y[3], y[4], y[5], y[6]
    k = 2.0 / (a * a + b * b + c * c + d * d)
    mass = par[7 * n + i]
    wrench[0] = mass * (
        (1.0 - k * (c * c + d * d)) * ax + k * (b * c - a * d) * ay + k * (b * d + a * c) * az - par[14 * n]
    )
    wrench[1] = mass * (
        k * (b * c + a * d) * ax
        + (1.0 - k * (b * b + d * d)) * ay
        + k * (c * d - a * b) * az
        - par[14 * n + 1]
    )
    wrench[2] = mass * (
        k * (b * d - a * c) * ax
        + k * (c * d + a * b) * ay
        + (1.0 - k * (b * b + c * c)) * az
        - par[14 * n + 2]
    )
    hx, hy, hz = par[8 * n + i], par[9 * n + i], par[10 * n + i]
    if i == 0:
        wrench[3] = hx * atx + (hz - hy) * wy * wz
        wrench[4] = hy * aty + (hx - hz) * wz * wx
        wrench[5] = hz * atz + (hy - hx) * wx * wy
    else:
        theta, g = y[17 + m + i], y[16 + 2 * m + i]
        co, s = np.cos(theta), np.sin(theta)
        ox, oy, oz = co * wx + s * wy, co * wy - s * wx, wz + g
        tx = co * atx + s * aty + par[TURNING] * g * oy
        ty = co * aty - s * atx - par[TURNING] * g * ox
        tz = atz + c0 * g + hist[7 + n + i]
        bx = hx * tx + (hz - hy) * oy * oz
        by = hy * ty + (hx - hz) * oz * ox
        wrench[3] = co * bx - s * by
        wrench[4] = s * bx + co * by
        wrench[5] = hz * tz + (hy - hx) * ox * oy


@njit(cache=True, nogil=True, error_model="numpy")
def enter(x, turning, n, par, ust_behind, ust, hist, hist_drive, c0, out, out_drive, w, near, far, torque, y):
    """State at s = 0+ from the unknowns there, (19) and (24): p, h, q, omega, theta, gamma are held by the tubes behind the plate.

    ``x``: (psi, psi_t, m_z) of the ``turning`` innermost tubes, which begin behind the plate, then n (3), m_xy (2), m_z of the others,
    which their drives hold here.
    """
    first = 3 * turning
    for k in range(state_size(n)):
        y[k] = 0.0
    for k in range(5):
        y[N + k] = x[first + k]
    psi1, rate1, outer = 0.0 * x[0], 0.0 * x[0], 0.0 * x[0]
    for i in range(n):
        if i < turning:
            psi, rate, moment = x[3 * i], x[3 * i + 1], x[3 * i + 2]
        else:
            moment = x[first + 5 + i - turning]
            psi, rate = drive(i, n, par, moment, hist_drive, c0, out_drive)
        y[Z + i] = moment
        if i == 0:
            psi1, rate1 = psi, rate
        else:
            y[17 + n + i] = psi - psi1
            y[16 + 2 * n + i] = rate - rate1
        outer = rate
    y[3], y[6] = np.cos(0.5 * psi1), np.sin(0.5 * psi1)
    y[12] = rate1
    mx, my = y[M], y[M + 1]
    y[Z + n - 1] += (
        par[14 * n + 12] * np.sqrt(mx * mx + my * my) * coulomb(n, par, outer) + par[14 * n + 13] * outer
    )
    strain(y, n, n, par, ust_behind, hist, c0, out, w)
    for i in range(n):
        near[2 * i], near[2 * i + 1] = -par[i] * w[2 * i], -par[i] * w[2 * i + 1]
    strain(y, n, n, par, ust, hist, c0, out, w)
    bending(y, n, n, par, hist, c0, out, w, far)
    friction(y, n, n, par, near, far, torque)
    for i in range(n):
        y[Z + i] += torque[i]


@njit(cache=True, nogil=True, error_model="numpy")
def cross(y, m, after, n, par, ust, hist, out, ust2, hist2, out2, c0, w, near, far, torque, wrench, y2):
    """Across a curvature change or the end of a tube: the state ``y2`` of the ``after`` tubes that go on.

    Where tube m ends its m_z in ``y`` is set to what its body and friction need, (20) with (22).
    """
    strain(y, m, n, par, ust, hist, c0, out, w)
    bending(y, m, n, par, hist, c0, out, w, near)
    for k in range(Z):
        y2[k] = y[k]
    for i in range(after):
        y2[Z + i] = y[Z + i]
        if i > 0:
            y2[17 + after + i] = y[17 + m + i]
            y2[16 + 2 * after + i] = y[16 + 2 * m + i]
    if after < m:
        body(y, m, m - 1, n, par, hist, c0, wrench)
        for k in range(5):
            y2[N + k] += wrench[k]
    strain(y2, after, n, par, ust2, hist2, c0, out2, w)
    bending(y2, after, n, par, hist2, c0, out2, w, far)
    friction(y, m, n, par, near, far, torque)
    for i in range(after):
        y2[Z + i] += torque[i]
    if after < m:
        y[Z + m - 1] = -wrench[5] - torque[m - 1]


@njit(cache=True, nogil=True, error_model="numpy")
def tip(y, n, par, ust, hist, c0, out, w, wrench):
    """Force and moment at the tip of tube 1, (21), into its state ``y``: the external wrench (base frame) less the body's inertia."""
    body(y, 1, 0, n, par, hist, c0, wrench)
    a, b, c, d = y[3], y[4], y[5], y[6]
    k = 2.0 / (a * a + b * b + c * c + d * d)
    tx, ty, tz = par[14 * n + 6], par[14 * n + 7], par[14 * n + 8]
    for r in range(3):
        y[N + r] = par[14 * n + 3 + r] - wrench[r]
    y[M] = (1.0 - k * (c * c + d * d)) * tx + k * (b * c + a * d) * ty + k * (b * d - a * c) * tz - wrench[3]
    y[M + 1] = (
        k * (b * c - a * d) * tx + (1.0 - k * (b * b + d * d)) * ty + k * (c * d + a * b) * tz - wrench[4]
    )
    y[Z] = k * (b * d + a * c) * tx + k * (c * d - a * b) * ty + (1.0 - k * (b * b + c * c)) * tz - wrench[5]
    strain(y, 1, n, par, ust, hist, c0, out, w)
