"""Arc-length kernels of the dynamic model: one sweep from the actuators to the tip, for many lanes at once.

Numbers live in the workspace of :mod:`ctr_dynamics.model.workspace`. A robot whose file names extensions that change the physics runs the
same sweep with the functions of :mod:`ctr_dynamics.model.extended` in their places (:func:`dispatch`).

What runs at every point is inlined by Numba: a compiled function that calls another counts references to its arrays, and those counts, atomic
as they are, cost as much as the arithmetic.
"""

import math

import numpy as np
from numba import njit, types
from numba.extending import overload

from ctr_dynamics.model import extended
from ctr_dynamics.model.workspace import (
    H0,
    M0,
    N0,
    O0,
    P0,
    Q0,
    Z0,
    field_rows,
    lane_count,
    lane_trips,
    offsets,
    parameter_rows,
    sincos,
    state_rows,
)


@njit(cache=True, inline="always", error_model="numpy")
def _plain_curvature(tubes, lanes, W, present, ust, u0, c0):
    """Strains from moments: (16), (17) with the damping history of every tube taken exactly (docs/model.md).

    Reads the state rows at ``YS`` and the history rows at ``HI``; writes to ``TMP``: u_1 (3), its time derivative (3), then per tube
    u_z, its time derivative, and the precurvature w_i = R_z(theta_i) u*_i (2), and (a, b) of the 2x2 system.
    """
    n = len(tubes)
    L = lane_count(lanes)
    trip = lane_trips(n, lanes, W)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes, lanes)
    mz, th, ga = Z0, Z0 + n, Z0 + 2 * n - 1
    EI, GJ, BB, BT, KS = PAR, PAR + n * L, PAR + 4 * n * L, PAR + 5 * n * L, PAR + 6 * n * L
    T = TMP + 13 * L
    ux_, uy_, uz_ = ust[u0], ust[u0 + 1], ust[u0 + 2]
    for j in range(trip):
        wx = W[KS + j] * ux_
        wy = W[KS + j] * uy_
        W[T + j] = wx
        W[T + L + j] = wy
        gj = W[GJ + j]
        uz = (W[YS + mz * L + j] + gj * W[KS + j] * uz_ - W[BT + j] * W[HI + 8 * L + j]) / (
            gj + c0 * W[BT + j]
        )
        W[TMP + 2 * L + j] = uz
        W[TMP + 5 * L + j] = c0 * uz + W[HI + 8 * L + j]
        ei = W[EI + j]
        bb = W[BB + j]
        W[TMP + 6 * L + j] = ei + c0 * bb
        W[TMP + 7 * L + j] = 0.0
        W[TMP + 8 * L + j] = ei * wx - bb * W[HI + 6 * L + j]
        W[TMP + 9 * L + j] = ei * wy - bb * W[HI + 7 * L + j]
    for i in range(1, n):
        if i < present:
            Ti = T + 7 * i * L
            vx_, vy_, vz_ = ust[u0 + 3 * i], ust[u0 + 3 * i + 1], ust[u0 + 3 * i + 2]
            EIi, GJi, BBi, BTi, KSi = EI + i * L, GJ + i * L, BB + i * L, BT + i * L, KS + i * L
            MZi, THi, GAi = YS + (mz + i) * L, YS + (th + i - 1) * L, YS + (ga + i - 1) * L
            HUi = HI + (8 + i) * L
            for j in range(trip):
                s, c = sincos(W[THi + j])
                ks = W[KSi + j]
                wx = ks * (c * vx_ - s * vy_)
                wy = ks * (s * vx_ + c * vy_)
                W[Ti + j] = wx
                W[Ti + L + j] = wy
                gj = W[GJi + j]
                hu = W[HUi + j]
                uz = (W[MZi + j] + gj * ks * vz_ - W[BTi + j] * hu) / (gj + c0 * W[BTi + j])
                W[Ti + 2 * L + j] = uz
                W[Ti + 3 * L + j] = c0 * uz + hu
                ei = W[EIi + j]
                bb = W[BBi + j]
                W[TMP + 6 * L + j] += ei + c0 * bb
                W[TMP + 7 * L + j] += bb * W[GAi + j]
                W[TMP + 8 * L + j] += ei * wx - bb * W[HI + 6 * L + j]
                W[TMP + 9 * L + j] += ei * wy - bb * W[HI + 7 * L + j]
    for j in range(trip):
        a = W[TMP + 6 * L + j]
        b = W[TMP + 7 * L + j]
        rx = W[YS + M0 * L + j] + W[TMP + 8 * L + j]
        ry = W[YS + (M0 + 1) * L + j] + W[TMP + 9 * L + j]
        d = 1.0 / (a * a + b * b)
        ux = (a * rx - b * ry) * d
        uy = (a * ry + b * rx) * d
        W[TMP + j] = ux
        W[TMP + L + j] = uy
        W[TMP + 3 * L + j] = c0 * ux + W[HI + 6 * L + j]
        W[TMP + 4 * L + j] = c0 * uy + W[HI + 7 * L + j]


