"""Two simulations in the same sweeps against each alone, and the spare lanes that renew their Jacobians."""

import numpy as np
import pytest

from ctr_dynamics.kernels.batched_shooting import renew_columns
from ctr_dynamics.kernels.kinds import Lanes
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.paired_steps import PairedSteps
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot_files import load_robot

DT, TOLERANCE = 0.003, 1e-9
ROBOT = load_robot("till2020_tissue")
BETA = np.array(ROBOT.rest.beta.value)
RATES = np.array([1.5, -1.0])


@pytest.fixture(scope="module")
def model():
    return Model(ROBOT, nodes=12)


def turning(force=0.0, slide=0.0):
    """Both tubes turn, a force in y, tube 2 is drawn in at ``slide`` m/s."""

    def at(t):
        beta_rate = np.array([0.0, -slide])
        return Inputs(
            np.array([1.2, 1.6]) + RATES * t,
            RATES,
            BETA + beta_rate * t,
            beta_rate,
            np.array([0.0, force, 0.0]),
        )

    return at


def simulators(model, scheme="sdirk3", stiffer=1.05):
    """One of the robot file, and one of another stiffness."""
    other, same = model.parameters.copy(), make_scheme(scheme, DT)
    other[model.layout["bending_stiffness"]] *= stiffer
    return tuple(Simulator(model, same, TOLERANCE, block) for block in (model.parameters, other))


def at_rest(simulator, inputs_at):
    start = inputs_at(0.0)
    return simulator.rest(Inputs(start.alpha, np.zeros(2), start.beta, np.zeros(2), start.force))


@pytest.mark.parametrize("scheme", ["sdirk3", "bdf2", "backward_euler"])
@pytest.mark.parametrize("slide", [0.0, 0.004], ids=["turning", "sliding"])
def test_a_pair_goes_where_each_goes_alone(model, scheme, slide):
    first, second = simulators(model, scheme)
    inputs = turning(0.02, slide), turning(0.0, slide)
    states = [at_rest(s, at) for s, at in zip((first, second), inputs, strict=True)]
    alone = [state.copy() for state in states]
    pair, hard = PairedSteps(first, second), 0
    for k in range(40):
        results = pair.step(*states, k * DT, *inputs)
        if results is None:
            hard += 1
            each = zip((first, second), states, inputs, strict=True)
            results = tuple(simulator.step(state, k * DT, at) for simulator, state, at in each)
        assert all(result.ok and result.sweeps >= first.scheme.stages for result in results)
        for simulator, state, at in zip((first, second), alone, inputs, strict=True):
            assert simulator.step(state, k * DT, at).ok
    assert hard <= 1  # the jump of the rates at the start
    for together, apart in zip(states, alone, strict=True):
        assert np.abs(together.nodes[:, :7] - apart.nodes[:, :7]).max() < 1e-7
        assert np.abs(together.fields - apart.fields).max() < 1e-4 * np.abs(apart.fields).max()
        assert np.array_equal(together.inputs.alpha, apart.inputs.alpha)
        # and either goes on alone from there
        assert first.step(together, 40 * DT, inputs[0]).ok
    assert np.abs(states[0].nodes[-1, :3] - states[1].nodes[-1, :3]).max() > 1e-3


def test_the_record_is_that_of_a_step_alone(model):
    first, second = simulators(model)
    at = turning(0.02)
    a, b = at_rest(first, at), at_rest(second, at)
    alone = a.copy()
    pair = PairedSteps(first, second)
    for k in range(5):
        found = pair.step(a, b, k * DT, at, at, record=True)
        expected = first.step(alone, k * DT, at, record="end")
        assert found is not None
        assert found[1].records == ()
    for one, other in zip(found[0].records[0], expected.records[0], strict=True):
        if isinstance(one, np.ndarray) and one.size:
            assert np.abs(one - other).max() <= 1e-5 * np.abs(other).max()


