"""Equation of motion of a concentric tube robot in strain coordinates, and its integration in time.

The backbone's strains (bending u_x, u_y of tube 1, torsion u_z of every tube) are Legendre polynomials on each section; their coefficients, the
tube angles at the actuators and a few extras are the generalized coordinates c. Along s the kinematics are integrated by two-point Gauss
quadrature (rotations by a fourth-order Magnus step), d'Alembert's principle with the transposed quadrature gives the residual

    r(c, c_t, c_tt, inputs) = 0,

which Radau IIA with three stages (order 5, L-stable) integrates. Nothing is shot and nothing is a finite difference in s.

Order of the coordinates: tube angles psi at the actuators (N); two twist coefficients for the straight length of every tube
(2N); for each section u_x, u_y (`nb` each) and u_z of the tubes present (`nt` each); z of the clearance's tilt, which is
play z / sqrt(1 + z^2) at the moment m0 z (2); position of a hanging bob (3).
Inputs: actuator angles (N), tip force and moment in base axes (3, 3), position, velocity and acceleration of the base plate
(3, 3, 3), factor of all Young's and shear moduli (1).
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

S3 = math.sqrt(3.0)
GAUSS = np.array([[0.25, 0.25 - S3 / 6.0], [0.25 + S3 / 6.0, 0.25]])  # of the unit cell
NODES = np.array([0.5 - S3 / 6.0, 0.5 + S3 / 6.0])
SLOW = 0.55  # rate of convergence that calls for new Jacobians
TIP = 18  # numbers of the tip's state: p, R (row major), v, omega in base axes


class Plant(NamedTuple):
    """Everything constant during a run; N tubes, S sections, C cells. SI units."""

    # sections and cells
    h: np.ndarray  # (C,) cell lengths
    first: np.ndarray  # (S + 1,) first cell of each section
    present: np.ndarray  # (S,) tubes that run through the section
    offset: np.ndarray  # (S,) first coordinate of the section
    nb: np.ndarray  # (S,) bending coefficients
    nt: np.ndarray  # (S,) torsion coefficients
    phi: np.ndarray  # (C, 2, K) Legendre polynomials at the Gauss points
    ustar: np.ndarray  # (C, 2, N, 3) precurvature there
    ustar_ends: np.ndarray  # (S, 2, N, 3) precurvature at the section's begin and end
    ustar_plate: np.ndarray  # (N, 2) bending precurvature just behind the plate
    straight: np.ndarray  # (N,) straight lengths behind the plate
    ustar_straight: np.ndarray  # (N, 2) torsional precurvature there, at the Gauss points
    # tubes: EI about the principal axes, their angle, GJ, rho A, rho I, damping, softening curvature (inverse)
    EI: np.ndarray  # (N, 2)
    axis: np.ndarray  # (N,)
    GJ: np.ndarray
    rho_a: np.ndarray
    rho_i: np.ndarray
    bend_damp: np.ndarray
    twist_damp: np.ndarray
    soft: np.ndarray
    # bodies at tube ends
    mass: np.ndarray  # (N,)
    inertia: np.ndarray  # (N, 3) in the tube's frame
    gravity: np.ndarray  # (3,)
    # drive: stiffness and inertia between actuator and tube
    drive: np.ndarray  # (N, 2)
    # mu_base, nu_base, mu_tubes, nu_tubes, epsilon, static ratio, Stribeck speed, distributed torque
    friction: np.ndarray
    drag: np.ndarray  # linear, quadratic
    # largest tilt, moment scale; the kink's section
    clearance: np.ndarray
    # stiffness, damping, anchor (3)
    spring: np.ndarray
    # stiffness, normal (3), offset
    contact: np.ndarray
    # bob: mass, length, stiffness, damping
    bob: np.ndarray


@njit(cache=True, inline="always")
def _cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit(cache=True, inline="always")
def _turn(R, x, y, z):
    """R (9,) row major times a vector."""
    return R[0] * x + R[1] * y + R[2] * z, R[3] * x + R[4] * y + R[5] * z, R[6] * x + R[7] * y + R[8] * z


@njit(cache=True, inline="always")
def _back(R, x, y, z):
    """R^T times a vector."""
    return R[0] * x + R[3] * y + R[6] * z, R[1] * x + R[4] * y + R[7] * z, R[2] * x + R[5] * y + R[8] * z


@njit(cache=True)
def _rotate(R, x, y, z, out):
    """out = R exp(hat(x, y, z)); `out` may not be `R`."""
    a2 = x * x + y * y + z * z
    if a2 < 1e-4:
        s = 1.0 - a2 / 6.0 * (1.0 - a2 / 20.0)
        k = 0.5 - a2 / 24.0 * (1.0 - a2 / 30.0)
    else:
        a = math.sqrt(a2)
        s = math.sin(a) / a
        k = (1.0 - math.cos(a)) / a2
    e0, e1, e2 = 1.0 - k * (y * y + z * z), k * x * y - s * z, k * x * z + s * y
    e3, e4, e5 = k * x * y + s * z, 1.0 - k * (x * x + z * z), k * y * z - s * x
    e6, e7, e8 = k * x * z - s * y, k * y * z + s * x, 1.0 - k * (x * x + y * y)
    for i in range(0, 9, 3):
        a0, a1, a2_ = R[i], R[i + 1], R[i + 2]
        out[i] = a0 * e0 + a1 * e3 + a2_ * e6
        out[i + 1] = a0 * e1 + a1 * e4 + a2_ * e7
        out[i + 2] = a0 * e2 + a1 * e5 + a2_ * e8


@njit(cache=True, inline="always")
def _bending(plant, i, factor, ux, uy, utx, uty, theta, gamma, wx, wy):
    """Bending moment of tube i in the frame of tube 1; (wx, wy) is its precurvature in its own frame."""
    # into the tube's own frame, and on to its principal axes
    angle = theta + plant.axis[i]
    c, s = math.cos(angle), math.sin(angle)
    ca, sa = math.cos(plant.axis[i]), math.sin(plant.axis[i])
    kx = c * ux + s * uy - (ca * wx + sa * wy)
    ky = -s * ux + c * uy - (-sa * wx + ca * wy)
    # u_i,t in the same axes: R^T (u_t - gamma e3 x u)
    vx, vy = utx + gamma * uy, uty - gamma * ux
    soften = 1.0 / math.sqrt(1.0 + (kx * kx + ky * ky) * plant.soft[i] * plant.soft[i])
    b = plant.bend_damp[i]
    mx = factor * plant.EI[i, 0] * soften * kx + b * (c * vx + s * vy)
    my = factor * plant.EI[i, 1] * soften * ky + b * (-s * vx + c * vy)
    return c * mx - s * my, s * mx + c * my


@njit(cache=True, inline="always")
def _coulomb(friction, mu, nu, preload, rate):
    """Smoothed Coulomb law with an optional Stribeck rise towards rest, and viscous friction."""
    ratio = rate / friction[6]
    rise = 1.0 + (friction[5] - 1.0) * math.exp(-ratio * ratio)
    return mu * rise * preload * rate / math.sqrt(rate * rate + friction[4] * friction[4]) + nu * rate


@njit(cache=True)
def residual(plant, c, v, a, inputs, r, tip):
    """Write the generalized residual (n,) of coordinates, rates and accelerations, and the tip's state (TIP,)."""
    n = plant.GJ.shape[0]
    cells = plant.h.shape[0]
    sections = plant.present.shape[0]
    points = 2 * cells
    factor = inputs[n + 15]
    gx, gy, gz = plant.gravity[0], plant.gravity[1], plant.gravity[2]
    friction = plant.friction
    r[:] = 0.0
    R_at = np.empty((points, 9))
    u_at = np.empty((points, 6))  # u, u_t
    t_at = np.empty((points, 3))
    f_at = np.empty((points, 3))  # force on the motion, per length
    m_at = np.empty((points, 3))  # moment on the motion, per length
    th_at = np.zeros((points, n))
    ga_at = np.zeros((points, n))
    tau_at = np.zeros((points, n))
    uz_at = np.zeros((points, n, 3))
    edge_R = np.empty((sections + 1, 9))
    edge = np.empty((sections + 1, 9))  # omega, alpha, acceleration
    edge_th = np.zeros((sections + 1, n, 3))
    w3 = np.empty((2, 3))
    a3 = np.empty((2, 3))
    Rw = np.empty((2, 3))
    Rwt = np.empty((2, 3))
    tan = np.empty((2, 3))
    vel = np.empty((2, 3))
    acc = np.empty((2, 3))
    psi = np.empty((n, 3))
    mid = np.empty(9)

    # straight lengths behind the plate: angle, rate and acceleration of every tube at s = 0
    for i in range(n):
        length = plant.straight[i]
        k = n + 2 * i
        psi[i, 0] = c[i] + length * c[k]
        psi[i, 1] = v[i] + length * v[k]
        psi[i, 2] = a[i] + length * a[k]

    R = np.zeros(9)
    R[0] = math.cos(psi[0, 0])
    R[1] = -math.sin(psi[0, 0])
    R[3] = -R[1]
    R[4] = R[0]
    R[8] = 1.0
    wx, wy, wz = 0.0, 0.0, psi[0, 1]
    ax, ay, az = 0.0, 0.0, psi[0, 2]
    b0 = n + 6
    px, py, pz = inputs[b0], inputs[b0 + 1], inputs[b0 + 2]
    qx, qy, qz = inputs[b0 + 3], inputs[b0 + 4], inputs[b0 + 5]
    dx, dy, dz = inputs[b0 + 6], inputs[b0 + 7], inputs[b0 + 8]
    th = np.zeros((n, 3))
    for i in range(1, n):
        for k in range(3):
            th[i, k] = psi[i, k] - psi[0, k]

    kink = int(plant.clearance[2])
    zk = c.shape[0] - 5
    tilt_on = plant.clearance[0] > 0.0
    Rmid_kink = np.empty(9)

    # outwards: kinematics and the forces of the motion
    for s in range(sections):
        if s == kink and tilt_on:
            z0, z1, zd0, zd1 = c[zk], c[zk + 1], v[zk], v[zk + 1]
            e = 1.0 + z0 * z0 + z1 * z1
            g = plant.clearance[0] / math.sqrt(e)
            zz = z0 * zd0 + z1 * zd1
            zza = zd0 * zd0 + zd1 * zd1 + z0 * a[zk] + z1 * a[zk + 1]
            t0, t1 = g * z0, g * z1
            gd = -g * zz / e
            gdd = -g * zza / e + 3.0 * g * zz * zz / (e * e)
            td0, td1 = g * zd0 + gd * z0, g * zd1 + gd * z1
            ta0, ta1 = (
                g * a[zk] + 2.0 * gd * zd0 + gdd * z0,
                g * a[zk + 1] + 2.0 * gd * zd1 + gdd * z1,
            )
            edge_R[s] = R
            edge[s, 0], edge[s, 1], edge[s, 2] = wx, wy, wz
            edge[s, 3], edge[s, 4], edge[s, 5] = ax, ay, az
            edge[s, 6], edge[s, 7], edge[s, 8] = dx, dy, dz
            _rotate(R, 0.5 * t0, 0.5 * t1, 0.0, Rmid_kink)
            x, y, z = _turn(Rmid_kink, td0, td1, 0.0)
            hx, hy, hz = wx + 0.5 * x, wy + 0.5 * y, wz + 0.5 * z
            kx, ky, kz = _cross(hx, hy, hz, x, y, z)
            wx, wy, wz = wx + x, wy + y, wz + z
            x, y, z = _turn(Rmid_kink, ta0, ta1, 0.0)
            ax, ay, az = ax + x + kx, ay + y + ky, az + z + kz
            _rotate(R, t0, t1, 0.0, mid)
            R[:] = mid
        else:
            edge_R[s] = R
            edge[s, 0], edge[s, 1], edge[s, 2] = wx, wy, wz
            edge[s, 3], edge[s, 4], edge[s, 5] = ax, ay, az
            edge[s, 6], edge[s, 7], edge[s, 8] = dx, dy, dz
        edge_th[s] = th
        present = plant.present[s]
        o, nb, nt = plant.offset[s], plant.nb[s], plant.nt[s]
        for cell in range(plant.first[s], plant.first[s + 1]):
            h = plant.h[cell]
            for g in range(2):
                j = 2 * cell + g
                for k in range(6):
                    u_at[j, k] = 0.0
                x, y = 0.0, 0.0
                for k in range(nb):
                    f = plant.phi[cell, g, k]
                    u_at[j, 0] += f * c[o + k]
                    u_at[j, 1] += f * c[o + nb + k]
                    u_at[j, 3] += f * v[o + k]
                    u_at[j, 4] += f * v[o + nb + k]
                    x += f * a[o + k]
                    y += f * a[o + nb + k]
                for i in range(present):
                    q = o + 2 * nb + i * nt
                    for k in range(nt):
                        f = plant.phi[cell, g, k]
                        uz_at[j, i, 0] += f * c[q + k]
                        uz_at[j, i, 1] += f * v[q + k]
                        uz_at[j, i, 2] += f * a[q + k]
                u_at[j, 2] = uz_at[j, 0, 0]
                u_at[j, 5] = uz_at[j, 0, 1]
                Rwt[g, 0], Rwt[g, 1], Rwt[g, 2] = x, y, uz_at[j, 0, 2]
            p0, p1 = 2 * cell, 2 * cell + 1
            com = _cross(u_at[p0, 0], u_at[p0, 1], u_at[p0, 2], u_at[p1, 0], u_at[p1, 1], u_at[p1, 2])
            for g in range(2):
                j = p0 + g
                k3 = NODES[g] ** 3 * h * h * S3 / 12.0
                A0, A1 = h * GAUSS[g, 0], h * GAUSS[g, 1]
                _rotate(
                    R,
                    A0 * u_at[p0, 0] + A1 * u_at[p1, 0] + k3 * com[0],
                    A0 * u_at[p0, 1] + A1 * u_at[p1, 1] + k3 * com[1],
                    A0 * u_at[p0, 2] + A1 * u_at[p1, 2] + k3 * com[2],
                    R_at[j],
                )
                Rg = R_at[j]
                tan[g, 0], tan[g, 1], tan[g, 2] = Rg[2], Rg[5], Rg[8]
                t_at[j] = tan[g]
                Rw[g, 0], Rw[g, 1], Rw[g, 2] = _turn(Rg, u_at[j, 3], u_at[j, 4], u_at[j, 5])
                Rwt[g, 0], Rwt[g, 1], Rwt[g, 2] = _turn(Rg, Rwt[g, 0], Rwt[g, 1], Rwt[g, 2])
            for g in range(2):
                A0, A1 = h * GAUSS[g, 0], h * GAUSS[g, 1]
                w3[g, 0] = wx + A0 * Rw[0, 0] + A1 * Rw[1, 0]
                w3[g, 1] = wy + A0 * Rw[0, 1] + A1 * Rw[1, 1]
                w3[g, 2] = wz + A0 * Rw[0, 2] + A1 * Rw[1, 2]
            for g in range(2):
                x, y, z = _cross(w3[g, 0], w3[g, 1], w3[g, 2], Rw[g, 0], Rw[g, 1], Rw[g, 2])
                Rwt[g, 0] += x
                Rwt[g, 1] += y
                Rwt[g, 2] += z
            for g in range(2):
                A0, A1 = h * GAUSS[g, 0], h * GAUSS[g, 1]
                a3[g, 0] = ax + A0 * Rwt[0, 0] + A1 * Rwt[1, 0]
                a3[g, 1] = ay + A0 * Rwt[0, 1] + A1 * Rwt[1, 1]
                a3[g, 2] = az + A0 * Rwt[0, 2] + A1 * Rwt[1, 2]
            for g in range(2):
                x, y, z = _cross(w3[g, 0], w3[g, 1], w3[g, 2], tan[g, 0], tan[g, 1], tan[g, 2])
                vel[g, 0], vel[g, 1], vel[g, 2] = x, y, z
                x, y, z = _cross(w3[g, 0], w3[g, 1], w3[g, 2], x, y, z)
                kx, ky, kz = _cross(a3[g, 0], a3[g, 1], a3[g, 2], tan[g, 0], tan[g, 1], tan[g, 2])
                acc[g, 0], acc[g, 1], acc[g, 2] = x + kx, y + ky, z + kz
            rho_a, rho_i = 0.0, 0.0
            for i in range(present):
                rho_a += plant.rho_a[i]
                rho_i += plant.rho_i[i]
            for g in range(2):
                j = p0 + g
                A0, A1 = h * GAUSS[g, 0], h * GAUSS[g, 1]
                f_at[j, 0] = rho_a * (dx + A0 * acc[0, 0] + A1 * acc[1, 0] - gx)
                f_at[j, 1] = rho_a * (dy + A0 * acc[0, 1] + A1 * acc[1, 1] - gy)
                f_at[j, 2] = rho_a * (dz + A0 * acc[0, 2] + A1 * acc[1, 2] - gz)
                if plant.drag[0] > 0.0 or plant.drag[1] > 0.0:
                    x = qx + A0 * vel[0, 0] + A1 * vel[1, 0]
                    y = qy + A0 * vel[0, 1] + A1 * vel[1, 1]
                    z = qz + A0 * vel[0, 2] + A1 * vel[1, 2]
                    k = plant.drag[0] + plant.drag[1] * math.sqrt(x * x + y * y + z * z)
                    f_at[j, 0] += k * x
                    f_at[j, 1] += k * y
                    f_at[j, 2] += k * z
                # rotary inertia of the cross-sections, in the frame of tube 1
                Rg = R_at[j]
                ox, oy, oz = _back(Rg, w3[g, 0], w3[g, 1], w3[g, 2])
                ex, ey, ez = _back(Rg, a3[g, 0], a3[g, 1], a3[g, 2])
                lz, mz = 0.0, 0.0
                for i in range(present):
                    if i > 0:
                        th_at[j, i] = (
                            th[i, 0]
                            + A0 * (uz_at[p0, i, 0] - uz_at[p0, 0, 0])
                            + A1 * (uz_at[p1, i, 0] - uz_at[p1, 0, 0])
                        )
                        ga_at[j, i] = (
                            th[i, 1]
                            + A0 * (uz_at[p0, i, 1] - uz_at[p0, 0, 1])
                            + A1 * (uz_at[p1, i, 1] - uz_at[p1, 0, 1])
                        )
                    rate_t = (
                        th[i, 2]
                        + A0 * (uz_at[p0, i, 2] - uz_at[p0, 0, 2])
                        + A1 * (uz_at[p1, i, 2] - uz_at[p1, 0, 2])
                    )
                    lz += 2.0 * plant.rho_i[i] * (oz + ga_at[j, i])
                    torque = 2.0 * plant.rho_i[i] * (ez + rate_t)
                    mz += torque
                    if i > 0:
                        tau_at[j, i] = torque
                m_at[j, 0], m_at[j, 1], m_at[j, 2] = _turn(
                    Rg, rho_i * ex + oy * lz - oz * rho_i * oy, rho_i * ey + oz * rho_i * ox - ox * lz, mz
                )
            # to the end of the cell
            k3 = h * h * S3 / 12.0
            H = 0.5 * h
            _rotate(
                R,
                H * (u_at[p0, 0] + u_at[p1, 0]) + k3 * com[0],
                H * (u_at[p0, 1] + u_at[p1, 1]) + k3 * com[1],
                H * (u_at[p0, 2] + u_at[p1, 2]) + k3 * com[2],
                mid,
            )
            R[:] = mid
            wx += H * (Rw[0, 0] + Rw[1, 0])
            wy += H * (Rw[0, 1] + Rw[1, 1])
            wz += H * (Rw[0, 2] + Rw[1, 2])
            ax += H * (Rwt[0, 0] + Rwt[1, 0])
            ay += H * (Rwt[0, 1] + Rwt[1, 1])
            az += H * (Rwt[0, 2] + Rwt[1, 2])
            px += H * (tan[0, 0] + tan[1, 0])
            py += H * (tan[0, 1] + tan[1, 1])
            pz += H * (tan[0, 2] + tan[1, 2])
            qx += H * (vel[0, 0] + vel[1, 0])
            qy += H * (vel[0, 1] + vel[1, 1])
            qz += H * (vel[0, 2] + vel[1, 2])
            dx += H * (acc[0, 0] + acc[1, 0])
            dy += H * (acc[0, 1] + acc[1, 1])
            dz += H * (acc[0, 2] + acc[1, 2])
            for i in range(1, present):
                for k in range(3):
                    th[i, k] += H * (uz_at[p0, i, k] + uz_at[p1, i, k] - uz_at[p0, 0, k] - uz_at[p1, 0, k])

    tip[0], tip[1], tip[2] = px, py, pz
    tip[3:12] = R
    tip[12], tip[13], tip[14] = qx, qy, qz
    tip[15], tip[16], tip[17] = wx, wy, wz

    # what acts on the tip: N and Q are conjugate to a displacement and a rotation of the section
    m = plant.mass[0]
    Nx = m * (dx - gx) - inputs[n]
    Ny = m * (dy - gy) - inputs[n + 1]
    Nz = m * (dz - gz) - inputs[n + 2]
    ox, oy, oz = _back(R, wx, wy, wz)
    ex, ey, ez = _back(R, ax, ay, az)
    i0, i1, i2 = plant.inertia[0, 0], plant.inertia[0, 1], plant.inertia[0, 2]
    x, y, z = _cross(ox, oy, oz, i0 * ox, i1 * oy, i2 * oz)
    Qx, Qy, Qz = _turn(R, i0 * ex + x, i1 * ey + y, i2 * ez + z)
    Qx -= inputs[n + 3]
    Qy -= inputs[n + 4]
    Qz -= inputs[n + 5]
    spring = plant.spring
    Nx += spring[0] * (px - spring[2]) + spring[1] * qx
    Ny += spring[0] * (py - spring[3]) + spring[1] * qy
    Nz += spring[0] * (pz - spring[4]) + spring[1] * qz
    contact = plant.contact
    if contact[0] > 0.0:
        depth = contact[4] - (contact[1] * px + contact[2] * py + contact[3] * pz)
        if depth > 0.0:
            Nx -= contact[0] * depth * contact[1]
            Ny -= contact[0] * depth * contact[2]
            Nz -= contact[0] * depth * contact[3]
    yk = c.shape[0] - 3
    bob = plant.bob
    if bob[0] > 0.0:
        x, y, z = c[yk] - px, c[yk + 1] - py, c[yk + 2] - pz
        length = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        rate = x * (v[yk] - qx) + y * (v[yk + 1] - qy) + z * (v[yk + 2] - qz)
        pull = bob[2] * (length - bob[1]) + bob[3] * rate
        r[yk] = bob[0] * (a[yk] - gx) + pull * x
        r[yk + 1] = bob[0] * (a[yk + 1] - gy) + pull * y
        r[yk + 2] = bob[0] * (a[yk + 2] - gz) + pull * z
        Nx -= pull * x
        Ny -= pull * y
        Nz -= pull * z
    else:
        for k in range(3):
            r[yk + k] = a[yk + k] + c[yk + k]
    if not tilt_on:
        r[zk] = a[zk] + c[zk]
        r[zk + 1] = a[zk + 1] + c[zk + 1]

    # inwards: transposed quadrature
    Th = np.zeros(n)
    pi = np.empty((2, 3))
    ph = np.empty((2, 3))
    near = np.empty((n, 2))
    far = np.empty((n, 2))
    for s in range(sections - 1, -1, -1):
        present = plant.present[s]
        o, nb, nt = plant.offset[s], plant.nb[s], plant.nt[s]
        for cell in range(plant.first[s + 1] - 1, plant.first[s] - 1, -1):
            h = plant.h[cell]
            H = 0.5 * h
            p0, p1 = 2 * cell, 2 * cell + 1
            for g in range(2):
                j = p0 + g
                B0, B1 = h * GAUSS[0, g] * H, h * GAUSS[1, g] * H
                pi[g, 0] = H * Nx + B0 * f_at[p0, 0] + B1 * f_at[p1, 0]
                pi[g, 1] = H * Ny + B0 * f_at[p0, 1] + B1 * f_at[p1, 1]
                pi[g, 2] = H * Nz + B0 * f_at[p0, 2] + B1 * f_at[p1, 2]
                x, y, z = _cross(t_at[j, 0], t_at[j, 1], t_at[j, 2], pi[g, 0], pi[g, 1], pi[g, 2])
                ph[g, 0] = x + H * m_at[j, 0]
                ph[g, 1] = y + H * m_at[j, 1]
                ph[g, 2] = z + H * m_at[j, 2]
            for g in range(2):
                j = p0 + g
                ux, uy, utx, uty = u_at[j, 0], u_at[j, 1], u_at[j, 3], u_at[j, 4]
                B0, B1 = h * GAUSS[0, g], h * GAUSS[1, g]
                x, y, z = _back(
                    R_at[j],
                    B0 * ph[0, 0] + B1 * ph[1, 0] + H * Qx,
                    B0 * ph[0, 1] + B1 * ph[1, 1] + H * Qy,
                    B0 * ph[0, 2] + B1 * ph[1, 2] + H * Qz,
                )
                for i in range(present):
                    mx, my = _bending(
                        plant,
                        i,
                        factor,
                        ux,
                        uy,
                        utx,
                        uty,
                        th_at[j, i],
                        ga_at[j, i],
                        plant.ustar[cell, g, i, 0],
                        plant.ustar[cell, g, i, 1],
                    )
                    x += H * mx
                    y += H * my
                    if i > 0:
                        tau_at[j, i] += mx * uy - my * ux
                        if friction[7] > 0.0:
                            rate = ga_at[j, i] - ga_at[j, i - 1]
                            torque = friction[7] * rate / math.sqrt(rate * rate + friction[4] * friction[4])
                            tau_at[j, i] += torque
                            if i > 1:
                                tau_at[j, i - 1] -= torque
                for k in range(nb):
                    f = plant.phi[cell, g, k]
                    r[o + k] += f * x
                    r[o + nb + k] += f * y
                u_at[j, 2] = z  # the strain is used up: now the torque on u_1z
            for g in range(2):
                j = p0 + g
                B0, B1 = h * GAUSS[0, g] * H, h * GAUSS[1, g] * H
                z = u_at[j, 2]
                for i in range(present - 1, -1, -1):
                    torque = H * (
                        factor * plant.GJ[i] * (uz_at[j, i, 0] - plant.ustar[cell, g, i, 2])
                        + plant.twist_damp[i] * uz_at[j, i, 1]
                    )
                    if i > 0:
                        twist = B0 * tau_at[p0, i] + B1 * tau_at[p1, i] + H * Th[i]
                        z -= twist
                        torque += twist
                    else:
                        torque += z
                    q = o + 2 * nb + i * nt
                    for k in range(nt):
                        r[q + k] += plant.phi[cell, g, k] * torque
            Nx += H * (f_at[p0, 0] + f_at[p1, 0])
            Ny += H * (f_at[p0, 1] + f_at[p1, 1])
            Nz += H * (f_at[p0, 2] + f_at[p1, 2])
            Qx += ph[0, 0] + ph[1, 0]
            Qy += ph[0, 1] + ph[1, 1]
            Qz += ph[0, 2] + ph[1, 2]
            for i in range(1, present):
                Th[i] += H * (tau_at[p0, i] + tau_at[p1, i])
        # the section's begin: kink, bodies of tubes that end here, friction
        if s == kink and tilt_on:
            x, y, z = _back(Rmid_kink, Qx, Qy, Qz)
            r[zk] = plant.clearance[1] * c[zk] + x
            r[zk + 1] = plant.clearance[1] * c[zk + 1] + y
        before = plant.present[s - 1] if s > 0 else present
        for i in range(present, before):
            m = plant.mass[i]
            Nx += m * (edge[s, 6] - gx)
            Ny += m * (edge[s, 7] - gy)
            Nz += m * (edge[s, 8] - gz)
            ox, oy, oz = _back(edge_R[s], edge[s, 0], edge[s, 1], edge[s, 2])
            ex, ey, ez = _back(edge_R[s], edge[s, 3], edge[s, 4], edge[s, 5])
            cs, sn = math.cos(edge_th[s, i, 0]), math.sin(edge_th[s, i, 0])
            ga = edge_th[s, i, 1]
            ix, iy, iz = cs * ox + sn * oy, -sn * ox + cs * oy, oz + ga
            jx, jy, jz = cs * ex + sn * ey, -sn * ex + cs * ey, ez + edge_th[s, i, 2]
            i0, i1, i2 = plant.inertia[i, 0], plant.inertia[i, 1], plant.inertia[i, 2]
            x, y, z = _cross(ix, iy, iz, i0 * ix, i1 * iy, i2 * iz)
            x += i0 * (jx + ga * iy)
            y += i1 * (jy - ga * ix)
            z += i2 * jz
            Th[i] += z
            x, y, z = _turn(edge_R[s], cs * x - sn * y, sn * x + cs * y, z)
            Qx += x
            Qy += y
            Qz += z
        for i in range(n):
            near[i] = 0.0
            far[i] = 0.0
        total_x, total_y = 0.0, 0.0
        for side in range(2):
            q = s - 1 + side
            if q < 0:
                for i in range(n):
                    cs, sn = math.cos(edge_th[0, i, 0]), math.sin(edge_th[0, i, 0])
                    a1 = plant.ustar_plate[i]
                    if a1[0] != 0.0 or a1[1] != 0.0:
                        near[i, 0], near[i, 1] = _bending(
                            plant,
                            i,
                            factor,
                            0.0,
                            0.0,
                            0.0,
                            0.0,
                            edge_th[0, i, 0],
                            edge_th[0, i, 1],
                            a1[0],
                            a1[1],
                        )
                continue
            ux, uy, utx, uty = 0.0, 0.0, 0.0, 0.0
            oq, nq = plant.offset[q], plant.nb[q]
            for k in range(nq):
                f = -1.0 if side == 1 and k % 2 == 1 else 1.0
                ux += f * c[oq + k]
                uy += f * c[oq + nq + k]
                utx += f * v[oq + k]
                uty += f * v[oq + nq + k]
            for i in range(plant.present[q]):
                mx, my = _bending(
                    plant,
                    i,
                    factor,
                    ux,
                    uy,
                    utx,
                    uty,
                    edge_th[s, i, 0],
                    edge_th[s, i, 1],
                    plant.ustar_ends[q, 1 - side, i, 0],
                    plant.ustar_ends[q, 1 - side, i, 1],
                )
                if side == 0:
                    near[i, 0], near[i, 1] = mx, my
                else:
                    far[i, 0], far[i, 1] = mx, my
                    total_x += mx
                    total_y += my
        for i in range(before - 1):
            rate = edge_th[s, i + 1, 1] - edge_th[s, i, 1]
            x, y = far[i, 0] - near[i, 0], far[i, 1] - near[i, 1]
            torque = _coulomb(friction, friction[2], friction[3], math.sqrt(x * x + y * y), rate)
            Th[i + 1] += torque
            if i > 0:
                Th[i] -= torque
        if s == 0:
            torque = _coulomb(
                friction,
                friction[0],
                friction[1],
                math.sqrt(total_x * total_x + total_y * total_y),
                psi[n - 1, 1],
            )
            # on the absolute angle of the outermost tube
            if n > 1:
                Th[n - 1] += torque
            Qz += torque

    # straight lengths and drives
    for i in range(n):
        k = n + 2 * i
        length = plant.straight[i]
        end = Th[i] if i > 0 else Qz
        if i == 0:
            for q in range(1, n):
                end -= Th[q]
        r[i] = end + plant.drive[i, 0] * (c[i] - inputs[i]) + plant.drive[i, 1] * a[i]
        r[k] = length * end
        if length < 1e-9:  # held at the plate: its twist coefficients mean nothing and stay zero
            r[k] = a[k] + c[k]
            r[k + 1] = a[k + 1] + c[k + 1]
            continue
        H = 0.5 * length
        inertia = 2.0 * plant.rho_i[i]
        for g in range(2):
            x = 2.0 * NODES[g] - 1.0
            # integrals of the two twist polynomials, 1 and x, from the actuator to this point
            w0, w1 = length * NODES[g], 0.25 * length * (x * x - 1.0)
            torque = H * inertia * (a[i] + w0 * a[k] + w1 * a[k + 1])
            strain = c[k] + x * c[k + 1]
            moment = H * (
                factor * plant.GJ[i] * (strain - plant.ustar_straight[i, g])
                + plant.twist_damp[i] * (v[k] + x * v[k + 1])
            )
            r[i] += torque
            r[k] += w0 * torque + moment
            r[k + 1] += w1 * torque + x * moment


