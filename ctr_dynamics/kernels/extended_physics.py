"""Physics beyond the plain equations, for robots whose files name such effects: what the kernels do differently then.

Equations and sources stand in docs/model.md: oval and softening tubes, drag, friction along the overlap and with a Stribeck peak, elastic drives
with inertia, clearance where a tube ends, springs, contact and a learned force at the tip, and the terms of moving tubes that the plain equations
leave out. Every function has a sister of the same name and arguments in :mod:`ctr_dynamics.kernels.plain_physics`.

With moving tubes the fields q, omega and gamma are the velocities of the *grid*: p_t, R_t and theta_t at a fixed place of a section. The grid
follows the breakpoints; s_t is its speed, and w_i = beta_i,t - s_t that of tube i against it. The parameter ``insertion_velocity`` multiplies all
rates of beta, so that 0 is the plain model and 1 the full one.
"""

import math

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.complex_rates import damped, damped_twice, delayed, oval_curvature
from ctr_dynamics.kernels.layout import LEARNED_DEGREE, base_end_rows, field_rows, state_rows, workspace_rows
from ctr_dynamics.kernels.plain_physics import keep_fields, weight
from ctr_dynamics.kernels.simd import largest, where_above
from ctr_dynamics.kernels.sincos import sincos

SOFTENING_ITERATIONS = 8


@njit(forceinline=True, error_model="numpy")
def start_motion(kind, W, c0, base_history, base_fields):
    """Rates and accelerations of every tube's beta, times ``insertion_velocity``; their history moves on."""
    n = kind.tubes
    at, end = workspace_rows(n), base_end_rows(n)
    IN = at.insertion_velocity
    last = len(base_history) - end.size + end.beta_rate
    for i in range(n):
        rate = W[at.beta_rate + i]
        base_fields[last + i] = rate
        W[at.tube_speed + i] = W[IN] * rate
        W[at.tube_acceleration + i] = W[IN] * (c0 * rate + base_history[last + i])
    for r in range(at.grid_speed, at.size):
        W[r] = 0.0


@njit(forceinline=True, error_model="numpy")
def start_section(kind, W, section_ends, section_lengths, k):
    """Grid speed and acceleration at both ends of section ``k``, and its rate of stretching; ``section_ends`` (sections,) tubes that end it."""
    n = kind.tubes
    at = workspace_rows(n)
    i = section_ends[k]
    W[at.speed_near] = W[at.speed_far] if k else 0.0
    W[at.acceleration_near] = W[at.acceleration_far] if k else 0.0
    W[at.speed_far] = W[at.tube_speed + i]
    W[at.acceleration_far] = W[at.tube_acceleration + i]
    length = section_lengths[k]
    W[at.stretching] = where_above(length, 1e-9, (W[at.speed_far] - W[at.speed_near]) / length, 0.0)


@njit(forceinline=True, error_model="numpy")
def move_grid(kind, W, fraction):
    """Grid speed and acceleration at the ``fraction`` of the section."""
    at = workspace_rows(kind.tubes)
    W[at.grid_speed] = W[at.speed_near] + fraction * (W[at.speed_far] - W[at.speed_near])
    W[at.grid_acceleration] = W[at.acceleration_near] + fraction * (
        W[at.acceleration_far] - W[at.acceleration_near]
    )


