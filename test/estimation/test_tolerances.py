"""When the estimate refutes the robot file, and updates that leave the delay alone, against dense conditional Gaussians."""

from dataclasses import replace

import numpy as np
import pytest
from estimation_cases import BAGS, Run, bag_messages, estimator, play, truth_error

from ctr_dynamics import chi_square
from ctr_dynamics.estimation.filter.tolerances import PROBABILITY, SHORT, Tolerances, gain_beside, release
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.replay import Player
from ctr_dynamics.sensing.tracker import DELAY, DRIFT, STATES


def spread(n, seed):
    root = np.random.default_rng(seed).normal(size=(n, n))
    return root @ root.T


def test_released_state_leaves_the_others_as_if_it_had_been_known():
    pi = spread(5, 1)
    rest = [0, 1, 3, 4]
    given = pi[np.ix_(rest, rest)] - np.outer(pi[rest, 2], pi[2, rest]) / pi[2, 2]
    expected = pi[:, 2] / pi[2, 2]
    gain = release(2, 0.3, pi)
    assert gain == pytest.approx(expected)
    assert pi[np.ix_(rest, rest)] == pytest.approx(given)
    assert pi[2] == pytest.approx([0.0, 0.0, 0.09, 0.0, 0.0])


def test_covariance_beside_a_state_is_that_of_the_errors():
    """Errors drawn from the covariance, corrected by the gain, have the covariance that is returned; the state has not moved."""
    pi, R = spread(4, 2), np.diag([0.5, 0.2])
    rng = np.random.default_rng(3)
    H = rng.normal(size=(2, 4))
    gain, after = gain_beside(1, pi, H, R)
    errors = rng.multivariate_normal(np.zeros(4), pi, 200_000)
    noise = rng.multivariate_normal(np.zeros(2), R, 200_000)
    left = errors - (errors @ H.T + noise) @ gain.T
    assert left.T @ left / len(left) == pytest.approx(after, abs=0.03 * np.abs(after).max())
    assert np.array_equal(left[:, 1], errors[:, 1])


def test_gain_beside_a_state_is_that_of_a_filter_that_knows_it():
    pi, R, H = spread(4, 4), np.eye(1), np.array([[1.0, 5.0, -1.0, 0.5]])
    rest = [0, 2, 3]
    P, h = pi[np.ix_(rest, rest)], H[:, rest]
    gain, _ = gain_beside(1, pi, H, R)
    assert gain[rest] == pytest.approx(P @ h.T / (h @ P @ h.T + R))


def test_the_file_is_refuted_beyond_chance_until_the_estimate_is_back():
    states = np.zeros(STATES)
    states[DELAY], states[DRIFT] = 1e-3, 1.0
    file = Tolerances(("stiffness", "force"), np.array([0.01, 0.0]), states)
    # of stiffness and delay; a drift is no error of the file, nor is a force
    limit = np.sqrt(max(chi_square.quantile(PROBABILITY, 2), 2 * SHORT**2))

    def refuted(times, before=False):
        found = np.zeros(STATES)
        found[DRIFT] = 1e3
        return file.refuted(np.array([0.01 * times, 1e3]), found, before)

    assert not refuted(0.99 * limit)
    assert refuted(1.01 * limit)
    assert refuted(2.0, before=True)
    assert not refuted(1.0, before=True)
    found = np.zeros(STATES)
    found[DELAY] = -7e-3
    assert file.farthest(np.array([0.02, 0.0]), found) == ("delay", pytest.approx(7.0))
    assert not Tolerances((), np.zeros(0), np.zeros(STATES)).refuted(np.zeros(0), np.zeros(STATES))


def test_a_robot_file_with_far_too_small_tolerances_does_not_make_the_filter_certain_of_a_delay():
    """Precurvatures 8 % off at a tolerance of 0.3 %: the file is refuted and named, and the delay stays as it is expected."""
    file = load_robot("till2020_tissue")
    tubes = []
    for tube in file.tubes:
        segments = [
            s.model_copy(
                update={
                    "curvature": s.curvature.model_copy(
                        update={"value": tuple(1.08 * c for c in s.curvature.value)}
                    )
                }
            )
            for s in tube.precurvature
        ]
        tubes.append(tube.model_copy(update={"precurvature": tuple(segments)}))
    made = estimator(robot=file.model_copy(update={"tubes": tuple(tubes)}))
    run = Run([], made)
    for out in Player(made).play(open_bag(BAGS / "clean_protocol.mcap")):
        run.outputs.append(out)
        if out.k > 900:
            break
    ekf = made.runs.fused.ekf
    assert ekf.refuted
    assert "precurvature" in made.health.refutation
    assert ekf.delay == pytest.approx(0.0, abs=1e-5)  # a shift that ends moves all else by a little
    at = len(ekf.pi) - STATES + DELAY
    assert ekf.pi[at, at] == pytest.approx(file.tracker.delay.tolerance**2, rel=0.01)
    assert run.last.valid


def test_a_tracker_clock_that_runs_fast_leaves_the_valid_tip_where_it_says_or_the_covariance_large():
    """Stamps run ahead by 3 ms in a second: either the delay that grows is found, or the bent parameters refute the file."""
    messages = [
        replace(m, stamp=round(m.stamp * 1.003)) if m.kind == "pose" else m
        for m in bag_messages("clean_sweep", 6.0)
    ]
    run = play(messages)
    error, steps = truth_error(run, "clean_sweep", "p_trk")
    distance = np.linalg.norm(error, axis=1)
    deviation = np.sqrt(np.trace(run.column("tip_covariance")[steps, :3, :3], axis1=1, axis2=2))
    assert run.estimator.health.refutation or "latency" in run.estimator.health.tracker
    assert np.all((distance < 3e-3) | (distance < 3.0 * deviation))