@njit(cache=True)
def jacobians(plant, c, v, a, inputs, K, D, M):
    """Write dr/dc, dr/dc_t and dr/dc_tt (n, n) by differences of the residual."""
    n = c.shape[0]
    r0, r1 = np.empty(n), np.empty(n)
    tip = np.empty(TIP)
    residual(plant, c, v, a, inputs, r0, tip)
    x = c.copy()
    for k in range(n):
        x[k] = c[k] + 1e-6
        residual(plant, x, v, a, inputs, r1, tip)
        K[:, k] = (r1 - r0) / (x[k] - c[k])
        x[k] = c[k]
    x[:] = v
    for k in range(n):
        x[k] = v[k] + 1e-4
        residual(plant, c, x, a, inputs, r1, tip)
        D[:, k] = (r1 - r0) / (x[k] - v[k])
        x[k] = v[k]
    x[:] = a
    for k in range(n):
        x[k] = a[k] + 1.0
        residual(plant, c, v, x, inputs, r1, tip)
        M[:, k] = (r1 - r0) / (x[k] - a[k])
        x[k] = a[k]


class Scheme(NamedTuple):
    """Radau IIA, three stages."""

    nodes: np.ndarray  # (3,)
    A: np.ndarray  # (3, 3)
    A2: np.ndarray  # (3, 3) its square
    eigenvalues: np.ndarray  # (3,) complex, the real one first
    T: np.ndarray  # (3, 3) complex, eigenvectors
    Tinv: np.ndarray
    extrapolate: np.ndarray  # (3, 3) stage values of the last step to those of the next


