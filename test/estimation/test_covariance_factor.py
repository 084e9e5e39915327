"""The covariance factor: interpolation between meshes, and propagation against finite differences."""

import dataclasses

import numpy as np
import pytest

import ctr_dynamics.estimation.filter.covariance_factor as factor_module
from ctr_dynamics.estimation.energy_norm import energy_rows, field_weights
from ctr_dynamics.estimation.filter.covariance_factor import CovarianceFactor
from ctr_dynamics.estimation.filter.parameter_priors import force_range, model_uncertainty
from ctr_dynamics.estimation.mode_tracker import ModeTracker
from ctr_dynamics.kernels.layout import base_field_count
from ctr_dynamics.model.mesh import build_mesh
from ctr_dynamics.model.mesh_interpolation import coarse_key, mesh_interpolation
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot import cantilever
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict
from ctr_dynamics.sensing import TrackerModel
from ctr_dynamics.sensing.tracker import DELAY

BETA, ALPHA, ZERO = np.array([-0.2521, -0.1977]), np.array([1.5708, 1.5708]), np.zeros(2)
DT = 0.003
XI = (0.0, 0.5, 0.5, 1.0)


@pytest.fixture(scope="module")
def robot():
    return load_robot("till2020_tissue")


@pytest.fixture(scope="module")
def model(robot):
    return Model(robot, nodes=24)


# -- mesh_interpolation --


def cubic(cells, rows, coefficients):
    """Values (points * rows,) of a cubic in each section's own coordinate, and (nodes, rows) of it."""
    points, nodes = [], []
    for k, count in enumerate(cells):
        at = [(cell + x) / count for cell in range(count) for x in XI] + [1.0]
        points.extend(np.polynomial.polynomial.polyval(np.array(at), coefficients[k]).T)
        nodes.extend(np.polynomial.polynomial.polyval(np.linspace(0.0, 1.0, count + 1), coefficients[k]).T)
    return np.array(points)[:, :rows], np.array(nodes)[:, :rows]


def test_transfer_is_exact_for_cubics_inside_each_section(robot):
    fine = Model(robot, nodes=100)
    key, mesh = fine.mesh(BETA)
    short = coarse_key(key, 24)
    assert sum(short[1]) < 30
    coarse = build_mesh(fine.segments, BETA, short, mesh.base_cells)
    assert max(coarse.sec_cells) >= 3
    F, S = 7 + 2 * fine.n, 16 + 3 * fine.n
    base = base_field_count(fine.n, mesh.base_cells)
    rng = np.random.default_rng(2)
    coefficients = rng.normal(size=(len(mesh.sec_cells), 4, S))
    for k, cells in enumerate(coarse.sec_cells):
        coefficients[k, cells + 1 :] = 0.0  # two nodes hold a straight line only
    behind = rng.normal(size=base)
    on_fine, fine_nodes = cubic(mesh.sec_cells, F, coefficients)
    on_coarse, _ = cubic(coarse.sec_cells, F, coefficients)
    _, coarse_nodes = cubic(coarse.sec_cells, S, coefficients)
    _, fine_nodes = cubic(mesh.sec_cells, S, coefficients)
    moved = mesh_interpolation(fine.n, mesh, coarse)
    assert np.allclose(moved.restrict @ np.r_[on_fine.ravel(), behind], np.r_[on_coarse.ravel(), behind])
    assert np.allclose(moved.prolong @ np.r_[on_coarse.ravel(), behind], np.r_[on_fine.ravel(), behind])
    assert np.allclose(moved.nodes @ coarse_nodes, fine_nodes)


# -- uncertainty --


def test_uncertain_parameters_are_the_robot_files(robot, model):
    unc = model_uncertainty(model)
    sigma = dict(zip(unc.names, unc.sigma, strict=True))
    assert sigma["youngs_modulus.tube1"] == pytest.approx(0.004)
    assert sigma["precurvature.tube2"] == pytest.approx(0.003)
    assert sigma["payload_mass.tube1"] == pytest.approx(20e-6)
    assert sigma["base_coulomb"] == pytest.approx(0.10)
    assert sigma["encoder_offset.tube2"] == pytest.approx(np.radians(0.1), rel=1e-3)
    assert unc.names[unc.force] == ("tip_force.x", "tip_force.y", "tip_force.z")
    # a turn of gravity changes its direction only
    for axis in "12":
        column = unc.effect[model.layout["gravity"], unc.names.index(f"gravity_direction.{axis}")]
        assert column @ np.array(robot.gravity.value) == pytest.approx(0.0, abs=1e-12)
        assert np.linalg.norm(column) == pytest.approx(9.81, abs=0.01)
    biases = TrackerModel.of_robot(robot).state_sigma
    assert biases[3:6] == pytest.approx([2e-4] * 3)
    assert biases[DELAY] == pytest.approx(1e-3)