@njit(cache=True, inline="always", error_model="numpy")
def _body_forces(tubes, lanes, W):
    """Gravity in the frame of tube 1, R_1^T g, into ``TMP`` rows 10-12 (non-unit quaternion, normalised when read)."""
    n = len(tubes)
    L = lane_count(lanes)
    trip = lane_trips(n, lanes, W)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes, lanes)
    G = PAR + 14 * n * L
    for j in range(trip):
        a, b, c, d = (
            W[YS + H0 * L + j],
            W[YS + (H0 + 1) * L + j],
            W[YS + (H0 + 2) * L + j],
            W[YS + (H0 + 3) * L + j],
        )
        k = 2.0 / (a * a + b * b + c * c + d * d)
        gx, gy, gz = W[G + j], W[G + L + j], W[G + 2 * L + j]
        W[TMP + 10 * L + j] = (
            (1.0 - k * (c * c + d * d)) * gx + k * (b * c + a * d) * gy + k * (b * d - a * c) * gz
        )
        W[TMP + 11 * L + j] = (
            k * (b * c - a * d) * gx + (1.0 - k * (b * b + d * d)) * gy + k * (c * d + a * b) * gz
        )
        W[TMP + 12 * L + j] = (
            k * (b * d + a * c) * gx + k * (c * d - a * b) * gy + (1.0 - k * (b * b + c * c)) * gz
        )


