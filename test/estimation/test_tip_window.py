"""Tip kinematics, the window of the last tips, and the tracker's sensitivities against finite differences."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracker_twin import expected, residual

from ctr_dynamics.estimation.filter.factor_reduction import through
from ctr_dynamics.estimation.filter.tip_window import TipWindow
from ctr_dynamics.kernels.rotations import conjugate, from_vector, matrix, multiply, to_vector
from ctr_dynamics.kernels.tip_kinematics import tip_from_node
from ctr_dynamics.kernels.tracker_measurement import fused_tip
from ctr_dynamics.sensing import Tip
from ctr_dynamics.sensing.tracker import (
    DELAY,
    DRIFT,
    LEVER,
    MODEL_POSITION,
    SHIFT,
    STATES,
    TrackerModel,
)

RNG = np.random.default_rng(11)
COLUMNS, STEP = 5, 1e-6


def random_unit():
    q = RNG.normal(size=4)
    return q / np.linalg.norm(q)


NO_FORCE = np.zeros((3, COLUMNS))


def random_tip():
    return Tip(
        0.0,
        np.concatenate([0.1 * RNG.normal(size=3), random_unit(), RNG.normal(size=6)]),
        RNG.normal(size=(12, COLUMNS)),
    )


def random_tracker():
    return TrackerModel(
        random_unit(),
        RNG.normal(size=3),
        0.02 * RNG.normal(size=3),
        0.004,
        np.ones(6, dtype=bool),
        np.full(6, 1e-7),
    )


def moved(tip, a, seconds=0.0):
    """The tip with its columns times `a` (r,) added, `seconds` later on its way."""
    d = tip.columns @ a
    turn = multiply(from_vector(d[3:6] + seconds * tip.rate), tip.quaternion)
    return Tip(
        0.0,
        np.concatenate(
            [tip.position + d[0:3] + seconds * tip.velocity, turn, tip.velocity + d[6:9], tip.rate + d[9:12]]
        ),
        tip.columns,
    )


def bias_of(scale):
    bias = scale * RNG.normal(size=STATES)
    bias[DELAY] = 0.0
    return bias


def test_a_tip_from_the_last_node_is_the_kinematics_and_their_derivative():
    node, change = RNG.normal(size=22), RNG.normal(size=(22, COLUMNS))

    def rows(at):
        mean, columns = np.empty(13), np.empty((12, COLUMNS))
        tip_from_node(at, change, 0.05, mean, columns)
        return mean, columns

    mean, columns = rows(node)
    R = Rotation.from_quat(node[[4, 5, 6, 3]]).as_matrix()
    assert np.allclose(mean[0:3], node[0:3])
    assert np.allclose(matrix(mean[3:7]), R)
    assert np.allclose(mean[7:10], R @ (node[7:10] + np.array([0.0, 0.0, 0.05])))
    assert np.allclose(mean[10:13], R @ node[10:13])
    for c in range(COLUMNS):
        plus, minus = rows(node + STEP * change[:, c])[0], rows(node - STEP * change[:, c])[0]
        turn = to_vector(multiply(plus[3:7], conjugate(minus[3:7]))) / (2 * STEP)
        rest = (plus - minus) / (2 * STEP)
        assert np.allclose(columns[:, c], np.concatenate([rest[:3], turn, rest[7:]]), rtol=1e-6, atol=1e-7)


def test_sensitivity_equals_finite_differences():
    tip, tracker, bias = random_tip(), random_tracker(), bias_of(0.0)
    H = tracker.innovation(bias, tip, np.eye(COLUMNS + STATES), *expected(tracker, bias, tip))[1]
    assert H.shape == (6, COLUMNS + STATES)
    for column in range(COLUMNS + STATES):
        measured = []
        for h in (STEP, -STEP):
            a, b = np.zeros(COLUMNS), bias.copy()
            if column < COLUMNS:
                a[column] = h
            else:
                b[column - COLUMNS] += h
            # an older pose is that of an earlier time
            measured.append(expected(tracker, b, moved(tip, a, seconds=-(b[DELAY] - bias[DELAY]))))
        difference = residual(*measured[0], *measured[1]) / (2 * STEP)
        assert np.allclose(H[:, column], difference, rtol=1e-6, atol=1e-7), column


@pytest.mark.parametrize("measured", ["111111", "111110", "111011", "111000", "110101", "111001"])
def test_innovation_equals_its_numpy_twin(measured):
    mask = np.array([axis == "1" for axis in measured])
    tip, tracker, bias = random_tip(), replace(random_tracker(), mask=mask), bias_of(0.02)
    position, quaternion = expected(tracker, bias_of(0.02), tip)
    root = RNG.normal(size=(COLUMNS + STATES, COLUMNS + STATES))
    nu, H, S, white = tracker.innovation(bias, tip, root @ root.T, position, quaternion)
    whole = tracker.changed(mask=np.ones(6, dtype=bool))
    everything = whole.innovation(bias, tip, root @ root.T, position, quaternion)[1]
    wanted = residual(position, quaternion, *expected(tracker, bias, tip), mask)[mask]
    np.testing.assert_allclose(nu, wanted, rtol=1e-10, atol=1e-13)
    np.testing.assert_array_equal(H, everything[mask])
    np.testing.assert_allclose(
        S, H @ root @ root.T @ H.T + np.diag(tracker.variance[mask]), rtol=1e-10, atol=1e-10
    )
    np.testing.assert_allclose(white @ white, nu @ np.linalg.solve(S, nu), rtol=1e-8)
    np.testing.assert_allclose(np.linalg.cholesky(S) @ white, nu, rtol=1e-8, atol=1e-12)


def test_residual_of_a_masked_rotation_leaves_the_arbitrary_turn_out():
    tip, tracker = random_tip(), random_tracker()
    position, quaternion = expected(tracker, np.zeros(STATES), tip)
    tilt = np.array([0.01, -0.02, 0.0])
    five = replace(tracker, mask=np.array([1, 1, 1, 1, 1, 0], dtype=bool))
    for roll in (0.0, 1.0, -2.5, np.pi):
        read = multiply(multiply(quaternion, from_vector(tilt)), from_vector(np.array([0.0, 0.0, roll])))
        nu = five.innovation(np.zeros(STATES), tip, np.eye(COLUMNS + STATES), position, read)[0]
        assert np.allclose(nu[3:5], tilt[:2], atol=1e-5)


@pytest.mark.parametrize(("state", "error"), [("all a little off", 1e-3), ("positions by much", 1e-6)])
def test_registered_pose_and_covariance_equal_finite_differences(state, error):
    tip, tracker, bias = random_tip(), random_tracker(), bias_of(1e-4)
    if state == "positions by much":  # in which the pose is linear
        bias[:] = 0.0
        bias[LEVER], bias[MODEL_POSITION] = RNG.normal(size=(2, 3))  # m

    def pose_of(a, b):
        at = moved(tip, a)
        mean = np.concatenate([at.position, at.quaternion, at.velocity, at.rate])
        pose, covariance = np.empty(7), np.empty((12, 12))
        assert fused_tip(
            mean, tip.columns, tracker.rotation, tracker.lever, b, pi, NO_FORCE, pose, covariance, np.empty(3)
        )
        return pose, covariance

    # correlated, or the sign of what a column does would not matter
    root = RNG.normal(size=(COLUMNS + STATES, COLUMNS + STATES))
    pi = root @ root.T
    _, covariance = pose_of(np.zeros(COLUMNS), bias)
    J = np.zeros((12, COLUMNS + STATES))
    for column in range(COLUMNS + STATES):
        ends = []
        for h in (STEP, -STEP):
            a, b = np.zeros(COLUMNS), bias.copy()
            if column < COLUMNS:
                a[column] = h
            else:
                b[column - COLUMNS] += h
            ends.append(pose_of(a, b)[0])
        J[0:3, column] = (ends[0] - ends[1])[:3] / (2 * STEP)
        J[3:6, column] = to_vector(multiply(ends[0][3:], conjugate(ends[1][3:]))) / (2 * STEP)
    J[6:, :COLUMNS] = tip.columns[6:]
    wanted = J @ pi @ J.T
    scale = np.sqrt(np.diag(wanted))
    assert np.allclose(covariance / np.outer(scale, scale), wanted / np.outer(scale, scale), atol=error)
    assert np.allclose(covariance, covariance.T)


def test_registered_pose_is_what_a_perfect_tracker_with_nominal_geometry_sees():
    tip, tracker, bias = random_tip(), random_tracker(), bias_of(1e-2)
    bias[DELAY], bias[DRIFT], bias[SHIFT] = 0.0, 0.0, 0.0
    position, quaternion = tracker.to_base(*expected(tracker, bias, tip))
    pose, covariance = np.empty(7), np.empty((12, 12))
    mean = np.concatenate([tip.position, tip.quaternion, tip.velocity, tip.rate])
    pi = np.eye(COLUMNS + STATES)
    fused_tip(
        mean, tip.columns, tracker.rotation, tracker.lever, bias, pi, NO_FORCE, pose, covariance, np.empty(3)
    )
    assert np.allclose(pose[:3], position, atol=1e-12)
    assert np.allclose(matrix(pose[3:]), matrix(quaternion), atol=1e-12)


def test_what_is_not_finite_is_noticed():
    tip, tracker = random_tip(), random_tracker()
    mean = np.concatenate([tip.position, tip.quaternion, tip.velocity, tip.rate])
    pose, covariance = np.empty(7), np.empty((12, 12))
    pi = np.eye(COLUMNS + STATES)
    pi[0, 0] = np.nan
    none = np.zeros(STATES)
    assert not fused_tip(
        mean, tip.columns, tracker.rotation, tracker.lever, none, pi, NO_FORCE, pose, covariance, np.empty(3)
    )


def test_the_published_tip_comes_with_the_deviation_of_the_force():
    tip, tracker, bias = random_tip(), random_tracker(), bias_of(1e-4)
    mean = np.concatenate([tip.position, tip.quaternion, tip.velocity, tip.rate])
    rng = np.random.default_rng(5)
    root = rng.normal(size=(COLUMNS + STATES, COLUMNS + STATES))
    pi, force_rows = root @ root.T, rng.normal(size=(3, COLUMNS))
    sigma = np.empty(3)
    whole = np.empty(7), np.empty((12, 12)), sigma
    given = (mean, tip.columns, tracker.rotation, tracker.lever, bias, pi)
    assert fused_tip(*given, force_rows, *whole)
    assert np.allclose(sigma**2, np.diag(force_rows @ pi[:COLUMNS, :COLUMNS] @ force_rows.T))
    assert not fused_tip(*given, force_rows * np.nan, *whole)


# -- the window --

RATE = np.array([0.3, -2.0, 1.0])
CUBIC = np.array([[0.1, 0.2, 0.3], [1.0, -2.0, 0.5], [3.0, 2.0, -4.0], [-50.0, 20.0, 10.0]])
DT = 0.003


def node_at(t):
    """Node state (22,) on a cubic path with a constant turn about a fixed axis; q and omega in the tip's frame."""
    h = from_vector(RATE * t)
    R = matrix(h)
    node = np.zeros(22)
    powers = np.array([1.0, t, t * t, t**3])
    node[0:3], node[3:7] = powers @ CUBIC, h
    node[7:10] = R.T @ (np.array([0.0, 1.0, 2 * t, 3 * t * t]) @ CUBIC)
    node[10:13] = R.T @ RATE
    return node


