"""Problems and the plain NumPy twin of (25) for tests of the finite-difference solver."""

from pathlib import Path

import numpy as np
from model_cases import many_tubes
from model_oracle import Oracle, rotation, turn

from ctr_dynamics.kernels.snap_residual import residual, solver_arrays
from ctr_dynamics.model.model import Model
from ctr_dynamics.snap.solver import SnapSolver

EXAMPLE, START = "till2020_snap_example", 3.56
DATA = Path(__file__).parent.parent / "data" / "snap"


def table(name: str) -> dict[str, np.ndarray]:
    """Columns of a reference table by header."""
    with (DATA / name).open() as stream:
        header = stream.readline().strip().split(",")
        return dict(zip(header, np.loadtxt(stream, delimiter=",").T, strict=True))


def random_problem(n: int, seed: int, last_at_plate: bool = True, extended: bool = False):
    """A solver of `n` tubes with random unknowns, actuators, loads and histories of the size of motion, everything in the model on.

    `extended`: compliant drives, friction along the overlap and its Stribeck peak too.
    """
    rng = np.random.default_rng(seed)
    robot = many_tubes(n)
    beta = np.array(robot.rest.beta.value)
    if last_at_plate and n > 1:
        beta -= beta[-1]
    model = Model(robot)
    from ctr_dynamics.model.mesh import breakpoints

    sections = len(breakpoints(model.segments, beta))
    solver = SnapSolver(robot, beta, (3, *[2] * sections))
    layout, par = solver.model.layout, solver.parameters
    par[layout["alpha"]] = rng.uniform(-3, 3, n)
    par[layout["alpha_rate"]] = rng.uniform(-2, 2, n)
    par[layout["force"]] = rng.uniform(-0.2, 0.2, 3)
    par[layout["torque"]] = rng.uniform(-0.01, 0.01, 3)
    if extended:
        par[layout["drive_compliance"]] = rng.uniform(1.0, 10.0, n)
        par[layout["drive_inertia"]] = rng.uniform(0.0, 1e-8, n)
        par[layout["overlap_friction"]] = 0.02
        par[layout["stribeck_excess"]], par[layout["stribeck_inverse_speed"]] = 0.7, 0.01
    work = solver.work
    scale = np.array([5.0] * 3 + [50.0] * 3 + [100.0] * 3 + [100.0] * (n - 1) + [50.0] * (n - 1))
    work.hist[:] = rng.uniform(-1, 1, work.hist.shape) * scale
    work.hist_base[:] = rng.uniform(-1, 1, work.hist_base.shape) * np.array([50.0, 100.0])
    if extended:
        work.hist_drive[:] = rng.uniform(-1, 1, 2 * n) * np.tile([5.0, 1e4], n)
    x = solver.x + 0.3 * rng.standard_normal(len(solver.x))
    return solver, x