@njit(cache=True, inline="always", error_model="numpy")
def _plain_derivative(tubes, lanes, W, present, ust, u0, c0):
    """Arc-length derivative of the state, (13), and the fields at this point (``OU``)."""
    n = len(tubes)
    L = lane_count(lanes)
    trip = lane_trips(n, lanes, W)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes, lanes)
    mz, th, ga = Z0, Z0 + n, Z0 + 2 * n - 1
    EI, RA, RI, BB = PAR, PAR + 2 * n * L, PAR + 3 * n * L, PAR + 4 * n * L
    T = TMP + 13 * L
    _plain_curvature(tubes, lanes, W, present, ust, u0, c0)
    # torsion of tube 1 and the sums over the tubes: rho A, rho I, rho I omega_z + 2 rho I gamma, m_z
    for j in range(trip):
        ux, uy = W[TMP + j], W[TMP + L + j]
        utx, uty = W[TMP + 3 * L + j], W[TMP + 4 * L + j]
        wz_t = c0 * W[YS + (O0 + 2) * L + j] + W[HI + 5 * L + j]
        W[K + mz * L + j] = (
            W[EI + j] * (ux * W[T + L + j] - uy * W[T + j])
            - W[BB + j] * (ux * uty - uy * utx)
            + 2.0 * W[RI + j] * wz_t
        )
        W[TMP + 6 * L + j] = W[RA + j]
        W[TMP + 7 * L + j] = W[RI + j]
        W[TMP + 8 * L + j] = W[RI + j] * W[YS + (O0 + 2) * L + j]
        W[TMP + 9 * L + j] = W[YS + mz * L + j]
    for i in range(1, n):
        if i < present:
            Ti = T + 7 * i * L
            EIi, RAi, RIi, BBi = EI + i * L, RA + i * L, RI + i * L, BB + i * L
            MZi, GAi = YS + (mz + i) * L, YS + (ga + i - 1) * L
            KM, KT, KG = K + (mz + i) * L, K + (th + i - 1) * L, K + (ga + i - 1) * L
            OUu, OUg, HG = OU + (8 + i) * L, OU + (7 + n + i) * L, HI + (7 + n + i) * L
            for j in range(trip):
                ux, uy = W[TMP + j], W[TMP + L + j]
                utx, uty = W[TMP + 3 * L + j], W[TMP + 4 * L + j]
                g = W[GAi + j]
                ri = W[RIi + j]
                wz_t = c0 * (W[YS + (O0 + 2) * L + j] + g) + W[HI + 5 * L + j] + W[HG + j]
                W[KM + j] = (
                    W[EIi + j] * (ux * W[Ti + L + j] - uy * W[Ti + j])
                    - W[BBi + j] * (ux * (uty - g * ux) - uy * (utx + g * uy))
                    + 2.0 * ri * wz_t
                )
                W[KT + j] = W[Ti + 2 * L + j] - W[TMP + 2 * L + j]
                W[KG + j] = W[Ti + 3 * L + j] - W[TMP + 5 * L + j]
                W[OUu + j] = W[Ti + 2 * L + j]
                W[OUg + j] = g
                W[TMP + 6 * L + j] += W[RAi + j]
                W[TMP + 7 * L + j] += ri
                W[TMP + 8 * L + j] += ri * (W[YS + (O0 + 2) * L + j] + 2.0 * g)
                W[TMP + 9 * L + j] += W[MZi + j]
    for i in range(1, n):
        if i >= present:
            for j in range(trip):
                W[K + (mz + i) * L + j] = 0.0
                W[K + (th + i - 1) * L + j] = 0.0
                W[K + (ga + i - 1) * L + j] = 0.0
                W[OU + (8 + i) * L + j] = 0.0
                W[OU + (7 + n + i) * L + j] = 0.0
    # kinematics
    for j in range(trip):
        ux, uy, uz = W[TMP + j], W[TMP + L + j], W[TMP + 2 * L + j]
        a, b, c, d = (
            W[YS + H0 * L + j],
            W[YS + (H0 + 1) * L + j],
            W[YS + (H0 + 2) * L + j],
            W[YS + (H0 + 3) * L + j],
        )
        k = 2.0 / (a * a + b * b + c * c + d * d)
        W[K + P0 * L + j] = k * (b * d + a * c)
        W[K + (P0 + 1) * L + j] = k * (c * d - a * b)
        W[K + (P0 + 2) * L + j] = 1.0 - k * (b * b + c * c)
        W[K + H0 * L + j] = -0.5 * (ux * b + uy * c + uz * d)
        W[K + (H0 + 1) * L + j] = 0.5 * (ux * a + uz * c - uy * d)
        W[K + (H0 + 2) * L + j] = 0.5 * (uy * a - uz * b + ux * d)
        W[K + (H0 + 3) * L + j] = 0.5 * (uz * a + uy * b - ux * c)
    # velocities and balance of forces and moments
    for j in range(trip):
        ux, uy, uz = W[TMP + j], W[TMP + L + j], W[TMP + 2 * L + j]
        qx, qy, qz = W[YS + Q0 * L + j], W[YS + (Q0 + 1) * L + j], W[YS + (Q0 + 2) * L + j]
        wx, wy, wz = W[YS + O0 * L + j], W[YS + (O0 + 1) * L + j], W[YS + (O0 + 2) * L + j]
        nx, ny, nz = W[YS + N0 * L + j], W[YS + (N0 + 1) * L + j], W[YS + (N0 + 2) * L + j]
        W[K + Q0 * L + j] = wy - (uy * qz - uz * qy)
        W[K + (Q0 + 1) * L + j] = -wx - (uz * qx - ux * qz)
        W[K + (Q0 + 2) * L + j] = -(ux * qy - uy * qx)
        W[K + O0 * L + j] = W[TMP + 3 * L + j] - (uy * wz - uz * wy)
        W[K + (O0 + 1) * L + j] = W[TMP + 4 * L + j] - (uz * wx - ux * wz)
        W[K + (O0 + 2) * L + j] = W[TMP + 5 * L + j] - (ux * wy - uy * wx)
        ra = W[TMP + 6 * L + j]
        W[K + N0 * L + j] = ra * (wy * qz - wz * qy + c0 * qx + W[HI + j] - W[TMP + 10 * L + j]) - (
            uy * nz - uz * ny
        )
        W[K + (N0 + 1) * L + j] = ra * (wz * qx - wx * qz + c0 * qy + W[HI + L + j] - W[TMP + 11 * L + j]) - (
            uz * nx - ux * nz
        )
        W[K + (N0 + 2) * L + j] = ra * (
            wx * qy - wy * qx + c0 * qz + W[HI + 2 * L + j] - W[TMP + 12 * L + j]
        ) - (ux * ny - uy * nx)
        mx, my, mz_ = W[YS + M0 * L + j], W[YS + (M0 + 1) * L + j], W[TMP + 9 * L + j]
        ri, gyro = W[TMP + 7 * L + j], W[TMP + 8 * L + j]
        W[K + M0 * L + j] = ny - (uy * mz_ - uz * my) + ri * (c0 * wx + W[HI + 3 * L + j]) + wy * gyro
        W[K + (M0 + 1) * L + j] = -nx - (uz * mx - ux * mz_) + ri * (c0 * wy + W[HI + 4 * L + j]) - wx * gyro
        W[OU + j] = qx
        W[OU + L + j] = qy
        W[OU + 2 * L + j] = qz
        W[OU + 3 * L + j] = wx
        W[OU + 4 * L + j] = wy
        W[OU + 5 * L + j] = wz
        W[OU + 6 * L + j] = ux
        W[OU + 7 * L + j] = uy
        W[OU + 8 * L + j] = uz