def test_every_axis_of_the_tracker_has_its_own_deviation(robot):
    tracker = robot.tracker
    translation = tracker.registration_translation.model_copy(update={"tolerance": (1e-4, 2e-4, 3e-3)})
    changed = robot.model_copy(
        update={"tracker": tracker.model_copy(update={"registration_translation": translation})}
    )
    assert TrackerModel.of_robot(changed).state_sigma[3:6].tolist() == [1e-4, 2e-4, 3e-3]
    np.testing.assert_array_equal(
        np.delete(TrackerModel.of_robot(changed).state_sigma, [3, 4, 5]),
        np.delete(TrackerModel.of_robot(robot).state_sigma, [3, 4, 5]),
    )


def test_an_equilibrium_that_cannot_be_linearised_begins_without_deviation(model, monkeypatch):
    def at_a_fold(*arguments):
        derivatives = arguments[-1]
        derivatives.unknowns[:], derivatives.fields[:], derivatives.nodes[:] = np.nan, np.nan, np.nan
        return False

    monkeypatch.setattr(factor_module, "linearise", at_a_fold)
    found = Statics(model).solve(BETA, ALPHA)
    factor = CovarianceFactor(model, model_uncertainty(model), rank=24)
    factor.start(found.key, found.mesh, BETA, ALPHA, model.parameters, found.x)
    assert not factor.fields.any()
    assert not factor.dnodes.any()
    assert factor.theta.any()


def test_the_force_s_range_follows_the_robot_s_compliance(robot, model):
    """Of the straight cantilever that the formula is for, a precurved robot under gravity has the compliance to a third."""
    push = 1e-4
    statics = Statics(model)
    tips = [statics.solve(BETA, ALPHA, np.array([0.0, 0.0, f])).tip_position for f in (push, -push)]
    across = [statics.solve(BETA, ALPHA, np.array([f, 0.0, 0.0])).tip_position for f in (push, -push)]
    found = max(np.linalg.norm(a - b) for a, b in (tips, across)) / (2 * push)
    assert cantilever(robot).deflection == pytest.approx(found, rel=0.35)
    least, most = force_range(robot, 0.0, 0.0)
    assert least * cantilever(robot).deflection == pytest.approx(0.005 * robot.tracker.noise.position.value)
    assert most * cantilever(robot).deflection == pytest.approx(
        0.1 * (robot.lengths[0] + robot.rest.beta.value[0])
    )
    assert force_range(robot, 1e-3, 0.0) == (1e-3, most)
    assert force_range(robot, 0.0, 1e-6) == (1e-6, 1e-6)


def test_the_speed_scale_of_friction_may_be_uncertain(robot):
    friction = robot.friction.model_copy(
        update={"epsilon": robot.friction.epsilon.model_copy(update={"tolerance": 3.0})}
    )
    model = Model(robot.model_copy(update={"friction": friction}))
    unc = model_uncertainty(model)
    i = unc.names.index("friction_epsilon")
    assert unc.sigma[i] == pytest.approx(0.2)
    assert unc.effect[model.layout["epsilon"], i] == pytest.approx(15.0)


# -- propagation --


def lighter():
    """The tissue robot with a quarter of its payload: its slowest modes have 11 and 17 Hz."""
    data = robot_to_dict(load_robot("till2020_tissue"))
    data["tubes"][0]["end_body"]["mass"]["value"] *= 0.25
    return Model(robot_from_dict(data), nodes=12)


def test_columns_follow_a_fast_vibration():
    """A small force that lets the tip go: the column of that force against runs in finer steps."""
    model, steps = lighter(), 100
    force = np.array([1e-3, 1e-3, 0.0])
    still = Inputs(ALPHA, ZERO, BETA, ZERO, np.zeros(3), np.zeros(3))

    def tips(pushed, dt):
        simulator, found = Simulator(model, make_scheme("sdirk3", dt), tolerance=1e-10), []
        state = simulator.rest(dataclasses.replace(still, force=pushed))
        for k in range(round(steps * DT / dt)):
            assert simulator.step(state, k * dt, lambda t: still).ok
            found.append(state.nodes[-1, :3].copy())
        return np.array(found)[round(DT / dt) - 1 :: round(DT / dt)]

    expected = tips(force, DT / 3) - tips(np.zeros(3), DT / 3)
    simulator, unc = Simulator(model), model_uncertainty(model)
    state = simulator.rest(still)
    factor = CovarianceFactor(model, unc, rank=24)
    factor.start(state.key, state.mesh, BETA, ALPHA, model.parameters, state.unknowns_at_base)
    assert factor.theta[unc.force, unc.force].diagonal() == pytest.approx([1e-3] * 3)
    factor.theta[unc.force] = 0.0  # the force is gone, and what it has done remains
    found = []
    for k in range(steps):
        record = simulator.step(state, k * DT, lambda t: still, record="end").records[-1]
        assert factor.propagate(record, model.parameters, DT)
        found.append(factor.dnodes[-model_rows(model) :][:3, unc.force][:, :2].sum(axis=1))
    error = np.linalg.norm(np.array(found) - expected, axis=1)
    size = np.sqrt((expected**2).sum(axis=1).mean())
    assert np.sqrt((error**2).mean()) < 0.01 * size