@njit(forceinline=True, error_model="numpy")
def curvature(kind, W, present, ust, u0, c0):
    """Strains from moments with oval cross-sections and moments that fall behind the curvature (softening).

    Writes what the plain function does and every tube's bending moment, in the frame of tube 1, into rows 4 and 5 of its ``tube``.
    """
    n = kind.tubes
    at, state, field = workspace_rows(n), state_rows(n), field_rows(n)
    Y, HI, u, u_t, T = at.stage, at.history, at.curvature, at.curvature_rate, at.tube
    for i in range(present):
        Ti = T + 7 * i
        vx_, vy_, vz_ = ust[u0 + 3 * i], ust[u0 + 3 * i + 1], ust[u0 + 3 * i + 2]
        GJi, BTi, KSi = at.torsional_stiffness + i, at.torsion_damping + i, at.precurvature + i
        s, c = 0.0, 1.0
        if i:
            s, c = sincos(W[Y + state.theta + i - 1])
        ks = W[KSi]
        W[Ti] = ks * (c * vx_ - s * vy_)
        W[Ti + 1] = ks * (s * vx_ + c * vy_)
        gj, hu = W[GJi], W[HI + field.curvature_z + i]
        uz = damped(c0, i, gj, W[BTi], W[Y + state.moment_z + i] + gj * ks * vz_ - W[BTi] * hu)
        W[Ti + 2] = uz
        W[Ti + 3] = c0 * uz + hu
        # cos and sin of twice the angle of the major axis, times the ovality, in the frame of tube 1
        oc, os = W[at.oval_cos + i], W[at.oval_sin + i]
        c2, s2 = c * c - s * s, 2.0 * s * c
        W[Ti + 4] = oc * c2 - os * s2
        W[Ti + 5] = oc * s2 + os * c2
        W[Ti + 6] = 1.0
    hx, hy = W[HI + field.curvature_xy], W[HI + field.curvature_xy + 1]
    soft = 0.0
    for i in range(present):
        soft = max(soft, largest(W[at.softening + i]))
    ux, uy = 0.0, 0.0
    for _ in range(SOFTENING_ITERATIONS if soft > 0.0 else 1):
        none = 0.0 * W[at.bending_stiffness]  # a number of the lanes from the start, as the compiler wants it
        k11_all, k12_all, k22_all, bb_all, turning, stiffness = none, none, none, none, none, none
        rx, ry = W[Y + state.moment_xy], W[Y + state.moment_xy + 1]
        for i in range(present):
            Ti = T + 7 * i
            ei, bb = W[at.bending_stiffness + i] * W[Ti + 6], W[at.bending_damping + i]
            g = W[Y + state.gamma + i - 1] if i else 0.0
            k11, k12, k22 = ei * (1.0 + W[Ti + 4]), ei * W[Ti + 5], ei * (1.0 - W[Ti + 4])
            wx, wy = W[Ti], W[Ti + 1]
            k11_all += k11
            k12_all += k12
            k22_all += k22
            bb_all += bb
            stiffness += W[at.bending_stiffness + i]
            turning += bb * g
            rx += k11 * wx + k12 * wy - bb * hx
            ry += k12 * wx + k22 * wy - bb * hy
        ux, uy = oval_curvature(
            c0, n + present - 1, stiffness, k11_all, k12_all, k22_all, bb_all, turning, rx, ry
        )
        if soft > 0.0:
            for i in range(present):
                Ti = T + 7 * i
                kx, ky = ux - W[Ti], uy - W[Ti + 1]
                W[Ti + 6] = 1.0 / math.sqrt(1.0 + W[at.softening + i] * (kx * kx + ky * ky))
    utx, uty = c0 * ux + hx, c0 * uy + hy
    W[u], W[u + 1] = ux, uy
    W[u + 2] = W[T + 2]
    W[u_t], W[u_t + 1] = utx, uty
    W[u_t + 2] = W[T + 3]
    for i in range(present):
        Ti = T + 7 * i
        ei, bb = W[at.bending_stiffness + i] * W[Ti + 6], W[at.bending_damping + i]
        g = W[Y + state.gamma + i - 1] if i else 0.0
        kx, ky = ux - W[Ti], uy - W[Ti + 1]
        o1, o2 = W[Ti + 4], W[Ti + 5]
        W[Ti + 4] = ei * ((1.0 + o1) * kx + o2 * ky) + bb * (utx + g * uy)
        W[Ti + 5] = ei * (o2 * kx + (1.0 - o1) * ky) + bb * (uty - g * ux)


