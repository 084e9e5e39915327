"""(25) against its plain NumPy twin, its Jacobian against differences, and the elimination against a dense solve."""

import numpy as np
import pytest
from snap_cases import Twin, error_of, random_problem

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.layout import field_rows, state_rows
from ctr_dynamics.kernels.snap_equations import Side, body, slope
from ctr_dynamics.kernels.snap_jacobian import back_solve, factorise
from ctr_dynamics.kernels.snap_residual import residual
from ctr_dynamics.model.model import Model
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.snap.grid import build_grid, default_cells
from ctr_dynamics.snap.solver import SnapSolver


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("at_plate", [True, False])
@pytest.mark.parametrize("c0", [0.0, 1.5e5])
@pytest.mark.parametrize("extended", [False, True])
def test_residual_equals_its_numpy_twin(n, at_plate, c0, extended):
    """Random states and histories; damping, friction, bodies, loads and every gyroscopic term on, with and without extensions."""
    solver, x = random_problem(n, 10 * n, at_plate, extended)
    found, *_ = error_of(solver, x, c0)
    expected = Twin(solver, c0).error(x)
    assert np.isfinite(expected).all()
    g = solver.grid.arrays
    for cell in range(len(g.ds)):
        rows = slice(g.row_start[cell], g.row_start[cell + 1])
        scale = np.abs(expected[rows]).max()
        np.testing.assert_allclose(
            found[rows], expected[rows], rtol=1e-8, atol=1e-11 * scale, err_msg=f"cell {cell}"
        )


def test_spinning_discs_turn_as_their_angular_momentum_says():
    """The terms in gamma of (12) and (20), which the printed equations hold in part.

    The angular momentum of a body of revolution does not depend on how far it has turned about its axis: in the frame of tube 1 it is
    L = (h omega_x, h omega_y, h_z (omega_z + gamma)), and the moment on it is L_t + omega x L, without any frame of tube i.
    """
    rng = np.random.default_rng(5)
    n, m, c0 = 2, 2, 1.5e5
    solver, _ = random_problem(n, 3)
    layout, par = solver.model.layout, solver.parameters.copy()
    for axis, value in zip("xyz", (4.9e-10, 4.9e-10, 9.6e-10), strict=True):
        par[layout[f"body_inertia_{axis}"]] = value
    y, hist = rng.uniform(-1, 1, state_rows(m).size), rng.uniform(-1, 1, field_rows(n).size) * 1e4
    y[10:13] *= 300.0
    gamma_row, omega = 17 + 2 * m, y[10:13]
    y[gamma_row] = 9000.0
    omega_t, gamma_t = c0 * omega + hist[3:6], c0 * y[gamma_row] + hist[7 + n + 1]

    def moment(across, along, spin, spin_t):
        inertia = np.array([across, across, along])
        total = omega + np.array([0.0, 0.0, spin])
        return inertia * (omega_t + np.array([0.0, 0.0, spin_t])) + np.cross(omega, inertia * total)

    wrench = np.zeros(6)
    body(y, m, 1, n, par, hist, c0, wrench)
    np.testing.assert_allclose(
        wrench[3:], moment(4.9e-10, 9.6e-10, y[gamma_row], gamma_t), rtol=1e-10, atol=1e-16
    )

    def bending_rate(parameters):
        """(2,) m_xy,s of a piece of the tubes."""
        side = Side(np.zeros(3 * n), hist, np.zeros(field_rows(n).size))
        w, f = np.zeros(2 * n), np.zeros(state_rows(m).size)
        slope(y, m, n, parameters, side, c0, w, f)
        return f[16:18]

    still = par.copy()
    still[layout["inertia_per_length"]] = 0.0
    inertia = par[layout["inertia_per_length"]]
    rods = moment(inertia[0], 2 * inertia[0], 0.0, 0.0) + moment(
        inertia[1], 2 * inertia[1], y[gamma_row], gamma_t
    )
    np.testing.assert_allclose(bending_rate(par) - bending_rate(still), rods[:2], rtol=1e-8)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("c0", [0.0, 1.5e3])
@pytest.mark.parametrize("extended", [False, True])
def test_elimination_inverts_the_jacobian(n, c0, extended):
    """The factors applied to (dense Jacobian by central differences) v give v."""
    solver, x = random_problem(n, n, extended=extended)
    x = solver.x + 0.1 * (x - solver.x)
    g, work = solver.grid.arrays, solver.work
    residual(g, x, solver.parameters, c0, work)
    size = work.left.shape[1]
    assert factorise(g, x, solver.parameters, c0, work, np.zeros((size, size)), np.zeros((size, size)))
    J = np.empty((len(x), len(x)))
    for j in range(len(x)):
        step = np.zeros(len(x))
        step[j] = 1e-6
        J[:, j] = (error_of(solver, x + step, c0)[0] - error_of(solver, x - step, c0)[0]) / 2e-6
    v = np.random.default_rng(n).standard_normal(len(x))
    solution = np.empty(len(x))
    back_solve(g, work, J @ v, solution)
    dense = np.linalg.solve(J, J @ v)
    assert np.abs(solution - v).max() < 1e-3
    assert np.abs(dense - v).max() < 1e-3  # the differences themselves are good enough to say so


def test_published_grid_has_the_published_unknowns():
    robot = load_robot("till2020_snap_example")
    solver = SnapSolver(robot, robot.rest.beta.value)
    assert solver.grid.cells == (14, 29, 9, 14, 9, 3)
    assert solver.grid.unknowns == 1441
    np.testing.assert_allclose(
        solver.grid.edges, [0, 7.97e-3, 13.2e-3, 43.6e-3, 53.1e-3, 55.1e-3], atol=1e-12
    )


def test_other_robots_get_cells_of_a_millimetre():
    robot = load_robot("till2020_snap")
    cells = default_cells(robot.name, Model(robot).segments, np.array(robot.rest.beta.value))
    assert cells == (14, 8, 3, 34, 10, 3)


def test_grid_refuses_wrong_counts():
    model = Model(load_robot("till2020_snap_example"))
    for cells in ((14, 29), (14, 29, 9, 14, 9, 0)):
        with pytest.raises(InputError, match="counts of cells"):
            build_grid(model.segments, np.array([-0.112, 0.0]), cells)


def test_coinciding_breakpoints_leave_a_solvable_grid():
    """A curvature change of one tube where the other one ends."""
    from model_cases import make_robot, make_tube

    inner = make_tube(0.0, 0.5e-3, segments=((0.1, (0, 0, 0)), (0.03, (20.0, 0, 0))))
    outer = make_tube(0.6e-3, 1e-3, segments=((0.05, (5.0, 0, 0)),))
    robot = make_robot([inner, outer], [-0.05, 0.0], gravity=(0, -9.81, 0))
    solver = SnapSolver(robot, (-0.05, 0.0))
    assert solver.statics(np.array([0.5, 0.0])).ok
    from ctr_dynamics.model.statics import Statics

    exact = Statics(Model(robot, nodes=200)).solve((-0.05, 0.0), (0.5, 0.0))
    assert np.linalg.norm(solver.tube_end(0) - exact.tip_position) < 1e-5