def filled(stamps, size=10):
    window = TipWindow(size)
    window.clear(1)
    for t in stamps:
        window.append(t, node_at(t), np.zeros((22, 1)), 0.0)
    return window


@pytest.mark.parametrize("count", [4, 25])
@pytest.mark.parametrize("back", [0.0, 0.0004, 0.0031, 0.008, -0.002])
def test_window_is_exact_on_cubic_paths_and_steady_turns(count, back):
    window = filled(DT * np.arange(count))
    time = DT * (count - 1) - back
    tip, node = window.at(time, DT), node_at(time)
    assert np.allclose(tip.position, node[0:3], atol=1e-12)
    assert np.allclose(matrix(tip.quaternion), matrix(node[3:7]), atol=1e-9)
    assert np.allclose(tip.velocity, matrix(node[3:7]) @ node[7:10], atol=1e-9)
    assert np.allclose(tip.rate, RATE, atol=1e-9)


def test_window_knows_its_ends():
    window = filled(DT * np.arange(25))
    assert window.at(DT * 25.1, DT) is None
    assert window.at(DT * 14.9, DT) is None
    assert window.at(DT * 15.0, DT) is not None
    assert TipWindow(5).at(0.0, DT) is None


def test_window_with_steps_missing():
    """Steps that failed leave no tip; times after them must not be taken from the wrong pair."""
    stamps = np.delete(DT * np.arange(12), [3, 4, 8])
    window = filled(stamps, size=20)
    for time in (0.004, 0.0115, 0.0195, 0.0255, 0.0325):
        assert np.allclose(window.at(time, DT).position, node_at(time)[0:3], atol=1e-12)