@njit(nogil=True, error_model="numpy")
def moving_derivative(kind, W, present, ust, u0, c0):
    """Arc-length derivative of the state on the moving grid, and the fields at this point; gravity in the frame of tube 1 is at hand."""
    n = kind.tubes
    at, state, field = workspace_rows(n), state_rows(n), field_rows(n)
    Y, K, HI, OU, g1 = at.stage, at.slope, at.history, at.fields, at.weight
    u, u_t, T = at.curvature, at.curvature_rate, at.tube
    Q, O, N, M = state.velocity, state.angular_velocity, state.force, state.moment_xy  # noqa: E741
    HQ, HO = HI + field.velocity, HI + field.angular_velocity
    curvature(kind, W, present, ust, u0, c0)
    ux, uy, uz = W[u], W[u + 1], W[u + 2]
    utz = W[u_t + 2]
    qx, qy, qz = W[Y + Q], W[Y + Q + 1], W[Y + Q + 2]
    wx, wy, wz = W[Y + O], W[Y + O + 1], W[Y + O + 2]
    st, stt, stretch = W[at.grid_speed], W[at.grid_acceleration], W[at.stretching]
    mass, inertia, gyro, total = 0.0, 0.0, 0.0, 0.0
    axial, coriolis, centripetal = 0.0, 0.0, 0.0
    before = 0.0  # friction of the overlap with the tube inside
    for i in range(present):
        Ti = T + 7 * i
        g = W[Y + state.gamma + i - 1] if i else 0.0
        ri, ra = W[at.inertia_per_length + i], W[at.mass_per_length + i]
        wz_t = c0 * (wz + g) + W[HO + 2] + (W[HI + field.gamma + i - 1] if i else 0.0)
        along = 0.0
        if i + 1 < present:
            rate = W[Y + state.gamma + i] - g
            eps = W[at.epsilon]
            along = W[at.overlap_friction] * rate / math.sqrt(rate * rate + eps * eps)
        W[K + state.moment_z + i] = -(ux * W[Ti + 5] - uy * W[Ti + 4]) + 2.0 * ri * wz_t - along + before
        before = along
        if i:
            W[K + state.theta + i - 1] = W[Ti + 2] - uz
            W[K + state.gamma + i - 1] = W[Ti + 3] - utz + stretch * (W[Ti + 2] - uz)
            W[OU + field.curvature_z + i] = W[Ti + 2]
            W[OU + field.gamma + i - 1] = g
        w, w_t = W[at.tube_speed + i] - st, W[at.tube_acceleration + i] - stt
        mass += ra
        inertia += ri
        gyro += ri * (wz + 2.0 * g)
        total += W[Y + state.moment_z + i]
        axial += ra * w_t
        coriolis += 2.0 * ra * w
        centripetal += ra * w * w
    for i in range(present, n):
        W[K + state.moment_z + i] = 0.0
        W[K + state.theta + i - 1] = 0.0
        W[K + state.gamma + i - 1] = 0.0
        W[OU + field.curvature_z + i] = 0.0
        W[OU + field.gamma + i - 1] = 0.0
    H = Y + state.quaternion
    a, b, c, d = W[H], W[H + 1], W[H + 2], W[H + 3]
    k = 2.0 / (a * a + b * b + c * c + d * d)
    P, H = K + state.position, K + state.quaternion
    W[P] = k * (b * d + a * c)
    W[P + 1] = k * (c * d - a * b)
    W[P + 2] = 1.0 - k * (b * b + c * c)
    W[H] = -0.5 * (ux * b + uy * c + uz * d)
    W[H + 1] = 0.5 * (ux * a + uz * c - uy * d)
    W[H + 2] = 0.5 * (uy * a - uz * b + ux * d)
    W[H + 3] = 0.5 * (uz * a + uy * b - ux * c)
    W[K + Q] = wy - (uy * qz - uz * qy)
    W[K + Q + 1] = -wx - (uz * qx - ux * qz)
    W[K + Q + 2] = stretch - (ux * qy - uy * qx)
    W[K + O] = W[u_t] + stretch * ux - (uy * wz - uz * wy)
    W[K + O + 1] = W[u_t + 1] + stretch * uy - (uz * wx - ux * wz)
    W[K + O + 2] = utz + stretch * uz - (ux * wy - uy * wx)
    nx, ny, nz = W[Y + N], W[Y + N + 1], W[Y + N + 2]
    # drag on the outermost tube here, which moves past the grid
    vz = qz + W[at.tube_speed + (present - 1)] - st
    drag = W[at.drag_linear] + W[at.drag_quadratic] * math.sqrt(qx * qx + qy * qy + vz * vz)
    W[K + N] = (
        mass * (wy * qz - wz * qy + c0 * qx + W[HQ] - W[g1]) + coriolis * wy + centripetal * uy
        + drag * qx - (uy * nz - uz * ny)
    )  # fmt: skip
    W[K + N + 1] = (
        mass * (wz * qx - wx * qz + c0 * qy + W[HQ + 1] - W[g1 + 1]) - coriolis * wx - centripetal * ux
        + drag * qy - (uz * nx - ux * nz)
    )  # fmt: skip
    W[K + N + 2] = (
        mass * (wx * qy - wy * qx + c0 * qz + W[HQ + 2] - W[g1 + 2]) + axial + drag * vz
        - (ux * ny - uy * nx)
    )  # fmt: skip
    mx, my = W[Y + M], W[Y + M + 1]
    W[K + M] = ny - (uy * total - uz * my) + inertia * (c0 * wx + W[HO]) + wy * gyro
    W[K + M + 1] = -nx - (uz * mx - ux * total) + inertia * (c0 * wy + W[HO + 1]) - wx * gyro
    keep_fields(kind, W, qx, qy, qz, wx, wy, wz, ux, uy, uz)


