"""Many simulations at once against each alone."""

import numpy as np
import pytest

from ctr_dynamics.effects import apply_effects
from ctr_dynamics.model.batch import run_many
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.model.trajectory import run
from ctr_dynamics.robot_files import load_robot

ROBOT = load_robot("till2020_tissue")
BETA = np.array(ROBOT.rest.beta.value)
SCHEME = make_scheme("sdirk3", 0.003)


def motion(model, turn, force, slide=0.0):
    """Both tubes turn at ``turn`` rad/s, a load of ``force`` N falls off at 0.06 s, tube 2 is drawn in at ``slide`` m/s."""
    n = model.n

    def rows(times):
        out = np.zeros((len(times), model.input_count))
        out[:, :n] = np.stack([1.2 + turn * times, 1.6 - turn * times], axis=1)
        out[:, n : 2 * n] = turn, -turn
        out[:, 2 * n : 3 * n] = BETA
        out[:, 3 * n - 1] -= slide * times
        out[:, 3 * n + 1] = np.interp(times, [0.0, 0.06, 0.062], [-force, -force, 0.0])
        return out

    return rows


@pytest.fixture(scope="module")
def model():
    return Model(ROBOT, nodes=12)


def test_every_case_is_what_it_is_alone(model):
    """More cases than lanes, of other stiffness, motion and load; one whose sections change leaves the batch."""
    rng = np.random.default_rng(1)
    blocks, inputs = [], []
    for k in range(19):
        plant = model.plant.copy()
        apply_effects(plant, {"youngs_modulus": {"all.scale": 1.0 + 0.05 * rng.standard_normal()}})
        blocks.append(plant.block)
        slide = 0.05 if k == 5 else 0.0
        inputs.append(motion(model, float(rng.uniform(-3, 3)), float(rng.uniform(0, 0.4)), slide))
    found = run_many(model, SCHEME, np.stack(blocks), inputs, 0.18, tolerance=1e-9)
    assert len(found) == 19
    for block, rows, one in zip(blocks, inputs, found, strict=True):
        alone = run(model, SCHEME, block, rows, 0.18, tolerance=1e-9)
        assert not one.failure
        assert not alone.failure
        assert np.array_equal(one.t, alone.t)
        assert np.abs(one.tip - alone.tip)[:, :7].max() < 1e-7
        assert np.abs(one.tip - alone.tip)[:, 7:].max() < 1e-4
    # they are different simulations
    assert np.ptp([one.tip[-1, :3] for one in found], axis=0).max() > 1e-3


def test_a_case_that_cannot_be_simulated_is_said_and_harms_no_other(model):
    blocks = np.stack([model.parameters] * 3)
    bad = blocks.copy()
    bad[1] = np.nan
    inputs = [motion(model, turn, 0.1) for turn in (1.0, 2.0, 3.0)]
    found = run_many(model, SCHEME, bad, inputs, 0.03)
    good = run_many(model, SCHEME, blocks, inputs, 0.03)
    assert found[1].failure
    for k in (0, 2):
        assert not found[k].failure
        # the lanes that are left iterate together: rounding may differ, the solution does not
        assert np.abs(found[k].tip - good[k].tip)[:, :7].max() < 1e-6


def test_one_case_and_none(model):
    assert run_many(model, SCHEME, np.zeros((0, len(model.parameters))), [], 0.03) == []
    one = run_many(model, SCHEME, model.parameters[None], [motion(model, 1.0, 0.1)], 0.03)
    assert len(one) == 1
    assert len(one[0].t) == 11