@njit(cache=True, nogil=True, error_model="numpy")
def _plain_bending_moments(tubes, lanes, W, present, dst):
    """Internal bending moment of each tube, (14), in the frame of tube 1, into rows ``dst``; zero for tubes that have ended."""
    n = len(tubes)
    L = lane_count(lanes)
    trip = lane_trips(n, lanes, W)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes, lanes)
    T = TMP + 13 * L
    for i in range(n):
        D, Ti, EI, BB = dst + 2 * i * L, T + 7 * i * L, PAR + i * L, PAR + (4 * n + i) * L
        GA = YS + (Z0 + 2 * n - 2 + i) * L
        if i >= present:
            for j in range(trip):
                W[D + j] = 0.0
                W[D + L + j] = 0.0
        elif i == 0:
            for j in range(trip):
                W[D + j] = W[EI + j] * (W[TMP + j] - W[Ti + j]) + W[BB + j] * W[TMP + 3 * L + j]
                W[D + L + j] = W[EI + j] * (W[TMP + L + j] - W[Ti + L + j]) + W[BB + j] * W[TMP + 4 * L + j]
        else:
            for j in range(trip):
                g = W[GA + j]
                W[D + j] = W[EI + j] * (W[TMP + j] - W[Ti + j]) + W[BB + j] * (
                    W[TMP + 3 * L + j] + g * W[TMP + L + j]
                )
                W[D + L + j] = W[EI + j] * (W[TMP + L + j] - W[Ti + L + j]) + W[BB + j] * (
                    W[TMP + 4 * L + j] - g * W[TMP + j]
                )


def dispatch(plain, other):
    """A function for kernels: ``plain`` for tube tuples of integers, ``other`` for those of floats. The choice is made when it is compiled."""

    def stub(*args):
        raise NotImplementedError("for compiled code only")

    @overload(stub, strict=False, jit_options={"error_model": "numpy", "nogil": True})
    def choose(*args):
        return (other if isinstance(args[0].dtype, types.Float) else plain).py_func

    return stub


@njit(cache=True, nogil=True, error_model="numpy")
def _plain_derivative_at(tubes, lanes, W, present, ust, u0, c0):
    _body_forces(tubes, lanes, W)
    _plain_derivative(tubes, lanes, W, present, ust, u0, c0)


@njit(cache=True, nogil=True, error_model="numpy")
def _extended_derivative_at(tubes, lanes, W, present, ust, u0, c0):
    _body_forces(tubes, lanes, W)
    extended.derivative(tubes, lanes, W, present, ust, u0, c0)


@njit(cache=True, inline="always")
def _nothing4(tubes, lanes, W, a):
    pass


@njit(cache=True, inline="always")
def _no_motion(tubes, lanes, W, c0, histb, outb):
    pass


@njit(cache=True, inline="always")
def _no_section(tubes, lanes, W, bp_tube, seclen, k):
    pass


@njit(cache=True, inline="always")
def _no_tilt(tubes, lanes, W, c0, i, histb, outb):
    pass


@njit(cache=True, inline="always")
def _one(tubes, lanes, W, j, rate):
    return 1.0


@njit(cache=True, inline="always")
def _rigid_drive(tubes, lanes, W, c0, i, j, torque, angle, rate, histb, outb):
    return angle, rate


@njit(cache=True, inline="always")
def _no_stretch(tubes, lanes, W, i, j, beta, u):
    return 0.0


_curvature = dispatch(_plain_curvature, extended.curvature)
_derivative = dispatch(_plain_derivative_at, _extended_derivative_at)
_bending_moments = dispatch(_plain_bending_moments, extended.bending_moments)
_start_motion = dispatch(_no_motion, extended.start_motion)
_start_section = dispatch(_no_section, extended.start_section)
_move_grid = dispatch(_nothing4, extended.move_grid)
_tip_forces = dispatch(_nothing4, extended.tip_forces)
_coulomb = dispatch(_one, extended.coulomb)
_drive = dispatch(_rigid_drive, extended.drive)
_base_stretch = dispatch(_no_stretch, extended.base_stretch)
_tilt = dispatch(_no_tilt, extended.tilt)


@njit(cache=True, nogil=True, error_model="numpy")
def _tube_friction(tubes, lanes, W, present):
    """Friction between neighbouring tubes at a transition, (22), (23): proportional to the jump of the inner tube's moment."""
    n = len(tubes)
    L = lane_count(lanes)
    trip = lane_trips(n, lanes, W)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes, lanes)
    FR = PAR + (14 * n + 9) * L
    ga = Z0 + 2 * n - 2
    for i in range(n - 1):
        if i < present - 1:
            A, B = MA + 2 * i * L, MB + 2 * i * L
            MZ = Y + (Z0 + i) * L
            G1, G2 = Y + (ga + i) * L, Y + (ga + i + 1) * L
            first = i == 0
            for j in range(trip):
                dx, dy = W[B + j] - W[A + j], W[B + L + j] - W[A + L + j]
                rate = W[G2 + j] if first else W[G2 + j] - W[G1 + j]
                eps = W[FR + 2 * L + j]
                tau = (
                    _coulomb(tubes, lanes, W, j, rate)
                    * W[FR + j]
                    * math.sqrt(dx * dx + dy * dy)
                    * rate
                    / math.sqrt(rate * rate + eps * eps)
                    + W[FR + L + j] * rate
                )
                W[MZ + j] -= tau
                W[MZ + L + j] += tau


