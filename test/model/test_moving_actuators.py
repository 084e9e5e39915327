"""Translations while the model runs.

Insertion, breakpoints that pass each other and the plate, meshes that follow, failures.
"""

from itertools import pairwise

import numpy as np
import pytest
from model_cases import make_robot, make_tube, many_tubes, still

from ctr_dynamics.kernels.layout import RATES
from ctr_dynamics.model.mesh import fits, node_count, section_key
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.remeshing import remap_fields
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot_files import load_robot

DT = 0.003


def slide(robot, tube, distance, speed, rotation=0.0):
    """Inputs of tube `tube` sliding out by `distance` m at `speed` m/s and back, all tubes turning to and
    fro; and the end time.
    """
    beta0, alpha0 = np.array(robot.rest.beta.value), np.array(robot.rest.alpha.value)
    half = abs(distance) / speed

    def at(t):
        out = np.clip(t, 0, half) - np.clip(t - half, 0, half)
        beta, alpha = beta0.copy(), alpha0.copy()
        beta[tube] += np.sign(distance) * speed * out
        alpha[0] += rotation * out
        direction = 1.0 if t < half else -1.0 if t < 2 * half else 0.0
        beta_rate, alpha_rate = np.zeros_like(beta), np.zeros_like(alpha)
        beta_rate[tube] = np.sign(distance) * speed * direction
        alpha_rate[0] = rotation * direction
        return Inputs(alpha, alpha_rate, beta, beta_rate)

    return at, 2 * half


def follow(model, at, seconds, scheme="sdirk3", every=50):
    """Tips after each step, and (time, tip, static tip) every so many steps; every step must succeed."""
    simulator = Simulator(model, make_scheme(scheme, DT))
    statics = Statics(model)
    parameters = simulator.parameters.copy()
    state = simulator.rest(at(0.0))
    tips, checks, keys = [state.nodes[-1, :3].copy()], [], {state.key}
    guess = state.unknowns[-1].copy()
    for k in range(round(seconds / DT)):
        result = simulator.step(state, k * DT, at)
        assert result.ok, (k, result)
        tips.append(state.nodes[-1, :3].copy())
        keys.add(state.key)
        if every and (k + 1) % every == 0:
            now = at((k + 1) * DT)
            still_tip = statics.solve(now.beta, now.alpha, guess=guess, parameters=parameters)
            assert still_tip.converged
            guess = still_tip.x.copy()
            checks.append(((k + 1) * DT, tips[-1], still_tip.tip_position.copy()))
    return np.array(tips), checks, keys, state


def test_insertion_out_and_back():
    """The inner tube slides 30 mm out and back at 5 mm/s while it turns at 0.1 rad/s.

    No step fails, the path is the static one, the end the start.
    """
    model = Model(load_robot("till2020_tissue"), nodes=24)
    at, end = slide(model.robot, 0, 0.03, 5e-3, rotation=0.1)
    tips, checks, _, _ = follow(model, at, end + 2.0)
    assert np.linalg.norm(tips[-1] - tips[0]) < 0.1e-3
    # the vibration that the sudden start leaves is no part of the quasi-static path: means over its period
    apart = np.array([np.linalg.norm(found - static) for t, found, static in checks if t > 1.0])
    back = np.linalg.norm(tips[-1] - tips[0])
    print(f"insertion: path {apart.max() * 1e3:.4f} mm, return {back * 1e3:.4f} mm")
    assert apart.max() < 0.2e-3
    assert np.linalg.norm(tips - tips[0], axis=1).max() > 0.02


def test_breakpoints_pass_the_plate_without_a_kick():
    """The outer tube is pulled back until its curved part begins behind the plate, and pushed out again."""
    model = Model(load_robot("till2020_tissue"), nodes=24)
    at, end = slide(model.robot, 1, -0.008, 4e-3)
    tips, checks, keys, _ = follow(model, at, end + 0.5, every=25)
    assert (
        len({key[0] for key in keys}) == 2
    )  # with and without the outer tube's straight part before the plate
    speed = np.linalg.norm(np.diff(tips, axis=0), axis=1) / DT
    quasi_static = max(np.linalg.norm(b[2] - a[2]) / (b[0] - a[0]) for a, b in pairwise(checks))
    apart = np.array([np.linalg.norm(found - static) for t, found, static in checks if t > 1.0])
    print(
        f"plate: path {apart.max() * 1e3:.4f} mm, speed {speed.max() / quasi_static:.3f} of the quasi-static"
    )
    assert apart.max() < 0.2e-3
    assert speed.max() < 3 * quasi_static + 1e-3
    assert np.linalg.norm(tips[-1] - tips[0]) < 0.1e-3