@njit(cache=True)
def _full_newton(plant, scheme, c, v, A, inputs, h, tolerance, counts):
    """Solve one step for the stage accelerations A (3, n) with the Jacobians of every stage; False when that fails."""
    n = c.shape[0]
    C, V = np.empty(n), np.empty(n)
    r = np.empty((3, n))
    flat = np.empty(3 * n)
    tip = np.empty(TIP)
    K, D, M = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    whole = np.empty((3 * n, 3 * n))
    for _ in range(25):
        counts[0] += 1
        counts[1] += 3
        for j in range(3):
            for k in range(n):
                C[k] = c[k] + h * scheme.nodes[j] * v[k]
                V[k] = v[k]
                for i in range(3):
                    C[k] += h * h * scheme.A2[j, i] * A[i, k]
                    V[k] += h * scheme.A[j, i] * A[i, k]
            residual(plant, C, V, A[j], inputs[j], r[j], tip)
            jacobians(plant, C, V, A[j], inputs[j], K, D, M)
            for i in range(3):
                block = h * scheme.A[j, i] * D + h * h * scheme.A2[j, i] * K
                if i == j:
                    block += M
                whole[j * n : (j + 1) * n, i * n : (i + 1) * n] = block
            flat[j * n : (j + 1) * n] = -r[j]
        change = np.linalg.solve(whole, flat)
        size = h * h * np.abs(change).max()
        if not size < 1e6:
            return False
        share = min(1.0, 20.0 / size)
        for j in range(3):
            for k in range(n):
                A[j, k] += share * change[j * n + k]
        if size < tolerance:
            return True
    return False


