"""Arc-length kernels of the dynamic model: one sweep from the actuators to the tip, for many lanes at once.

Numbers live in the workspace of :mod:`ctr_dynamics.kernels.workspace`. A robot whose file names extensions that change the physics runs the
same sweep with the functions of :mod:`ctr_dynamics.kernels.extended_rod` in their places (:func:`dispatch`).

Kernels are written for one number, which may stand for several lanes (:mod:`ctr_dynamics.kernels.lanes`). Arrays come as views: a compiled
function that passes an array on counts references to it, and those counts, atomic as they are, cost as much as the arithmetic.
"""

import math

from numba import types
from numba.extending import overload

from ctr_dynamics.kernels import extended_rod as extended
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.lanes import PACK, fma, local_copy, rows, sincos
from ctr_dynamics.kernels.workspace import (
    H0,
    M0,
    N0,
    O0,
    P0,
    Q0,
    Z0,
    field_rows,
    lane_count,
    offsets,
    parameter_rows,
    state_rows,
)


@njit(cache=True, forceinline=True, error_model="numpy")
def _plain_curvature(tubes, W, present, ust, u0, c0):
    """Strains from moments: (16), (17) with the damping history of every tube taken exactly (docs/model.md).

    Reads the state rows at ``YS`` and the history rows at ``HI``; writes to ``TMP``: u_1 (3), its time derivative (3), and from row 13 on per tube
    the moment of its precurvature and damping history, E I R_z(theta_i) u*_i - B h_u (2), u_z, its time derivative, and B gamma.
    """
    n = len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    mz, th, ga = Z0, Z0 + n, Z0 + 2 * n - 1
    for i in range(n):
        if i < present:
            T = TMP + 13 + 7 * i
            EI, GJ, BB, BT, KS = PAR + i, PAR + n + i, PAR + 4 * n + i, PAR + 5 * n + i, PAR + 6 * n + i
            # what only depends on parameters stands in brackets: the compiler takes it out of the loop over the points
            wx, wy = (W[EI] * W[KS]) * ust[u0 + 3 * i], (W[EI] * W[KS]) * ust[u0 + 3 * i + 1]
            if i > 0:
                s, c = sincos(W[YS + th + i - 1])
                wx, wy = c * wx - s * wy, s * wx + c * wy
            rx, ry = wx - W[BB] * W[HI + 6], wy - W[BB] * W[HI + 7]
            a = W[EI] + c0 * W[BB]
            uz = (W[YS + mz + i] + (W[GJ] * W[KS]) * ust[u0 + 3 * i + 2] - W[BT] * W[HI + 8 + i]) * (
                1.0 / (W[GJ] + c0 * W[BT])
            )
            W[T], W[T + 1], W[T + 2], W[T + 3] = rx, ry, uz, c0 * uz + W[HI + 8 + i]
            if i == 0:
                W[TMP + 2], W[TMP + 5] = uz, W[T + 3]
                W[TMP + 6], W[TMP + 7] = a, 0.0
                W[TMP + 8], W[TMP + 9] = W[YS + M0] + rx, W[YS + M0 + 1] + ry
            else:
                b = W[BB] * W[YS + ga + i - 1]
                W[T + 4] = b
                W[TMP + 6] += a
                W[TMP + 7] += b
                W[TMP + 8] += rx
                W[TMP + 9] += ry
    a, b, rx, ry = W[TMP + 6], W[TMP + 7], W[TMP + 8], W[TMP + 9]
    d = 1.0 / (a * a + b * b)
    ux, uy = (a * rx - b * ry) * d, (a * ry + b * rx) * d
    W[TMP], W[TMP + 1] = ux, uy
    W[TMP + 3], W[TMP + 4] = c0 * ux + W[HI + 6], c0 * uy + W[HI + 7]