@njit(cache=True, nogil=True, error_model="numpy")
def _body(tubes, lanes, W, i, c0):
    """Inertial wrench and weight of the rigid body at the end of tube ``i``, (20), (21), in the frame of tube 1.

    ``TMP`` rows 0-2: m (p_tt - g); rows 3-5: H omega_t + omega x H omega with the tube's own angular velocity. Needs R_1^T g in
    ``TMP`` rows 10-12.
    """
    n = len(tubes)
    L = lane_count(lanes)
    trip = lane_trips(n, lanes, W)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes, lanes)
    MB, HX, HY, HZ = (
        PAR + (7 * n + i) * L,
        PAR + (8 * n + i) * L,
        PAR + (9 * n + i) * L,
        PAR + (10 * n + i) * L,
    )
    TH, GA, HG = Y + (Z0 + n + i - 1) * L, Y + (Z0 + 2 * n - 2 + i) * L, HI + (7 + n + i) * L
    for j in range(trip):
        qx, qy, qz = W[Y + Q0 * L + j], W[Y + (Q0 + 1) * L + j], W[Y + (Q0 + 2) * L + j]
        wx, wy, wz = W[Y + O0 * L + j], W[Y + (O0 + 1) * L + j], W[Y + (O0 + 2) * L + j]
        atx, aty, atz = c0 * wx + W[HI + 3 * L + j], c0 * wy + W[HI + 4 * L + j], c0 * wz + W[HI + 5 * L + j]
        mass = W[MB + j]
        W[TMP + j] = mass * (wy * qz - wz * qy + c0 * qx + W[HI + j] - W[TMP + 10 * L + j])
        W[TMP + L + j] = mass * (wz * qx - wx * qz + c0 * qy + W[HI + L + j] - W[TMP + 11 * L + j])
        W[TMP + 2 * L + j] = mass * (wx * qy - wy * qx + c0 * qz + W[HI + 2 * L + j] - W[TMP + 12 * L + j])
        hx, hy, hz = W[HX + j], W[HY + j], W[HZ + j]
        if i == 0:
            W[TMP + 3 * L + j] = hx * atx + (hz - hy) * wy * wz
            W[TMP + 4 * L + j] = hy * aty + (hx - hz) * wz * wx
            W[TMP + 5 * L + j] = hz * atz + (hy - hx) * wx * wy
        else:
            s, c = sincos(W[TH + j])
            g = W[GA + j]
            ox, oy, oz = c * wx + s * wy, c * wy - s * wx, wz + g
            tx = c * atx + s * aty + g * oy
            ty = c * aty - s * atx - g * ox
            tz = atz + c0 * g + W[HG + j]
            bx = hx * tx + (hz - hy) * oy * oz
            by = hy * ty + (hx - hz) * oz * ox
            W[TMP + 3 * L + j] = c * bx - s * by
            W[TMP + 4 * L + j] = s * bx + c * by
            W[TMP + 5 * L + j] = hz * tz + (hy - hx) * ox * oy


