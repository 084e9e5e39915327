"""Radau collocation in lanes and multiple shooting, against the equations of single stages, a scheme of small steps, and each other."""

import copy
from itertools import pairwise

import numpy as np
import pytest
from model_cases import make_robot, make_tube, many_tubes

from ctr_dynamics.kernels.condensing import factorise, solve_system
from ctr_dynamics.kernels.coupling import STAGES
from ctr_dynamics.kernels.kinds import ONE_LANE, cut_size
from ctr_dynamics.kernels.layout import input_row, unknown_rows
from ctr_dynamics.kernels.structures import SystemFactors
from ctr_dynamics.kernels.sweep import sweep
from ctr_dynamics.model.collocation_pair import CollocationPair
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.segments import segments_of
from ctr_dynamics.model.simulator import Simulator
from ctr_dynamics.model.state import Inputs, stage_inputs
from ctr_dynamics.model.time_scheme import collocation, make_scheme, radau_nodes
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict

BETA = np.array([-0.05, -0.04])
EXTENSIONS = {
    "drivetrain_compliance": {"tube1.stiffness_Nm_per_rad": 0.5, "tube2.inertia_kgm2": 1e-5, "tube2.stiffness_Nm_per_rad": 0.8},
    "ovality": {"tube1.ratio": 1.1, "tube1.axis_rad": 0.3, "tube2.ratio": 1.05, "tube2.axis_rad": 1.0},
    "clearance": {"play_rad": 0.02},
    "insertion_velocity": {"scale": 1.0},
}  # fmt: skip


def two_tubes(damping=1.0, **options):
    """Two precurved tubes with damping and a payload."""
    inner = {"bending_damping": 2e-6 * damping, "torsion_damping": 1e-6 * damping}
    outer = {"bending_damping": 6e-6 * damping, "torsion_damping": 4e-6 * damping}
    tubes = [
        make_tube(segments=((0.11, (0, 0, 0)), (0.09, (9.0, 0, 0))), mass=2e-3, inertia=(1e-7, 1e-7, 1e-8), **inner),
        make_tube(0.7e-3, 0.9e-3, segments=((0.07, (0, 0, 0)), (0.05, (5.0, 2.0, 0))), **outer),
    ]  # fmt: skip
    return make_robot(tubes, BETA, gravity=(0.0, -9.81, 0.0), **options)


def extended(robot):
    """The robot with every extension that stands in the time derivatives."""
    data = copy.deepcopy(robot_to_dict(robot))
    data["extensions"] = EXTENSIONS
    return robot_from_dict(data)


def moving(beta, hz=2.0, amplitude=0.5, insertion=0.0):
    """Tubes that turn against each other and move in together, from rest."""
    n, w = len(beta), 2 * np.pi * hz
    sign, beta = np.array([1.0, -1.0, 1.0, -1.0])[:n], np.array(beta, float)

    def at(t):
        t = max(t, 0.0)
        s, v = 1 - np.cos(w * t), w * np.sin(w * t)
        insert = 0.5 * insertion * np.ones(n)
        return Inputs(sign * amplitude * s, sign * amplitude * v, beta + insert * s, insert * v)

    return at


def tips_of(model, at, scheme, steps, tolerance=1e-9):
    """(steps + 1, 3) m; every step must succeed as it is."""
    simulator = Simulator(model, scheme, tolerance)
    state = simulator.rest(at(0.0))
    tips = [state.nodes[-1, :3].copy()]
    for k in range(steps):
        result = simulator.step(state, k * scheme.dt, at)
        assert result.ok, (k, result)
        tips.append(state.nodes[-1, :3].copy())
    return np.array(tips)


def released(robot, mass, cut=0.010):
    """The weight of ``mass`` kg on the tip, cut within ``cut`` s."""
    alpha, beta = np.array(robot.rest.alpha.value), np.array(robot.rest.beta.value)
    force = mass * np.array(robot.gravity.value)

    def at(t):
        share = min(1.0, max(0.0, 1.0 - t / cut))
        return Inputs(alpha, np.zeros_like(alpha), beta, np.zeros_like(beta), force * share)

    return at


def test_radau_matrix_integrates_polynomials():
    A, c = radau_nodes(4)
    for degree in range(4):
        assert A @ c**degree == pytest.approx(c ** (degree + 1) / (degree + 1), abs=1e-13)
    # the last row has order 7: it integrates up to degree 6
    for degree in range(7):
        assert A[-1] @ c**degree == pytest.approx(1.0 / (degree + 1), abs=1e-13)
    assert abs(A[-1] @ c**7 - 1.0 / 8) > 1e-6


def test_transformation_diagonalises_the_stages():
    C, rates, to_modes, from_modes = collocation(0.003).coefficients
    x = np.random.default_rng(1).normal(size=4)
    # a mode and its conjugate together: the real part of the doubled columns
    assert (from_modes @ (rates * (to_modes @ x))).real == pytest.approx(C @ x, rel=1e-10)
    assert (from_modes @ (to_modes @ x)).real == pytest.approx(x, abs=1e-12)