@njit(cache=True)
def integrate(plant, scheme, c, v, inputs, h, tolerance, tips, counts, path):
    """Integrate len(inputs) steps of h s in place of (c, v); tips[0] is the begin.

    `inputs` (steps, 3, N + 16) at the stages, `tips` (steps + 1, TIP), `counts` (2,) iterations and Jacobians; `path` gets the coordinates
    (steps, n) behind every step unless it is empty. Returns the number of steps done; fewer than asked when Newton's method fails.
    """
    n = c.shape[0]
    steps = inputs.shape[0]
    A = np.zeros((3, n))
    dA = np.empty((3, n))
    r = np.empty((3, n))
    C = np.empty(n)
    V = np.empty(n)
    K, D, M = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    inverse0 = np.empty((n, n))
    inverse1 = np.empty((n, n), dtype=np.complex128)
    z0 = np.empty(n)
    z1 = np.empty(n, dtype=np.complex128)
    age = 1000
    for step in range(steps):
        start = A[2].copy()
        guess = np.dot(scheme.extrapolate, A)
        done = False
        for attempt in range(3):
            if attempt == 0:
                A[:] = guess
            else:  # after an event the extrapolation leads astray
                for j in range(3):
                    A[j] = (2 - attempt) * start
                age = 1000
            last, rising, since = np.inf, 0, 0
            for _ in range(60):
                counts[0] += 1
                for j in range(2, -1, -1):
                    for k in range(n):
                        C[k] = c[k] + h * scheme.nodes[j] * v[k]
                        V[k] = v[k]
                        for i in range(3):
                            C[k] += h * h * scheme.A2[j, i] * A[i, k]
                            V[k] += h * scheme.A[j, i] * A[i, k]
                    residual(plant, C, V, A[j], inputs[step, j], r[j], tips[step + 1])
                    if j == 1 and age >= 1000:
                        jacobians(plant, C, V, A[1], inputs[step, 1], K, D, M)
                        counts[1] += 1
                        lam = scheme.eigenvalues[0].real
                        inverse0[:] = np.linalg.inv(M + h * lam * D + h * h * lam * lam * K)
                        mu = scheme.eigenvalues[1]
                        inverse1[:] = np.linalg.inv(M + (h * mu) * D + (h * h * mu * mu) * K)
                        age, since = 0, 0
                for k in range(n):
                    z0[k] = -(
                        scheme.Tinv[0, 0] * r[0, k]
                        + scheme.Tinv[0, 1] * r[1, k]
                        + scheme.Tinv[0, 2] * r[2, k]
                    ).real
                    z1[k] = -(
                        scheme.Tinv[1, 0] * r[0, k]
                        + scheme.Tinv[1, 1] * r[1, k]
                        + scheme.Tinv[1, 2] * r[2, k]
                    )
                y0 = np.dot(inverse0, z0)
                y1 = np.dot(inverse1, z1)
                size = 0.0
                for j in range(3):
                    for k in range(n):
                        dA[j, k] = scheme.T[j, 0].real * y0[k] + 2.0 * (scheme.T[j, 1] * y1[k]).real
                        size = max(size, abs(dA[j, k]))
                size *= h * h
                if not size < 1e4:
                    break
                for j in range(3):
                    for k in range(n):
                        A[j, k] += dA[j, k]
                if size < tolerance:
                    done = True
                    break
                since += 1
                rising = rising + 1 if size > last else 0
                if rising > 4:
                    break
                if size > SLOW * last and since > 1:
                    age = 1000
                last = size
            if done:
                age += 1 if age < 1000 else 0
                break
        if not done:
            A[:] = 0.0
            done = _full_newton(plant, scheme, c, v, A, inputs[step], h, tolerance, counts)
            if not done:
                for j in range(3):
                    A[j] = start
                done = _full_newton(plant, scheme, c, v, A, inputs[step], h, tolerance, counts)
            age = 1000
        if not done:
            return step
        for k in range(n):
            C[k] = c[k] + h * v[k]
            V[k] = v[k]
            for i in range(3):
                C[k] += h * h * scheme.A2[2, i] * A[i, k]
                V[k] += h * scheme.A[2, i] * A[i, k]
        c[:] = C
        v[:] = V
        if len(path):
            path[step] = C
        residual(plant, c, v, A[2], inputs[step, 2], r[0], tips[step + 1])
    return steps