@njit(cache=True, forceinline=True, error_model="numpy")
def _body_forces(tubes, W):
    """Gravity in the frame of tube 1, R_1^T g, into ``TMP`` rows 10-12 (non-unit quaternion, normalised when read)."""
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    G = PAR + 14 * len(tubes)
    a, b, c, d = W[YS + H0], W[YS + H0 + 1], W[YS + H0 + 2], W[YS + H0 + 3]
    k = 2.0 / (a * a + b * b + c * c + d * d)
    gx, gy, gz = W[G], W[G + 1], W[G + 2]
    W[TMP + 10] = gx - k * ((c * c + d * d) * gx - (b * c + a * d) * gy - (b * d - a * c) * gz)
    W[TMP + 11] = gy - k * ((b * b + d * d) * gy - (b * c - a * d) * gx - (c * d + a * b) * gz)
    W[TMP + 12] = gz - k * ((b * b + c * c) * gz - (b * d + a * c) * gx - (c * d - a * b) * gy)


@njit(cache=True, forceinline=True, error_model="numpy")
def _plain_derivative(tubes, W, present, ust, u0, c0):
    """Arc-length derivative of the state, (13), and the fields at this point (``OU``)."""
    n = len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    mz, th, ga = Z0, Z0 + n, Z0 + 2 * n - 1
    _plain_curvature(tubes, W, present, ust, u0, c0)
    ux, uy, uz = W[TMP], W[TMP + 1], W[TMP + 2]
    # torsion of every tube, and the sums over the tubes: rho A, rho I, rho I omega_z + 2 rho I gamma, m_z
    wz = W[YS + O0 + 2]
    wz_t = c0 * wz + W[HI + 5]
    for i in range(n):
        T, RA, RI = TMP + 13 + 7 * i, PAR + 2 * n + i, PAR + 3 * n + i
        KM, KT, KG = K + mz + i, K + th + i - 1, K + ga + i - 1
        OUu, OUg = OU + 8 + i, OU + 7 + n + i
        if i < present:
            turn = ux * W[T + 1] - uy * W[T]
            if i == 0:
                W[KM] = turn + (2.0 * W[RI]) * wz_t
                W[TMP + 6], W[TMP + 7] = W[RA], W[RI]
                W[TMP + 8], W[TMP + 9] = W[RI] * wz, W[YS + mz]
            else:
                g = W[YS + ga + i - 1]
                g_t = c0 * g + W[HI + 7 + n + i]
                W[KM] = turn + W[T + 4] * (ux * ux + uy * uy) + (2.0 * W[RI]) * (wz_t + g_t)
                W[KT], W[KG] = W[T + 2] - uz, W[T + 3] - W[TMP + 5]
                W[OUu], W[OUg] = W[T + 2], g
                W[TMP + 6] += W[RA]
                W[TMP + 7] += W[RI]
                W[TMP + 8] += W[RI] * (wz + 2.0 * g)
                W[TMP + 9] += W[YS + mz + i]
        else:
            W[KM], W[KT], W[KG] = 0.0, 0.0, 0.0
            W[OUu], W[OUg] = 0.0, 0.0
    # kinematics
    a, b, c, d = W[YS + H0], W[YS + H0 + 1], W[YS + H0 + 2], W[YS + H0 + 3]
    k = 2.0 / (a * a + b * b + c * c + d * d)
    W[K + P0], W[K + P0 + 1], W[K + P0 + 2] = (
        k * (b * d + a * c),
        k * (c * d - a * b),
        1.0 - k * (b * b + c * c),
    )
    hx, hy, hz = 0.5 * ux, 0.5 * uy, 0.5 * uz
    W[K + H0] = -(hx * b + hy * c + hz * d)
    W[K + H0 + 1] = hx * a + hz * c - hy * d
    W[K + H0 + 2] = hy * a - hz * b + hx * d
    W[K + H0 + 3] = hz * a + hy * b - hx * c
    # velocities and balance of forces and moments
    ux, uy, uz = W[TMP], W[TMP + 1], W[TMP + 2]
    qx, qy, qz = W[YS + Q0], W[YS + (Q0 + 1)], W[YS + (Q0 + 2)]
    wx, wy, wz = W[YS + O0], W[YS + (O0 + 1)], W[YS + (O0 + 2)]
    nx, ny, nz = W[YS + N0], W[YS + (N0 + 1)], W[YS + (N0 + 2)]
    W[K + Q0] = wy - (uy * qz - uz * qy)
    W[K + (Q0 + 1)] = -wx - (uz * qx - ux * qz)
    W[K + (Q0 + 2)] = -(ux * qy - uy * qx)
    W[K + O0] = W[TMP + 3] - (uy * wz - uz * wy)
    W[K + (O0 + 1)] = W[TMP + 4] - (uz * wx - ux * wz)
    W[K + (O0 + 2)] = W[TMP + 5] - (ux * wy - uy * wx)
    ra = W[TMP + 6]
    W[K + N0] = ra * (wy * qz - wz * qy + c0 * qx + W[HI] - W[TMP + 10]) - (uy * nz - uz * ny)
    W[K + (N0 + 1)] = ra * (wz * qx - wx * qz + c0 * qy + W[HI + 1] - W[TMP + 11]) - (uz * nx - ux * nz)
    W[K + (N0 + 2)] = ra * (wx * qy - wy * qx + c0 * qz + W[HI + 2] - W[TMP + 12]) - (ux * ny - uy * nx)
    mx, my, mz_ = W[YS + M0], W[YS + (M0 + 1)], W[TMP + 9]
    ri, gyro = W[TMP + 7], W[TMP + 8]
    W[K + M0] = ny - (uy * mz_ - uz * my) + ri * (c0 * wx + W[HI + 3]) + wy * gyro
    W[K + (M0 + 1)] = -nx - (uz * mx - ux * mz_) + ri * (c0 * wy + W[HI + 4]) - wx * gyro
    W[OU] = qx
    W[OU + 1] = qy
    W[OU + 2] = qz
    W[OU + 3] = wx
    W[OU + 4] = wy
    W[OU + 5] = wz
    W[OU + 6] = ux
    W[OU + 7] = uy
    W[OU + 8] = uz