def test_curvature_change_passes_a_tube_end():
    """Tube 1's curved part begins inside tube 2 and comes out beyond its end.

    The order of breakpoints changes on the way.
    """
    robot = load_robot("three_tube")
    model = Model(robot, nodes=30)
    beta0 = np.array(robot.rest.beta.value)
    ends = beta0 + robot.lengths
    change = ends[1] - (beta0[0] + robot.tubes[0].breakpoints[1])  # tube 1's change behind tube 2's end, m
    at, end = slide(robot, 1, change + 0.004 if change > 0 else change - 0.004, 0.02)
    tips, checks, keys, _ = follow(model, at, end + 0.5, every=20)
    assert len({key[0] for key in keys}) >= 2
    assert np.linalg.norm(tips[-1] - tips[0]) < 0.2e-3
    assert np.linalg.norm(checks[-1][1] - checks[-1][2]) < 0.2e-3


def test_mesh_follows_a_section_that_grows():
    """A section that begins short gets the cells of its length as it grows, and not at every step."""
    tube = make_tube(segments=((0.101, (0, 0, 0)), (0.1, (6.0, 0, 0))))
    model = Model(make_robot([tube], [-0.1]), nodes=24)
    at, end = slide(model.robot, 0, 0.08, 0.02)
    _, checks, keys, state = follow(model, at, end / 2, every=100)
    assert 2 <= len(keys) <= 12
    wanted = section_key(model.segments, at(end / 2).beta, model.nodes)[1]
    assert np.abs(np.log2(np.array(state.key[1]) / wanted)).max() <= 1.0
    assert fits(state.key, model.segments, at(end / 2).beta, model.nodes)
    assert node_count(state.mesh) == len(state.nodes)
    assert max(np.linalg.norm(a - b) for t, a, b in checks if t > 1.0) < 0.2e-3


def test_accuracy_does_not_depend_on_what_was_solved_before():
    """A pose after another one with the same order of breakpoints but other lengths.

    The same shape as from a fresh model.
    """
    robot = load_robot("till2020_tissue")
    first, second = [-0.2521, -0.1999], [-0.2521, -0.1500]
    used, fresh = Model(robot, nodes=24), Model(robot, nodes=24)
    Statics(used).solve(first, [1.0, 0.5])
    a = Statics(used).solve(second, [1.0, 0.5]).tip_position
    b = Statics(fresh).solve(second, [1.0, 0.5]).tip_position
    np.testing.assert_array_equal(a, b)


def test_remap_is_exact_for_smooth_fields():
    """Quadratic fields in every section survive a change of cells to rounding."""
    model = Model(load_robot("till2020_tissue"), nodes=24)
    finer = Model(load_robot("till2020_tissue"), nodes=40)
    beta = np.array(model.robot.rest.beta.value)
    (_, old), (_, new) = model.mesh(beta), finer.mesh(beta)
    from ctr_dynamics.model.mesh import point_positions

    def fields(mesh):
        s, section = point_positions(mesh, beta)
        main = (
            (1 + section[:, None]) * (1.0 + 3 * s[:, None] - 7 * s[:, None] ** 2) * np.arange(1, 12)
        ).ravel()
        return np.concatenate([main, np.ones(len(mesh.ust_base) * 2)])[None]

    np.testing.assert_allclose(remap_fields(2, fields(old), old, beta, new, beta), fields(new), rtol=1e-12)


def test_polynomial_precurvature_moves_with_its_tube():
    """A tube of linearly rising curvature slides.

    The dynamic path is the static one, whose precurvature was taken anew at each position.
    """
    tube = make_tube(segments=((0.2, [[0, 40.0], [0, 0], [0, 0]]),))
    model = Model(make_robot([tube], [-0.08]), nodes=24)
    at, end = slide(model.robot, 0, 0.03, 0.01)
    tips, checks, _, _ = follow(model, at, end + 1.0, every=50)
    assert max(np.linalg.norm(a - b) for t, a, b in checks if t > 1.0) < 0.2e-3
    assert np.linalg.norm(tips[-1] - tips[0]) < 0.1e-3


