"""Plain NumPy twin of the arc-length kernels, written from the vector form of the equations, one point and
one tube at a time.

Nothing is simplified by hand: the common curvature follows from (14) by solving for it numerically, and
angular rates of the tubes are differentiated as vectors, so that (12), (13), (16) and (17) in the kernels are
checked against where they come from.
"""

import numpy as np

E3 = np.array([0.0, 0.0, 1.0])


def turn(angle: float) -> np.ndarray:
    """R_z(angle)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation(h: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion of any length."""
    w, v = h[0], h[1:]
    V = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2.0 / (h @ h) * (w * V + V @ V)


class Oracle:
    """One robot: named parameters, equations at a point, and the sweep over a mesh."""

    def __init__(self, layout, par: np.ndarray, mesh, seclen: np.ndarray, c0: float) -> None:
        self.n, self.mesh, self.seclen, self.c0 = layout.n, mesh, seclen, c0
        self.p = {name: par[layout[name]] for name in layout.names}
        self.J = [np.diag([1.0, 1.0, 2.0]) * i for i in self.p["inertia_per_length"]]
        self.K = [
            np.diag([e, e, g])
            for e, g in zip(self.p["bending_stiffness"], self.p["torsional_stiffness"], strict=True)
        ]
        self.B = [
            np.diag([b, b, t])
            for b, t in zip(self.p["bending_damping"], self.p["torsion_damping"], strict=True)
        ]

    def unpack(self, y: np.ndarray):
        """p, h, q, omega, n, m_xy, m_z (N,), theta (N,), gamma (N,)."""
        n = self.n
        theta, gamma = np.zeros(n), np.zeros(n)
        theta[1:], gamma[1:] = y[18 + n : 17 + 2 * n], y[17 + 2 * n : 16 + 3 * n]
        return y[:3], y[3:7], y[7:10], y[10:13], y[13:16], y[16:18], y[18 : 18 + n], theta, gamma

    def tube_moment(self, i, u1, u1_t, uz, uz_t, theta, gamma, reference):
        """Internal moment of tube i in its own frame, (14), and its curvature vector.

        U_i,t is the derivative of R_z^T u_1 as a vector.
        """
        Rt = turn(theta[i]).T
        u = Rt @ u1
        u_t = Rt @ u1_t - gamma[i] * np.cross(E3, u)
        u[2], u_t[2] = uz[i], uz_t[i]
        return self.K[i] @ (u - self.p["precurvature"][i] * reference[i]) + self.B[i] @ u_t, u

    def strains(self, y, history, present, reference):
        """u_1, u_1,t, u_z and u_z,t of all tubes."""
        *_, m_xy, mz, theta, gamma = self.unpack(y)
        c0, n = self.c0, self.n
        uz, uz_t = np.zeros(n), np.zeros(n)
        for i in range(present):
            g, b = self.K[i][2, 2], self.B[i][2, 2]
            target = mz[i] + g * self.p["precurvature"][i] * reference[i, 2]
            uz[i] = (target - b * history[8 + i]) / (g + c0 * b)
            uz_t[i] = c0 * uz[i] + history[8 + i]

        def total(xy):
            u1 = np.array([*xy, uz[0]])
            u1_t = np.array([*(c0 * np.asarray(xy) + history[6:8]), uz_t[0]])
            return sum(
                turn(theta[i]) @ self.tube_moment(i, u1, u1_t, uz, uz_t, theta, gamma, reference)[0]
                for i in range(present)
            )[:2]

        free = total((0.0, 0.0))
        slope = np.column_stack([total((1.0, 0.0)) - free, total((0.0, 1.0)) - free])
        xy = np.linalg.solve(slope, m_xy - free)
        u1 = np.array([*xy, uz[0]])
        u1_t = np.array([*(c0 * xy + history[6:8]), uz_t[0]])
        return u1, u1_t, uz, uz_t

    def rates(self, y, history, gamma):
        """omega_1,t, gamma_t (N,) and acceleration in the frame of tube 1."""
        _, _, q, w, *_ = self.unpack(y)
        w_t = self.c0 * w + history[3:6]
        g_t = np.zeros(self.n)
        g_t[1:] = self.c0 * gamma[1:] + history[8 + self.n : 7 + 2 * self.n]
        return w_t, g_t, np.cross(w, q) + self.c0 * q + history[:3]

    def own_rate(self, i, w, w_t, theta, gamma, g_t):
        """omega_i and its derivative, (7), in the frame of tube i."""
        Rt = turn(theta[i]).T
        wi = Rt @ w + gamma[i] * E3
        wi_t = Rt @ w_t - gamma[i] * np.cross(E3, Rt @ w) + g_t[i] * E3
        return wi, wi_t

    def derivative(self, y, history, present, reference):
        """(13), and the fields at the point."""
        n, p = self.n, self.p
        _, h, q, w, nb, m_xy, mz, theta, gamma = self.unpack(y)
        u1, u1_t, uz, uz_t = self.strains(y, history, present, reference)
        w_t, g_t, acceleration = self.rates(y, history, gamma)
        R = rotation(h)
        y_s = np.zeros_like(y)
        y_s[:3] = R @ E3
        a, b, c = u1
        Q = np.array([[0, -a, -b, -c], [a, 0, c, -b], [b, -c, 0, a], [c, b, -a, 0]])
        y_s[3:7] = 0.5 * Q @ h
        y_s[7:10] = -np.cross(u1, q) + np.cross(w, E3)
        y_s[10:13] = u1_t - np.cross(u1, w)
        mass = p["mass_per_length"][:present].sum()
        y_s[13:16] = mass * (acceleration - R.T @ p["gravity"]) - np.cross(u1, nb)
        m = np.array([*m_xy, mz[:present].sum()])
        inertia = np.zeros(3)
        for i in range(present):
            wi, wi_t = self.own_rate(i, w, w_t, theta, gamma, g_t)
            torque = np.cross(wi, self.J[i] @ wi) + self.J[i] @ wi_t
            inertia += turn(theta[i]) @ torque
            mi, ui = self.tube_moment(i, u1, u1_t, uz, uz_t, theta, gamma, reference)
            y_s[18 + i] = -np.cross(ui, mi)[2] + torque[2]
            if i:
                y_s[17 + n + i] = uz[i] - uz[0]
                y_s[16 + 2 * n + i] = uz_t[i] - uz_t[0]
        y_s[16:18] = (-np.cross(u1, m) - np.cross(E3, nb) + inertia)[:2]
        fields = np.zeros(7 + 2 * n)
        fields[:3], fields[3:6], fields[6:9] = q, w, u1
        fields[9 : 8 + present] = uz[1:present]
        fields[8 + n : 7 + n + present] = gamma[1:present]
        return y_s, fields

    def moments(self, y, history, present, reference):
        """Internal moments (N, 2) in the frame of tube 1."""
        *_, theta, gamma = self.unpack(y)
        u1, u1_t, uz, uz_t = self.strains(y, history, present, reference)
        result = np.zeros((self.n, 2))
        for i in range(present):
            mi, _ = self.tube_moment(i, u1, u1_t, uz, uz_t, theta, gamma, reference)
            result[i] = (turn(theta[i]) @ mi)[:2]
        return result

    def slip(self, rate):
        """Smoothed sign of a sliding rate."""
        return rate / np.hypot(rate, self.p["epsilon"][0])

    def friction(self, y, near, far, present):
        """(22), (23) between every pair of neighbours; changes the m_z of `y`."""
        *_, gamma = self.unpack(y)
        for i in range(present - 1):
            rate = gamma[i + 1] - gamma[i]
            jump = np.linalg.norm(far[i] - near[i])
            tau = self.p["tube_coulomb"][0] * jump * self.slip(rate) + self.p["tube_viscous"][0] * rate
            y[18 + i] -= tau
            y[19 + i] += tau

    def body(self, y, history, i):
        """m (p_tt - g) and the body's rate of angular momentum, both in the frame of tube 1."""
        p = self.p
        _, h, _, w, *_, theta, gamma = self.unpack(y)
        w_t, g_t, acceleration = self.rates(y, history, gamma)
        wi, wi_t = self.own_rate(i, w, w_t, theta, gamma, g_t)
        H = np.diag([p[f"body_inertia_{k}"][i] for k in "xyz"])
        force = p["body_mass"][i] * (acceleration - rotation(h).T @ p["gravity"])
        return force, turn(theta[i]) @ (H @ wi_t + np.cross(wi, H @ wi))

    def below(self, x, histb):
        """(18) and (19): state at s = 0- and the fields behind the plate."""
        n, p, mesh, c0 = self.n, self.p, self.mesh, self.c0
        points = 4 * mesh.base_cells + 1
        histb = histb[: n * points * 2].reshape(n, points, 2)
        reference = mesh.ust_base.reshape(n, points)
        fields = np.zeros((n, points, 2))
        ends = []
        for i in range(n):
            g, b, ks = self.K[i][2, 2], self.B[i][2, 2], p["precurvature"][i]

            def slope(v, point, i=i, g=g, b=b, ks=ks):
                u = (v[2] + g * ks * reference[i, point] - b * histb[i, point, 1]) / (g + c0 * b)
                fields[i, point] = v[1], u
                rate = 2.0 * p["inertia_per_length"][i] * (c0 * v[1] + histb[i, point, 0])
                return np.array([u, c0 * u + histb[i, point, 1], rate])

            v = np.array([p["alpha"][i], p["alpha_rate"][i], x[i]])
            step = -p["beta"][i] / mesh.base_cells
            for cell in range(mesh.base_cells):
                v = runge_kutta(v, step, slope, 4 * cell)
            slope(v, points - 1)
            ends.append(v)
        psi, rate, torque = np.array(ends).T
        y = np.zeros(16 + 3 * n)
        y[3], y[6] = np.cos(psi[0] / 2), np.sin(psi[0] / 2)
        y[12] = rate[0]
        y[13:16], y[16:18] = x[n : n + 3], x[n + 3 :]
        y[18 : 18 + n] = torque
        y[18 + n : 17 + 2 * n] = psi[1:] - psi[0]
        y[17 + 2 * n :] = rate[1:] - rate[0]
        return y, fields

    def sweep(self, x, hist, histb):
        """(res, fields (points, F), base fields (N, points, 2), nodes) as the kernel returns them."""
        n, p, mesh = self.n, self.p, self.mesh
        F = 7 + 2 * n
        hist = hist.reshape(-1, F)
        ust = mesh.ust.reshape(-1, n, 3)
        y, base = self.below(x, histb)
        fields, nodes, res = np.zeros_like(hist), [], np.zeros(5 + n)
        *_, theta, gamma = self.unpack(y)
        straight = mesh.ust0.reshape(n, 3)
        near = np.array(
            [
                -p["bending_stiffness"][i] * p["precurvature"][i] * (turn(theta[i]) @ straight[i])[:2]
                for i in range(n)
            ]
        )
        # base plate on the outermost tube, (24)
        rate = y[12] + gamma[n - 1]
        y[18 + n - 1] += (
            p["base_coulomb"][0] * np.linalg.norm(y[16:18]) * self.slip(rate) + p["base_viscous"][0] * rate
        )
        point, before = 0, n
        for k, cells in enumerate(mesh.sec_cells):
            present = int(mesh.sec_tubes[k])
            far = self.moments(y, hist[point], present, ust[point])
            self.friction(y, near, far, before)
            if before > present:
                res[5 + present] = -y[18 + present]
                y[18 + present] = 0.0
            step = self.seclen[k] / cells
            for _ in range(cells):
                nodes.append(y.copy())

                def slope(v, at, present=present):
                    v_s, fields[at] = self.derivative(v, hist[at], present, ust[at])
                    return v_s

                y = runge_kutta(y, step, slope, point)
                point += 4
            nodes.append(y.copy())
            _, fields[point] = self.derivative(y, hist[point], present, ust[point])
            near = self.moments(y, hist[point], present, ust[point])
            here = hist[point]
            point += 1
            before = present
            after = int(mesh.sec_tubes[k + 1]) if k + 1 < len(mesh.sec_cells) else 0
            if after < present:
                force, moment = self.body(y, here, present - 1)
                if present > 1:
                    y[13:16] += force
                    y[16:18] += moment[:2]
                    y[18 + present - 1] += moment[2]
        R = rotation(y[3:7])
        m = np.array([y[16], y[17], y[18]])
        res[:3] = R.T @ p["force"] - y[13:16] - force
        res[3:6] = R.T @ p["torque"] - m - moment
        return res, fields, base, np.array(nodes)


def runge_kutta(y, step, slope, point):
    """One classical step whose four slopes are taken at the points `point` .. `point` + 3."""
    k1 = slope(y, point)
    k2 = slope(y + 0.5 * step * k1, point + 1)
    k3 = slope(y + 0.5 * step * k2, point + 2)
    k4 = slope(y + step * k3, point + 3)
    return y + step / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