@njit(cache=True, forceinline=True, error_model="numpy")
def _plain_bending_moments(tubes, W, present, dst):
    """Internal bending moment of each tube, (14), in the frame of tube 1, into rows ``dst``; zero for tubes that have ended."""
    n = len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    ux, uy = W[TMP], W[TMP + 1]
    cx, cy = (
        W[TMP + 3] - W[HI + 6],
        W[TMP + 4] - W[HI + 7],
    )  # c0 u: the damping history is in the rows of the tube
    for i in range(n):
        D, T, EI, BB = dst + 2 * i, TMP + 13 + 7 * i, PAR + i, PAR + 4 * n + i
        if i < present:
            W[D], W[D + 1] = W[EI] * ux + W[BB] * cx - W[T], W[EI] * uy + W[BB] * cy - W[T + 1]
            if i > 0:
                W[D] += W[T + 4] * uy
                W[D + 1] -= W[T + 4] * ux
        else:
            W[D], W[D + 1] = 0.0, 0.0


def dispatch(plain, other):
    """A function for kernels: ``plain`` for tube tuples of integers, ``other`` for those of floats. The choice is made when it is compiled."""

    def stub(*args):
        raise NotImplementedError("for compiled code only")

    @overload(stub, strict=False, jit_options={"error_model": "numpy", "forceinline": True})
    def choose(*args):
        return (other if isinstance(args[0].dtype, types.Float) else plain).py_func

    return stub


@njit(cache=True, forceinline=True, error_model="numpy")
def _plain_derivative_at(tubes, W, present, ust, u0, c0):
    _body_forces(tubes, W)
    _plain_derivative(tubes, W, present, ust, u0, c0)


@njit(cache=True, forceinline=True, error_model="numpy")
def _extended_derivative_at(tubes, W, present, ust, u0, c0):
    _body_forces(tubes, W)
    extended.derivative(tubes, W, present, ust, u0, c0)