@njit(forceinline=True, error_model="numpy")
def derivative(kind, W, present, ust, u0, c0):
    """Arc-length derivative of the state at ``stage``, the fields at this point, and gravity in the frame of tube 1."""
    weight(kind, W)
    moving_derivative(kind, W, present, ust, u0, c0)


@njit(forceinline=True, error_model="numpy")
def bending_moments(kind, W, present, target):
    """Bending moments of the tubes, as :func:`curvature` has left them, into rows ``target``; zero for tubes that have ended."""
    n = kind.tubes
    T = workspace_rows(n).tube
    for i in range(n):
        for r in range(2):
            W[target + 2 * i + r] = W[T + (7 * i + 4) + r] if i < present else 0.0


@njit(forceinline=True)
def _stribeck(excess, inverse, rate):
    """Factor on a Coulomb coefficient: the kinetic one far from rest, ``1 + excess`` times it at rest (Armstrong-Helouvry et al. 1994)."""
    x = rate * inverse
    return 1.0 + excess * math.exp(-x * x)


@njit(forceinline=True, error_model="numpy")
def coulomb(kind, W, rate):
    """Factor on the Coulomb coefficients at a relative speed."""
    at = workspace_rows(kind.tubes)
    return _stribeck(W[at.stribeck_excess], W[at.stribeck_inverse_speed], rate)


@njit(forceinline=True, error_model="numpy")
def drive(kind, W, c0, i, torque, angle, rate, base_history, base_fields):
    """(psi, psi_t) of tube ``i`` at its actuator: the drive gives way by compliance times (internal moment - inertia times psi_tt)."""
    n = kind.tubes
    at, end = workspace_rows(n), base_end_rows(n)
    points = len(base_history) - end.size
    row = points + end.drive_angle + i
    first = i * points // n  # psi_t of the tube's first point
    c = W[at.drive_compliance + i]
    inertia = W[at.drive_inertia + i]
    h = base_history[row]
    load = c * (torque - inertia * (c0 * (rate + h) + base_history[first]))
    give = damped_twice(c0, 2 * n + i, c * inertia, load)
    base_fields[row] = give
    return angle + give, rate + c0 * give + h


@njit(forceinline=True, error_model="numpy")
def base_stretch(kind, W, i, beta, u):
    """Twist rate that the stretching of the grid behind the plate adds, (beta_t / beta) u_z."""
    return where_above(-1e-9, beta, W[workspace_rows(kind.tubes).tube_speed + i] / beta * u, 0.0)


