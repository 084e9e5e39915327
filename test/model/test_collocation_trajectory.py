"""Whole simulations by collocation against single steps, and their sensitivities against finite differences of whole simulations."""

import numpy as np
import pytest
from test_trajectory import ROBOT, extended_robot, inputs_of, plain_parameters

from ctr_dynamics.model import collocation_trajectory, trajectory
from ctr_dynamics.model.collocation_trajectory import run_collocation
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Simulator
from ctr_dynamics.model.time_scheme import collocation, make_scheme
from ctr_dynamics.model.trajectory import TIP_ROWS, run, to_inputs

DT, DURATION = 0.003, 0.3
EVENTS = (0.1, 0.102)
# rows of the tip, and what columns may miss of their size; rates jump with the motors' at the start
PARTS = {
    "position": (slice(0, 3), 0.01),
    "quaternion": (slice(3, 7), 0.01),
    "velocity": (slice(7, 10), 0.1),
    "rate": (slice(10, 13), 0.1),
}


def follow(
    model, slide=0.0, parameters=None, shift=None, events=EVENTS, tolerance=1e-8, duration=DURATION, **columns
):
    parameters = model.parameters if parameters is None else parameters
    found = run_collocation(
        model, collocation(DT), parameters, inputs_of(model, slide, shift), duration, tolerance=tolerance, events=events, **columns
    )  # fmt: skip
    assert not found.failure
    return found


@pytest.mark.parametrize("slide", [0.0, 0.03], ids=["fixed sections", "sections that change"])
def test_a_run_is_its_steps(slide):
    model = Model(ROBOT, nodes=12)
    inputs = inputs_of(model, slide)
    found = follow(model, slide)
    assert len(found.t) == 101
    simulator = Simulator(model, collocation(DT), 1e-8, model.parameters)

    def at(t):
        return to_inputs(model.n, inputs(np.array([t]))[0])

    start, still = at(0.0), np.zeros(2)
    state = simulator.rest(type(start)(start.alpha, still, start.beta, still, start.force, start.torque))
    keys, tips = {state.key}, [state.nodes[-1, :TIP_ROWS].copy()]
    for k in range(100):
        assert simulator.step(state, k * DT, at, events=EVENTS).ok
        keys.add(state.key)
        tips.append(state.nodes[-1, :TIP_ROWS].copy())
    assert (len(keys) > 1) == (slide > 0.0)
    # both meet the tolerance, by different Newton histories
    assert np.abs(found.tip - tips)[:, :7].max() < 1e-6
    assert np.abs(found.tip - tips)[:, 7:].max() < 1e-3


def wrong_columns(model, slide, parameters, inputs, **given):
    """Columns that differ from central differences of runs by more than PARTS allows.

    ``parameters``: (group, index, unit) of the block; ``inputs``: (row, unit) of the inputs, shifted by a constant.
    """
    count = len(parameters) + len(inputs)
    effect, change = np.zeros((model.layout.size, count)), np.zeros((model.input_count, count))
    for c, (group, index, unit) in enumerate(parameters):
        effect[model.layout[group].start + index, c] = unit
    for c, (row, unit) in enumerate(inputs):
        change[row, len(parameters) + c] = unit
    found = follow(
        model, slide, effect=effect, input_effect=lambda times: np.repeat(change[None], len(times), axis=0), **given
    )  # fmt: skip
    assert found.columns.shape == (101, TIP_ROWS, count)
    h, wrong = 2e-2, []  # large against the tolerance of the steps
    for c, name in enumerate((*parameters, *inputs)):
        ends = [
            follow(model, slide, model.parameters + s * h * effect[:, c], s * h * change[:, c], **given).tip
            for s in (1.0, -1.0)
        ]
        expected = (ends[0] - ends[1]) / (2.0 * h)
        for part, (rows, tolerance) in PARTS.items():
            size = np.abs(expected[:, rows]).max()
            error = np.abs(found.columns[:, rows, c] - expected[:, rows]).max()
            if not (size > 0.0 and error < tolerance * size):
                wrong.append((name, part, size, error / max(size, 1e-300)))
    return wrong


def test_columns_of_a_plain_run():
    """Stiffness, damping, friction, weight; angles, force; with a change of sections on the way, over which the columns are carried."""
    model = Model(ROBOT, nodes=12)
    assert not wrong_columns(model, 0.03, plain_parameters(model), [(0, 0.01), (6, 0.01)])
    # beta itself on sections that stay: a shift of beta also shifts the time at which they change
    assert not wrong_columns(model, 0.0, [], [(4, 1e-4), (5, 1e-4)])


