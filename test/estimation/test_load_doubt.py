"""A known load that jumps: confirmed by the tracker, or left out where the robot does not bear it."""

import numpy as np
import pytest
from estimation_cases import Message, bag_messages, check_outputs, play, truth_error

from ctr_dynamics.estimation.load_doubt import HeldLoad, LoadDoubtOptions

NO_TORQUE = (0.0, 0.0, 0.0)
BEGIN_S, END_S = 1.5, 2.0


def load(t, force_N):
    """A force along y of `t` s."""
    return Message("load", round(1e9 * t), round(1e9 * t), ((0.0, force_N, 0.0), NO_TORQUE, ""))


def wrong_load(size_N):
    """A force that the robot does not bear, from a sensor that is right before and after."""
    steps = ((BEGIN_S, 0.0), (BEGIN_S + 0.01, -size_N), (END_S, -size_N), (END_S + 0.01, 0.0))
    return [load(t, force) for t, force in steps]


@pytest.fixture(scope="module")
def sweep():
    return bag_messages("clean_sweep", 3.0)


@pytest.mark.parametrize("policy", ["wait", "predict"])
@pytest.mark.parametrize("size_N", [0.1, 1.0, 5.0])
def test_a_load_that_the_robot_does_not_bear_is_left_out(sweep, size_N, policy):
    run = play([*sweep, *wrong_load(size_N)], {"output.policy": policy})
    check_outputs(run)
    error, steps = truth_error(run, "clean_sweep", "p_trk")
    deviation = np.sqrt(np.trace(run.column("tip_covariance")[steps, :3, :3], axis1=1, axis2=2))
    valid, distance = run.column("valid")[steps], np.linalg.norm(error, axis=1)
    assert not np.any(valid & (distance > 3e-3) & (distance > 3.0 * deviation))
    after = run.t[steps] > BEGIN_S + 0.35
    assert valid[after].all()
    assert distance[after].max() < 1e-3
    assert f"from 0 to {size_N:g} N, as the tracker shows" in run.estimator.health.load["contradicted"].last
    assert not run.estimator.inputs.load.values[-1].any()


@pytest.mark.parametrize("policy", ["wait", "predict"])
def test_of_two_publishers_in_turn_the_one_that_the_robot_follows_counts(sweep, policy):
    """One sends the load that is there, none, and the other one that is not."""
    turns = [load(BEGIN_S + 0.05 * i, -0.1 * (i % 2)) for i in range(20)]
    run = play([*sweep, *turns], {"output.policy": policy})
    error, steps = truth_error(run, "clean_sweep", "p_trk")
    after = run.t[steps] > BEGIN_S + 0.5
    assert run.column("valid")[steps][after].all()
    assert np.linalg.norm(error, axis=1)[after].max() < 1e-3
    assert run.estimator.health.load["contradicted"].count > 5
    assert not run.estimator.inputs.load.values[-1].any()
    assert run.estimator.runs.fused.ekf.expected.delay == 0.0


def test_a_load_counts_again_once_it_has_returned(sweep):
    run = play([*sweep, *wrong_load(1.0)])
    change = run.estimator.inputs.add_load(run.outputs[-1].stamp_ns, (0.0, -0.02, 0.0), NO_TORQUE, "")
    assert change.difference[1] == pytest.approx(-0.02)


@pytest.mark.parametrize("late_s", [0.0, 0.08])
@pytest.mark.parametrize("policy", ["wait", "predict"])
def test_a_load_that_the_robot_bears_is_confirmed(policy, late_s):
    """Also by a tracker that is late by an unknown time, and shows the robot at rest for so long."""
    messages = [m.shifted(late_s) if m.kind == "pose" else m for m in bag_messages("clean_release", 2.0)]
    run = play(messages, {"output.policy": policy})
    assert "contradicted" not in run.estimator.health.load
    assert run.estimator.runs.load_doubt.begin_ns is None
    error, steps = truth_error(run, "clean_release", "p_trk")
    deviation = np.sqrt(np.trace(run.column("tip_covariance")[steps, :3, :3], axis1=1, axis2=2))
    valid, distance = run.column("valid")[steps], np.linalg.norm(error, axis=1)
    assert not np.any(valid & (distance > 3e-3) & (distance > 3.0 * deviation))
    if late_s:
        assert "older than their stamps" in run.estimator.health.tracker["latency"].last
    else:
        assert run.column("valid").all()


def test_without_a_tracker_a_load_is_taken_as_it_is_said(sweep):
    run = play([m for m in sweep if m.kind != "pose"] + wrong_load(0.3)[:2])
    doubt = run.estimator.runs.load_doubt
    assert BEGIN_S + LoadDoubtOptions().expires_s < run.t[-1]
    assert doubt.begin_ns is None
    assert run.estimator.inputs.load.values[-1][1] == -0.3
    assert run.column("valid").all()


def test_the_load_of_the_run_without_it_stays_as_it_was(sweep):
    run = play([*sweep[:100], *wrong_load(0.3)])
    runs = run.estimator.runs
    file_load = np.arange(float(runs.open_loop.inputs_at.load.size))
    held = HeldLoad(runs.open_loop.inputs_at.interpolated, file_load)
    held.held = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    rows, inputs = held.stages(np.array([0.1, 0.102]))
    assert np.array_equal(rows[:, 6:12], np.tile(file_load[6:12] + held.held, (2, 1)))
    assert np.array_equal(inputs.force, rows[-1, 6:9])
    assert np.array_equal(inputs.torque, rows[-1, 9:12])


def test_only_measurements_that_speak_against_the_load_stop_conclusions(sweep, monkeypatch):
    """A release shows best how late a tracker is, while its load is still in doubt."""
    runs = play(sweep[:100]).estimator.runs
    monkeypatch.setattr(runs.fused.alternatives, "conclude", lambda *arguments: True)
    doubt = runs.load_doubt
    doubt.begin_ns = 0
    assert runs.conclude(True)
    doubt._taken = dict.fromkeys(range(3), (-5.0, 1.0))
    assert not runs.conclude(True)
