"""The covariance's columns: transfer between meshes, propagation against finite differences, vibration modes against a simulation."""

import numpy as np
import pytest
from scipy.optimize import curve_fit

import ctr_dynamics.estimation.filter.covariance_factor as columns_module
from ctr_dynamics.estimation.filter.covariance_factor import Columns, energy_rows, field_weights
from ctr_dynamics.estimation.filter.parameter_priors import bias_sigma, model_uncertainty
from ctr_dynamics.estimation.modes import MOST_KEPT, ModeTracker, modal_basis
from ctr_dynamics.kernels.workspace import base_rows
from ctr_dynamics.model.mesh import build_mesh
from ctr_dynamics.model.mesh_interpolation import coarse_key, transfer
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot_files import load_robot

BETA, ALPHA, ZERO = np.array([-0.2521, -0.1977]), np.array([1.5708, 1.5708]), np.zeros(2)
DT = 0.003
XI = (0.0, 0.5, 0.5, 1.0)


@pytest.fixture(scope="module")
def robot():
    return load_robot("till2020_tissue")


@pytest.fixture(scope="module")
def model(robot):
    return Model(robot, nodes=24)


# -- transfer --


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
    base = base_rows(fine.n, mesh.base_cells)
    rng = np.random.default_rng(2)
    coefficients = rng.normal(size=(len(mesh.sec_cells), 4, S))
    for k, cells in enumerate(coarse.sec_cells):
        coefficients[k, cells + 1 :] = 0.0  # two nodes hold a straight line only
    behind = rng.normal(size=base)
    on_fine, fine_nodes = cubic(mesh.sec_cells, F, coefficients)
    on_coarse, _ = cubic(coarse.sec_cells, F, coefficients)
    _, coarse_nodes = cubic(coarse.sec_cells, S, coefficients)
    _, fine_nodes = cubic(mesh.sec_cells, S, coefficients)
    moved = transfer(fine.n, mesh, coarse)
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
    biases = bias_sigma(robot)
    assert biases[3:6] == pytest.approx([2e-4] * 3)
    assert biases[9] == pytest.approx(1e-3)


def test_every_axis_of_the_tracker_has_its_own_deviation(robot):
    tracker = robot.tracker
    translation = tracker.registration_translation.model_copy(update={"tolerance": (1e-4, 2e-4, 3e-3)})
    changed = robot.model_copy(
        update={"tracker": tracker.model_copy(update={"registration_translation": translation})}
    )
    assert bias_sigma(changed)[3:6].tolist() == [1e-4, 2e-4, 3e-3]
    np.testing.assert_array_equal(
        np.delete(bias_sigma(changed), [3, 4, 5]), np.delete(bias_sigma(robot), [3, 4, 5])
    )


def test_an_equilibrium_that_cannot_be_linearised_begins_without_deviation(model, monkeypatch):
    def at_a_fold(*arguments):
        *_, dx, fields, dnodes = arguments
        dx[:], fields[:], dnodes[:] = np.nan, np.nan, np.nan
        return False

    monkeypatch.setattr(columns_module, "linearise", at_a_fold)
    found = Statics(model).solve(BETA, ALPHA)
    columns = Columns(model, model_uncertainty(model), rank=24)
    columns.start(found.key, found.mesh, BETA, ALPHA, model.parameters, found.x)
    assert not columns.stored.any()
    assert not columns.dnodes.any()
    assert columns.theta.any()


# -- propagation --


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
def test_columns_follow_finite_differences_of_the_simulation(robot, nodes, every):
    model = Model(robot, nodes=nodes)
    unc = model_uncertainty(model)
    start, _state, records = simulated(model, model.parameters, (0.0, 0.0), 20)
    columns = Columns(model, unc, rank=24)
    par = model.parameters.copy()
    par[model.layout["force"]] = start.inputs.force
    columns.start(start.key, start.mesh, BETA, ALPHA, par, start.unknowns[-1])
    for record in records[every - 1 :: every]:
        assert columns.propagate(record, model.parameters, behind=(every - 1) * DT)
    weight = field_weights(model, columns.mesh, BETA)
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
        if columns.transfer is not None:
            expected = columns.transfer.restrict @ expected
        difference = columns.fields[:, i] - expected
        error = np.sqrt((weight * difference**2).sum() / (weight * expected**2).sum())
        assert error < 0.05, (name, error)
        tip = columns.dnodes[-model_rows(model) :, i][:3]
        shift = ends[0].nodes[-1, :3] - ends[1].nodes[-1, :3]
        assert np.linalg.norm(tip - shift) < 0.05 * np.linalg.norm(shift) + 1e-7, name


