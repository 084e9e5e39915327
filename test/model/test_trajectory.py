"""Whole simulations in compiled loops against single steps, and their sensitivities against finite differences of whole simulations."""

import copy

import numpy as np
import pytest

from ctr_dynamics.model import trajectory
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Simulator
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.model.trajectory import TIP_ROWS, run, to_inputs
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict

DT = 0.003
ROBOT = load_robot("till2020_tissue")
BETA = np.array(ROBOT.rest.beta.value)


def inputs_of(model, slide=0.0, shift=None):
    """Tubes that turn, a load that falls off at 0.1 s, tube 2 drawn in at ``slide`` m/s from 0.05 s on; ``shift`` is added to all rows."""
    n = model.n

    def rows(times):
        out = np.zeros((len(times), model.input_count))
        out[:, :n] = np.stack([1.2 + 3.0 * times, 1.6 - 2.0 * times], axis=1)
        out[:, n : 2 * n] = 3.0, -2.0
        out[:, 2 * n : 3 * n] = BETA
        late = np.clip(times - 0.05, 0.0, None)
        out[:, 3 * n - 1] -= slide * late
        out[:, 3 * n + 1] = np.interp(times, [0.0, 0.1, 0.102], [-0.2, -0.2, 0.0])
        if model.extended:
            out[:, -1] = np.where(times > 0.05, -slide, 0.0)
        return out if shift is None else out + shift

    return rows


@pytest.mark.parametrize("slide", [0.0, 0.03], ids=["fixed sections", "sections that change"])
def test_run_equals_steps(slide):
    model = Model(ROBOT, nodes=12)
    scheme = make_scheme("sdirk3", DT)
    inputs = inputs_of(model, slide)
    found = run(model, scheme, model.parameters, inputs, 0.3, tolerance=1e-9)
    assert not found.failure
    assert len(found.t) == 101
    simulator = Simulator(model, scheme, 1e-9, model.parameters)

    def at(t):
        return to_inputs(model.n, inputs(np.array([t]))[0])

    start = at(0.0)
    state = simulator.rest(
        type(start)(start.alpha, np.zeros(2), start.beta, np.zeros(2), start.force, start.torque)
    )
    keys = {state.key}
    tips = [state.nodes[-1, :TIP_ROWS]]
    for k in range(100):
        assert simulator.step(state, k * DT, at).ok
        keys.add(state.key)
        tips.append(state.nodes[-1, :TIP_ROWS])
    assert (len(keys) > 1) == (slide > 0.0)
    # both meet the tolerance, by different Newton histories
    assert np.abs(found.tip - tips)[:, :7].max() < 1e-7
    assert np.abs(found.tip - tips)[:, 7:].max() < 1e-4
    moved = BETA[1] - slide * np.clip(found.t - 0.05, 0.0, None)
    assert moved[-1] == pytest.approx(at(found.t[-1]).beta[1])


def plain_parameters(model):
    """(group, index, unit) of parameters of every kind that a plain run has: stiffness, shape, damping, friction, weight."""
    block, layout = model.parameters, model.layout
    return [
        ("bending_stiffness", 0, 0.02 * block[layout["bending_stiffness"]][0]),
        ("torsional_stiffness", 1, 0.02 * block[layout["torsional_stiffness"]][1]),
        ("precurvature", 0, 0.01),
        ("bending_damping", 0, 1e-6),
        ("body_mass", 0, 1e-4),
        ("base_coulomb", 0, 0.05),
        ("tube_viscous", 0, 1e-5),
        ("gravity", 0, 0.1),
    ]


def compare(model, slide, parameters, inputs, tolerance):
    """Columns of a run against central differences of runs.

    ``parameters``: (group, index, unit) of the block; ``inputs``: (row, unit) of the inputs, shifted by a constant.
    """
    scheme = make_scheme("sdirk3", DT)
    units = [(model.layout[g].start + i, None, unit) for g, i, unit in parameters]
    units += [(None, row, unit) for row, unit in inputs]
    effect = np.zeros((model.layout.size, len(units)))
    change = np.zeros((model.input_count, len(units)))
    for c, (row, column, unit) in enumerate(units):
        if row is not None:
            effect[row, c] = unit
        else:
            change[column, c] = unit
    duration = 0.3
    found = run(
        model,
        scheme,
        model.parameters,
        inputs_of(model, slide),
        duration,
        effect=effect,
        input_effect=lambda times: np.repeat(change[None], len(times), axis=0),
        tolerance=1e-11,
    )
    assert not found.failure
    assert found.columns is not None
    assert found.columns.shape == (101, TIP_ROWS, len(units))
    h, wrong = 2e-3, []
    for c in range(len(units)):
        ends = []
        for sign in (1.0, -1.0):
            other = run(
                model,
                scheme,
                model.parameters + sign * h * effect[:, c],
                inputs_of(model, slide, sign * h * change[:, c]),
                duration,
                tolerance=1e-11,
            )
            assert not other.failure
            ends.append(other.tip)
        expected = (ends[0] - ends[1]) / (2.0 * h)
        for part in (slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)):
            size = np.abs(expected[:, part]).max()
            error = np.abs(found.columns[:, part, c] - expected[:, part]).max()
            if not (size > 0.0 and error < tolerance * size):
                wrong.append(((*parameters, *inputs)[c], part, size, error / max(size, 1e-300)))
    assert not wrong, wrong