@pytest.mark.parametrize("kind", ["damped", "undamped", "extended"])
def test_every_stage_solves_its_own_equations(kind):
    """A plain sweep of one stage, with what the other stages do as its history, finds the same fields and no residual."""
    robot = two_tubes(0.0 if kind == "undamped" else 1.0, base=(0.05, 1e-6), between=(0.05, 1e-7))
    model = Model(extended(robot) if kind == "extended" else robot, nodes=12)
    scheme, at = collocation(0.003), moving(BETA)
    simulator = Simulator(model, scheme, 1e-10)
    state = simulator.rest(at(0.0))
    for k in range(5):
        before = state.fields.copy()
        assert simulator.step(state, 0.003 * k, at).reason == "ok"
    work = simulator.collocation.workspaces.of(state.key, state.mesh, BETA, scheme)
    b, C = work.solver.stages, scheme.coefficients.C
    stages = np.concatenate([b.fields.reshape(-1, STAGES), b.base_fields.reshape(-1, STAGES)])
    rows, _ = stage_inputs(model, at, 0.012 + scheme.times * scheme.dt)
    single = model.sweep_buffers(work.segments.mesh, 1, len(work.segments.nodes))
    m, main = unknown_rows(2).size, len(single.history)
    single.section_lengths[:] = b.section_lengths.reshape(-1, STAGES)[:, 0]
    for q in range(STAGES):
        single.parameters[:] = model.parameters
        for i in range(rows.shape[1]):
            single.parameters[input_row(2, i)] = rows[q, i]
        history = stages @ C[q] - C[q, q] * stages[:, q] - C[q].sum() * before
        single.history[:], single.base_history[:] = history[:main], history[main:]
        single.unknowns[:] = state.unknowns[-STAGES + q]
        sweep(model.kind, ONE_LANE, C[q, q], work.segments.mesh, single)
        found = np.concatenate([single.fields, single.base_fields])
        assert found == pytest.approx(stages[:, q], rel=1e-5, abs=1e-8 * np.abs(stages[:, q]).max())
        assert np.abs(single.residual / work.solver.point.residual_units).max() < 1e-8
        assert len(single.residual) == m + len(work.segments.nodes) * cut_size(model.kind)


@pytest.mark.parametrize("kind", ["damped", "extended", "friction", "insertion", "three tubes"])
def test_agrees_with_small_steps_of_another_scheme(kind):
    robot = many_tubes(3) if kind == "three tubes" else two_tubes(
        **({"base": (0.05, 1e-6), "between": (0.05, 1e-7)} if kind == "friction" else {})
    )  # fmt: skip
    model = Model(extended(robot) if kind == "extended" else robot, nodes=12)
    at = moving(robot.rest.beta.value, insertion=-0.01 if kind == "insertion" else 0.0, amplitude=0.2)
    found = tips_of(model, at, collocation(0.003), 20)
    fine = tips_of(model, at, make_scheme("sdirk3", 0.001), 60)[::3]
    assert np.ptp(fine, axis=0).max() > 1e-4  # it does move
    assert np.linalg.norm(found - fine, axis=1).max() < 3e-7


def test_order_of_convergence_on_smooth_motion():
    """Above the order of a stage, four; the solver's own floor hides the full seven."""
    model, at = Model(two_tubes(), nodes=12), moving(BETA, hz=3.0)
    reference = tips_of(model, at, collocation(0.003), 32, 1e-11)[-1]
    errors = [
        np.linalg.norm(tips_of(model, at, collocation(0.096 / steps), steps, 1e-11)[-1] - reference)
        for steps in (4, 8)
    ]
    assert np.log2(errors[0] / errors[1]) > 4.0
    assert errors[1] < 1e-7


def test_two_runs_together_are_each_alone():
    model, scheme = Model(two_tubes(), nodes=12), collocation(0.003)
    stiffer = model.parameters.copy()
    stiffer[model.layout["bending_stiffness"]] *= 1.1
    simulators = [Simulator(model, scheme, 1e-8, block) for block in (None, stiffer)]
    motions = [moving(BETA), moving(BETA, amplitude=0.4)]
    pair = CollocationPair(*simulators)
    states = [s.rest(at(0.0)) for s, at in zip(simulators, motions, strict=True)]
    alone = [s.copy() for s in states]
    for k in range(20):
        events = (0.0315,) if k == 10 else ()
        both = pair.step(*states, 0.003 * k, *motions, record=True, events=events)
        assert both is not None
        assert all(result.ok for result in both)
        assert len(both[0].records) == 1 + len(events)
        for simulator, state, at in zip(simulators, alone, motions, strict=True):
            assert simulator.step(state, 0.003 * k, at, events=events).ok
    for together, single in zip(states, alone, strict=True):
        assert together.nodes == pytest.approx(single.nodes, rel=1e-6, abs=1e-7)
    assert np.abs(states[0].nodes[-1, :3] - states[1].nodes[-1, :3]).max() > 1e-4
    record = both[0].records[-1]
    assert record.found.shape == (STAGES, model.unknown_count)
    assert np.array_equal(record.after, states[0].fields)