def test_columns_are_interpolated_like_the_tip():
    """The columns' interpolation is the derivative of the tip's: move all stored tips along a column and compare."""
    rng = np.random.default_rng(12)
    changes = [0.1 * rng.normal(size=(22, 2)) for _ in range(3)]

    def window(along):
        made = TipWindow(3)
        made.clear(2)
        for i, change in enumerate(changes):
            made.append(i * DT, node_at(i * DT) + change @ along, change, 0.0)
        return made

    time = 1.3 * DT
    columns = window(np.zeros(2)).at(time, DT).columns
    for c in range(2):
        along = np.zeros(2)
        along[c] = STEP
        plus, minus = window(along).at(time, DT), window(-along).at(time, DT)
        assert np.allclose(columns[0:3, c], (plus.position - minus.position) / (2 * STEP), atol=1e-6)
        assert np.allclose(
            columns[6:9, c], (plus.velocity - minus.velocity) / (2 * STEP), rtol=1e-5, atol=1e-5
        )
        turn = to_vector(multiply(plus.quaternion, conjugate(minus.quaternion))) / (2 * STEP)
        # linear between the ends, while the rotations are of small difference
        assert np.allclose(columns[3:6, c], turn, atol=2e-2 * np.abs(turn).max())


def test_shift_moves_every_kept_tip_along_its_columns():
    window = TipWindow(4)
    window.clear(3)
    for i in range(6):
        window.append(i * DT, node_at(i * DT), RNG.normal(size=(22, 3)), 0.0)
    a = 1e-4 * RNG.normal(size=3)
    before = window.checkpoint()
    old = [window.at(i * DT, DT) for i in range(2, 6)]
    window.shift(a)
    for i, was in zip(range(2, 6), old, strict=True):
        now, d = window.at(i * DT, DT), was.columns @ a
        assert np.allclose(now.position, was.position + d[0:3], atol=1e-12)
        assert np.allclose(now.velocity, was.velocity + d[6:9], atol=1e-9)
        turn = to_vector(multiply(now.quaternion, conjugate(was.quaternion)))
        assert np.allclose(turn, d[3:6], atol=1e-6 * np.abs(d[3:6]).max() + 1e-9)
    window.restore(before)
    assert np.array_equal(window.at(4 * DT, DT).position, old[2].position)