@njit(cache=True, forceinline=True)
def _nothing4(tubes, W, a):
    pass


@njit(cache=True, forceinline=True)
def _no_motion(tubes, W, c0, histb, outb):
    pass


@njit(cache=True, forceinline=True)
def _no_section(tubes, W, bp_tube, seclen, k):
    pass


@njit(cache=True, forceinline=True)
def _no_tilt(tubes, W, c0, i, histb, outb):
    pass


@njit(cache=True, forceinline=True)
def _one(tubes, W, rate):
    return 1.0


@njit(cache=True, forceinline=True)
def _rigid_drive(tubes, W, c0, i, torque, angle, rate, histb, outb):
    return angle, rate


@njit(cache=True, forceinline=True)
def _no_stretch(tubes, W, i, beta, u):
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


@njit(cache=True, forceinline=True, error_model="numpy")
def _tube_friction(tubes, W, present):
    """Friction between neighbouring tubes at a transition, (22), (23): proportional to the jump of the inner tube's moment."""
    n = len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    FR = PAR + (14 * n + 9)
    ga = Z0 + 2 * n - 2
    for i in range(n - 1):
        if i < present - 1:
            A, B = MA + 2 * i, MB + 2 * i
            MZ = Y + (Z0 + i)
            G1, G2 = Y + (ga + i), Y + (ga + i + 1)
            first = i == 0
            dx, dy = W[B] - W[A], W[B + 1] - W[A + 1]
            rate = W[G2] if first else W[G2] - W[G1]
            eps = W[FR + 2]
            tau = (
                _coulomb(tubes, W, rate)
                * W[FR]
                * math.sqrt(dx * dx + dy * dy)
                * rate
                / math.sqrt(rate * rate + eps * eps)
                + W[FR + 1] * rate
            )
            W[MZ] -= tau
            W[MZ + 1] += tau


@njit(cache=True, nogil=True, error_model="numpy")
def _body(tubes, W, i, c0):
    """Inertial wrench and weight of the rigid body at the end of tube ``i``, (20), (21), in the frame of tube 1.

    ``TMP`` rows 0-2: m (p_tt - g); rows 3-5: H omega_t + omega x H omega with the tube's own angular velocity. Needs R_1^T g in
    ``TMP`` rows 10-12.
    """
    n = len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    MB, HX, HY, HZ = (
        PAR + (7 * n + i),
        PAR + (8 * n + i),
        PAR + (9 * n + i),
        PAR + (10 * n + i),
    )
    TH, GA, HG = Y + (Z0 + n + i - 1), Y + (Z0 + 2 * n - 2 + i), HI + (7 + n + i)
    qx, qy, qz = W[Y + Q0], W[Y + (Q0 + 1)], W[Y + (Q0 + 2)]
    wx, wy, wz = W[Y + O0], W[Y + (O0 + 1)], W[Y + (O0 + 2)]
    atx, aty, atz = c0 * wx + W[HI + 3], c0 * wy + W[HI + 4], c0 * wz + W[HI + 5]
    mass = W[MB]
    W[TMP] = mass * (wy * qz - wz * qy + c0 * qx + W[HI] - W[TMP + 10])
    W[TMP + 1] = mass * (wz * qx - wx * qz + c0 * qy + W[HI + 1] - W[TMP + 11])
    W[TMP + 2] = mass * (wx * qy - wy * qx + c0 * qz + W[HI + 2] - W[TMP + 12])
    hx, hy, hz = W[HX], W[HY], W[HZ]
    if i == 0:
        W[TMP + 3] = hx * atx + (hz - hy) * wy * wz
        W[TMP + 4] = hy * aty + (hx - hz) * wz * wx
        W[TMP + 5] = hz * atz + (hy - hx) * wx * wy
    else:
        s, c = sincos(W[TH])
        g = W[GA]
        ox, oy, oz = c * wx + s * wy, c * wy - s * wx, wz + g
        tx = c * atx + s * aty + g * oy
        ty = c * aty - s * atx - g * ox
        tz = atz + c0 * g + W[HG]
        bx = hx * tx + (hz - hy) * oy * oz
        by = hy * ty + (hx - hz) * oz * ox
        W[TMP + 3] = c * bx - s * by
        W[TMP + 4] = s * bx + c * by
        W[TMP + 5] = hz * tz + (hy - hx) * ox * oy


