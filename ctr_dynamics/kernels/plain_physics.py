"""The equations of the paper at one point of the robot: strains, arc-length derivative, bending moments (docs/model.md).

Every function has a sister of the same name and arguments in :mod:`ctr_dynamics.kernels.extended_physics`; what only that one needs does nothing
here. :mod:`ctr_dynamics.kernels.physics` chooses between them.

Numbers live in the workspace ``W`` at the rows of :func:`ctr_dynamics.kernels.layout.workspace_rows`. Loops count to the tubes of the robot and ask
which are present, so that the rows of each tube are constants for the compiler.
"""

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.complex_rates import across, damped, plane_curvature
from ctr_dynamics.kernels.layout import field_rows, state_rows, workspace_rows
from ctr_dynamics.kernels.sincos import sincos


@njit(forceinline=True, error_model="numpy")
def curvature(kind, W, present, ust, u0, c0):
    """Strains from moments: (16), (17) with the damping history of every tube taken exactly (docs/model.md).

    Reads the state at ``stage`` and the history; writes u of tube 1 to ``curvature``, its time derivative to ``curvature_rate``, and to the seven
    rows of each ``tube`` the moment of its precurvature and damping history, E I R_z(theta_i) u*_i - B h_u (2), u_z, its time derivative, and
    B gamma.
    """
    n = kind.tubes
    at, state, field = workspace_rows(n), state_rows(n), field_rows(n)
    u, u_t, total, hist = at.curvature, at.curvature_rate, at.sums, at.history
    hux, huy = hist + field.curvature_xy, hist + field.curvature_xy + 1
    moment = at.stage + state.moment_xy
    for i in range(n):
        if i < present:
            T = at.tube + 7 * i
            EI, GJ = at.bending_stiffness + i, at.torsional_stiffness + i
            BB, BT, KS = at.bending_damping + i, at.torsion_damping + i, at.precurvature + i
            HUZ = hist + field.curvature_z + i
            # what only depends on parameters stands in brackets: the compiler takes it out of the loop over the points
            wx, wy = (W[EI] * W[KS]) * ust[u0 + 3 * i], (W[EI] * W[KS]) * ust[u0 + 3 * i + 1]
            if i > 0:
                s, c = sincos(W[at.stage + state.theta + i - 1])
                wx, wy = c * wx - s * wy, s * wx + c * wy
            rx, ry = wx - W[BB] * W[hux], wy - W[BB] * W[huy]
            load = W[at.stage + state.moment_z + i] + (W[GJ] * W[KS]) * ust[u0 + 3 * i + 2] - W[BT] * W[HUZ]
            uz = damped(c0, i, W[GJ], W[BT], load)
            W[T], W[T + 1], W[T + 2], W[T + 3] = rx, ry, uz, c0 * uz + W[HUZ]
            if i == 0:
                W[u + 2], W[u_t + 2] = uz, W[T + 3]
                W[total], W[total + 1], W[total + 2] = W[EI], W[BB], 0.0
                load_x, load_y = W[moment] + rx, W[moment + 1] + ry
            else:
                b = W[BB] * W[at.stage + state.gamma + i - 1]
                W[T + 4] = b
                W[total] += W[EI]
                W[total + 1] += W[BB]
                W[total + 2] += b
                load_x += rx
                load_y += ry
    ux, uy = plane_curvature(c0, n + present - 1, W[total], W[total + 1], W[total + 2], load_x, load_y)
    W[u], W[u + 1] = ux, uy
    W[u_t], W[u_t + 1] = c0 * ux + W[hux], c0 * uy + W[huy]


@njit(forceinline=True, error_model="numpy")
def weight(kind, W):
    """Gravity in the frame of tube 1, R_1^T g, into ``weight`` (non-unit quaternion, normalised when read)."""
    n = kind.tubes
    at, state = workspace_rows(n), state_rows(n)
    H = at.stage + state.quaternion
    a, b, c, d = W[H], W[H + 1], W[H + 2], W[H + 3]
    k = 2.0 / (a * a + b * b + c * c + d * d)
    gx, gy, gz = W[at.gravity], W[at.gravity + 1], W[at.gravity + 2]
    W[at.weight] = gx - k * ((c * c + d * d) * gx - (b * c + a * d) * gy - (b * d - a * c) * gz)
    W[at.weight + 1] = gy - k * ((b * b + d * d) * gy - (b * c - a * d) * gx - (c * d + a * b) * gz)
    W[at.weight + 2] = gz - k * ((b * b + c * c) * gz - (b * d + a * c) * gx - (c * d - a * b) * gy)