def test_energy_is_that_of_all_points(model):
    """Half of the points stand for all: the others lie in the same places and carry nearly the same."""
    unc = model_uncertainty(model)
    start, _, records = simulated(model, model.parameters, (0.0, 0.0), 3)
    columns = Columns(model, unc, rank=24)
    columns.start(start.key, start.mesh, BETA, ALPHA, model.parameters, start.unknowns[-1])
    for record in records:
        assert columns.propagate(record, model.parameters)
    weights = field_weights(model, columns.mesh, BETA)
    rows, roots = energy_rows(model, columns.mesh, BETA)
    assert len(rows) < 0.6 * np.count_nonzero(weights)
    assert (roots**2).sum() == pytest.approx(weights.sum(), rel=1e-12)
    wanted = columns.fields.T @ (weights[:, None] * columns.fields)
    scale = np.sqrt(np.outer(wanted.diagonal(), wanted.diagonal()))
    found = columns.energy()
    np.testing.assert_allclose(found.diagonal(), wanted.diagonal(), rtol=1e-2)
    np.testing.assert_array_less(np.abs(found - wanted), 0.05 * scale + 1e-30)


def model_rows(model):
    """Rows of a node's state."""
    return 16 + 3 * model.n


def test_snapshot_of_columns_is_not_written_by_later_steps(model):
    unc = model_uncertainty(model)
    start, _, records = simulated(model, model.parameters, (0.0, 0.0), 3)
    columns = Columns(model, unc, rank=24)
    columns.start(start.key, start.mesh, BETA, ALPHA, model.parameters, start.unknowns[-1])
    kept = columns.snapshot()
    before = columns.fields.copy()
    for record in records:
        columns.propagate(record, model.parameters)
    columns.theta *= 0.5
    after = columns.fields.copy()
    columns.restore(kept)
    assert np.array_equal(columns.fields, before)
    for record in records:
        columns.propagate(record, model.parameters)
    assert np.array_equal(columns.fields, after)


@pytest.mark.parametrize("lent", [False, True])
def test_columns_stay_where_a_step_cannot_be_linearised(model, monkeypatch, lent):
    """A failure shows in a later pack of lanes only, when the first columns have been written."""
    start, _, records = simulated(model, model.parameters, (0.0, 0.0), 3)
    columns = Columns(model, model_uncertainty(model), rank=24)
    columns.start(start.key, start.mesh, BETA, ALPHA, model.parameters, start.unknowns[-1])
    columns.propagate(records[0], model.parameters)
    before = [np.copy(x) for x in (columns.stored, columns.dx, columns.dnodes)]
    if lent:
        columns.snapshot()

    def failing(*arguments):
        result = arguments[15]
        result[:, :, :8] = np.nan
        return False

    with monkeypatch.context() as patch:
        patch.setattr(columns_module, "theta_tangent", failing)
        assert not columns.propagate(records[1], model.parameters)
    for was, now in zip(before, (columns.stored, columns.dx, columns.dnodes), strict=True):
        assert np.array_equal(was, now)
    assert columns.propagate(records[2], model.parameters)
    assert np.isfinite(columns.stored).all()


# -- modes --


