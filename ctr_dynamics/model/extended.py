"""Physics beyond the plain model, for robots whose files name such extensions: what the kernels do differently then.

The compiler takes these functions in place of the plain ones when the tube tuple holds floats instead of integers
(:func:`ctr_dynamics.model.kernels.dispatch`), so that the plain model pays nothing for them. Equations and sources stand in docs/model.md:
oval and softening tubes, drag, friction along the overlap and with a Stribeck peak, elastic drives with inertia, play where a tube ends, springs and
contact at the tip, and the terms of moving tubes that the plain model leaves out.

With moving tubes the fields q, omega and gamma are the velocities of the *grid*: p_t, R_t and theta_t at a fixed place of a section. The grid
follows the breakpoints; s_t is its speed, and w_i = beta_i,t - s_t that of tube i against it. The factor ``insertion`` multiplies all rates of
beta, so that 0 is the plain model and 1 the full one.
"""

import math

from numba import njit

from ctr_dynamics.model.workspace import H0, M0, N0, O0, P0, Q0, Z0, extra, lane_count, offsets, sincos

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


@njit(cache=True, inline="always")
def _scalar(tubes, lanes, row):
    n = len(tubes)
    return offsets(tubes, lanes)[7] + (14 * n + 14 + row) * lane_count(lanes)


@njit(cache=True, inline="always")
def _group(tubes, lanes, row, i):
    n = len(tubes)
    return offsets(tubes, lanes)[7] + (14 * n + 33 + row * n + i) * lane_count(lanes)


@njit(cache=True, nogil=True, error_model="numpy")
def start_motion(tubes, lanes, W, c0, histb, outb):
    """Rates and accelerations of every tube's beta into the workspace, times the insertion factor; their history moves on."""
    n, L = len(tubes), lane_count(lanes)
    EX, IN = extra(tubes, lanes), _scalar(tubes, lanes, INSERTION)
    last = len(histb) - n * L
    for i in range(n):
        RATE = _group(tubes, lanes, BETA_RATE, i)
        for j in range(L):
            rate = W[RATE + j]
            outb[last + i * L + j] = rate
            W[EX + i * L + j] = W[IN + j] * rate
            W[EX + (n + i) * L + j] = W[IN + j] * (c0 * rate + histb[last + i * L + j])
    for r in range(2 * n * L, (2 * n + 7) * L):
        W[EX + r] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def start_section(tubes, lanes, W, bp_tube, seclen, k):
    """Grid speed and acceleration at both ends of section ``k``, and its rate of stretching."""
    n, L = len(tubes), lane_count(lanes)
    G = extra(tubes, lanes) + 2 * n * L
    EX = extra(tubes, lanes)
    i = bp_tube[k]
    for j in range(L):
        W[G + 3 * L + j] = W[G + 4 * L + j] if k else 0.0
        W[G + 5 * L + j] = W[G + 6 * L + j] if k else 0.0
        W[G + 4 * L + j] = W[EX + i * L + j]
        W[G + 6 * L + j] = W[EX + (n + i) * L + j]
        length = seclen[k * L + j]
        W[G + 2 * L + j] = (W[G + 4 * L + j] - W[G + 3 * L + j]) / length if length > 1e-9 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def move_grid(tubes, lanes, W, share):
    """Grid speed and acceleration at the fraction ``share`` of the section."""
    n, L = len(tubes), lane_count(lanes)
    G = extra(tubes, lanes) + 2 * n * L
    for j in range(L):
        W[G + j] = W[G + 3 * L + j] + share * (W[G + 4 * L + j] - W[G + 3 * L + j])
        W[G + L + j] = W[G + 5 * L + j] + share * (W[G + 6 * L + j] - W[G + 5 * L + j])


