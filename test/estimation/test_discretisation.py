"""Nodes and expected errors from the vibration modes, against errors that are measured."""

import math

import numpy as np
import pytest

from ctr_dynamics.estimation.discretisation import (
    MOST,
    RESOLVED_HZ,
    amplification,
    discretise,
    resolved,
)
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Simulator
from ctr_dynamics.model.state import Inputs
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import collocation, radau_nodes
from ctr_dynamics.robot_files import load_robot


def released(robot, nodes, dt, seconds):
    """Tips (k, 3) m every 6 ms after a force is cut within 12 ms that deflects the tip by a third of the exposed length, and how far it was
    deflected."""
    model = Model(robot, nodes=nodes)
    alpha, beta = np.array(robot.rest.alpha.value), np.array(robot.rest.beta.value)
    zero = np.zeros_like(alpha)
    reach = float(robot.lengths[0] + beta[0])
    free = Statics(model).solve(beta, alpha)
    small = np.array([1e-3, 0.0, 0.0])
    give = np.linalg.norm(Statics(model).solve(beta, alpha, small).tip_position - free.tip_position) / 1e-3
    force = np.array([reach / 3.0 / give, 0.0, 0.0])
    simulator = Simulator(model, collocation(dt), 1e-6)
    state = simulator.rest(Inputs(alpha, zero, beta, zero, force))
    deflected = np.linalg.norm(state.nodes[-1, :3] - free.tip_position)

    def cut(t):
        return Inputs(alpha, zero, beta, zero, force * max(0.0, 1.0 - t / 0.012))

    tips = []
    for k in range(round(seconds / dt)):
        assert simulator.step(state, k * dt, cut).ok
        if (k + 1) % round(0.006 / dt) == 0:
            tips.append(state.nodes[-1, :3].copy())
    return np.array(tips), deflected


def test_amplification_is_the_stability_function_of_radau():
    A, _ = radau_nodes(4)
    for z in (0.3j, -2.0 + 1.0j, 8.0j):
        one = np.ones(4)
        expected = 1.0 + z * A[-1] @ np.linalg.solve(np.eye(4) - z * A, one)
        assert amplification(collocation(0.003), np.array([z]))[0] == pytest.approx(expected, rel=1e-10)


def test_the_highest_resolved_frequency_is_the_one_that_is_said():
    found = resolved(collocation(0.003), np.array([1.0, RESOLVED_HZ - 1.5, RESOLVED_HZ + 1.5, 160.0]))
    assert found.tolist() == [True, True, False, False]
    assert resolved(collocation(0.0015), np.array([2.0 * RESOLVED_HZ - 3.0]))[0]


def test_expected_error_of_the_mesh_is_that_of_a_release():
    """Within a factor: what is expected is of the worst direction."""
    robot = load_robot("three_tube")
    found = discretise(robot, 12, 1.0)
    assert found.nodes < 30
    coarse, deflected = released(robot, found.nodes, 0.003, 0.6)
    fine, _ = released(robot, 60, 0.003, 0.6)
    # what grows with the time is smaller after a shorter one
    expected = (
        found.space_error_m * (0.6 / 4.0) * deflected / (robot.lengths[0] + robot.rest.beta.value[0]) * 3
    )
    error = math.sqrt(((coarse - fine) ** 2).sum(axis=1).mean())
    assert 0.1 * expected < error < 2.0 * expected


def test_more_accuracy_wants_more_nodes_by_the_fourth_power():
    robot = load_robot("three_tube")
    loose, tight = discretise(robot, 8, 1e-3), discretise(robot, 8, 1e-3 / 16)
    assert tight.nodes == pytest.approx(2 * loose.nodes, abs=2)
    assert loose.space_error_m <= 1e-3
    assert discretise(robot, 8, 1e-9).nodes == MOST
    assert discretise(robot, 50, 1.0).nodes == 50


def test_fast_modes_are_declared_unresolved():
    numerics = discretise(load_robot("three_tube"), 12, 5e-5).numerics()
    assert min(numerics["unresolved_modes_hz"]) > RESOLVED_HZ
    assert numerics["time_error_m"] < 5e-5
    said = discretise(load_robot("three_tube"), 12, 5e-5).shortfall(5e-5)
    assert said.startswith("modes above 103 Hz are too fast for the steps")
    assert discretise(load_robot("till2020_tissue"), 12, 5e-5).shortfall(5e-5) == ""
    slow = [mode["frequency_hz"] for mode in numerics["modes"] if mode["resolved"]]
    assert slow[0] == pytest.approx(16.0, abs=0.3)