def error_of(solver: SnapSolver, x: np.ndarray, c0: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """E, fields and base fields at `x` with the solver's histories."""
    arrays = solver.grid.arrays
    work = solver_arrays(arrays)
    for mine, given in (
        (work.hist, solver.work.hist),
        (work.hist_base, solver.work.hist_base),
        (work.hist_drive, solver.work.hist_drive),
    ):
        mine[:] = given
    residual(arrays, x, solver.parameters, c0, work)
    return work.error, work.out, work.out_base


class ExtendedOracle(Oracle):
    """The model's twin with a Stribeck peak of Coulomb friction."""

    def slip(self, rate):
        """Smoothed sign of a sliding rate, larger near rest."""
        excess, inverse = self.p["stribeck_excess"][0], self.p["stribeck_inverse_speed"][0]
        return super().slip(rate) * (1.0 + excess * np.exp(-((rate * inverse) ** 2)))


class Twin:
    """E of (25) point by point from the vector equations of the model's own twin, which writes n in the frame of tube 1."""

    def __init__(self, solver: SnapSolver, c0: float) -> None:
        self.g, self.c0, self.n = solver.grid.arrays, c0, solver.n
        self.work = solver.work
        self.oracle = ExtendedOracle(solver.model.layout, solver.parameters, None, None, c0)
        self.rows = []

    def to_model(self, y, m):
        """State of `m` tubes here as the twin's state of all."""
        n = self.n
        full = np.zeros(16 + 3 * n)
        full[:18] = y[:18]
        full[13:16] = rotation(y[3:7]).T @ y[13:16]
        full[18 : 18 + m] = y[18 : 18 + m]
        full[18 + n : 17 + n + m] = y[18 + m : 17 + 2 * m]
        full[17 + 2 * n : 16 + 2 * n + m] = y[17 + 2 * m : 16 + 3 * m]
        return full

    def slope(self, y, m, hist, reference):
        """(13) of the paper's state, n in the base frame."""
        n, full = self.n, self.to_model(y, m)
        k, fields = self.oracle.derivative(full, hist, m, reference)
        R = rotation(y[3:7])
        found = np.zeros(16 + 3 * m)
        found[:18] = k[:18]
        found[13:16] = R @ (k[13:16] + np.cross(fields[6:9], full[13:16]))
        found[18 : 18 + m] = k[18 : 18 + m]
        p, gamma = self.oracle.p, np.concatenate([[0.0], y[17 + 2 * m : 16 + 3 * m]])
        for i in range(m - 1):
            rub = p["overlap_friction"][0] * Oracle.slip(self.oracle, gamma[i + 1] - gamma[i])
            found[18 + i] -= rub
            found[19 + i] += rub
        found[18 + m : 17 + 2 * m] = k[18 + n : 17 + n + m]
        found[17 + 2 * m :] = k[17 + 2 * n : 16 + 2 * n + m]
        return found

    def drive(self, i, torque):
        """(psi, psi_t) of tube i at its actuator, by the balance of its drive: J psi_tt = (alpha - psi) / compliance + torque."""
        p, c0 = self.oracle.p, self.c0
        h, h_rate = self.work.hist_drive[2 * i : 2 * i + 2]

        def torque_residual(give):
            rate = p["alpha_rate"][i] + c0 * give + h
            inertia = p["drive_inertia"][i] * (c0 * rate + h_rate)
            return give - p["drive_compliance"][i] * (torque - inertia), rate

        # linear in what the drive gives way
        at_0, at_1 = torque_residual(0.0)[0], torque_residual(1.0)[0]
        give = -at_0 / (at_1 - at_0)
        return p["alpha"][i] + give, torque_residual(give)[1]

    def base_slope(self, v, i, reference, hist):
        """(18) of tube i."""
        o = self.oracle
        g, b, ks = o.K[i][2, 2], o.B[i][2, 2], o.p["precurvature"][i]
        u = (v[2] + g * ks * reference - b * hist[1]) / (g + self.c0 * b)
        rate = 2.0 * o.p["inertia_per_length"][i] * (self.c0 * v[1] + hist[0])
        return np.array([u, self.c0 * u + hist[1], rate])

    def enter(self, x):
        """(19), (24) and friction at the plate: state at s = 0+."""
        g, n, o = self.g, self.n, self.oracle
        t = g.turning
        psi, rate, torque = o.p["alpha"].copy(), o.p["alpha_rate"].copy(), np.zeros(n)
        for i in range(t):
            psi[i], rate[i], torque[i] = x[3 * i : 3 * i + 3]
        torque[t:] = x[3 * t + 5 :]
        for i in range(t, n):
            psi[i], rate[i] = self.drive(i, torque[i])
        y = np.zeros(16 + 3 * n)
        y[3], y[6], y[12] = np.cos(psi[0] / 2), np.sin(psi[0] / 2), rate[0]
        y[13:18] = x[3 * t : 3 * t + 5]
        y[18 : 18 + n] = torque
        y[18 + n : 17 + 2 * n], y[17 + 2 * n :] = psi[1:] - psi[0], rate[1:] - rate[0]
        y[17 + n] += (
            o.p["base_coulomb"][0] * np.linalg.norm(y[16:18]) * o.slip(rate[-1])
            + o.p["base_viscous"][0] * rate[-1]
        )
        behind = g.ust_behind.reshape(n, 3)
        near = np.array(
            [
                -o.p["bending_stiffness"][i]
                * o.p["precurvature"][i]
                * (turn(psi[i] - psi[0]) @ behind[i])[:2]
                for i in range(n)
            ]
        )
        cells = len(g.ds) - g.base
        full = self.to_model(y, n)
        far = o.moments(full, self.work.hist[cells], n, g.ust_start[0].reshape(n, 3))
        o.friction(full, near, far, n)
        y[18 : 18 + n] = full[18 : 18 + n]
        return y

    def cross(self, y, m, section):
        """(20)-(23) at the end of a section: the near state completed, and the far one."""
        g, n, o = self.g, self.n, self.oracle
        cells = len(g.ds) - g.base
        after = int(g.tubes[section + 1])
        here = self.work.hist[cells + 2 * section + 1]
        full = self.to_model(y, m)
        near = o.moments(full, here, m, g.ust_end[section].reshape(n, 3))
        beyond = full.copy()
        moment = np.zeros(3)
        R = rotation(y[3:7])
        force = np.zeros(3)
        if after < m:
            force, moment = o.body(full, here, m - 1)
            beyond[16:18] += moment[:2]
        far = o.moments(
            beyond, self.work.hist[cells + 2 * section + 2], after, g.ust_start[section + 1].reshape(n, 3)
        )
        rubbed = full.copy()
        rubbed[18 + after : 18 + n] = 0.0
        o.friction(rubbed, near, far, m)
        result = np.zeros(16 + 3 * after)
        result[:18] = y[:18]
        result[13:16] += R @ force
        result[16:18] += moment[:2]
        result[18 : 18 + after] = rubbed[18 : 18 + after]
        result[18 + after : 17 + 2 * after] = y[18 + m : 17 + m + after]
        result[17 + 2 * after :] = y[17 + 2 * m : 16 + 2 * m + after]
        if after < m:
            y = y.copy()
            y[17 + m] = -moment[2] - rubbed[17 + m]  # its own balance: m_z + body + friction = 0
        return y, result

    def tip(self, x):
        """(21)."""
        g, o = self.g, self.oracle
        y = np.zeros(19)
        y[:13] = x
        cells = len(g.ds) - g.base
        force, moment = o.body(self.to_model(y, 1), self.work.hist[cells + 2 * len(g.tubes) - 1], 0)
        R = rotation(y[3:7])
        y[13:16] = o.p["force"] - R @ force
        y[16:19] = R.T @ o.p["torque"] - moment
        return y

    def error(self, x):
        """E, cell by cell."""
        g, n, E = self.g, self.n, []
        part = lambda k: x[g.start[k] : g.start[k + 1]]  # noqa: E731
        left = None
        for k in range(len(g.size)):
            if k == 0 and g.base:
                left = np.array([[*self.drive(i, part(0)[i]), part(0)[i]] for i in range(g.turning)])
                continue
            right: np.ndarray
            following = None
            if k <= g.base:
                right = part(k)[: 3 * g.turning].reshape(-1, 3)
                following = right if k < g.base else self.enter(part(k))
            else:
                section = int(g.cell_section[k - 1])
                m = int(g.tubes[section])
                right = part(k)
                last = k == len(g.size) - 1
                if last:
                    right = self.tip(part(k))
                elif g.cell_section[k] != section:
                    if g.tubes[section + 1] < m:
                        right = np.insert(right, 17 + m, 0.0)
                    right, following = self.cross(right, m, section)
                else:
                    following = right
            if k > 0:
                cell = k - 1
                mean = 0.5 * (left + right)
                if cell < g.base:
                    for i in range(g.turning):
                        f = self.base_slope(mean[i], i, g.uz_base[cell, i], self.work.hist_base[cell, i])
                        E.extend((right[i] - left[i]) / g.base_ds[i] - f)
                else:
                    m = int(g.tubes[g.cell_section[cell]])
                    f = self.slope(mean, m, self.work.hist[cell - g.base], g.ust[cell].reshape(n, 3))
                    E.extend((right - left) / g.ds[cell] - f)
            left = following
        return np.array(E)