def moving(t, turn=(0.0, 0.0)):
    """A load that is taken away within 60 ms, and tubes that begin to turn."""
    rate = np.array([0.6, -0.4])
    force = np.array([0.0, -0.3 * (1.0 - t / 0.06), 0.0])
    return Inputs(ALPHA + np.array(turn) + rate * t, rate, BETA, ZERO, force, np.zeros(3))


def simulated(model, parameters, turn, steps):
    """Fields and node states after `steps` from rest, with the records."""
    simulator = Simulator(model, tolerance=1e-10, parameters=parameters)
    rest = moving(0.0, turn)
    state = simulator.rest(Inputs(rest.alpha, ZERO, BETA, ZERO, rest.force, rest.torque))
    start, records = state.copy(), []
    for k in range(steps):
        result = simulator.step(state, k * DT, lambda t: moving(t, turn), record=True)
        assert result.ok
        records.append(result.records)
    return start, state, records


@pytest.mark.parametrize(("nodes", "every"), [(24, 1), (24, 2), (60, 2)])
def test_the_factor_follows_finite_differences_of_the_simulation(robot, nodes, every):
    model = Model(robot, nodes=nodes)
    unc = model_uncertainty(model)
    start, _state, records = simulated(model, model.parameters, (0.0, 0.0), 20)
    factor = CovarianceFactor(model, unc, rank=24)
    par = model.parameters.copy()
    par[model.layout["force"]] = start.inputs.force
    factor.start(start.key, start.mesh, BETA, ALPHA, par, start.unknowns_at_base)
    for done in records[every - 1 :: every]:
        assert factor.propagate(done[-1], model.parameters, every * DT)
    weight = field_weights(model, factor.mesh, BETA)
    for name in (
        "youngs_modulus.tube1",
        "precurvature.tube2",
        "payload_mass.tube1",
        "density",
        "base_viscous",
        "gravity_direction.1",
        "encoder_offset.tube2",
    ):
        i = unc.names.index(name)
        size = unc.sigma[i]
        ends = []
        for sign in (0.5, -0.5):
            turn, parameters = [0.0, 0.0], model.parameters.copy()
            if name.startswith("encoder"):
                turn[int(name[-1]) - 1] = sign * size
            else:
                parameters += sign * size * unc.effect[:, i]
            _, end, _ = simulated(model, parameters, tuple(turn), 20)
            ends.append(end)
        expected = ends[0].fields - ends[1].fields
        if factor.interpolation is not None:
            expected = factor.interpolation.restrict @ expected
        difference = factor.fields[:, i] - expected
        error = np.sqrt((weight * difference**2).sum() / (weight * expected**2).sum())
        # inertia moves fast modes, which the columns' function of order 5 damps
        assert error < (0.07 if name == "density" else 0.012 * every), (name, error)
        tip = factor.dnodes[-model_rows(model) :, i][:3]
        shift = ends[0].nodes[-1, :3] - ends[1].nodes[-1, :3]
        assert np.linalg.norm(tip - shift) < 0.015 * every * np.linalg.norm(shift) + 1e-7, name


