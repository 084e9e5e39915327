"""Predictions, derivatives and fits on one second of a motion whose truth is known."""

import numpy as np
import pytest

from ctr_dynamics.diagnosis import numerics
from ctr_dynamics.diagnosis.experiment import NODES, Experiment
from ctr_dynamics.diagnosis.fit import fit, make_problem
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.effects import quantities
from ctr_dynamics.robot import load_robot

PAYLOAD = ("payload_mass", "added_kg")
AIR = ("air_drag", "linear_Ns_per_m2")
STIFFNESS = ("youngs_modulus", "tube1.scale")


@pytest.fixture(scope="module")
def robot():
    return load_robot("till2020_tissue")


@pytest.fixture(scope="module")
def known(robot):
    return {q.key: q for q in quantities(robot)}


@pytest.fixture(scope="module")
def recording(robot):
    """Both tubes turned by 0.6 rad within 0.3 s, seen by a tracker without noise; 0.3 g more payload than the robot file says."""
    t = np.arange(101) / 100.0
    turn = 0.6 * np.clip(t / 0.3, 0.0, 1.0)[:, None]
    joints = np.column_stack([t, robot.rest.alpha.value + turn, np.tile(robot.rest.beta.value, (len(t), 1))])
    stamps = np.arange(40) / 40.0
    empty = np.tile([1.0, 0.0, 0.0, 0.0], (40, 1))
    blind = Recording("truth", "", {}, joints, np.zeros((0, 7)), stamps, np.zeros((40, 3)), empty, ())
    seen = Experiment(blind, robot).predict({PAYLOAD: 3e-4})
    assert not seen.failure
    return Recording("seen", "", {}, joints, np.zeros((0, 7)), stamps, seen.position, seen.quaternion, ())


def test_columns_together_are_those_apart(recording, robot, known):
    """With a cause that needs the extended model, plain columns go through that one too."""
    experiment = Experiment(recording, robot)
    alone = experiment.jacobian({}, [known[STIFFNESS]])[1][:, :, 0]
    together = experiment.jacobian({}, [known[STIFFNESS], known[AIR]])[1]
    size = np.abs(alone).max(axis=0)
    np.testing.assert_allclose(together[:, :, 0] / size, alone / size, atol=1e-4)
    step = 0.01
    shifted = [
        experiment.predict({AIR: known[AIR].off + side * step * known[AIR].scale}).position for side in (0, 1)
    ]
    slope = (shifted[1] - shifted[0]) / step
    assert np.abs(together[:, :3, 1] - slope).max() < 0.03 * np.abs(slope).max()


def test_a_fit_finds_the_payload_and_a_hopeless_one_does_not_move(recording, robot, known):
    nuisances = [known[key] for key in known if key[0] in ("registration_translation", "encoder_offset")]
    problem = make_problem(robot, [recording], nuisances, np.ones(6, bool))
    found = fit(problem, [known[PAYLOAD]], {})
    assert found is not None
    sigma = found.sigma[[q.key for q in found.active].index(PAYLOAD)]
    assert abs(found.point[PAYLOAD] - 3e-4) < 0.3 * sigma
    assert found.chi2 < 1.0
    # without the payload no tolerance reaches that
    hopeless = fit(problem, (), {}, limit=found.cost + 1.0)
    best = fit(problem, (), {})
    assert hopeless is not None
    assert best is not None
    assert hopeless.cost > best.cost > found.cost + 1.0
    assert np.all(hopeless.values == [q.off for q in problem.nuisances])


def test_more_nodes_where_the_data_can_see_them(recording, robot, monkeypatch):
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    errors = numerics.add_numerics(problem, {}, 1)
    assert problem.experiments[0].nodes == NODES
    monkeypatch.setattr(numerics, "SPACE_LIMIT", 0.0)
    finer = numerics.add_numerics(problem, {}, 1)
    assert problem.experiments[0].nodes == numerics.MOST_NODES
    assert finer["space_error_m"] < 0.3 * errors["space_error_m"]
    assert finer["time_error_m"] == pytest.approx(errors["time_error_m"], rel=0.2)