def test_sensitivities_of_a_plain_run():
    """Stiffness, damping, friction, weight; angles, force; with a change of sections on the way, over which the columns are carried."""
    model = Model(ROBOT, nodes=12)
    compare(model, 0.03, plain_parameters(model), [(0, 0.01), (6, 0.01)], 2e-3)
    # beta itself on sections that stay: a shift of beta also shifts the time at which they change
    compare(model, 0.0, [], [(4, 1e-4), (5, 1e-4)], 2e-3)


def test_sensitivities_with_strong_friction():
    """Sixty times the stated friction between tubes makes the residual nonlinear: a tangent by too large changes would grow from step to step."""
    model = Model(ROBOT, nodes=12)
    model.parameters[model.layout["tube_coulomb"]] = 0.19
    unit = 0.02 * model.parameters[model.layout["bending_stiffness"]][0]
    compare(model, 0.0, [("bending_stiffness", 0, unit), ("body_mass", 0, 1e-4)], [(0, 0.03)], 2e-2)


def extended_robot(extensions):
    """The tissue robot with ``extensions``."""
    data = copy.deepcopy(robot_to_dict(ROBOT))
    data["extensions"] = extensions
    return robot_from_dict(data)


def test_sensitivities_of_an_extended_run():
    """Every extension that is smooth, away from its off-value, and a plain parameter beside them."""
    robot = extended_robot(
        {
            "drivetrain_compliance": {
                "tube1.stiffness_Nm_per_rad": 1.0,
                "tube1.inertia_kgm2": 2e-7,
                "tube2.stiffness_Nm_per_rad": 3.0,
            },
            "clearance": {"play_rad": 0.01},
            "ovality": {"tube1.ratio": 1.1, "tube1.axis_rad": 0.4},
            "softening": {"tube1.curvature_1_per_m": 40.0},
            "air_drag": {"linear_Ns_per_m2": 0.05, "quadratic_Ns2_per_m3": 0.1},
            "stribeck": {"static_ratio": 1.5, "speed_rad_s": 5.0},
            "distributed_friction": {"torque_Nm_per_m": 2e-3},
            "tip_spring": {"stiffness_N_per_m": 1.0, "damping_Ns_per_m": 0.01, "anchor_z_m": 0.1},
            "insertion_velocity": {"scale": 1.0},
        }
    )
    model = Model(robot, nodes=12)
    assert model.extended
    compare(
        model,
        0.03,
        [
            ("bending_stiffness", 0, 0.02 * model.parameters[0]),
            ("drive_compliance", 0, 2.0),
            ("drive_inertia", 0, 1e-5),
            ("clearance", 0, 4e-3),
            ("clearance_kinematics", 0, 0.5),
            ("oval_cos", 0, 0.01),
            ("softening", 0, 4e-4),
            ("drag_linear", 0, 0.04),
            ("drag_quadratic", 0, 0.2),
            ("stribeck_excess", 0, 0.05),
            ("overlap_friction", 0, 8e-4),
            ("spring_stiffness", 0, 0.1),
            ("spring_damping", 0, 2e-3),
            ("insertion_velocity", 0, 0.1),
        ],
        [(1, 0.01), (7, 0.01)],
        2e-3,
    )