@njit(cache=True, nogil=True, error_model="numpy")
def _below_base(tubes, W, c0, cells, ust_base, x, histb, outb):
    """Torsion of the straight lengths behind the base plate, (18), and the coupling (19) into the state at s = 0-."""
    n = len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    points = 4 * cells + 1
    # state, stage, accumulated increment (psi, psi_t, m_z each), step, compliance
    S, A, B = TMP, TMP + 3, TMP + 6
    DS, CO, US = TMP + 9, TMP + 10, TMP + 11
    for i in range(n):
        GJ, RI, BT, KS = (
            PAR + (n + i),
            PAR + (3 * n + i),
            PAR + (5 * n + i),
            PAR + (6 * n + i),
        )
        AL, AV, BE = PAR + (11 * n + i), PAR + (12 * n + i), PAR + (13 * n + i)
        W[S + 2] = x[i]
        psi, psi_t = _drive(tubes, W, c0, i, x[i], W[AL], W[AV], histb, outb)
        W[S] = psi
        W[S + 1] = psi_t
        W[DS] = -W[BE] / cells
        W[CO] = 1.0 / (W[GJ] + c0 * W[BT])
        W[US] = W[GJ] * W[KS]
        for cell in range(cells):
            for r in range(3):
                W[A + r] = W[S + r]
                W[B + r] = 0.0
            for stage in range(4):
                at = (i * points + 4 * cell + stage) * 2
                uz_ref = ust_base[i * points + 4 * cell + stage]
                weight = 1.0 if stage == 0 or stage == 3 else 2.0
                ahead = 0.5 if stage < 2 else 1.0
                W[HI] = histb[at]
                W[HI + 1] = histb[at + 1]
                psi_t = W[A + 1]
                u = (W[A + 2] + W[US] * uz_ref - W[BT] * W[HI + 1]) * W[CO]
                kv = c0 * u + W[HI + 1] + _base_stretch(tubes, W, i, W[BE], u)
                km = 2.0 * W[RI] * (c0 * psi_t + W[HI])
                W[OU] = psi_t
                W[OU + 1] = u
                h = ahead * W[DS]
                W[B] += weight * u
                W[B + 1] += weight * kv
                W[B + 2] += weight * km
                W[A] = W[S] + h * u
                W[A + 1] = W[S + 1] + h * kv
                W[A + 2] = W[S + 2] + h * km
                outb[at] = W[OU]
                outb[at + 1] = W[OU + 1]
            h = W[DS] / 6.0
            W[S] += h * W[B]
            W[S + 1] += h * W[B + 1]
            W[S + 2] += h * W[B + 2]
        end = (i * points + 4 * cells) * 2
        gj, bt = W[GJ], W[BT]
        outb[end] = W[S + 1]
        outb[end + 1] = (W[S + 2] + gj * W[KS] * ust_base[i * points + 4 * cells] - bt * histb[end + 1]) / (
            gj + c0 * bt
        )
        W[Y + (Z0 + i)] = W[S + 2]
        if i == 0:
            half = 0.5 * W[S]
            s, c = sincos(half)
            W[Y + H0] = c
            W[Y + (H0 + 1)] = 0.0
            W[Y + (H0 + 2)] = 0.0
            W[Y + (H0 + 3)] = s
            W[Y + (O0 + 2)] = W[S + 1]
            W[Y + M0] = W[S]  # psi_1, held here until the other tubes have used it
        else:
            W[Y + (Z0 + n + i - 1)] = W[S] - W[Y + M0]
            W[Y + (Z0 + 2 * n + i - 2)] = W[S + 1] - W[Y + (O0 + 2)]
    for r in range(3):
        W[Y + (P0 + r)] = 0.0
        W[Y + (Q0 + r)] = 0.0
        W[Y + (N0 + r)] = x[(n + r)]
    W[Y + O0] = 0.0
    W[Y + (O0 + 1)] = 0.0
    W[Y + M0] = x[(n + 3)]
    W[Y + (M0 + 1)] = x[(n + 4)]