@njit(forceinline=True, error_model="numpy")
def derivative(kind, W, present, ust, u0, c0):
    """Arc-length derivative of the state at ``stage``, (13), into ``slope``, the fields at this point, and gravity as :func:`weight` leaves it."""
    n = kind.tubes
    at, state, field = workspace_rows(n), state_rows(n), field_rows(n)
    Y, K, HI, OU = at.stage, at.slope, at.history, at.fields
    u, u_t, total, g1 = at.curvature, at.curvature_rate, at.sums, at.weight
    weight(kind, W)
    curvature(kind, W, present, ust, u0, c0)
    ux, uy, uz = W[u], W[u + 1], W[u + 2]
    # torsion of every tube, and the sums over the tubes: rho A, rho I, rho I omega_z + 2 rho I gamma, m_z
    wz = W[Y + state.angular_velocity + 2]
    wz_t = c0 * wz + W[HI + field.angular_velocity + 2]
    for i in range(n):
        T, RA, RI = at.tube + 7 * i, at.mass_per_length + i, at.inertia_per_length + i
        KM, KT, KG = K + state.moment_z + i, K + state.theta + i - 1, K + state.gamma + i - 1
        OUu, OUg = OU + field.curvature_z + i, OU + field.gamma + i - 1
        if i < present:
            turn = ux * W[T + 1] - uy * W[T] - across(c0, W[at.bending_damping + i], ux, uy)
            if i == 0:
                W[KM] = turn + (2.0 * W[RI]) * wz_t
                W[total], W[total + 1] = W[RA], W[RI]
                W[total + 2], W[total + 3] = W[RI] * wz, W[Y + state.moment_z]
            else:
                g = W[Y + state.gamma + i - 1]
                g_t = c0 * g + W[HI + field.gamma + i - 1]
                W[KM] = turn + W[T + 4] * (ux * ux + uy * uy) + (2.0 * W[RI]) * (wz_t + g_t)
                W[KT], W[KG] = W[T + 2] - uz, W[T + 3] - W[u_t + 2]
                W[OUu], W[OUg] = W[T + 2], g
                W[total] += W[RA]
                W[total + 1] += W[RI]
                W[total + 2] += W[RI] * (wz + 2.0 * g)
                W[total + 3] += W[Y + state.moment_z + i]
        else:
            W[KM], W[KT], W[KG] = 0.0, 0.0, 0.0
            W[OUu], W[OUg] = 0.0, 0.0
    # kinematics
    H = Y + state.quaternion
    a, b, c, d = W[H], W[H + 1], W[H + 2], W[H + 3]
    k = 2.0 / (a * a + b * b + c * c + d * d)
    P = K + state.position
    W[P], W[P + 1], W[P + 2] = k * (b * d + a * c), k * (c * d - a * b), 1.0 - k * (b * b + c * c)
    hx, hy, hz = 0.5 * ux, 0.5 * uy, 0.5 * uz
    H = K + state.quaternion
    W[H] = -(hx * b + hy * c + hz * d)
    W[H + 1] = hx * a + hz * c - hy * d
    W[H + 2] = hy * a - hz * b + hx * d
    W[H + 3] = hz * a + hy * b - hx * c
    # velocities and balance of forces and moments
    Q, O, N, M = state.velocity, state.angular_velocity, state.force, state.moment_xy  # noqa: E741
    ux, uy, uz = W[u], W[u + 1], W[u + 2]
    qx, qy, qz = W[Y + Q], W[Y + Q + 1], W[Y + Q + 2]
    wx, wy, wz = W[Y + O], W[Y + O + 1], W[Y + O + 2]
    nx, ny, nz = W[Y + N], W[Y + N + 1], W[Y + N + 2]
    W[K + Q] = wy - (uy * qz - uz * qy)
    W[K + Q + 1] = -wx - (uz * qx - ux * qz)
    W[K + Q + 2] = -(ux * qy - uy * qx)
    W[K + O] = W[u_t] - (uy * wz - uz * wy)
    W[K + O + 1] = W[u_t + 1] - (uz * wx - ux * wz)
    W[K + O + 2] = W[u_t + 2] - (ux * wy - uy * wx)
    HQ, HO = HI + field.velocity, HI + field.angular_velocity
    ra = W[total]
    W[K + N] = ra * (wy * qz - wz * qy + c0 * qx + W[HQ] - W[g1]) - (uy * nz - uz * ny)
    W[K + N + 1] = ra * (wz * qx - wx * qz + c0 * qy + W[HQ + 1] - W[g1 + 1]) - (uz * nx - ux * nz)
    W[K + N + 2] = ra * (wx * qy - wy * qx + c0 * qz + W[HQ + 2] - W[g1 + 2]) - (ux * ny - uy * nx)
    mx, my, mz = W[Y + M], W[Y + M + 1], W[total + 3]
    ri, gyro = W[total + 1], W[total + 2]
    W[K + M] = ny - (uy * mz - uz * my) + ri * (c0 * wx + W[HO]) + wy * gyro
    W[K + M + 1] = -nx - (uz * mx - ux * mz) + ri * (c0 * wy + W[HO + 1]) - wx * gyro
    keep_fields(kind, W, qx, qy, qz, wx, wy, wz, ux, uy, uz)