@pytest.mark.parametrize("column", range(4))
def test_columns_of_a_start_in_motion_follow_the_vibration(robot, column):
    """The fields moved along such a column, then simulated: the tip moves as its rows say, and for one deviation of all by what was asked."""
    model = Model(robot, nodes=24)
    inputs = Inputs(ALPHA, ZERO, BETA, ZERO, np.zeros(3), np.zeros(3))
    simulator = Simulator(model, tolerance=1e-10)
    state = simulator.rest(inputs)
    vibrating = ModeTracker(model, 100).vibrating(state, model.parameters, 2e-3)
    assert vibrating is not None
    factor, uncertainty = CovarianceFactor(model, model_uncertainty(model), rank=24), model_uncertainty(model)
    pi = factor.start(state.key, state.mesh, BETA, ALPHA, model.parameters, state.unknowns_at_base, vibrating)
    first = len(uncertainty.names)
    assert pi[first + column, first + column] == 1.0
    assert not factor.theta[:, first:].any()
    a = np.zeros(len(pi))
    a[first + column] = 0.1
    moved = state.copy()
    moved.bank[:2] += factor.fields_change(a)
    moved.forget_history()
    largest, error = 0.0, 0.0
    for k in range(30):
        results = [simulator.step(run, k * DT, lambda t: inputs, record=True) for run in (moved, state)]
        assert all(result.ok for result in results)
        assert factor.propagate(results[1].records[-1], model.parameters, DT)
        rows = factor.dnodes[-model_rows(model) :][:3]
        shift = moved.nodes[-1, :3] - state.nodes[-1, :3]
        largest, error = max(largest, np.linalg.norm(shift)), max(error, np.linalg.norm(rows @ a - shift))
    assert error < 0.05 * largest
    square = sum(np.linalg.norm(rows[:, first + i]) ** 2 for i in range(vibrating.fields.shape[1]))
    assert np.sqrt(square) == pytest.approx(2e-3, rel=0.3)


def test_energy_is_that_of_all_points(model):
    """Half of the points stand for all: the others lie in the same places and carry nearly the same."""
    unc = model_uncertainty(model)
    start, _, records = simulated(model, model.parameters, (0.0, 0.0), 3)
    factor = CovarianceFactor(model, unc, rank=24)
    factor.start(start.key, start.mesh, BETA, ALPHA, model.parameters, start.unknowns_at_base)
    for done in records:
        assert factor.propagate(done[-1], model.parameters, DT)
    weights = field_weights(model, factor.mesh, BETA)
    rows, roots = energy_rows(model, factor.mesh, BETA)
    assert len(rows) < 0.6 * np.count_nonzero(weights)
    assert (roots**2).sum() == pytest.approx(weights.sum(), rel=1e-12)
    wanted = factor.fields.T @ (weights[:, None] * factor.fields)
    scale = np.sqrt(np.outer(wanted.diagonal(), wanted.diagonal()))
    found = factor.energy()
    np.testing.assert_allclose(found.diagonal(), wanted.diagonal(), rtol=1e-2)
    np.testing.assert_array_less(np.abs(found - wanted), 0.05 * scale + 1e-30)


def model_rows(model):
    """Rows of a node's state."""
    return 16 + 3 * model.n


def test_a_checkpoint_of_the_factor_is_not_written_by_later_steps(model):
    unc = model_uncertainty(model)
    start, _, records = simulated(model, model.parameters, (0.0, 0.0), 3)
    factor = CovarianceFactor(model, unc, rank=24)
    factor.start(start.key, start.mesh, BETA, ALPHA, model.parameters, start.unknowns_at_base)
    stored = factor.checkpoint()
    before = factor.fields.copy()
    for done in records:
        factor.propagate(done[-1], model.parameters, DT)
    factor.theta *= 0.5
    after = factor.fields.copy()
    factor.restore(stored)
    assert np.array_equal(factor.fields, before)
    for done in records:
        factor.propagate(done[-1], model.parameters, DT)
    assert np.array_equal(factor.fields, after)


@pytest.mark.parametrize("lent", [False, True])
def test_the_factor_stays_where_a_step_cannot_be_linearised(model, monkeypatch, lent):
    """A failure shows in a later batch of lanes only, when the first columns have been written."""
    start, _, records = simulated(model, model.parameters, (0.0, 0.0), 3)
    factor = CovarianceFactor(model, model_uncertainty(model), rank=24)
    factor.start(start.key, start.mesh, BETA, ALPHA, model.parameters, start.unknowns_at_base)
    factor.propagate(records[0][-1], model.parameters, DT)
    before = [np.copy(x) for x in (factor.fields, factor.dx, factor.dnodes)]
    if lent:
        factor.checkpoint()

    def failing(*arguments):
        arguments[-1].fields[:, :8] = np.nan
        return False

    with monkeypatch.context() as patch:
        patch.setattr(factor_module, "rational_tangent", failing)
        assert not factor.propagate(records[1][-1], model.parameters, DT)
    for was, now in zip(before, (factor.fields, factor.dx, factor.dnodes), strict=True):
        assert np.array_equal(was, now)
    assert factor.propagate(records[2][-1], model.parameters, DT)
    assert np.isfinite(factor.fields).all()