@njit(cache=True, nogil=True, error_model="numpy")
def _base_plate(tubes, W, ust0):
    """Near side of s = 0: moments of precurved lengths held straight into ``MA``, and the friction of the plate on the outermost tube, (24)."""
    n = len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    FR = PAR + (14 * n + 9)
    for i in range(n):
        EI, KS, A = PAR + i, PAR + (6 * n + i), MA + 2 * i
        vx, vy = ust0[3 * i], ust0[3 * i + 1]
        s, c = 0.0, 1.0
        if i > 0:
            s, c = sincos(W[Y + (Z0 + n + i - 1)])
        W[A] = -W[EI] * W[KS] * (c * vx - s * vy)
        W[A + 1] = -W[EI] * W[KS] * (s * vx + c * vy)
    rate = W[Y + (O0 + 2)]
    if n > 1:
        rate += W[Y + (Z0 + 3 * n - 3)]
    mx, my = W[Y + M0], W[Y + (M0 + 1)]
    eps = W[FR + 2]
    W[Y + (Z0 + n - 1)] += (
        _coulomb(tubes, W, rate)
        * W[FR + 3]
        * math.sqrt(mx * mx + my * my)
        * rate
        / math.sqrt(rate * rate + eps * eps)
        + W[FR + 4] * rate
    )


@njit(cache=True, forceinline=True)
def _load_history(tubes, W, hist, shared, own, point):
    """History parts of ``point`` into ``HI``: those of every lane or, if ``own`` is False, those that all lanes share."""
    F = field_rows(len(tubes))
    HI = offsets(tubes)[4]
    if own:
        for r in range(F):
            W[HI + r] = hist[point * F + r]
    else:
        for r in range(F):
            W[HI + r] = shared[point * F + r]


@njit(cache=True, forceinline=True, error_model="numpy")
def _cells(tubes, V, present, cells, h, point, node, ust, c0, hist, shared, own, out, nodes, kept):
    """Runge-Kutta steps of length ``h`` through the ``cells`` of a section, from and to the state in ``Y``. ``kept``: whether the fields, and
    whether the states at the nodes."""
    S, F, n = state_rows(len(tubes)), field_rows(len(tubes)), len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    fields_kept, nodes_kept = kept
    for cell in range(cells):
        for r in range(S):
            if nodes_kept:
                nodes[(node + cell) * S + r] = V[Y + r]
            V[YS + r] = V[Y + r]
            V[ACC + r] = 0.0
        for stage in range(4):
            _load_history(tubes, V, hist, shared, own, point)
            _move_grid(tubes, V, (cell + (0.0 if stage == 0 else 1.0 if stage == 3 else 0.5)) / cells)
            _derivative(tubes, V, present, ust, point * 3 * n, c0)
            if fields_kept:
                for r in range(F):
                    out[point * F + r] = V[OU + r]
            point += 1
            weight = 1.0 if stage == 0 or stage == 3 else 2.0
            ahead = (0.5 if stage < 2 else 1.0) * h
            for r in range(S):
                V[ACC + r] = fma(V[K + r], weight, V[ACC + r])
                if stage < 3:
                    V[YS + r] = fma(V[K + r], ahead, V[Y + r])
        for r in range(S):
            V[Y + r] = fma(V[ACC + r], h * (1.0 / 6.0), V[Y + r])