@njit(forceinline=True)
def keep_fields(kind, W, qx, qy, qz, wx, wy, wz, ux, uy, uz):
    """Velocity, angular velocity and curvature of tube 1 into ``fields``."""
    n = kind.tubes
    field = field_rows(n)
    Q = workspace_rows(n).fields + field.velocity
    O, U = workspace_rows(n).fields + field.angular_velocity, workspace_rows(n).fields + field.curvature_xy  # noqa: E741
    W[Q], W[Q + 1], W[Q + 2] = qx, qy, qz
    W[O], W[O + 1], W[O + 2] = wx, wy, wz
    W[U], W[U + 1], W[U + 2] = ux, uy, uz


@njit(forceinline=True, error_model="numpy")
def bending_moments(kind, W, present, target):
    """Internal bending moment of each tube, (14), in the frame of tube 1, into rows ``target``; zero for tubes that have ended."""
    n = kind.tubes
    at, field = workspace_rows(n), field_rows(n)
    hist = at.history + field.curvature_xy
    ux, uy = W[at.curvature], W[at.curvature + 1]
    # c0 u: the damping history is in the rows of the tube
    cx, cy = W[at.curvature_rate] - W[hist], W[at.curvature_rate + 1] - W[hist + 1]
    for i in range(n):
        D, T, EI, BB = target + 2 * i, at.tube + 7 * i, at.bending_stiffness + i, at.bending_damping + i
        if i < present:
            W[D], W[D + 1] = W[EI] * ux + W[BB] * cx - W[T], W[EI] * uy + W[BB] * cy - W[T + 1]
            if i > 0:
                W[D] += W[T + 4] * uy
                W[D + 1] -= W[T + 4] * ux
        else:
            W[D], W[D + 1] = 0.0, 0.0


@njit(forceinline=True, error_model="numpy")
def start_motion(kind, W, c0, base_history, base_fields):
    """The grid does not move."""


@njit(forceinline=True, error_model="numpy")
def start_section(kind, W, section_ends, section_lengths, k):
    """The grid does not move."""


@njit(forceinline=True, error_model="numpy")
def move_grid(kind, W, fraction):
    """The grid does not move."""


@njit(forceinline=True, error_model="numpy")
def coulomb(kind, W, rate):
    """The Coulomb coefficients do not depend on the relative speed."""
    return 1.0


@njit(forceinline=True, error_model="numpy")
def drive(kind, W, c0, i, torque, angle, rate, base_history, base_fields):
    """(psi, psi_t) of tube ``i`` at its actuator: rigid drives."""
    return angle, rate


@njit(forceinline=True, error_model="numpy")
def base_stretch(kind, W, i, beta, u):
    """The grid behind the plate does not stretch."""
    return 0.0


@njit(forceinline=True, error_model="numpy")
def tilt(kind, W, c0, i, base_history, base_fields):
    """Tubes have no clearance."""


@njit(forceinline=True, error_model="numpy")
def tip_forces(kind, W, force, c0, base_history, base_fields):
    """No spring, no contact and nothing learned at the tip."""
