"""Physics beyond the plain model, for robots whose files name such extensions: what the kernels do differently then.

The compiler takes these functions in place of the plain ones when the tube tuple holds floats instead of integers
(:func:`ctr_dynamics.kernels.rod.dispatch`), so that the plain model pays nothing for them. Equations and sources stand in docs/model.md:
oval and softening tubes, drag, friction along the overlap and with a Stribeck peak, elastic drives with inertia, play where a tube ends, springs and
contact at the tip, and the terms of moving tubes that the plain model leaves out.

With moving tubes the fields q, omega and gamma are the velocities of the *grid*: p_t, R_t and theta_t at a fixed place of a section. The grid
follows the breakpoints; s_t is its speed, and w_i = beta_i,t - s_t that of tube i against it. The factor ``insertion`` multiplies all rates of
beta, so that 0 is the plain model and 1 the full one.
"""

import math

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.lanes import largest, sincos, where_above
from ctr_dynamics.kernels.workspace import H0, M0, N0, O0, P0, Q0, Z0, extra, offsets

# Rows of the parameters after the plain ones: scalars, then groups of one row a tube.
EXCESS, INV_SPEED, OVERLAP, DRAG, DRAG2, PLAY, PLAY_MOMENT = 0, 1, 2, 3, 4, 5, 6
SPRING, DAMPER, SPRING_FORCE, CONTACT, NORMAL, CONTACT_OFFSET, INSERTION, PLAY_SHARE = (
    7,
    8,
    9,
    12,
    13,
    16,
    17,
    18,
)
OVAL_COS, OVAL_SIN, SOFTENING, COMPLIANCE, INERTIA, BETA_RATE = 0, 1, 2, 3, 4, 5
SOFTENING_ITERATIONS = 8


@njit(cache=True, forceinline=True)
def _scalar(tubes, row):
    n = len(tubes)
    return offsets(tubes)[7] + (14 * n + 14 + row)


@njit(cache=True, forceinline=True)
def _group(tubes, row, i):
    n = len(tubes)
    return offsets(tubes)[7] + (14 * n + 33 + row * n + i)