@njit(cache=True, nogil=True, error_model="numpy")
def _section(
    tubes, W, before, present, cells, length, point, node, ust, c0, hist, shared, own, out, nodes, kept, res
):
    """From the state in ``Y`` at the near side of a section's start, where ``before`` tubes lie, to its end: friction from the jump of the inner
    tubes' moments, Runge-Kutta steps through its ``cells``, and at the end fields, moments on the near side (``MA``) and R_1^T g."""
    S, F, n = state_rows(len(tubes)), field_rows(len(tubes)), len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    V = local_copy(tubes, W)  # nothing else points to it
    fields_kept, nodes_kept = kept
    _load_history(tubes, V, hist, shared, own, point)
    for r in range(S):
        V[YS + r] = V[Y + r]
    _curvature(tubes, V, present, ust, point * 3 * n, c0)
    _bending_moments(tubes, V, present, MB)
    _tube_friction(tubes, V, before)
    for i in range(1, n):
        # a tube that ended here has its own balance about its axis; its m_z holds the body's part already
        if i >= present and i < before:
            res[5 + i] = -V[Y + (Z0 + i)]
            V[Y + (Z0 + i)] = 0.0
    _cells(
        tubes, V, present, cells, length / cells, point, node, ust, c0, hist, shared, own, out, nodes, kept
    )
    point += 4 * cells
    _load_history(tubes, V, hist, shared, own, point)
    for r in range(S):
        if nodes_kept:
            nodes[(node + cells) * S + r] = V[Y + r]
        V[YS + r] = V[Y + r]
    _move_grid(tubes, V, 1.0)
    _derivative(tubes, V, present, ust, point * 3 * n, c0)
    if fields_kept:
        for r in range(F):
            out[point * F + r] = V[OU + r]
    _bending_moments(tubes, V, present, MA)
    for r in range(S):
        W[Y + r] = V[Y + r]
    for r in range(F):
        W[HI + r] = V[HI + r]
    for r in range(2 * n):
        W[MA + r] = V[MA + r]
    for r in range(10, 13):
        W[TMP + r] = V[TMP + r]