def test_columns_of_an_extended_run():
    """Extensions away from their off-values, and a plain parameter beside them."""
    extensions = {
        "drivetrain_compliance": {"tube1.stiffness_Nm_per_rad": 1.0, "tube2.stiffness_Nm_per_rad": 3.0},
        "clearance": {"play_rad": 0.01},
        "ovality": {"tube1.ratio": 1.1, "tube1.axis_rad": 0.4},
        "air_drag": {"linear_Ns_per_m2": 0.05, "quadratic_Ns2_per_m3": 0.1},
        "tip_spring": {"stiffness_N_per_m": 1.0, "damping_Ns_per_m": 0.01, "anchor_z_m": 0.1},
        "insertion_velocity": {"scale": 1.0},
    }
    model = Model(extended_robot(extensions), nodes=12)
    assert model.extended
    parameters = [
        ("bending_stiffness", 0, 0.02 * model.parameters[0]),
        ("drive_compliance", 0, 2.0),
        ("clearance", 0, 4e-3),
        ("oval_cos", 0, 0.01),
        ("drag_quadratic", 0, 0.2),
        ("spring_stiffness", 0, 0.1),
        ("insertion_velocity", 0, 0.1),
    ]
    assert not wrong_columns(model, 0.03, parameters, [(1, 0.01), (7, 0.01)])


def test_steps_are_divided_at_events():
    """A load that falls off within one step: divided there, coarse steps are those of a fine solution."""
    model = Model(ROBOT, nodes=12)
    fine = run(
        model, make_scheme("sdirk3", 0.0005), model.parameters, inputs_of(model), DURATION, tolerance=1e-9
    )
    error = {
        events: np.abs(follow(model, events=events).tip[:, :3] - fine.tip[::6, :3]).max()
        for events in ((), EVENTS)
    }
    assert error[EVENTS] < 1e-6
    assert error[EVENTS] < 0.2 * error[()]


def test_steps_of_several_lengths_keep_the_tip_and_its_columns():
    """Twice the length before the load falls off and half of it behind, in steps that the load divides or not."""
    model = Model(ROBOT, nodes=12)
    unit = 0.02 * model.parameters[model.layout["bending_stiffness"]][0]
    effect = np.zeros((model.layout.size, 1))
    effect[model.layout["bending_stiffness"].start] = unit
    even = follow(model, slide=0.03, effect=effect)
    lengths = np.concatenate([np.full(15, 2.0 * DT), np.full(140, 0.5 * DT)])
    found = follow(model, slide=0.03, effect=effect, duration=lengths)
    np.testing.assert_allclose(found.t, np.concatenate([[0.0], np.cumsum(lengths)]), atol=1e-12)
    assert found.t[-1] == pytest.approx(DURATION)
    for one, other in ((slice(None, 16), slice(0, 31, 2)), (slice(15, None, 2), slice(30, None))):
        assert np.abs(found.tip[one, :3] - even.tip[other, :3]).max() < 1e-5
        error = np.abs(found.columns[one, :3] - even.columns[other, :3])
        assert error.max() < 0.01 * np.abs(even.columns[:, :3]).max()


@pytest.mark.parametrize("refused", [1, 1000], ids=["a step is halved", "a step is rescued"])
def test_hard_steps_keep_the_columns(monkeypatch, refused):
    """Steps around 0.15 s that the compiled loop refuses, up to ``refused`` times, go on in halves or by the rescue, and columns with them."""
    model = Model(ROBOT, nodes=12)
    plain = collocation_trajectory._Run.fast
    times = [0]

    def fast(self, scheme, at, *others):
        if (
            at[0, 0] < 0.15 < at[-1, -1]
            and (len(at) > 1 or scheme.dt > 0.4 * DT)
            and times[0] % 1000 < refused
        ):
            times[0] += 1
            return 0
        if len(at) == 1 and refused == 1000 and abs(at[0, 0] - 0.15) < DT:
            return 0
        return plain(self, scheme, at, *others)

    unit = 0.02 * model.parameters[model.layout["bending_stiffness"]][0]
    effect = np.zeros((model.layout.size, 1))
    effect[model.layout["bending_stiffness"].start] = unit
    whole = follow(model, effect=effect)
    monkeypatch.setattr(collocation_trajectory._Run, "fast", fast)
    hard = follow(model, effect=effect)
    assert times[0] >= 1
    assert np.abs(hard.tip[:, :3] - whole.tip[:, :3]).max() < 1e-5
    size = np.abs(whole.columns[:, :3]).max()
    assert np.abs(hard.columns[:, :3] - whole.columns[:, :3]).max() < 0.05 * size


def test_columns_end_where_they_tell_nothing(monkeypatch):
    """The simulation goes on without them."""
    model = Model(ROBOT, nodes=12)
    effect = np.zeros((len(model.parameters), 1))
    effect[model.layout["bending_stiffness"].start] = 0.02 * model.parameters[0]
    whole = follow(model, effect=effect)
    np.testing.assert_array_equal(whole.tip, follow(model).tip)
    size = np.abs(whole.columns[:, :3]).max(axis=(1, 2))
    k = int(np.argmax(size > 1.5 * size[0]))
    monkeypatch.setattr(trajectory, "SENSITIVE", 1.5 * size[0])
    cut = follow(model, effect=effect)
    np.testing.assert_allclose(cut.tip, whole.tip, atol=1e-4)
    np.testing.assert_allclose(cut.columns[:k], whole.columns[:k], atol=1e-12)
    assert not np.any(cut.columns[k + 1 :])