@njit(cache=True, nogil=True, error_model="numpy")
def start_motion(tubes, W, c0, histb, outb):
    """Rates and accelerations of every tube's beta into the workspace, times the insertion factor; their history moves on."""
    n = len(tubes)
    EX, IN = extra(tubes), _scalar(tubes, INSERTION)
    last = len(histb) - n
    for i in range(n):
        RATE = _group(tubes, BETA_RATE, i)
        rate = W[RATE]
        outb[last + i] = rate
        W[EX + i] = W[IN] * rate
        W[EX + (n + i)] = W[IN] * (c0 * rate + histb[last + i])
    for r in range(2 * n, (2 * n + 7)):
        W[EX + r] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def start_section(tubes, W, bp_tube, seclen, k):
    """Grid speed and acceleration at both ends of section ``k``, and its rate of stretching."""
    n = len(tubes)
    G = extra(tubes) + 2 * n
    EX = extra(tubes)
    i = bp_tube[k]
    W[G + 3] = W[G + 4] if k else 0.0
    W[G + 5] = W[G + 6] if k else 0.0
    W[G + 4] = W[EX + i]
    W[G + 6] = W[EX + (n + i)]
    length = seclen[k]
    W[G + 2] = where_above(length, 1e-9, (W[G + 4] - W[G + 3]) / length, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def move_grid(tubes, W, share):
    """Grid speed and acceleration at the fraction ``share`` of the section."""
    n = len(tubes)
    G = extra(tubes) + 2 * n
    W[G] = W[G + 3] + share * (W[G + 4] - W[G + 3])
    W[G + 1] = W[G + 5] + share * (W[G + 6] - W[G + 5])


@njit(cache=True, nogil=True, error_model="numpy")
def curvature(tubes, W, present, ust, u0, c0):
    """Strains from moments with oval cross-sections and moments that fall behind the curvature (softening).

    Writes what the plain function does and every tube's bending moment, in the frame of tube 1, into its rows 4 and 5 of ``TMP``.
    """
    n = len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    mz, th, ga = Z0, Z0 + n, Z0 + 2 * n - 1
    T = TMP + 13
    for i in range(present):
        Ti = T + 7 * i
        vx_, vy_, vz_ = ust[u0 + 3 * i], ust[u0 + 3 * i + 1], ust[u0 + 3 * i + 2]
        GJi, BTi, KSi = PAR + (n + i), PAR + (5 * n + i), PAR + (6 * n + i)
        HUi = HI + (8 + i)
        s, c = 0.0, 1.0
        if i:
            s, c = sincos(W[YS + (th + i - 1)])
        ks = W[KSi]
        W[Ti] = ks * (c * vx_ - s * vy_)
        W[Ti + 1] = ks * (s * vx_ + c * vy_)
        gj, hu = W[GJi], W[HUi]
        uz = (W[YS + (mz + i)] + gj * ks * vz_ - W[BTi] * hu) / (gj + c0 * W[BTi])
        W[Ti + 2] = uz
        W[Ti + 3] = c0 * uz + hu
        # cos and sin of twice the angle of the major axis, times the ovality, in the frame of tube 1
        oc, os = W[_group(tubes, OVAL_COS, i)], W[_group(tubes, OVAL_SIN, i)]
        c2, s2 = c * c - s * s, 2.0 * s * c
        W[Ti + 4] = oc * c2 - os * s2
        W[Ti + 5] = oc * s2 + os * c2
        W[Ti + 6] = 1.0
    hx, hy = W[HI + 6], W[HI + 7]
    soft = 0.0
    for i in range(present):
        soft = max(soft, largest(W[_group(tubes, SOFTENING, i)]))
    ux, uy = 0.0, 0.0
    for _ in range(SOFTENING_ITERATIONS if soft > 0.0 else 1):
        a11, a12, a21, a22 = 0.0, 0.0, 0.0, 0.0
        rx, ry = W[YS + M0], W[YS + (M0 + 1)]
        for i in range(present):
            Ti = T + 7 * i
            ei, bb = W[PAR + i] * W[Ti + 6], W[PAR + (4 * n + i)]
            g = W[YS + (ga + i - 1)] if i else 0.0
            k11, k12, k22 = (
                ei * (1.0 + W[Ti + 4]),
                ei * W[Ti + 5],
                ei * (1.0 - W[Ti + 4]),
            )
            wx, wy = W[Ti], W[Ti + 1]
            a11 += k11 + c0 * bb
            a12 += k12 + bb * g
            a21 += k12 - bb * g
            a22 += k22 + c0 * bb
            rx += k11 * wx + k12 * wy - bb * hx
            ry += k12 * wx + k22 * wy - bb * hy
        d = 1.0 / (a11 * a22 - a12 * a21)
        ux, uy = (a22 * rx - a12 * ry) * d, (a11 * ry - a21 * rx) * d
        if soft > 0.0:
            for i in range(present):
                Ti = T + 7 * i
                kx, ky = ux - W[Ti], uy - W[Ti + 1]
                W[Ti + 6] = 1.0 / math.sqrt(1.0 + W[_group(tubes, SOFTENING, i)] * (kx * kx + ky * ky))
    utx, uty = c0 * ux + hx, c0 * uy + hy
    W[TMP], W[TMP + 1] = ux, uy
    W[TMP + 2] = W[T + 2]
    W[TMP + 3], W[TMP + 4] = utx, uty
    W[TMP + 5] = W[T + 3]
    for i in range(present):
        Ti = T + 7 * i
        ei, bb = W[PAR + i] * W[Ti + 6], W[PAR + (4 * n + i)]
        g = W[YS + (ga + i - 1)] if i else 0.0
        kx, ky = ux - W[Ti], uy - W[Ti + 1]
        o1, o2 = W[Ti + 4], W[Ti + 5]
        W[Ti + 4] = ei * ((1.0 + o1) * kx + o2 * ky) + bb * (utx + g * uy)
        W[Ti + 5] = ei * (o2 * kx + (1.0 - o1) * ky) + bb * (uty - g * ux)


@njit(cache=True, nogil=True, error_model="numpy")
def derivative(tubes, W, present, ust, u0, c0):
    """Arc-length derivative of the state on the moving grid, and the fields at this point (``OU``).

    R_1^T g stands in ``TMP`` rows 10-12.
    """
    n = len(tubes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes)
    mz, th, ga = Z0, Z0 + n, Z0 + 2 * n - 1
    T = TMP + 13
    EX = extra(tubes)
    G = EX + 2 * n
    OV, EP = _scalar(tubes, OVERLAP), PAR + (14 * n + 11)
    D1, D2 = _scalar(tubes, DRAG), _scalar(tubes, DRAG2)
    curvature(tubes, W, present, ust, u0, c0)
    ux, uy, uz = W[TMP], W[TMP + 1], W[TMP + 2]
    utz = W[TMP + 5]
    qx, qy, qz = W[YS + Q0], W[YS + (Q0 + 1)], W[YS + (Q0 + 2)]
    wx, wy, wz = W[YS + O0], W[YS + (O0 + 1)], W[YS + (O0 + 2)]
    st, stt, stretch = W[G], W[G + 1], W[G + 2]
    mass, inertia, gyro, total = 0.0, 0.0, 0.0, 0.0
    axial, coriolis, centripetal = 0.0, 0.0, 0.0
    before = 0.0  # friction of the overlap with the tube inside
    for i in range(present):
        Ti = T + 7 * i
        g = W[YS + (ga + i - 1)] if i else 0.0
        ri, ra = W[PAR + (3 * n + i)], W[PAR + (2 * n + i)]
        wz_t = c0 * (wz + g) + W[HI + 5] + (W[HI + (7 + n + i)] if i else 0.0)
        along = 0.0
        if i + 1 < present:
            rate = W[YS + (ga + i)] - g
            eps = W[EP]
            along = W[OV] * rate / math.sqrt(rate * rate + eps * eps)
        W[K + (mz + i)] = -(ux * W[Ti + 5] - uy * W[Ti + 4]) + 2.0 * ri * wz_t - along + before
        before = along
        if i:
            W[K + (th + i - 1)] = W[Ti + 2] - uz
            W[K + (ga + i - 1)] = W[Ti + 3] - utz + stretch * (W[Ti + 2] - uz)
            W[OU + (8 + i)] = W[Ti + 2]
            W[OU + (7 + n + i)] = g
        w, w_t = W[EX + i] - st, W[EX + (n + i)] - stt
        mass += ra
        inertia += ri
        gyro += ri * (wz + 2.0 * g)
        total += W[YS + (mz + i)]
        axial += ra * w_t
        coriolis += 2.0 * ra * w
        centripetal += ra * w * w
    for i in range(present, n):
        W[K + (mz + i)] = 0.0
        W[K + (th + i - 1)] = 0.0
        W[K + (ga + i - 1)] = 0.0
        W[OU + (8 + i)] = 0.0
        W[OU + (7 + n + i)] = 0.0
    a, b, c, d = (
        W[YS + H0],
        W[YS + (H0 + 1)],
        W[YS + (H0 + 2)],
        W[YS + (H0 + 3)],
    )
    k = 2.0 / (a * a + b * b + c * c + d * d)
    W[K + P0] = k * (b * d + a * c)
    W[K + (P0 + 1)] = k * (c * d - a * b)
    W[K + (P0 + 2)] = 1.0 - k * (b * b + c * c)
    W[K + H0] = -0.5 * (ux * b + uy * c + uz * d)
    W[K + (H0 + 1)] = 0.5 * (ux * a + uz * c - uy * d)
    W[K + (H0 + 2)] = 0.5 * (uy * a - uz * b + ux * d)
    W[K + (H0 + 3)] = 0.5 * (uz * a + uy * b - ux * c)
    W[K + Q0] = wy - (uy * qz - uz * qy)
    W[K + (Q0 + 1)] = -wx - (uz * qx - ux * qz)
    W[K + (Q0 + 2)] = stretch - (ux * qy - uy * qx)
    W[K + O0] = W[TMP + 3] + stretch * ux - (uy * wz - uz * wy)
    W[K + (O0 + 1)] = W[TMP + 4] + stretch * uy - (uz * wx - ux * wz)
    W[K + (O0 + 2)] = utz + stretch * uz - (ux * wy - uy * wx)
    nx, ny, nz = W[YS + N0], W[YS + (N0 + 1)], W[YS + (N0 + 2)]
    # drag on the outermost tube here, which moves past the grid
    vz = qz + W[EX + (present - 1)] - st
    drag = W[D1] + W[D2] * math.sqrt(qx * qx + qy * qy + vz * vz)
    W[K + N0] = (
        mass * (wy * qz - wz * qy + c0 * qx + W[HI] - W[TMP + 10]) + coriolis * wy + centripetal * uy
        + drag * qx - (uy * nz - uz * ny)
    )  # fmt: skip
    W[K + (N0 + 1)] = (
        mass * (wz * qx - wx * qz + c0 * qy + W[HI + 1] - W[TMP + 11]) - coriolis * wx - centripetal * ux
        + drag * qy - (uz * nx - ux * nz)
    )  # fmt: skip
    W[K + (N0 + 2)] = (
        mass * (wx * qy - wy * qx + c0 * qz + W[HI + 2] - W[TMP + 12]) + axial + drag * vz
        - (ux * ny - uy * nx)
    )  # fmt: skip
    mx, my = W[YS + M0], W[YS + (M0 + 1)]
    W[K + M0] = ny - (uy * total - uz * my) + inertia * (c0 * wx + W[HI + 3]) + wy * gyro
    W[K + (M0 + 1)] = -nx - (uz * mx - ux * total) + inertia * (c0 * wy + W[HI + 4]) - wx * gyro
    W[OU], W[OU + 1], W[OU + 2] = qx, qy, qz
    W[OU + 3], W[OU + 4], W[OU + 5] = wx, wy, wz
    W[OU + 6], W[OU + 7], W[OU + 8] = ux, uy, uz


@njit(cache=True, nogil=True, error_model="numpy")
def bending_moments(tubes, W, present, dst):
    """Bending moments of the tubes, as :func:`curvature` has left them, into rows ``dst``; zero for tubes that have ended."""
    n = len(tubes)
    T = offsets(tubes)[6] + 13
    for i in range(n):
        for r in range(2):
            W[dst + 2 * i + r] = W[T + (7 * i + 4) + r] if i < present else 0.0


@njit(cache=True, forceinline=True)
def _stribeck(excess, inverse, rate):
    """Factor on a Coulomb coefficient: the kinetic one far from rest, ``1 + excess`` times it at rest (Armstrong-Helouvry et al. 1994)."""
    x = rate * inverse
    return 1.0 + excess * math.exp(-x * x)


@njit(cache=True, nogil=True, error_model="numpy")
def coulomb(tubes, W, rate):
    """Factor on the Coulomb coefficients at a relative speed."""
    return _stribeck(W[_scalar(tubes, EXCESS)], W[_scalar(tubes, INV_SPEED)], rate)


@njit(cache=True, nogil=True, error_model="numpy")
def drive(tubes, W, c0, i, torque, angle, rate, histb, outb):
    """(psi, psi_t) of tube ``i`` at its actuator: the drive gives way by compliance times (internal moment - inertia times psi_tt)."""
    n = len(tubes)
    at = len(histb) - (4 * n - i)
    psi_t_history = i * (len(histb) - 4 * n) // n
    c = W[_group(tubes, COMPLIANCE, i)]
    inertia = W[_group(tubes, INERTIA, i)]
    h = histb[at]
    give = c * (torque - inertia * (c0 * (rate + h) + histb[psi_t_history])) / (1.0 + c * inertia * c0 * c0)
    outb[at] = give
    return angle + give, rate + c0 * give + h


@njit(cache=True, nogil=True, error_model="numpy")
def base_stretch(tubes, W, i, beta, u):
    """Twist rate that the stretching of the grid behind the plate adds, (beta_t / beta) u_z."""
    return where_above(-1e-9, beta, W[extra(tubes) + i] / beta * u, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def tilt(tubes, W, c0, i, histb, outb):
    """Play at the end of tube ``i``: the tubes inside tilt about the moment that passes, and the state is taken to their frame.

    q and omega are turned by ``play_share`` times the tilt. 1 is rigid kinematics; diagnosis lets it vary (docs/model.md).
    """
    n = len(tubes)
    Y = offsets(tubes)[0]
    PL, PM, PS = (
        _scalar(tubes, PLAY),
        _scalar(tubes, PLAY_MOMENT),
        _scalar(tubes, PLAY_SHARE),
    )
    at = len(histb) - (3 * n - 2 * i)
    mx, my = W[Y + M0], W[Y + (M0 + 1)]
    m0 = W[PM]
    k = W[PL] / math.sqrt(mx * mx + my * my + m0 * m0)
    tx, ty = k * mx, k * my
    outb[at], outb[at + 1] = tx, ty
    a, b, c, d = (
        W[Y + H0],
        W[Y + (H0 + 1)],
        W[Y + (H0 + 2)],
        W[Y + (H0 + 3)],
    )
    x, y = 0.5 * tx, 0.5 * ty
    W[Y + H0] = a - b * x - c * y
    W[Y + (H0 + 1)] = b + a * x - d * y
    W[Y + (H0 + 2)] = c + a * y + d * x
    W[Y + (H0 + 3)] = d + b * y - c * x
    for part in range(2):
        # v in the tilted frame: E(x, y)^T v with E the rotation of the quaternion (1, x, y, 0)
        if part == 0:
            x, y = 0.5 * W[PS] * tx, 0.5 * W[PS] * ty
        else:
            x, y = 0.5 * tx, 0.5 * ty
        f = 2.0 / (1.0 + x * x + y * y)
        e00, e11, e22 = 1.0 - f * y * y, 1.0 - f * x * x, 1.0 - f * (x * x + y * y)
        e01, e02, e12 = f * x * y, f * y, -f * x
        for block in range(2):
            row = Y + ((Q0 if block == 0 else O0) if part == 0 else (N0 if block == 0 else M0))
            vx, vy = W[row], W[row + 1]
            vz = 0.0
            if part == 1 and block == 1:
                for tube in range(i):
                    vz += W[Y + (Z0 + tube)]
            else:
                vz = W[row + 2]
            W[row] = e00 * vx + e01 * vy - e02 * vz
            W[row + 1] = e01 * vx + e11 * vy - e12 * vz
            turned = e02 * vx + e12 * vy + e22 * vz
            if part == 1 and block == 1:
                W[Y + Z0] += turned - vz
            else:
                W[row + 2] = turned
    W[Y + O0] += c0 * tx + histb[at]
    W[Y + (O0 + 1)] += c0 * ty + histb[at + 1]


@njit(cache=True, nogil=True, error_model="numpy")
def tip_forces(tubes, W, F):
    """Add the spring's, the damper's and the contact's force on the tip (base axes) to the rows ``F``."""
    Y = offsets(tubes)[0]
    KS, CS, F0 = (
        _scalar(tubes, SPRING),
        _scalar(tubes, DAMPER),
        _scalar(tubes, SPRING_FORCE),
    )
    KC, NO, OF = (
        _scalar(tubes, CONTACT),
        _scalar(tubes, NORMAL),
        _scalar(tubes, CONTACT_OFFSET),
    )
    px, py, pz = W[Y + P0], W[Y + (P0 + 1)], W[Y + (P0 + 2)]
    a, b, c, d = (
        W[Y + H0],
        W[Y + (H0 + 1)],
        W[Y + (H0 + 2)],
        W[Y + (H0 + 3)],
    )
    k2 = 2.0 / (a * a + b * b + c * c + d * d)
    qx, qy, qz = W[Y + Q0], W[Y + (Q0 + 1)], W[Y + (Q0 + 2)]
    vx = (1.0 - k2 * (c * c + d * d)) * qx + k2 * (b * c - a * d) * qy + k2 * (b * d + a * c) * qz
    vy = k2 * (b * c + a * d) * qx + (1.0 - k2 * (b * b + d * d)) * qy + k2 * (c * d - a * b) * qz
    vz = k2 * (b * d - a * c) * qx + k2 * (c * d + a * b) * qy + (1.0 - k2 * (b * b + c * c)) * qz
    depth = W[OF] - (W[NO] * px + W[NO + 1] * py + W[NO + 2] * pz)
    push = W[KC] * where_above(depth, 0.0, depth, 0.0)
    W[F] += W[F0] - W[KS] * px - W[CS] * vx + push * W[NO]
    W[F + 1] += W[F0 + 1] - W[KS] * py - W[CS] * vy + push * W[NO + 1]
    W[F + 2] += W[F0 + 2] - W[KS] * pz - W[CS] * vz + push * W[NO + 2]
