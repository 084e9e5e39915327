"""The finite-difference solver against the shooting one, its orders, and what it does when a step fails."""

import numpy as np
import pytest
from model_cases import many_tubes

from ctr_dynamics.effects import EFFECTS
from ctr_dynamics.errors import InputError
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot_files import load_robot, robot_with
from ctr_dynamics.snap.solver import HELD, OUTSIDE, SnapSolver


def cells_for(robot, beta, spacing):
    """About `spacing` m a cell everywhere."""
    from ctr_dynamics.model.mesh import breakpoints

    edges = [0.0, *(s for s, _, _ in breakpoints(Model(robot).segments, np.asarray(beta, float)))]
    return (max(2, round(-min(beta) / spacing)), *(max(2, round(d / spacing)) for d in np.diff(edges)))


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_statics_agree_with_shooting_to_second_order(n):
    """Error of the tip against the fourth-order sweep falls fourfold when the cells halve."""
    robot = many_tubes(n)
    beta = np.array(robot.rest.beta.value)
    alpha = np.linspace(0.0, 0.4, n)
    exact = Statics(Model(robot, nodes=300)).solve(beta, alpha)
    errors = []
    for spacing in (0.006, 0.003):
        solver = SnapSolver(robot, beta, cells_for(robot, beta, spacing))
        assert solver.approach(alpha).ok
        errors.append(np.linalg.norm(solver.tube_end(0) - exact.tip_position))
    assert errors[1] < 1e-4
    assert 3.0 < errors[0] / errors[1] < 5.0
    np.testing.assert_allclose(solver.end_angles(), exact.end_angles, atol=2e-3)


SOFT = {
    # swings below 10 Hz, so that stiffness and inertia both count
    "drivetrain_compliance": {
        "tube1.stiffness_Nm_per_rad": 0.05,
        "tube1.inertia_kgm2": 2e-5,
        "tube2.stiffness_Nm_per_rad": 0.1,
    },
    "distributed_friction": {"torque_Nm_per_m": 0.02},
    "stribeck": {"static_ratio": 2.0, "speed_rad_s": 5.0},
}


def with_extensions(robot, extensions):
    """The robot with effects in its file."""
    return robot.model_copy(update={"extensions": extensions})


@pytest.mark.parametrize(("n", "extensions"), [(1, {}), (2, {}), (3, {}), (2, SOFT)])
def test_both_solvers_agree_on_a_smooth_motion(n, extensions):
    """Tubes turning smoothly with damping, friction, bodies and weight, the same scheme and step in both solvers.

    The difference is that of the discretisations along s, second order here.
    """
    robot = with_extensions(many_tubes(n), extensions)
    beta = np.array(robot.rest.beta.value)
    dt, steps = 2e-3, 40

    def turn(t):
        w = np.linspace(1.0, -0.5, n)
        angle, rate = 0.9 * (1 - np.cos(20.0 * t)), 18.0 * np.sin(20.0 * t)
        return Inputs(w * angle, w * rate, beta, np.zeros(n))

    simulator = Simulator(Model(robot, nodes=120), make_scheme("bdf2", dt), tolerance=1e-9)
    state = simulator.rest(turn(0.0))
    shooting = []
    for k in range(steps):
        assert simulator.step(state, k * dt, turn).ok
        shooting.append(state.nodes[-1, :3].copy())
    shooting = np.array(shooting)
    errors = []
    for spacing in (0.004, 0.002):
        solver = SnapSolver(robot, beta, cells_for(robot, beta, spacing))
        assert solver.statics(np.zeros(n)).ok
        tips = []
        for k in range(1, steps + 1):
            now = turn(k * dt)
            assert solver.step(dt, now.alpha, now.alpha_rate).ok
            tips.append(solver.tube_end(0))
        errors.append(np.linalg.norm(np.array(tips) - shooting, axis=1).max())
    moved = np.linalg.norm(shooting - shooting[0], axis=1).max()
    print(f"{n} tubes: moved {moved:.4f} m, errors {errors}")
    assert moved > 1e-3
    assert errors[1] < 0.01 * moved
    assert errors[1] < 0.4 * errors[0]


def ringing(scheme, dt, alpha=-0.45, sizes=None):
    """theta_f at 0.2 ms after the base of the frictionless example begins to turn smoothly, far from its fold."""
    robot = robot_with(load_robot("till2020_snap_example"), {"friction.tubes.coulomb": 0.0})
    solver = SnapSolver(robot, (-0.112, 0.0), (4, 4, 3, 6, 4, 2))
    assert solver.statics(np.zeros(2)).ok
    end = 4e-4
    t = 0.0
    sizes = sizes or [dt] * round(end / dt)
    for size in sizes:
        t += size
        angle, rate = 0.3 * np.sin(0.5 * np.pi * t / end) ** 4, 0.0
        rate = (
            0.3 * 4 * np.sin(0.5 * np.pi * t / end) ** 3 * np.cos(0.5 * np.pi * t / end) * 0.5 * np.pi / end
        )
        assert solver.step(size, np.array([-angle, 0.0]), np.array([-rate, 0.0]), scheme, alpha).ok
    return solver.theta_f


@pytest.mark.parametrize(
    ("scheme", "order"), [("bdf2", 2), ("bdf_alpha", 2), ("trapezoid", 2), ("backward_euler", 1)]
)
def test_order_in_time(scheme, order):
    exact = ringing("trapezoid", 2.5e-7)
    errors = [abs(ringing(scheme, dt) - exact) for dt in (4e-6, 2e-6)]
    print(scheme, errors)
    assert errors[0] > 1e-9
    assert order - 0.35 < np.log2(errors[0] / errors[1]) < order + 0.5