@njit(cache=True, nogil=True, error_model="numpy")
def _below_base(tubes, lanes, W, c0, cells, ust_base, x, histb, outb):
    """Torsion of the straight lengths behind the base plate, (18), and the coupling (19) into the state at s = 0-."""
    n = len(tubes)
    L = lane_count(lanes)
    trip = lane_trips(n, lanes, W)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes, lanes)
    points = 4 * cells + 1
    # state, stage, accumulated increment (psi, psi_t, m_z each), step, compliance: all in the workspace, so that lanes vectorise
    S, A, B = TMP, TMP + 3 * L, TMP + 6 * L
    DS, CO, US = TMP + 9 * L, TMP + 10 * L, TMP + 11 * L
    for i in range(n):
        GJ, RI, BT, KS = (
            PAR + (n + i) * L,
            PAR + (3 * n + i) * L,
            PAR + (5 * n + i) * L,
            PAR + (6 * n + i) * L,
        )
        AL, AV, BE = PAR + (11 * n + i) * L, PAR + (12 * n + i) * L, PAR + (13 * n + i) * L
        for j in range(trip):
            W[S + 2 * L + j] = x[i * L + j]
        for j in range(trip):
            psi, psi_t = _drive(tubes, lanes, W, c0, i, j, x[i * L + j], W[AL + j], W[AV + j], histb, outb)
            W[S + j] = psi
            W[S + L + j] = psi_t
            W[DS + j] = -W[BE + j] / cells
            W[CO + j] = 1.0 / (W[GJ + j] + c0 * W[BT + j])
            W[US + j] = W[GJ + j] * W[KS + j]
        for cell in range(cells):
            for r in range(3 * L):
                W[A + r] = W[S + r]
                W[B + r] = 0.0
            for stage in range(4):
                point = (i * points + 4 * cell + stage) * 2 * L
                at = np.uint64(point)
                uz_ref = ust_base[i * points + 4 * cell + stage]
                weight = 1.0 if stage == 0 or stage == 3 else 2.0
                ahead = 0.5 if stage < 2 else 1.0
                for r in range(2 * L):
                    W[HI + r] = histb[at + np.uint64(r)]
                for j in range(trip):
                    psi_t = W[A + L + j]
                    u = (W[A + 2 * L + j] + W[US + j] * uz_ref - W[BT + j] * W[HI + L + j]) * W[CO + j]
                    kv = c0 * u + W[HI + L + j] + _base_stretch(tubes, lanes, W, i, j, W[BE + j], u)
                    km = 2.0 * W[RI + j] * (c0 * psi_t + W[HI + j])
                    W[OU + j] = psi_t
                    W[OU + L + j] = u
                    h = ahead * W[DS + j]
                    W[B + j] += weight * u
                    W[B + L + j] += weight * kv
                    W[B + 2 * L + j] += weight * km
                    W[A + j] = W[S + j] + h * u
                    W[A + L + j] = W[S + L + j] + h * kv
                    W[A + 2 * L + j] = W[S + 2 * L + j] + h * km
                for r in range(2 * L):
                    outb[at + np.uint64(r)] = W[OU + r]
            for j in range(trip):
                h = W[DS + j] / 6.0
                W[S + j] += h * W[B + j]
                W[S + L + j] += h * W[B + L + j]
                W[S + 2 * L + j] += h * W[B + 2 * L + j]
        end = (i * points + 4 * cells) * 2 * L
        for j in range(trip):
            gj, bt = W[GJ + j], W[BT + j]
            outb[end + j] = W[S + L + j]
            outb[end + L + j] = (
                W[S + 2 * L + j] + gj * W[KS + j] * ust_base[i * points + 4 * cells] - bt * histb[end + L + j]
            ) / (gj + c0 * bt)
            W[Y + (Z0 + i) * L + j] = W[S + 2 * L + j]
        if i == 0:
            for j in range(trip):
                half = 0.5 * W[S + j]
                s, c = sincos(half)
                W[Y + H0 * L + j] = c
                W[Y + (H0 + 1) * L + j] = 0.0
                W[Y + (H0 + 2) * L + j] = 0.0
                W[Y + (H0 + 3) * L + j] = s
                W[Y + (O0 + 2) * L + j] = W[S + L + j]
                W[Y + M0 * L + j] = W[S + j]  # psi_1, held here until the other tubes have used it
        else:
            for j in range(trip):
                W[Y + (Z0 + n + i - 1) * L + j] = W[S + j] - W[Y + M0 * L + j]
                W[Y + (Z0 + 2 * n + i - 2) * L + j] = W[S + L + j] - W[Y + (O0 + 2) * L + j]
    for j in range(trip):
        for r in range(3):
            W[Y + (P0 + r) * L + j] = 0.0
            W[Y + (Q0 + r) * L + j] = 0.0
            W[Y + (N0 + r) * L + j] = x[(n + r) * L + j]
        W[Y + O0 * L + j] = 0.0
        W[Y + (O0 + 1) * L + j] = 0.0
        W[Y + M0 * L + j] = x[(n + 3) * L + j]
        W[Y + (M0 + 1) * L + j] = x[(n + 4) * L + j]