@njit(cache=True, nogil=True, error_model="numpy")
def _sweep(tubes, W, c0, mesh, par, seclen, x, hist, shared, own, histb, out, outb, nodes, kept, res):
    """:func:`sweep` for the lanes of one block, from views of the arrays."""
    n = len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    for r in range(parameter_rows(n)):
        W[PAR + r] = par[r]
    sec_cells, sec_tubes, ust = mesh.sec_cells, mesh.sec_tubes, rows((), mesh.ust, 0, 1)
    _start_motion(tubes, W, c0, histb, outb)
    _below_base(tubes, W, c0, mesh.base_cells, rows((), mesh.ust_base, 0, 1), x, histb, outb)
    _base_plate(tubes, W, rows((), mesh.ust0, 0, 1))

    point = 0
    node = 0
    before = n
    for k in range(len(sec_cells)):
        present = sec_tubes[k]
        _start_section(tubes, W, mesh.bp_tube, seclen, k)
        cells = sec_cells[k]
        _section(
            tubes,
            W,
            before,
            present,
            cells,
            seclen[k],
            point,
            node,
            ust,
            c0,
            hist,
            shared,
            own,
            out,
            nodes,
            kept,
            res,
        )
        point += 4 * cells + 1
        node += cells + 1
        before = present
        after = sec_tubes[k + 1] if k + 1 < len(sec_cells) else 0
        if after < present:
            i = present - 1
            _body(tubes, W, i, c0)
            if i > 0:
                W[Y + N0] += W[TMP]
                W[Y + (N0 + 1)] += W[TMP + 1]
                W[Y + (N0 + 2)] += W[TMP + 2]
                W[Y + M0] += W[TMP + 3]
                W[Y + (M0 + 1)] += W[TMP + 4]
                W[Y + (Z0 + i)] += W[TMP + 5]
                _tilt(tubes, W, c0, i, histb, outb)
    # tip of tube 1: external wrench (base axes) against the internal one and the body, (21)
    FT = PAR + (14 * n + 3)
    FE = TMP + 6  # the force on the tip
    for r in range(3):
        W[FE + r] = W[FT + r]
    _tip_forces(tubes, W, FE)
    a, b_, c, d = (
        W[Y + H0],
        W[Y + (H0 + 1)],
        W[Y + (H0 + 2)],
        W[Y + (H0 + 3)],
    )
    k2 = 2.0 / (a * a + b_ * b_ + c * c + d * d)
    r00, r01, r02 = 1.0 - k2 * (c * c + d * d), k2 * (b_ * c - a * d), k2 * (b_ * d + a * c)
    r10, r11, r12 = k2 * (b_ * c + a * d), 1.0 - k2 * (b_ * b_ + d * d), k2 * (c * d - a * b_)
    r20, r21, r22 = k2 * (b_ * d - a * c), k2 * (c * d + a * b_), 1.0 - k2 * (b_ * b_ + c * c)
    fx, fy, fz = W[FE], W[FE + 1], W[FE + 2]
    tx, ty, tz = W[FT + 3], W[FT + 4], W[FT + 5]
    res[0] = r00 * fx + r10 * fy + r20 * fz - W[Y + N0] - W[TMP]
    res[1] = r01 * fx + r11 * fy + r21 * fz - W[Y + (N0 + 1)] - W[TMP + 1]
    res[2] = r02 * fx + r12 * fy + r22 * fz - W[Y + (N0 + 2)] - W[TMP + 2]
    res[3] = r00 * tx + r10 * ty + r20 * tz - W[Y + M0] - W[TMP + 3]
    res[4] = r01 * tx + r11 * ty + r21 * tz - W[Y + (M0 + 1)] - W[TMP + 4]
    res[5] = r02 * tx + r12 * ty + r22 * tz - W[Y + Z0] - W[TMP + 5]


@njit(cache=True, nogil=True, error_model="numpy")
def _block(tubes, lanes, first, stride, W, c0, mesh, par, seclen, x, hist, histb, out, outb, nodes, res):
    """The sweep of the lanes from ``first`` on, one pack or one lane, of ``stride`` in the arrays."""
    own = len(hist) == len(mesh.ust) // (3 * len(tubes)) * field_rows(len(tubes)) * stride
    _sweep(
        tubes, rows(lanes, W, 0, lane_count(lanes)), c0, mesh, rows(lanes, par, first, stride), rows(lanes, seclen, first, stride),
        rows(lanes, x, first, stride), rows(lanes, hist, first, stride), rows((), hist, 0, 1), own, rows(lanes, histb, first, stride),
        rows(lanes, out, first, stride), rows(lanes, outb, first, stride), rows(lanes, nodes, first, stride), (len(out) > 0, len(nodes) > 0),
        rows(lanes, res, first, stride),
    )  # fmt: skip


def _one_lane(tubes, lanes, *arguments):
    _block(tubes, (), 0, 1, *arguments)


def _packs(tubes, lanes, *arguments):
    for first in range(0, lane_count(lanes), PACK):
        _block(tubes, (0,), first, lane_count(lanes), *arguments)


def _short_pack(tubes, lanes, *arguments):
    _block(tubes, lanes, 0, lane_count(lanes), *arguments)


def _in_blocks(*args):
    raise NotImplementedError("for compiled code only")


@overload(_in_blocks, jit_options={"error_model": "numpy", "nogil": True})
def _choose_blocks(tubes, lanes, *arguments):
    if not len(lanes):
        return _one_lane
    return _short_pack if isinstance(lanes.dtype, types.Boolean) else _packs


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
    With several lanes ``hist`` may be (points, F), which all share, and ``out`` and ``nodes`` may be empty: then they are not written.
    """
    _in_blocks(tubes, lanes, W, c0, mesh, par, seclen, x, hist, histb, out, outb, nodes, res)