def test_window_follows_changes_of_the_columns():
    window = TipWindow(3)
    window.clear(2)
    change = RNG.normal(size=(22, 2))
    window.append(0.0, node_at(0.0), change, 0.0)
    columns = window.last.columns.copy()
    T = RNG.normal(size=(3, 2))  # the third column has been appended since: it does not move this tip
    window.change_basis(through(T), 2)
    assert np.allclose(window.last.columns, np.c_[columns, np.zeros(12)] @ T)


@pytest.mark.parametrize("count", [1, 2])
def test_steps_without_columns_of_their_own_get_those_between_their_neighbours(count):
    window = TipWindow(5)
    window.clear(2)
    for k in range(5):
        window.append(k * DT, node_at(k * DT), RNG.normal(size=(22, 2)), 0.0)
    first, last = window.columns[window.end - 2 - count].copy(), window.last.columns.copy()
    older = window.columns[: window.end - 2 - count].copy()
    window.interpolate(count)
    for i in range(1, count + 1):
        fraction = i / (count + 1)
        assert np.allclose(
            window.columns[window.end - 2 - count + i], (1 - fraction) * first + fraction * last
        )
    assert np.array_equal(window.columns[: len(older)], older)


def test_checkpoints_by_reference_are_as_good_as_copies():
    """Going back and forth past the end of the room, with columns reduced, interpolated and shifted on the way."""
    rng, step = np.random.default_rng(4), 0.003
    window = TipWindow(6)
    window.clear(COLUMNS)
    stored_states: list[tuple] = []
    k = 0

    def seen(w):
        rows = slice(w.begin, w.end)
        return w.stamps[rows].copy(), w.means[rows].copy(), w.columns[rows].copy()

    for _ in range(400):
        action = rng.choice(["step", "reduce", "shift", "back"], p=[0.7, 0.1, 0.1, 0.1])
        if action == "step":
            window.append(step * k, node_at(step * k), rng.normal(size=(22, COLUMNS)), 0.0)
            k += 1
            window.interpolate(int(rng.integers(window.OPEN)))
            stored_states.append((k, window.checkpoint(), copy.deepcopy(window)))
        elif action == "reduce" and k:
            window.change_basis(through(rng.normal(size=(COLUMNS + 3, COLUMNS))), COLUMNS)
        elif action == "shift" and k:
            window.shift(1e-3 * rng.normal(size=COLUMNS))
        elif action == "back" and len(stored_states) > 5:
            del stored_states[-int(rng.integers(1, 5)) :]
            k, stored, copied = stored_states[-1]
            window.restore(stored)
            for a, b in zip(seen(window), seen(copied), strict=True):
                np.testing.assert_array_equal(a, b)
    assert k > 100  # the room ended at least once


def test_a_reused_covariance_lies_around_the_windows_own_tips():
    there, here = filled(DT * np.arange(10)), filled(DT * np.arange(9))
    here.means[: here.end, 0] += 0.5
    node = node_at(DT * 9.0) + np.eye(22)[1]
    here.reuse_covariance(there.checkpoint(), node, 0.0)
    assert (here.end, here.last.stamp) == (10, there.last.stamp)
    np.testing.assert_array_equal(here.columns, there.columns)
    np.testing.assert_allclose(here.means[:9, 0], there.means[:9, 0] + 0.5)
    np.testing.assert_allclose(here.last.position, node[:3])