@njit(cache=True, nogil=True, error_model="numpy")
def _base_plate(tubes, lanes, W, ust0):
    """Near side of s = 0: moments of precurved lengths held straight into ``MA``, and the friction of the plate on the outermost tube, (24)."""
    n = len(tubes)
    L = lane_count(lanes)
    trip = lane_trips(n, lanes, W)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes, lanes)
    FR = PAR + (14 * n + 9) * L
    for i in range(n):
        EI, KS, A = PAR + i * L, PAR + (6 * n + i) * L, MA + 2 * i * L
        vx, vy = ust0[3 * i], ust0[3 * i + 1]
        for j in range(trip):
            s, c = 0.0, 1.0
            if i > 0:
                s, c = sincos(W[Y + (Z0 + n + i - 1) * L + j])
            W[A + j] = -W[EI + j] * W[KS + j] * (c * vx - s * vy)
            W[A + L + j] = -W[EI + j] * W[KS + j] * (s * vx + c * vy)
    for j in range(trip):
        rate = W[Y + (O0 + 2) * L + j]
        if n > 1:
            rate += W[Y + (Z0 + 3 * n - 3) * L + j]
        mx, my = W[Y + M0 * L + j], W[Y + (M0 + 1) * L + j]
        eps = W[FR + 2 * L + j]
        W[Y + (Z0 + n - 1) * L + j] += (
            _coulomb(tubes, lanes, W, j, rate)
            * W[FR + 3 * L + j]
            * math.sqrt(mx * mx + my * my)
            * rate
            / math.sqrt(rate * rate + eps * eps)
            + W[FR + 4 * L + j] * rate
        )


@njit(cache=True, inline="always")
def _load_history(tubes, lanes, W, hist, point, shared):
    """History parts of ``point`` into ``HI``, from rows of as many lanes or, if ``shared``, of one."""
    n = len(tubes)
    L = lane_count(lanes)
    F = field_rows(n)
    HI = offsets(tubes, lanes)[4]
    if shared:
        trip = lane_trips(n, lanes, W)
        at = np.uint64(point * F)
        for row in range(F):
            value = hist[at + np.uint64(row)]
            for j in range(trip):
                W[HI + row * L + j] = value
    else:
        at = np.uint64(point * F * L)
        for r in range(F * L):
            W[HI + r] = hist[at + np.uint64(r)]