def test_sensitivities_of_a_learned_force():
    values = {
        "origin_z_m": 0.2,
        "potential_xyy_N": 0.01,
        "drag_y_N": 0.01,
        "memory_y_N": 0.02,
        "memory_s": 0.05,
        "tube1.sine_x_N": 0.01,
    }
    model = Model(extended_robot({"learned_force": values}), nodes=12)
    quantities = [
        ("learned_potential", 3, 0.005),
        ("learned_drag", 1, 5e-3),
        ("learned_memory", 1, 0.02),
        ("learned_memory_time", 0, 0.02),
        ("learned_cosine", 1, 5e-3),
    ]
    compare(model, 0.03, quantities, [(1, 0.01)], 5e-3)


@pytest.mark.parametrize("slide", [0.0, 0.03], ids=["in the compiled loop", "in single steps"])
def test_sensitivities_end_where_they_tell_nothing(monkeypatch, slide):
    """The simulation goes on without them."""
    model = Model(ROBOT, nodes=12)
    effect = np.zeros((len(model.parameters), 1))
    effect[model.layout["bending_stiffness"].start] = 0.02 * model.parameters[0]
    given = (
        model,
        make_scheme("sdirk3", DT),
        model.parameters,
        inputs_of(model, slide),
        0.3,
    )
    whole = run(*given, effect=effect)
    size = np.abs(whole.columns[:, :3]).max(axis=(1, 2))
    k = int(np.argmax(size > 1.5 * size[0]))
    monkeypatch.setattr(trajectory, "SENSITIVE", 1.5 * size[0])
    cut = run(*given, effect=effect)
    np.testing.assert_array_equal(cut.tip, whole.tip)
    np.testing.assert_array_equal(cut.columns[:k], whole.columns[:k])
    assert not np.any(cut.columns[k + 1 :])
    assert not cut.failure


def test_steps_are_divided_at_events():
    """A load that falls off within one step: divided there, coarse steps come nearer to fine ones, and sensitivities are those of the run."""
    model = Model(ROBOT, nodes=12)
    effect = np.zeros((len(model.parameters), 1))
    effect[0, 0] = 0.01 * model.parameters[0]

    def follow(dt, events=(), stiffer=0.0, columns=None):
        found = run(
            model, make_scheme("sdirk3", dt), model.parameters + stiffer * effect[:, 0], inputs_of(model), 0.3, effect=columns, tolerance=1e-9,
            events=events,
        )  # fmt: skip
        assert not found.failure
        return found

    fine = follow(0.0005).tip[::6, :3]
    whole, divided = follow(DT).tip[:, :3], follow(DT, (0.1, 0.102), columns=effect)
    assert np.sum((divided.tip[:, :3] - fine) ** 2) < 0.7 * np.sum((whole - fine) ** 2)
    plus, minus = (follow(DT, (0.1, 0.102), sign * 1e-3).tip[:, :3] for sign in (1, -1))
    expected = (plus - minus) / 2e-3
    assert np.abs(divided.columns[:, :3, 0] - expected).max() < 1e-3 * np.abs(expected).max()
    met = follow(DT, (0.102, 0.3))  # events at the ends of steps divide nothing
    np.testing.assert_array_equal(met.tip[:, :3], whole)


def test_a_step_is_divided_at_events_and_whole_where_a_part_fails():
    model = Model(ROBOT, nodes=12)
    inputs = inputs_of(model)

    def at(t):
        return to_inputs(model.n, inputs(np.array([t]))[0])

    def follow(scheme, events, at=at):
        simulator = Simulator(model, make_scheme(scheme, DT), 1e-9, model.parameters)
        state = simulator.rest(at(0.0))
        for k in range(33):
            assert simulator.step(state, k * DT, at).ok
        result = simulator.step(state, 33 * DT, at, record=True, events=events)
        assert result.ok
        return result, state

    cut = (0.102, 0.1)  # in any order; the second stands at a step's end
    divided, state = follow("sdirk3", cut)
    assert divided.reason == "divided at an event"
    assert [r.scheme.dt for r in divided.records] == pytest.approx([0.001, 0.002], abs=1e-12)
    np.testing.assert_array_equal(divided.records[-1].after, state.fields)
    assert len(follow("sdirk3", (0.0990001, 0.100, 0.1000001))[0].records) == 2  # too close to divide twice
    for scheme, events in (("sdirk3", (0.099, 0.102)), ("bdf2", cut)):
        whole, _ = follow(scheme, events)
        assert whole.reason == "ok"
        assert len(whole.records) == 1
    # one part meets a load that is no number: the step as a whole, whose stages do not, is taken
    whole, state = follow("sdirk3", cut, lambda t: at(t) if abs(t - 0.1) > 1e-9 else at(np.nan))
    assert whole.reason == "ok"
    assert np.isfinite(state.fields).all()