@njit(forceinline=True, error_model="numpy")
def tilt(kind, W, c0, i, base_history, base_fields):
    """Clearance at the end of tube ``i``: the tubes inside tilt about the moment that passes, and the state is taken to their frame.

    q and omega are turned by ``clearance_kinematics`` times the tilt. 1 is rigid kinematics; diagnosis lets it vary (docs/model.md).
    """
    n = kind.tubes
    at, state, end = workspace_rows(n), state_rows(n), base_end_rows(n)
    Y, share = at.state, at.clearance_kinematics
    Q, O, N, M = state.velocity, state.angular_velocity, state.force, state.moment_xy  # noqa: E741
    row = len(base_history) - end.size + end.tilt + 2 * i
    mx, my = W[Y + M], W[Y + M + 1]
    m0 = W[at.clearance_moment]
    k = W[at.clearance] / math.sqrt(mx * mx + my * my + m0 * m0)
    tx, ty = k * mx, k * my
    base_fields[row], base_fields[row + 1] = tx, ty
    H = Y + state.quaternion
    a, b, c, d = W[H], W[H + 1], W[H + 2], W[H + 3]
    x, y = 0.5 * tx, 0.5 * ty
    W[H] = a - b * x - c * y
    W[H + 1] = b + a * x - d * y
    W[H + 2] = c + a * y + d * x
    W[H + 3] = d + b * y - c * x
    for part in range(2):
        # v in the tilted frame: E(x, y)^T v with E the rotation of the quaternion (1, x, y, 0)
        if part == 0:
            x, y = 0.5 * W[share] * tx, 0.5 * W[share] * ty
        else:
            x, y = 0.5 * tx, 0.5 * ty
        f = 2.0 / (1.0 + x * x + y * y)
        e00, e11, e22 = 1.0 - f * y * y, 1.0 - f * x * x, 1.0 - f * (x * x + y * y)
        e01, e02, e12 = f * x * y, f * y, -f * x
        for block in range(2):
            v = Y + ((Q if block == 0 else O) if part == 0 else (N if block == 0 else M))
            vx, vy = W[v], W[v + 1]
            vz = 0.0
            if part == 1 and block == 1:
                for tube in range(i):
                    vz += W[Y + state.moment_z + tube]
            else:
                vz = W[v + 2]
            W[v] = e00 * vx + e01 * vy - e02 * vz
            W[v + 1] = e01 * vx + e11 * vy - e12 * vz
            turned = e02 * vx + e12 * vy + e22 * vz
            if part == 1 and block == 1:
                W[Y + state.moment_z] += turned - vz
            else:
                W[v + 2] = turned
    W[Y + O] += c0 * tx + base_history[row]
    W[Y + O + 1] += c0 * ty + base_history[row + 1]


@njit(forceinline=True, error_model="numpy")
def tip_forces(kind, W, force, c0, base_history, base_fields):
    """Add the forces of spring, damper and contact, and the learned one, on the tip (base axes) to the rows ``force``."""
    n = kind.tubes
    at, state = workspace_rows(n), state_rows(n)
    KS, CS, F0 = at.spring_stiffness, at.spring_damping, at.spring_force
    KC, NO, OF = at.contact_stiffness, at.contact_normal, at.contact_offset
    P, H, Q = at.state + state.position, at.state + state.quaternion, at.state + state.velocity
    px, py, pz = W[P], W[P + 1], W[P + 2]
    a, b, c, d = W[H], W[H + 1], W[H + 2], W[H + 3]
    k2 = 2.0 / (a * a + b * b + c * c + d * d)
    qx, qy, qz = W[Q], W[Q + 1], W[Q + 2]
    vx = (1.0 - k2 * (c * c + d * d)) * qx + k2 * (b * c - a * d) * qy + k2 * (b * d + a * c) * qz
    vy = k2 * (b * c + a * d) * qx + (1.0 - k2 * (b * b + d * d)) * qy + k2 * (c * d - a * b) * qz
    vz = k2 * (b * d - a * c) * qx + k2 * (c * d + a * b) * qy + (1.0 - k2 * (b * b + c * c)) * qz
    depth = W[OF] - (W[NO] * px + W[NO + 1] * py + W[NO + 2] * pz)
    push = W[KC] * where_above(depth, 0.0, depth, 0.0)
    F = force
    W[F] += W[F0] - W[KS] * px - W[CS] * vx + push * W[NO]
    W[F + 1] += W[F0 + 1] - W[KS] * py - W[CS] * vy + push * W[NO + 1]
    W[F + 2] += W[F0 + 2] - W[KS] * pz - W[CS] * vz + push * W[NO + 2]
    learned_force(kind, W, force, vx, vy, vz, c0, base_history, base_fields)