@njit(cache=True, nogil=True, error_model="numpy")
def curvature(tubes, lanes, W, present, ust, u0, c0):
    """Strains from moments with oval cross-sections and moments that fall behind the curvature (softening).

    Writes what the plain function does and every tube's bending moment, in the frame of tube 1, into its rows 4 and 5 of ``TMP``.
    """
    n, L = len(tubes), lane_count(lanes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes, lanes)
    mz, th, ga = Z0, Z0 + n, Z0 + 2 * n - 1
    T = TMP + 13 * L
    for i in range(present):
        Ti = T + 7 * i * L
        vx_, vy_, vz_ = ust[u0 + 3 * i], ust[u0 + 3 * i + 1], ust[u0 + 3 * i + 2]
        GJi, BTi, KSi = PAR + (n + i) * L, PAR + (5 * n + i) * L, PAR + (6 * n + i) * L
        HUi = HI + (8 + i) * L
        for j in range(L):
            s, c = 0.0, 1.0
            if i:
                s, c = sincos(W[YS + (th + i - 1) * L + j])
            ks = W[KSi + j]
            W[Ti + j] = ks * (c * vx_ - s * vy_)
            W[Ti + L + j] = ks * (s * vx_ + c * vy_)
            gj, hu = W[GJi + j], W[HUi + j]
            uz = (W[YS + (mz + i) * L + j] + gj * ks * vz_ - W[BTi + j] * hu) / (gj + c0 * W[BTi + j])
            W[Ti + 2 * L + j] = uz
            W[Ti + 3 * L + j] = c0 * uz + hu
            # cos and sin of twice the angle of the major axis, times the ovality, in the frame of tube 1
            oc, os = W[_group(tubes, lanes, OVAL_COS, i) + j], W[_group(tubes, lanes, OVAL_SIN, i) + j]
            c2, s2 = c * c - s * s, 2.0 * s * c
            W[Ti + 4 * L + j] = oc * c2 - os * s2
            W[Ti + 5 * L + j] = oc * s2 + os * c2
            W[Ti + 6 * L + j] = 1.0
    for j in range(L):
        hx, hy = W[HI + 6 * L + j], W[HI + 7 * L + j]
        soft = 0.0
        for i in range(present):
            soft = max(soft, W[_group(tubes, lanes, SOFTENING, i) + j])
        ux, uy = 0.0, 0.0
        for _ in range(SOFTENING_ITERATIONS if soft > 0.0 else 1):
            a11, a12, a21, a22 = 0.0, 0.0, 0.0, 0.0
            rx, ry = W[YS + M0 * L + j], W[YS + (M0 + 1) * L + j]
            for i in range(present):
                Ti = T + 7 * i * L
                ei, bb = W[PAR + i * L + j] * W[Ti + 6 * L + j], W[PAR + (4 * n + i) * L + j]
                g = W[YS + (ga + i - 1) * L + j] if i else 0.0
                k11, k12, k22 = (
                    ei * (1.0 + W[Ti + 4 * L + j]),
                    ei * W[Ti + 5 * L + j],
                    ei * (1.0 - W[Ti + 4 * L + j]),
                )
                wx, wy = W[Ti + j], W[Ti + L + j]
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
                    Ti = T + 7 * i * L
                    kx, ky = ux - W[Ti + j], uy - W[Ti + L + j]
                    W[Ti + 6 * L + j] = 1.0 / math.sqrt(
                        1.0 + W[_group(tubes, lanes, SOFTENING, i) + j] * (kx * kx + ky * ky)
                    )
        utx, uty = c0 * ux + hx, c0 * uy + hy
        W[TMP + j], W[TMP + L + j] = ux, uy
        W[TMP + 2 * L + j] = W[T + 2 * L + j]
        W[TMP + 3 * L + j], W[TMP + 4 * L + j] = utx, uty
        W[TMP + 5 * L + j] = W[T + 3 * L + j]
        for i in range(present):
            Ti = T + 7 * i * L
            ei, bb = W[PAR + i * L + j] * W[Ti + 6 * L + j], W[PAR + (4 * n + i) * L + j]
            g = W[YS + (ga + i - 1) * L + j] if i else 0.0
            kx, ky = ux - W[Ti + j], uy - W[Ti + L + j]
            o1, o2 = W[Ti + 4 * L + j], W[Ti + 5 * L + j]
            W[Ti + 4 * L + j] = ei * ((1.0 + o1) * kx + o2 * ky) + bb * (utx + g * uy)
            W[Ti + 5 * L + j] = ei * (o2 * kx + (1.0 - o1) * ky) + bb * (uty - g * ux)


