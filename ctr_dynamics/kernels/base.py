"""From the actuators to the state at s = 0+: the straight lengths behind the base plate, and the plate."""

import math

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.complex_rates import damped
from ctr_dynamics.kernels.layout import state_rows, unknown_rows, workspace_rows
from ctr_dynamics.kernels.physics import base_stretch, coulomb, drive
from ctr_dynamics.kernels.sincos import sincos


@njit(nogil=True, error_model="numpy")
def below_base(kind, W, c0, cells, ust_base, x, base_history, base_fields):
    """Torsion of the straight lengths behind the base plate, (18), and the coupling (19) into the state at s = 0-.

    ``x``: unknowns of the shooting problem. The rows from ``curvature`` on hold, for one tube after the other, state, stage and accumulated
    increment (psi, psi_t, m_z each), step, and the factor on u*_z.
    """
    n = kind.tubes
    at, state, unknown = workspace_rows(n), state_rows(n), unknown_rows(n)
    points = 4 * cells + 1
    Y, HI, OU = at.state, at.history, at.fields
    S, A, B = at.curvature, at.curvature + 3, at.curvature + 6
    DS, US = at.curvature + 9, at.curvature + 10
    P, H, Q, O = state.position, state.quaternion, state.velocity, state.angular_velocity  # noqa: E741
    N, M = state.force, state.moment_xy
    for i in range(n):
        GJ, RI, BT = at.torsional_stiffness + i, at.inertia_per_length + i, at.torsion_damping + i
        KS, AL, AV, BE = at.precurvature + i, at.alpha + i, at.alpha_rate + i, at.beta + i
        W[S + 2] = x[unknown.torque + i]
        psi, psi_t = drive(kind, W, c0, i, x[unknown.torque + i], W[AL], W[AV], base_history, base_fields)
        W[S] = psi
        W[S + 1] = psi_t
        W[DS] = -W[BE] / cells
        gj, bt = W[GJ], W[BT]
        W[US] = W[GJ] * W[KS]
        for cell in range(cells):
            for r in range(3):
                W[A + r] = W[S + r]
                W[B + r] = 0.0
            for stage in range(4):
                point = (i * points + 4 * cell + stage) * 2
                uz_ref = ust_base[i * points + 4 * cell + stage]
                weight = 1.0 if stage == 0 or stage == 3 else 2.0
                ahead = 0.5 if stage < 2 else 1.0
                W[HI] = base_history[point]
                W[HI + 1] = base_history[point + 1]
                psi_t = W[A + 1]
                u = damped(c0, i, gj, bt, W[A + 2] + W[US] * uz_ref - bt * W[HI + 1])
                kv = c0 * u + W[HI + 1] + base_stretch(kind, W, i, W[BE], u)
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
                base_fields[point] = W[OU]
                base_fields[point + 1] = W[OU + 1]
            h = W[DS] / 6.0
            W[S] += h * W[B]
            W[S + 1] += h * W[B + 1]
            W[S + 2] += h * W[B + 2]
        end = (i * points + 4 * cells) * 2
        base_fields[end] = W[S + 1]
        load = W[S + 2] + gj * W[KS] * ust_base[i * points + 4 * cells] - bt * base_history[end + 1]
        base_fields[end + 1] = damped(c0, i, gj, bt, load)
        W[Y + state.moment_z + i] = W[S + 2]
        if i == 0:
            half = 0.5 * W[S]
            s, c = sincos(half)
            W[Y + H] = c
            W[Y + H + 1] = 0.0
            W[Y + H + 2] = 0.0
            W[Y + H + 3] = s
            W[Y + O + 2] = W[S + 1]
            W[Y + M] = W[S]  # psi_1, held here until the other tubes have used it
        else:
            W[Y + state.theta + i - 1] = W[S] - W[Y + M]
            W[Y + state.gamma + i - 1] = W[S + 1] - W[Y + O + 2]
    for r in range(3):
        W[Y + P + r] = 0.0
        W[Y + Q + r] = 0.0
        W[Y + N + r] = x[unknown.force + r]
    W[Y + O] = 0.0
    W[Y + O + 1] = 0.0
    W[Y + M] = x[unknown.moment_xy]
    W[Y + M + 1] = x[unknown.moment_xy + 1]


@njit(nogil=True, error_model="numpy")
def base_plate(kind, W, ust_plate):
    """Near side of s = 0: moments of precurved lengths held straight, and the friction of the plate on the outermost tube, (24).

    ``ust_plate`` (3N,): precurvature just behind the plate.
    """
    n = kind.tubes
    at, state = workspace_rows(n), state_rows(n)
    Y = at.state
    for i in range(n):
        EI, KS, A = at.bending_stiffness + i, at.precurvature + i, at.near_moments + 2 * i
        vx, vy = ust_plate[3 * i], ust_plate[3 * i + 1]
        s, c = 0.0, 1.0
        if i > 0:
            s, c = sincos(W[Y + state.theta + i - 1])
        W[A] = -W[EI] * W[KS] * (c * vx - s * vy)
        W[A + 1] = -W[EI] * W[KS] * (s * vx + c * vy)
    rate = W[Y + state.angular_velocity + 2]
    if n > 1:
        rate += W[Y + state.gamma + n - 2]
    mx, my = W[Y + state.moment_xy], W[Y + state.moment_xy + 1]
    eps = W[at.epsilon]
    W[Y + state.moment_z + n - 1] += (
        coulomb(kind, W, rate)
        * W[at.base_coulomb]
        * math.sqrt(mx * mx + my * my)
        * rate
        / math.sqrt(rate * rate + eps * eps)
        + W[at.base_viscous] * rate
    )