def test_a_step_that_is_divided_is_that_of_each_alone(model):
    first, second = simulators(model)

    def letting_go(t):
        return turning(0.02 * min(1.0, max(0.0, 1.0 - (t - 4.4 * DT) / (0.3 * DT))))(t)

    states = [at_rest(first, letting_go), at_rest(second, letting_go)]
    alone, whole = [state.copy() for state in states], states[0].copy()
    pair = PairedSteps(first, second)
    for k in range(8):
        events = (4.4 * DT, 4.7 * DT) if k == 4 else ()
        results = pair.step(*states, k * DT, letting_go, letting_go, record=True, events=events)
        each = [
            simulator.step(state, k * DT, letting_go, record="end", events=events)
            for simulator, state in zip((first, second), alone, strict=True)
        ]
        first.step(whole, k * DT, letting_go)
        if results is None:  # the jump of the rates at the start
            assert k == 0
            results = [
                s.step(x, 0.0, letting_go, record="end") for s, x in zip((first, second), states, strict=True)
            ]
        assert [r.reason for r in results] == [r.reason for r in each]
        assert len(results[0].records) == len(each[0].records) == len(events) + 1
        for record, expected in zip(results[0].records, each[0].records, strict=True):
            assert record.scheme.dt == expected.scheme.dt
            for one, other in zip(record, expected, strict=True):
                if isinstance(one, np.ndarray) and one.size:
                    assert np.abs(one - other).max() <= 1e-4 * np.abs(other).max()
    for together, apart in zip(states, alone, strict=True):
        assert np.abs(together.nodes[:, :7] - apart.nodes[:, :7]).max() < 1e-7
    assert np.abs(states[0].nodes[:, :3] - whole.nodes[:, :3]).max() > 1e-6, "it is another step undivided"


@pytest.mark.parametrize(
    "case",
    [
        "other translations",
        "other translations on the way",
        "other sections",
        "not finite",
        "beyond the plate",
        "no solution",
    ],
)
def test_where_they_cannot_go_together_nothing_is_done(model, case):
    first, second = simulators(model)
    at = other = turning()
    if case == "other translations":
        other = turning(slide=1e-3)
    elif case == "other translations on the way":

        def other(t):
            return turning(slide=1.0 if 0.0 < t < DT - 1e-9 else 0.0)(t)

    elif case == "other sections":
        at = other = turning(slide=8.0)
    elif case == "not finite":
        other = turning(force=np.nan)
    elif case == "beyond the plate":
        at = other = turning(slide=1e3)
    elif case == "no solution":
        other = turning(force=1e9)
    a, b = at_rest(first, turning()), at_rest(second, turning())
    before = a.copy(), b.copy()
    assert PairedSteps(first, second).step(a, b, 0.0, at, other) is None
    for state, was in zip((a, b), before, strict=True):
        assert state.key == was.key
        for name in ("bank", "unknowns", "earlier", "nodes"):
            assert np.array_equal(getattr(state, name), getattr(was, name))
    assert PairedSteps(first, second).step(a, b, 0.0, turning(), turning()) is not None


def test_the_parameters_hold_the_inputs_of_the_step_as_after_one_alone(model):
    first, second = simulators(model)
    alone = Simulator(model, first.scheme, TOLERANCE)
    at = turning(0.02)
    a, b = at_rest(first, at), at_rest(second, at)
    c = a.copy()
    assert PairedSteps(first, second).step(a, b, 0.0, at, at) is not None
    assert alone.step(c, 0.0, at).ok
    assert np.array_equal(first.parameters, alone.parameters)


def test_a_finite_difference_renews_its_column():
    """Of an inverse that is a little wrong, one column of what it inverts becomes exact, the others stay; all of them after a round."""
    rng, m = np.random.default_rng(0), 7
    exact, units = rng.normal(size=(m, m)), 10.0 ** -rng.integers(5, 8, m)
    wrong = exact + 0.1 * rng.normal(size=(m, m))
    inverse = np.linalg.inv(wrong)[None].copy()
    column = 3
    for renewed in (3, 4, 5, 6, 0, 1, 2):
        residual = np.zeros((m, 2))
        residual[:, 1] = exact[:, renewed] * units[renewed]
        column = renew_columns(Lanes(2, 2), residual.ravel(), column, units, inverse, np.empty((2, m)))
        wrong[:, renewed] = exact[:, renewed]
        assert np.allclose(np.linalg.inv(inverse[0]), wrong, atol=1e-9)
    assert column == 3
    assert np.allclose(np.linalg.inv(inverse[0]), exact, atol=1e-9)


@pytest.mark.parametrize("residual", [np.nan, np.inf, 0.0], ids=["nan", "infinite", "singular"])
def test_a_finite_difference_that_tells_nothing_changes_nothing(residual):
    rng, m = np.random.default_rng(1), 7
    inverse = rng.normal(size=(1, m, m))
    before = inverse.copy()
    found = np.zeros((m, 2))
    found[:, 1] = residual
    assert renew_columns(Lanes(2, 2), found.ravel(), 0, np.full(m, 1e-6), inverse, np.empty((2, m))) == 1
    assert np.array_equal(inverse, before)