@njit(cache=True, nogil=True, error_model="numpy")
def derivative(tubes, lanes, W, present, ust, u0, c0):
    """Arc-length derivative of the state on the moving grid, and the fields at this point (``OU``).

    R_1^T g stands in ``TMP`` rows 10-12.
    """
    n, L = len(tubes), lane_count(lanes)
    Y, YS, K, ACC, HI, OU, TMP, PAR, MA, MB = offsets(tubes, lanes)
    mz, th, ga = Z0, Z0 + n, Z0 + 2 * n - 1
    T = TMP + 13 * L
    EX = extra(tubes, lanes)
    G = EX + 2 * n * L
    OV, EP = _scalar(tubes, lanes, OVERLAP), PAR + (14 * n + 11) * L
    D1, D2 = _scalar(tubes, lanes, DRAG), _scalar(tubes, lanes, DRAG2)
    curvature(tubes, lanes, W, present, ust, u0, c0)
    for j in range(L):
        ux, uy, uz = W[TMP + j], W[TMP + L + j], W[TMP + 2 * L + j]
        utz = W[TMP + 5 * L + j]
        qx, qy, qz = W[YS + Q0 * L + j], W[YS + (Q0 + 1) * L + j], W[YS + (Q0 + 2) * L + j]
        wx, wy, wz = W[YS + O0 * L + j], W[YS + (O0 + 1) * L + j], W[YS + (O0 + 2) * L + j]
        st, stt, stretch = W[G + j], W[G + L + j], W[G + 2 * L + j]
        mass, inertia, gyro, total = 0.0, 0.0, 0.0, 0.0
        axial, coriolis, centripetal = 0.0, 0.0, 0.0
        before = 0.0  # friction of the overlap with the tube inside
        for i in range(present):
            Ti = T + 7 * i * L
            g = W[YS + (ga + i - 1) * L + j] if i else 0.0
            ri, ra = W[PAR + (3 * n + i) * L + j], W[PAR + (2 * n + i) * L + j]
            wz_t = c0 * (wz + g) + W[HI + 5 * L + j] + (W[HI + (7 + n + i) * L + j] if i else 0.0)
            along = 0.0
            if i + 1 < present:
                rate = W[YS + (ga + i) * L + j] - g
                eps = W[EP + j]
                along = W[OV + j] * rate / math.sqrt(rate * rate + eps * eps)
            W[K + (mz + i) * L + j] = (
                -(ux * W[Ti + 5 * L + j] - uy * W[Ti + 4 * L + j]) + 2.0 * ri * wz_t - along + before
            )
            before = along
            if i:
                W[K + (th + i - 1) * L + j] = W[Ti + 2 * L + j] - uz
                W[K + (ga + i - 1) * L + j] = W[Ti + 3 * L + j] - utz + stretch * (W[Ti + 2 * L + j] - uz)
                W[OU + (8 + i) * L + j] = W[Ti + 2 * L + j]
                W[OU + (7 + n + i) * L + j] = g
            w, w_t = W[EX + i * L + j] - st, W[EX + (n + i) * L + j] - stt
            mass += ra
            inertia += ri
            gyro += ri * (wz + 2.0 * g)
            total += W[YS + (mz + i) * L + j]
            axial += ra * w_t
            coriolis += 2.0 * ra * w
            centripetal += ra * w * w
        for i in range(present, n):
            W[K + (mz + i) * L + j] = 0.0
            W[K + (th + i - 1) * L + j] = 0.0
            W[K + (ga + i - 1) * L + j] = 0.0
            W[OU + (8 + i) * L + j] = 0.0
            W[OU + (7 + n + i) * L + j] = 0.0
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
        W[K + Q0 * L + j] = wy - (uy * qz - uz * qy)
        W[K + (Q0 + 1) * L + j] = -wx - (uz * qx - ux * qz)
        W[K + (Q0 + 2) * L + j] = stretch - (ux * qy - uy * qx)
        W[K + O0 * L + j] = W[TMP + 3 * L + j] + stretch * ux - (uy * wz - uz * wy)
        W[K + (O0 + 1) * L + j] = W[TMP + 4 * L + j] + stretch * uy - (uz * wx - ux * wz)
        W[K + (O0 + 2) * L + j] = utz + stretch * uz - (ux * wy - uy * wx)
        nx, ny, nz = W[YS + N0 * L + j], W[YS + (N0 + 1) * L + j], W[YS + (N0 + 2) * L + j]
        # drag on the outermost tube here, which moves past the grid
        vz = qz + W[EX + (present - 1) * L + j] - st
        drag = W[D1 + j] + W[D2 + j] * math.sqrt(qx * qx + qy * qy + vz * vz)
        W[K + N0 * L + j] = (
            mass * (wy * qz - wz * qy + c0 * qx + W[HI + j] - W[TMP + 10 * L + j]) + coriolis * wy + centripetal * uy
            + drag * qx - (uy * nz - uz * ny)
        )  # fmt: skip
        W[K + (N0 + 1) * L + j] = (
            mass * (wz * qx - wx * qz + c0 * qy + W[HI + L + j] - W[TMP + 11 * L + j]) - coriolis * wx - centripetal * ux
            + drag * qy - (uz * nx - ux * nz)
        )  # fmt: skip
        W[K + (N0 + 2) * L + j] = (
            mass * (wx * qy - wy * qx + c0 * qz + W[HI + 2 * L + j] - W[TMP + 12 * L + j]) + axial + drag * vz
            - (ux * ny - uy * nx)
        )  # fmt: skip
        mx, my = W[YS + M0 * L + j], W[YS + (M0 + 1) * L + j]
        W[K + M0 * L + j] = ny - (uy * total - uz * my) + inertia * (c0 * wx + W[HI + 3 * L + j]) + wy * gyro
        W[K + (M0 + 1) * L + j] = (
            -nx - (uz * mx - ux * total) + inertia * (c0 * wy + W[HI + 4 * L + j]) - wx * gyro
        )
        W[OU + j], W[OU + L + j], W[OU + 2 * L + j] = qx, qy, qz
        W[OU + 3 * L + j], W[OU + 4 * L + j], W[OU + 5 * L + j] = wx, wy, wz
        W[OU + 6 * L + j], W[OU + 7 * L + j], W[OU + 8 * L + j] = ux, uy, uz