@njit(cache=True, nogil=True, error_model="numpy")
def sweep(
    tubes,
    lanes,
    W,
    c0,
    mesh,
    par,
    seclen,
    x,
    hist,
    histb,
    out,
    outb,
    nodes,
    res,
):
    """Integrate (18), (19), (13), (20)-(24) from the actuators to the tip with the unknowns ``x``, and return the tip's imbalance.

    Shapes, all flat with the lane as last index: ``par`` (NP, L); ``seclen`` (sections, L) m; ``x`` (5 + N, L): base torques of the
    tubes, n and m_xy at s = 0+; ``hist``, ``out`` (points, F, L): history parts and fields at every Runge-Kutta stage of every cell
    and at section ends; ``histb``, ``outb`` (N, base points, 2, L); ``nodes`` (cells + sections, S, L): the state at the nodes;
    ``res`` (5 + N, L): imbalance of force (3), moment m_xy (2) and m_z of every tube's end. c0 = 0 with zero history is the static model.
    With several lanes ``hist`` may be (points, F), which all share, and ``out`` with ``nodes`` may be empty: then neither is written.
    """
    n = len(tubes)
    L = lane_count(lanes)
    trip = lane_trips(n, lanes, W)
    S = state_rows(n)
    F = field_rows(n)
    NP = parameter_rows(n)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes, lanes)
    kept = L == 1 or len(out) > 0
    shared = L > 1 and len(hist) == len(mesh.ust) // (3 * n) * F
    for r in range(NP * L):
        W[PAR + r] = par[r]
    sec_cells, sec_tubes, ust = mesh.sec_cells, mesh.sec_tubes, mesh.ust
    _start_motion(tubes, lanes, W, c0, histb, outb)
    _below_base(tubes, lanes, W, c0, mesh.base_cells, mesh.ust_base, x, histb, outb)
    _base_plate(tubes, lanes, W, mesh.ust0)

    point = 0
    node = 0
    before = n
    for k in range(len(sec_cells)):
        present = sec_tubes[k]
        # transition into this section: friction from the jump of the inner tubes' moments
        _start_section(tubes, lanes, W, mesh.bp_tube, seclen, k)
        _load_history(tubes, lanes, W, hist, point, shared)
        for r in range(S * L):
            W[YS + r] = W[Y + r]
        _curvature(tubes, lanes, W, present, ust, point * 3 * n, c0)
        _bending_moments(tubes, lanes, W, present, MB)
        _tube_friction(tubes, lanes, W, before)
        if (
            before > present
        ):  # tube `present` ended here: its own balance about its axis; its m_z holds the body's part already
            for j in range(trip):
                res[(5 + present) * L + j] = -W[Y + (Z0 + present) * L + j]
                W[Y + (Z0 + present) * L + j] = 0.0
        cells = sec_cells[k]
        for j in range(trip):
            W[MA + j] = seclen[k * L + j] / cells  # MA is free until the section's end
        for cell in range(cells):
            if kept:
                here = np.uint64(node * S * L)
                for r in range(S * L):
                    nodes[here + np.uint64(r)] = W[Y + r]
            for r in range(S * L):
                W[YS + r] = W[Y + r]
                W[ACC + r] = 0.0
            node += 1
            for stage in range(4):
                _load_history(tubes, lanes, W, hist, point, shared)
                _move_grid(
                    tubes, lanes, W, (cell + (0.0 if stage == 0 else 1.0 if stage == 3 else 0.5)) / cells
                )
                _derivative(tubes, lanes, W, present, ust, point * 3 * n, c0)
                if kept:
                    at = np.uint64(point * F * L)
                    for r in range(F * L):
                        out[at + np.uint64(r)] = W[OU + r]
                point += 1
                weight = 1.0 if stage == 0 or stage == 3 else 2.0
                ahead = 0.5 if stage < 2 else 1.0
                for row in range(S):
                    for j in range(trip):
                        r = row * L + j
                        W[ACC + r] += weight * W[K + r]
                        W[YS + r] = W[Y + r] + ahead * W[MA + j] * W[K + r]
            for row in range(S):
                for j in range(trip):
                    r = row * L + j
                    W[Y + r] += W[MA + j] / 6.0 * W[ACC + r]
        # end of the section: fields, moments on the near side, body of the tube that ends
        _load_history(tubes, lanes, W, hist, point, shared)
        if kept:
            here = np.uint64(node * S * L)
            for r in range(S * L):
                nodes[here + np.uint64(r)] = W[Y + r]
        for r in range(S * L):
            W[YS + r] = W[Y + r]
        node += 1
        _move_grid(tubes, lanes, W, 1.0)
        _derivative(tubes, lanes, W, present, ust, point * 3 * n, c0)
        if kept:
            at = np.uint64(point * F * L)
            for r in range(F * L):
                out[at + np.uint64(r)] = W[OU + r]
        point += 1
        _bending_moments(tubes, lanes, W, present, MA)
        before = present
        after = sec_tubes[k + 1] if k + 1 < len(sec_cells) else 0
        if after < present:
            i = present - 1
            _body(tubes, lanes, W, i, c0)
            if i > 0:
                for j in range(trip):
                    W[Y + N0 * L + j] += W[TMP + j]
                    W[Y + (N0 + 1) * L + j] += W[TMP + L + j]
                    W[Y + (N0 + 2) * L + j] += W[TMP + 2 * L + j]
                    W[Y + M0 * L + j] += W[TMP + 3 * L + j]
                    W[Y + (M0 + 1) * L + j] += W[TMP + 4 * L + j]
                    W[Y + (Z0 + i) * L + j] += W[TMP + 5 * L + j]
                _tilt(tubes, lanes, W, c0, i, histb, outb)
    # tip of tube 1: external wrench (base axes) against the internal one and the body, (21)
    FT = PAR + (14 * n + 3) * L
    FE = TMP + 6 * L  # the force on the tip
    for r in range(3 * L):
        W[FE + r] = W[FT + r]
    _tip_forces(tubes, lanes, W, FE)
    for j in range(trip):
        a, b_, c, d = (
            W[Y + H0 * L + j],
            W[Y + (H0 + 1) * L + j],
            W[Y + (H0 + 2) * L + j],
            W[Y + (H0 + 3) * L + j],
        )
        k2 = 2.0 / (a * a + b_ * b_ + c * c + d * d)
        r00, r01, r02 = 1.0 - k2 * (c * c + d * d), k2 * (b_ * c - a * d), k2 * (b_ * d + a * c)
        r10, r11, r12 = k2 * (b_ * c + a * d), 1.0 - k2 * (b_ * b_ + d * d), k2 * (c * d - a * b_)
        r20, r21, r22 = k2 * (b_ * d - a * c), k2 * (c * d + a * b_), 1.0 - k2 * (b_ * b_ + c * c)
        fx, fy, fz = W[FE + j], W[FE + L + j], W[FE + 2 * L + j]
        tx, ty, tz = W[FT + 3 * L + j], W[FT + 4 * L + j], W[FT + 5 * L + j]
        res[j] = r00 * fx + r10 * fy + r20 * fz - W[Y + N0 * L + j] - W[TMP + j]
        res[L + j] = r01 * fx + r11 * fy + r21 * fz - W[Y + (N0 + 1) * L + j] - W[TMP + L + j]
        res[2 * L + j] = r02 * fx + r12 * fy + r22 * fz - W[Y + (N0 + 2) * L + j] - W[TMP + 2 * L + j]
        res[3 * L + j] = r00 * tx + r10 * ty + r20 * tz - W[Y + M0 * L + j] - W[TMP + 3 * L + j]
        res[4 * L + j] = r01 * tx + r11 * ty + r21 * tz - W[Y + (M0 + 1) * L + j] - W[TMP + 4 * L + j]
        res[5 * L + j] = r02 * tx + r12 * ty + r22 * tz - W[Y + Z0 * L + j] - W[TMP + 5 * L + j]