def test_unequal_steps_keep_second_order():
    """Steps that double and halve: BDF2 with the coefficients of unequal steps."""
    exact = ringing("trapezoid", 2.5e-7)

    def sizes(dt):
        return [dt, dt, 2 * dt, 2 * dt, dt, dt] * round(4e-4 / (8 * dt))

    errors = [abs(ringing("bdf2", dt, sizes=sizes(dt)) - exact) for dt in (4e-6, 2e-6)]
    assert np.log2(errors[0] / errors[1]) > 1.6


def test_robot_at_rest_stays_at_rest():
    robot = load_robot("till2020_snap_example")
    solver = SnapSolver(robot, (-0.112, 0.0))
    assert solver.approach(np.array([-1.0, 0.0])).ok
    tip, angle = solver.tube_end(0), solver.theta_f
    for _ in range(20):
        assert solver.step(1e-5, np.array([-1.0, 0.0]), np.zeros(2)).ok
    assert np.linalg.norm(solver.tube_end(0) - tip) < 1e-9
    assert abs(solver.theta_f - angle) < 1e-7


def test_failed_step_leaves_the_state_and_says_why():
    robot = load_robot("till2020_snap_example")
    solver = SnapSolver(robot, (-0.112, 0.0))
    assert solver.approach(np.array([-1.0, 0.0])).ok
    kept = solver.x.copy(), solver.bank.copy(), solver.t
    for bad in (np.array([np.nan, 0.0]), np.array([1e300, 0.0])):
        solved = solver.step(1e-5, bad, np.zeros(2))
        assert not solved.ok
        assert "Newton" in solved.reason
        np.testing.assert_array_equal(solver.x, kept[0])
        np.testing.assert_array_equal(solver.bank, kept[1])
        assert solver.t == kept[2]
    assert solver.step(1e-5, np.array([-1.0, 0.0]), np.zeros(2)).ok
    assert np.isfinite(solver.theta_f)


def test_approach_does_not_pass_a_fold():
    """There is no equilibrium near the branch beyond its fold."""
    solver = SnapSolver(load_robot("till2020_snap_example"), (-0.112, 0.0))
    assert solver.approach(np.array([-3.56, 0.0])).ok
    jumped = solver.approach(np.array([-3.62, 0.0]), largest=0.01)
    assert not jumped.ok or solver.theta_f < 2.3


def test_soft_drive_is_a_rigid_one_turned_by_torque_over_stiffness():
    """At rest; the S-curve's fold moves by as much."""
    robot = load_robot("till2020_snap")
    soft = with_extensions(robot, {"drivetrain_compliance": {"tube1.stiffness_Nm_per_rad": 0.2}})
    beta, cells = np.array(robot.rest.beta.value), (4, 3, 2, 8, 3, 2)
    yielding, rigid = SnapSolver(soft, beta, cells), SnapSolver(robot, beta, cells)
    assert yielding.approach(np.array([-3.0, 0.0])).ok
    gave = float(yielding.work.out_drive[0])
    assert gave == pytest.approx(float(yielding.work.left[0, 2]) / 0.2, rel=1e-9)  # m_z at the actuator
    assert gave > 0.05
    assert rigid.approach(np.array([-3.0 + gave, 0.0])).ok
    assert yielding.theta_f == pytest.approx(rigid.theta_f, abs=1e-6)
    assert yielding.end_angles() == pytest.approx(rigid.end_angles(), abs=1e-6)
    np.testing.assert_allclose(yielding.tube_end(0), rigid.tube_end(0), atol=1e-8)


def test_every_effect_is_in_the_equations_or_outside_them_or_refused():
    """An effect that nobody has placed is refused; those of the first two kinds are mechanics and measurement."""
    assert not HELD & OUTSIDE
    assert set(EFFECTS) >= HELD | OUTSIDE
    refused = {
        "air_drag", "clearance", "contact", "exposed_length", "learned_force", "oval_mean", "ovality", "play_kinematics", "softening", "tip_force",
        "tip_spring",
    }  # fmt: skip
    assert set(EFFECTS) - HELD - OUTSIDE == refused


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("clearance", {"play_rad": 0.01}),
        ("learned_force", {"constant_x_N": 0.1}),
        ("of_your_own", {"size": 1.0}),
    ],
)
def test_extensions_that_the_equations_lack_are_refused(name, values):
    robot = with_extensions(load_robot("till2020_snap"), {"stribeck": {"static_ratio": 1.2}, name: values})
    with pytest.raises(InputError, match=f"extension '{name}' is not in the finite-difference solver"):
        SnapSolver(robot, robot.rest.beta.value)


def test_solver_refuses_translations_and_schemes_that_do_not_fit():
    robot = load_robot("till2020_snap_example")
    with pytest.raises(InputError, match="beta"):
        SnapSolver(robot, (-0.112,))
    solver = SnapSolver(robot, (-0.112, 0.0))
    assert solver.statics(np.zeros(2)).ok
    with pytest.raises(InputError, match="stages"):
        solver.step(1e-5, np.zeros(2), np.zeros(2), "sdirk3")
    assert solver.step(1e-5, np.zeros(2), np.zeros(2), "trapezoid").ok
    with pytest.raises(InputError, match="equal steps"):
        solver.step(2e-5, np.zeros(2), np.zeros(2), "trapezoid")