@njit(cache=True, nogil=True, error_model="numpy")
def bending_moments(tubes, lanes, W, present, dst):
    """Bending moments of the tubes, as :func:`curvature` has left them, into rows ``dst``; zero for tubes that have ended."""
    n, L = len(tubes), lane_count(lanes)
    T = offsets(tubes, lanes)[6] + 13 * L
    for i in range(n):
        for r in range(2 * L):
            W[dst + 2 * i * L + r] = W[T + (7 * i + 4) * L + r] if i < present else 0.0


@njit(cache=True, inline="always")
def _stribeck(excess, inverse, rate):
    """Factor on a Coulomb coefficient: the kinetic one far from rest, ``1 + excess`` times it at rest (Armstrong-Helouvry et al. 1994)."""
    x = rate * inverse
    return 1.0 + excess * math.exp(-x * x)


@njit(cache=True, nogil=True, error_model="numpy")
def coulomb(tubes, lanes, W, j, rate):
    """Factor on the Coulomb coefficients of lane ``j`` at a relative speed."""
    return _stribeck(W[_scalar(tubes, lanes, EXCESS) + j], W[_scalar(tubes, lanes, INV_SPEED) + j], rate)


@njit(cache=True, nogil=True, error_model="numpy")
def drive(tubes, lanes, W, c0, i, j, torque, angle, rate, histb, outb):
    """(psi, psi_t) of tube ``i`` at its actuator: the drive gives way by compliance times (internal moment - inertia times psi_tt)."""
    n, L = len(tubes), lane_count(lanes)
    at = len(histb) - (4 * n - i) * L + j
    psi_t_history = i * (len(histb) // L - 4 * n) // n * L + j
    c = W[_group(tubes, lanes, COMPLIANCE, i) + j]
    inertia = W[_group(tubes, lanes, INERTIA, i) + j]
    h = histb[at]
    give = c * (torque - inertia * (c0 * (rate + h) + histb[psi_t_history])) / (1.0 + c * inertia * c0 * c0)
    outb[at] = give
    return angle + give, rate + c0 * give + h


@njit(cache=True, nogil=True, error_model="numpy")
def base_stretch(tubes, lanes, W, i, j, beta, u):
    """Twist rate that the stretching of the grid behind the plate adds, (beta_t / beta) u_z."""
    return W[extra(tubes, lanes) + i * lane_count(lanes) + j] / beta * u if beta < -1e-9 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def tilt(tubes, lanes, W, c0, i, histb, outb):
    """Play at the end of tube ``i``: the tubes inside tilt about the moment that passes, and the state is taken to their frame.

    q and omega are turned by ``play_share`` times the tilt. 1 is rigid kinematics; diagnosis lets it vary (docs/model.md).
    """
    n, L = len(tubes), lane_count(lanes)
    Y = offsets(tubes, lanes)[0]
    PL, PM, PS = (
        _scalar(tubes, lanes, PLAY),
        _scalar(tubes, lanes, PLAY_MOMENT),
        _scalar(tubes, lanes, PLAY_SHARE),
    )
    at = len(histb) - (3 * n - 2 * i) * L
    for j in range(L):
        mx, my = W[Y + M0 * L + j], W[Y + (M0 + 1) * L + j]
        m0 = W[PM + j]
        k = W[PL + j] / math.sqrt(mx * mx + my * my + m0 * m0)
        tx, ty = k * mx, k * my
        outb[at + j], outb[at + L + j] = tx, ty
        a, b, c, d = (
            W[Y + H0 * L + j],
            W[Y + (H0 + 1) * L + j],
            W[Y + (H0 + 2) * L + j],
            W[Y + (H0 + 3) * L + j],
        )
        x, y = 0.5 * tx, 0.5 * ty
        W[Y + H0 * L + j] = a - b * x - c * y
        W[Y + (H0 + 1) * L + j] = b + a * x - d * y
        W[Y + (H0 + 2) * L + j] = c + a * y + d * x
        W[Y + (H0 + 3) * L + j] = d + b * y - c * x
        for part in range(2):
            # v in the tilted frame: E(x, y)^T v with E the rotation of the quaternion (1, x, y, 0)
            if part == 0:
                x, y = 0.5 * W[PS + j] * tx, 0.5 * W[PS + j] * ty
            else:
                x, y = 0.5 * tx, 0.5 * ty
            f = 2.0 / (1.0 + x * x + y * y)
            e00, e11, e22 = 1.0 - f * y * y, 1.0 - f * x * x, 1.0 - f * (x * x + y * y)
            e01, e02, e12 = f * x * y, f * y, -f * x
            for block in range(2):
                row = Y + ((Q0 if block == 0 else O0) if part == 0 else (N0 if block == 0 else M0)) * L + j
                vx, vy = W[row], W[row + L]
                vz = 0.0
                if part == 1 and block == 1:
                    for tube in range(i):
                        vz += W[Y + (Z0 + tube) * L + j]
                else:
                    vz = W[row + 2 * L]
                W[row] = e00 * vx + e01 * vy - e02 * vz
                W[row + L] = e01 * vx + e11 * vy - e12 * vz
                turned = e02 * vx + e12 * vy + e22 * vz
                if part == 1 and block == 1:
                    W[Y + Z0 * L + j] += turned - vz
                else:
                    W[row + 2 * L] = turned
        W[Y + O0 * L + j] += c0 * tx + histb[at + j]
        W[Y + (O0 + 1) * L + j] += c0 * ty + histb[at + L + j]


@njit(cache=True, nogil=True, error_model="numpy")
def tip_forces(tubes, lanes, W, F):
    """Add the spring's, the damper's and the contact's force on the tip (base axes) to the rows ``F``."""
    L = lane_count(lanes)
    Y = offsets(tubes, lanes)[0]
    KS, CS, F0 = (
        _scalar(tubes, lanes, SPRING),
        _scalar(tubes, lanes, DAMPER),
        _scalar(tubes, lanes, SPRING_FORCE),
    )
    KC, NO, OF = (
        _scalar(tubes, lanes, CONTACT),
        _scalar(tubes, lanes, NORMAL),
        _scalar(tubes, lanes, CONTACT_OFFSET),
    )
    for j in range(L):
        px, py, pz = W[Y + P0 * L + j], W[Y + (P0 + 1) * L + j], W[Y + (P0 + 2) * L + j]
        a, b, c, d = (
            W[Y + H0 * L + j],
            W[Y + (H0 + 1) * L + j],
            W[Y + (H0 + 2) * L + j],
            W[Y + (H0 + 3) * L + j],
        )
        k2 = 2.0 / (a * a + b * b + c * c + d * d)
        qx, qy, qz = W[Y + Q0 * L + j], W[Y + (Q0 + 1) * L + j], W[Y + (Q0 + 2) * L + j]
        vx = (1.0 - k2 * (c * c + d * d)) * qx + k2 * (b * c - a * d) * qy + k2 * (b * d + a * c) * qz
        vy = k2 * (b * c + a * d) * qx + (1.0 - k2 * (b * b + d * d)) * qy + k2 * (c * d - a * b) * qz
        vz = k2 * (b * d - a * c) * qx + k2 * (c * d + a * b) * qy + (1.0 - k2 * (b * b + c * c)) * qz
        depth = W[OF + j] - (W[NO + j] * px + W[NO + L + j] * py + W[NO + 2 * L + j] * pz)
        push = W[KC + j] * max(depth, 0.0)
        W[F + j] += W[F0 + j] - W[KS + j] * px - W[CS + j] * vx + push * W[NO + j]
        W[F + L + j] += W[F0 + L + j] - W[KS + j] * py - W[CS + j] * vy + push * W[NO + L + j]
        W[F + 2 * L + j] += W[F0 + 2 * L + j] - W[KS + j] * pz - W[CS + j] * vz + push * W[NO + 2 * L + j]