def test_modes_equal_a_simulated_small_vibration(model):
    """Let go of 2 mN: the tip's motion is the sum of modes with the frequencies and dampings found."""
    inputs = Inputs(ALPHA, ZERO, BETA, ZERO)
    equilibrium = Statics(model, 1e-10).solve(BETA, ALPHA, np.zeros(3), np.zeros(3))
    par = model.parameters.copy()
    par[model.layout["alpha"]], par[model.layout["beta"]] = ALPHA, BETA
    basis = modal_basis(model, equilibrium, par, BETA)
    assert basis is not None
    assert np.all(np.diff(basis.frequency_hz) > 0)
    assert np.all(basis.damping > 0)
    slowest = basis.direction[0]

    simulator = Simulator(model, tolerance=1e-10)
    state = simulator.rest(Inputs(ALPHA, ZERO, BETA, ZERO, 2e-3 * slowest))
    tips, modes = [], []
    for k in range(500):
        assert simulator.step(state, k * DT, lambda t: inputs).ok
        tips.append(state.nodes[-1, :3].copy())
        modes.append(basis.measure(state.fields, inputs))
    path = (np.array(tips) - equilibrium.nodes[-1, :3]) @ slowest
    t = DT * np.arange(1, 501)

    def waves(t, *numbers):
        return sum(
            size * np.exp(-decay * t) * np.cos(2 * np.pi * frequency * t + phase)
            for size, decay, frequency, phase in np.reshape(numbers, (-1, 4))
        )

    # two bending modes lie close together; the spectrum's peak is where the fit begins
    after = slice(30, None)
    spectrum = np.abs(np.fft.rfft(path[after] * np.hanning(470), 8192))
    peak = np.fft.rfftfreq(8192, DT)[np.argmax(spectrum)]
    size = np.abs(path[after]).max()
    start = (size, 3.0, peak, 0.0, 0.3 * size, 3.0, 1.6 * peak, 0.0)
    found = np.reshape(curve_fit(waves, t[after], path[after], p0=start, maxfev=20000)[0], (2, 4))
    assert np.std(path[after] - waves(t[after], *found.ravel())) < 0.02 * np.std(path[after])
    for _, decay, frequency, _ in found:
        mode = int(np.argmin(np.abs(basis.frequency_hz - frequency)))
        assert basis.frequency_hz[mode] == pytest.approx(frequency, rel=0.01)
        assert basis.damping[mode] == pytest.approx(
            decay / np.hypot(decay, 2 * np.pi * frequency), rel=0.1, abs=5e-4
        )

    amplitude, rate = (np.array([getattr(m, name) for m in modes]) for name in ("amplitude", "rate"))
    along = amplitude @ (basis.direction @ slowest)
    assert np.sqrt(np.mean((along - path) ** 2)) < 0.05 * np.sqrt(np.mean(path**2))
    # the rate is the amplitude's derivative
    slope = np.gradient(amplitude[:, 0], DT)
    assert np.sqrt(np.mean((rate[5:-5, 0] - slope[5:-5]) ** 2)) < 0.05 * np.sqrt(np.mean(slope**2))


def test_modes_at_rest_are_zero_also_where_actuators_have_moved(model):
    equilibrium = Statics(model, 1e-10).solve(BETA, ALPHA, np.zeros(3), np.zeros(3))
    par = model.parameters.copy()
    par[model.layout["alpha"]], par[model.layout["beta"]] = ALPHA, BETA
    basis = modal_basis(model, equilibrium, par, BETA)
    there = Inputs(ALPHA, ZERO, BETA, ZERO)
    assert np.abs(basis.measure(equilibrium.fields, there).amplitude).max() < 1e-9
    alpha = ALPHA + np.array([0.004, -0.002])
    near = Statics(model, 1e-10).solve(BETA, alpha, np.zeros(3), np.zeros(3))
    moved = basis.measure(near.fields, Inputs(alpha, ZERO, BETA, ZERO))
    still = basis.measure(near.fields, there)
    assert np.abs(moved.amplitude).max() < 0.1 * np.abs(still.amplitude).max()


def test_modes_are_found_anew_only_where_the_robot_has_moved(model):
    tracker = ModeTracker(model, every=0)
    simulator = Simulator(model)

    def refreshed(alpha):
        """Frequencies and amplitudes after a refresh at rest at ``alpha``, and whether the modes were found for it."""
        state = simulator.rest(Inputs(alpha, ZERO, BETA, ZERO))
        tracker.measure(state)
        parts = 0
        while not parts or tracker._pending is not None:
            tracker.refresh(state, simulator.parameters)
            parts += 1
        found = tracker.measure(state)
        return found.frequency_hz, found.amplitude, parts > 1

    frequency, amplitude, found = refreshed(ALPHA)
    assert found
    assert np.abs(amplitude).max() < 1e-8
    for k in range(1, MOST_KEPT + 1):
        same, amplitude, found = refreshed(ALPHA + k * 1e-4)
        assert not found
        assert np.array_equal(same, frequency)
        assert np.abs(amplitude).max() < 1e-8
    assert refreshed(ALPHA)[2]  # kept often enough
    assert not refreshed(ALPHA)[2]
    moved, amplitude, found = refreshed(ALPHA + np.array([0.3, 0.0]))
    assert found
    assert np.abs(moved / frequency - 1).max() > 1e-4
    assert np.abs(amplitude).max() < 1e-8
    assert refreshed(ALPHA + 0.02)[2]
    turned = ALPHA + 0.02 + 0.015
    assert refreshed(turned)[2]