@njit(nogil=True, error_model="numpy")
def learned_force(kind, W, force, vx, vy, vz, c0, base_history, base_fields):
    """Add the learned force at the tip velocity ``vx``, ``vy``, ``vz`` (m/s, base axes) to the rows ``force``.

    The part of the position is minus the gradient of a polynomial, so that it makes no energy; beyond the length it stays what it is there, for
    polynomials grow without limit where nothing was learned. The memory is z_t = (p - z) / time, implicit in the step as all fields are.
    """
    n = kind.tubes
    at, state, end = workspace_rows(n), state_rows(n), base_end_rows(n)
    F, X, D = force, at.powers, at.learned_damping
    scale, orders = W[at.learned_inverse_length], LEARNED_DEGREE + 1
    row = len(base_history) - end.size + end.memory
    for axis in range(3):
        p = W[at.state + state.position + axis]
        x = (p - W[at.learned_origin + axis]) * scale
        x = where_above(x, 1.0, 1.0, x)
        x = where_above(-1.0, x, -1.0, x)
        W[X + axis * orders] = 1.0
        for power in range(1, orders):
            W[X + axis * orders + power] = x * W[X + axis * orders + power - 1]
        time, before = W[at.learned_memory_time], base_history[row + axis]
        z = delayed(c0, 3 * n, time, p - time * before)
        base_fields[row + axis] = z
        W[F + axis] -= W[at.learned_memory + axis] * ((p - z) * scale)
    term = at.learned_potential
    for a in range(orders):
        for b in range(orders - a):
            for c in range(orders - a - b):
                if a + b + c > 1:
                    x, y, z = W[X + a], W[X + orders + b], W[X + 2 * orders + c]
                    k = W[term]
                    if a > 0:
                        W[F] -= (1.0 * a) * k * W[X + a - 1] * y * z
                    if b > 0:
                        W[F + 1] -= (1.0 * b) * k * x * W[X + orders + b - 1] * z
                    if c > 0:
                        W[F + 2] -= (1.0 * c) * k * x * y * W[X + 2 * orders + c - 1]
                    term += 1
    scale, dry = W[at.learned_inverse_speed], W[at.learned_dry_speed]
    ux, uy, uz = scale * vx, scale * vy, scale * vz
    speed = math.sqrt(ux * ux + uy * uy + uz * uz)
    share = 1.0 / math.sqrt(vx * vx + vy * vy + vz * vz + dry * dry)
    W[F] -= W[D] * ux + W[D + 3] * uy + W[D + 4] * uz
    W[F + 1] -= W[D + 3] * ux + W[D + 1] * uy + W[D + 5] * uz
    W[F + 2] -= W[D + 4] * ux + W[D + 5] * uy + W[D + 2] * uz
    DR, DY = at.learned_drag, at.learned_dry
    W[F] -= W[DR] * speed * ux + W[DY] * share * vx
    W[F + 1] -= W[DR + 1] * speed * uy + W[DY + 1] * share * vy
    W[F + 2] -= W[DR + 2] * speed * uz + W[DY + 2] * share * vz
    for i in range(n):
        s, c = sincos(W[at.alpha + i])
        slide = W[at.beta + i] * W[at.learned_inverse_length]
        for axis in range(3):
            k = 3 * i + axis
            W[F + axis] += W[at.learned_sine + k] * s + W[at.learned_cosine + k] * c
            W[F + axis] += W[at.learned_slide + k] * slide