def test_a_jump_that_cannot_be_followed_leaves_the_state_alone():
    """Actuators or loads beyond reach.

    Ok False with a reason, everything finite and as it was, and the next step goes on.
    """
    model = Model(load_robot("till2020_tissue"), nodes=24)
    beta, alpha = model.robot.rest.beta.value, model.robot.rest.alpha.value
    calm = still(beta, alpha)
    simulator = Simulator(model, make_scheme("sdirk3", DT))
    state = simulator.rest(calm)
    for k in range(3):
        assert simulator.step(state, k * DT, lambda t: calm).ok
    before = state.copy()
    jumps = {
        "load": still(beta, alpha, (0.0, -4e4, 3e4)),
        "order": still([-0.2521, 0.0], alpha),
        "behind the plate": still([-0.41, -0.3], alpha),
        "not a number": still(beta, [np.nan, 0.0]),
        "not a position": still([np.nan, -0.1977], alpha),
    }
    for name, jump in jumps.items():
        result = simulator.step(state, 0.009, lambda t, jump=jump: jump)
        assert not result.ok, name
        assert result.reason
        assert state.key == before.key
        np.testing.assert_array_equal(state.bank[:RATES], before.bank[:RATES])
        np.testing.assert_array_equal(state.nodes, before.nodes)
        np.testing.assert_array_equal(state.unknowns, before.unknowns)
        assert simulator.step(state, 0.009, lambda t: calm).ok
        for field in ("bank", "nodes", "unknowns", "earlier", "inverse"):
            setattr(state, field, getattr(before, field).copy())
        state.inputs, state.usable = before.inputs, False


def test_a_failed_step_across_the_plate_keeps_its_sections():
    """A step that would change the set of sections and fails must not leave the fields on the new ones."""
    model = Model(load_robot("till2020_tissue"), nodes=24)
    beta, alpha = model.robot.rest.beta.value, model.robot.rest.alpha.value
    simulator = Simulator(model, make_scheme("sdirk3", DT))
    state = simulator.rest(still(beta, alpha))
    before = state.copy()
    across = still([-0.2521, -0.2046], alpha, (0.0, -4e4, 3e4))
    assert model.mesh(across.beta)[0] != before.key
    assert not simulator.step(state, 0.0, lambda t: across).ok
    assert state.key == before.key
    assert state.bank.shape == before.bank.shape
    np.testing.assert_array_equal(state.bank[:RATES], before.bank[:RATES])
    assert simulator.step(state, 0.0, lambda t: still(beta, alpha)).ok


@pytest.mark.parametrize("n", [1, 3, 4])
def test_any_number_of_tubes_runs(n):
    """Turning and sliding robots of one, three and four tubes with every term on stay finite and settle where
    statics says.
    """
    model = Model(many_tubes(n), nodes=20)
    beta0 = np.array(model.robot.rest.beta.value)

    def at(t):
        s = np.clip(t / 0.2, 0, 1)
        rate = 2.5 if t < 0.2 else 0.0
        alpha = 0.5 * s * np.arange(1, n + 1)
        beta = beta0 + 0.004 * s * np.linspace(1, 0, n)
        return Inputs(
            alpha,
            0.2 * rate * np.arange(1, n + 1) * 5,
            beta,
            np.zeros(n),
            np.array([0.02, 0, 0]),
            np.zeros(3),
        )

    simulator = Simulator(model, make_scheme("backward_euler", DT))
    state = simulator.rest(at(0.0))
    for k in range(900):
        result = simulator.step(state, k * DT, at)
        assert result.ok, (k, result)
    last = at(3.0)
    still_tip = Statics(model).solve(last.beta, last.alpha, last.force, guess=state.unknowns[-1])
    assert np.linalg.norm(still_tip.tip_position - state.nodes[-1, :3]) < 0.2e-3


def test_simulation_repeats_to_the_last_bit():
    """Two runs of the same inputs give equal numbers."""
    model = Model(load_robot("till2020_tissue"), nodes=24)
    at, _ = slide(model.robot, 0, 0.01, 5e-3, rotation=0.1)
    runs = [follow(model, at, 0.3, every=0)[0] for _ in range(2)]
    np.testing.assert_array_equal(runs[0], runs[1])
