"""The tip's Jacobian and compliance against finite differences of equilibria."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from ctr_dynamics.estimation.tip_jacobian import JacobianTracker
from ctr_dynamics.kernels import rotations
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.step_encoder import jacobian_names

SMALL = {"rotation": 1e-3, "translation": 1e-5, "force": 1e-4, "torque": 1e-6}


def tip(statics, at, n):
    found = statics.solve(at[n : 2 * n], at[:n], at[2 * n : 2 * n + 3], at[2 * n + 3 :])
    return found.tip_position, found.tip_quaternion


def differences(model, at):
    """(6, 2N + 6) central differences of the static tip at alpha, beta, force and torque."""
    statics, n, columns = Statics(model, 1e-10), model.n, []
    names = [name.split(".", 1)[1] for name in jacobian_names(2 * n + 6)[: 2 * n + 6]]
    for i, name in enumerate(names):
        step = next(size for kind, size in SMALL.items() if kind in name)
        (ahead, turned_ahead), (behind, turned_behind) = (
            tip(statics, at + sign * step * np.eye(len(at))[i], n) for sign in (1, -1)
        )
        turn = rotations.to_vector(rotations.multiply(turned_ahead, rotations.conjugate(turned_behind)))
        columns.append(np.r_[ahead - behind, turn] / (2 * step))
    return np.array(columns).T


ROBOTS = ["till2020_tissue", "three_tube"]


def resting(name, torque):
    """A model, its alpha, beta, force and torque in one vector, and its state at rest."""
    robot = load_robot(name)
    model = Model(robot, nodes=24)
    alpha = np.array(robot.rest.alpha.value) + 0.3 * np.arange(model.n)
    beta = np.array(robot.rest.beta.value)
    force, zero = np.array([0.01, -0.05, 0.0]), np.zeros(model.n)
    state = Simulator(model).rest(Inputs(alpha, zero, beta, zero, force, torque))
    return model, np.r_[alpha, beta, force, torque], state


@pytest.fixture(scope="module", params=ROBOTS)
def found(request):
    model, at, state = resting(request.param, np.array([0.0, 2e-4, 0.0]))
    tracker = JacobianTracker(model, 33)
    assert tracker.measure(state).shape == (6, 0)
    assert tracker.refresh(state, model.parameters.copy())
    assert not tracker.refresh(state, model.parameters.copy()), "it is new"
    return model, at, state, tracker


def test_it_is_the_derivative_of_the_equilibrium(found):
    model, at, state, tracker = found
    jacobian, expected = tracker.measure(state), differences(model, at)
    assert jacobian.shape == (6, 2 * model.n + 6)
    for rows in (slice(0, 3), slice(3, 6)):
        scale = np.abs(expected[rows]).max(axis=0)
        assert np.all(np.abs(jacobian[rows] - expected[rows]).max(axis=0) < 0.01 * scale)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_compliance_without_torque_is_symmetric(name):
    """Of a force that keeps its direction there is a potential; of a torque that does there is none."""
    model, _, state = resting(name, np.zeros(3))
    tracker = JacobianTracker(model, 33)
    tracker.refresh(state, model.parameters.copy())
    compliance = tracker.measure(state)[:, 2 * model.n :]
    size = np.sqrt(np.diag(compliance))
    scaled = compliance / np.outer(size, size)
    np.testing.assert_allclose(scaled, scaled.T, atol=2e-3)


def test_between_two_computations_it_turns_with_the_tubes(found):
    model, at, state, tracker = found
    n, angle = model.n, 0.2
    rotation = rotations.matrix(rotations.from_vector(np.array([0.0, 0.0, angle])))
    later = state.copy()
    later.inputs = replace(later.inputs, alpha=later.inputs.alpha + angle)
    jacobian = tracker.measure(later)
    with_load = np.r_[
        at[:n] + angle, at[n : 2 * n], rotation @ at[2 * n : 2 * n + 3], rotation @ at[2 * n + 3 :]
    ]
    pair = block_diag(rotation, rotation)
    twin = pair @ tracker.measure(state) @ block_diag(np.eye(2 * n), pair).T
    np.testing.assert_allclose(jacobian, twin, rtol=0, atol=1e-12)
    expected = differences(model, with_load)
    still = tracker.measure(state)
    assert np.linalg.norm(jacobian[:3, : 2 * n] - expected[:3, : 2 * n]) < 0.3 * np.linalg.norm(
        still[:3, : 2 * n] - expected[:3, : 2 * n]
    )


def test_names_are_row_by_row():
    names = jacobian_names(10)
    assert len(names) == 60
    assert names[:5] == [
        "x.tube1_rotation",
        "x.tube2_rotation",
        "x.tube1_translation",
        "x.tube2_translation",
        "x.force_x",
    ]
    assert names[-1] == "rz.torque_z"