def test_condensed_solution_is_that_of_the_whole_system():
    rng = np.random.default_rng(3)
    m, size, cuts = 8, 22, 2
    mt = m + cuts * size
    owner = np.array([2, 2, 2, 2, 2, 2, 1, 0])
    system = np.zeros((mt, mt), complex)

    def random(rows, columns):
        return rng.normal(size=(rows, columns)) + 1j * rng.normal(size=(rows, columns))

    starts = [(0, m), *((m + j * size, size) for j in range(cuts))]
    for q in range(m):
        first, count = starts[owner[q]]
        system[q, first : first + count] = random(1, count)
    for j in range(cuts):
        rows, (first, count) = slice(m + j * size, m + (j + 1) * size), starts[j]
        system[rows, first : first + count] = random(size, count)
        system[rows, m + j * size : m + (j + 1) * size] -= np.eye(size)
    F = rng.normal(size=mt) + 1j * rng.normal(size=mt)
    condensed = SystemFactors(
        np.zeros((1, cuts, 2, size, size)), np.zeros((1, cuts, 2, m, size)), np.zeros((1, 2, m, size)), np.zeros((1, 2, m, m)),
        np.zeros((1, 2, 0, 0)),
    )  # fmt: skip
    whole = SystemFactors(
        np.zeros((1, 0, 2, 0, 0)), np.zeros((1, 0, 2, 0, 0)), np.zeros((1, 2, 0, 0)), np.zeros((1, 2, 0, 0)), np.zeros((1, 2, mt, mt)),
    )  # fmt: skip
    for factors in (condensed, whole):
        matrix, z = np.stack([system.real, system.imag]), np.zeros((2, mt))
        assert factorise(matrix, owner, factors, 0)
        solve_system(owner, factors, 0, np.stack([F.real, F.imag]), z)
        assert z[0] + 1j * z[1] == pytest.approx(-np.linalg.solve(system, F), rel=1e-9)


def test_cuts_divide_the_growth():
    model = Model(load_robot("three_tube"), nodes=24)
    beta = np.array(model.robot.rest.beta.value)
    key, mesh = model.mesh(beta)
    found = {}
    for dt in (0.003, 0.0005):
        segments = segments_of(model, key, mesh, beta, collocation(dt).coefficients.rates)
        cells = np.flatnonzero(segments.mesh.cut >= 0)
        assert segments.mesh.cut[cells].tolist() == list(range(len(cells)))
        bounds = [0, *cells, len(segments.mesh.cut)]
        longest = max(b - a for a, b in pairwise(bounds)) / bounds[-1]
        assert longest < 2.0 / (len(cells) + 1)
        found[dt] = len(cells)
    assert found[0.0005] > found[0.003] >= 2


@pytest.mark.parametrize(("name", "nodes"), [("three_tube", 24), ("three_tube", 100)])
def test_no_solve_fails_at_small_steps(name, nodes):
    """Single shooting ends at 0.5 ms on this robot; a mesh that is too coarse for a step (growth per cell above 1.2) is not asked for it."""
    robot = load_robot(name)
    for mass in (0.005, 0.060):
        for dt in (0.003, 0.001, 0.0005, *((0.00025,) if nodes > 24 else ())):
            model, at = Model(robot, nodes=nodes), released(robot, mass)
            simulator = Simulator(model, collocation(dt), 1e-6)
            state = simulator.rest(at(-1.0))
            sweeps, steps = 0, 12
            for k in range(steps):
                events = (0.010,) if k * dt < 0.010 < (k + 1) * dt else ()
                result = simulator.step(state, k * dt, at, events=events)
                assert result.ok, (mass, dt, k, result)
                assert result.reason in ("ok", "divided at an event")
                sweeps += result.sweeps
            assert sweeps < 25 * steps


def test_a_failed_step_leaves_the_state():
    model, at = Model(two_tubes(), nodes=12), moving(BETA)
    simulator = Simulator(model, tolerance=1e-8)
    state = simulator.rest(at(0.0))
    before = state.copy()

    def broken(t):
        inputs = at(t)
        return (
            inputs
            if t < 0.002
            else Inputs(inputs.alpha * np.nan, inputs.alpha_rate, inputs.beta, inputs.beta_rate)
        )

    result = simulator.step(state, 0.0, broken)
    assert not result.ok
    assert "not finite" in result.reason
    assert np.array_equal(state.fields, before.fields)
    assert np.array_equal(state.nodes, before.nodes)
    assert simulator.step(state, 0.0, at).ok
