"""The tracker model: arrays of readings against the kernel of one reading, inverse against forward, derivative against differences, averages."""

from dataclasses import dataclass

import numpy as np
import pytest

from ctr_dynamics.kernels.rotations import (
    conjugate_rows,
    from_vector,
    matrix,
    multiply_rows,
    rotate_rows,
    to_vector_rows,
)
from ctr_dynamics.kernels.tracker_measurement import expected_measurement, pose_difference
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.sensing import Tip, TrackerModel
from ctr_dynamics.sensing.tracker import DELAY, STATE_NAMES, STATES, free_axis, pose_differences

RNG = np.random.default_rng(4)
STAMPS = np.linspace(0.1, 0.9, 17)
STILL = np.zeros(6)


@dataclass(frozen=True)
class Wedge:
    """A field that turns and lifts what it shows in proportion to y."""

    size: float

    def forward(self, stamps, position, quaternion):
        turn = np.stack([from_vector(np.array([self.size * y, 0.0, 0.0])) for y in position[:, 1]])
        lifted = position + np.outer(self.size * position[:, 1], [0.0, 0.0, 1.0])
        return lifted, multiply_rows(turn, quaternion)

    def inverse(self, stamps, position, quaternion):
        turn = np.stack([from_vector(np.array([-self.size * y, 0.0, 0.0])) for y in position[:, 1]])
        lowered = position - np.outer(self.size * position[:, 1], [0.0, 0.0, 1.0])
        return lowered, multiply_rows(turn, quaternion)

    def derivative(self, stamps, position, quaternion, columns):
        changed = columns.copy()
        changed[:, 2] += self.size * columns[:, 1]
        axis = np.stack(
            [matrix(h).T @ [1.0, 0.0, 0.0] for h in quaternion]
        )  # the tracker's x in the sensor's axes
        changed[:, 3:] += self.size * axis[:, :, None] * columns[:, None, 1]
        return changed


def model(**values):
    """A tracker that is nowhere nominal."""
    given = {
        "rotation": from_vector(np.array([0.3, -0.8, 0.2])),
        "translation": np.array([0.1, 0.4, -0.2]),
        "lever": np.array([0.004, -0.002, 0.01]),
        "delay": 0.012,
        "mask": np.ones(6, dtype=bool),
        "variance": np.full(6, 1e-6),
    }
    return TrackerModel(**{**given, **values})


KINDS = {
    "geometry": {},
    "distorted": {"scale": 1.03, "skew": 0.02, "drift": np.array([2e-3, 0.0, -1e-3])},
    "corrected": {"scale": 0.98, "corrections": (Wedge(0.2), Wedge(-0.1))},
    "averaged": {"averaging": 0.04, "skew": 0.01, "corrections": (Wedge(0.1),)},
}


def tip_at(times, change=STILL):
    """A tip that swings and turns; moved by ``change`` (6,): position, rotation vector in its own axes."""
    t = times[:, None]
    position = np.hstack([0.1 + 0.02 * np.sin(9 * t), 0.05 * np.cos(7 * t), 0.1 + 0.01 * t]) + change[:3]
    turns = np.hstack([0.4 * np.sin(8 * t), 0.3 * t, 1.0 + 0.5 * t])
    quaternion = np.stack([from_vector(r) for r in turns])
    return np.hstack([position, multiply_rows(quaternion, from_vector(change[3:]))])


def columns_at(times):
    """Derivatives of :func:`tip_at` by its ``change``, (s, 42)."""
    h = 1e-6
    ends = [np.stack([tip_at(times, sign * h * axis) for axis in np.eye(6)], axis=2) for sign in (1.0, -1.0)]
    return ((ends[0] - ends[1]) / (2 * h)).reshape(len(times), -1)


def test_arrays_of_readings_are_those_of_the_kernel():
    tracker, tip = model(), tip_at(STAMPS - 0.012)
    position, quaternion = tracker.forward(STAMPS, tip_at)
    for k in range(len(STAMPS)):
        one = expected_measurement(
            np.r_[tip[k], np.zeros(6)], tracker.rotation, tracker.translation, tracker.lever, np.zeros(STATES)
        )
        np.testing.assert_allclose(one, np.r_[position[k], quaternion[k]], atol=1e-15)


@pytest.mark.parametrize("kind", ["geometry", "distorted", "corrected"])
def test_inverse_undoes_forward(kind):
    tracker = model(**KINDS[kind])
    positions, quaternions = tracker.forward(STAMPS, tip_at)
    for stamp, position, quaternion in zip(STAMPS, positions, quaternions, strict=True):
        time, p, h = tracker.inverse(float(stamp), position, quaternion)
        tip = tip_at(np.array([time]))[0]
        np.testing.assert_allclose(p, tip[:3], atol=1e-14)
        assert abs(h @ tip[3:]) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_are_those_of_forward(kind):
    tracker, h = model(**KINDS[kind]), 1e-6
    found = tracker.derivative(STAMPS, tip_at, columns_at)
    for column, axis in enumerate(np.eye(6)):
        (p1, h1), (p0, h0) = (
            tracker.forward(STAMPS, lambda times, change=sign * h * axis: tip_at(times, change))
            for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose(found[:, :3, column], (p1 - p0) / (2 * h), atol=1e-8)
        turn = to_vector_rows(multiply_rows(conjugate_rows(h0), h1)) / (2 * h)
        np.testing.assert_allclose(found[:, 3:, column], turn, atol=1e-8)


def test_an_average_is_the_mean_over_the_window_for_arrays_and_for_the_filter():
    window = 0.04
    tracker = model(
        averaging=window, lever=np.zeros(3), rotation=np.array([1.0, 0, 0, 0]), translation=np.zeros(3)
    )
    position, _ = tracker.forward(STAMPS, tip_at)
    fine = (np.arange(4000) + 0.5) / 4000 * window
    exact = np.stack([tip_at(t - 0.012 - fine)[:, :3].mean(0) for t in STAMPS])
    np.testing.assert_allclose(position, exact, atol=1e-9)

    def one(time):
        return Tip(time, np.r_[tip_at(np.array([time]))[0], np.zeros(6)], np.ones((12, 1)))

    tip = tracker.observed_tip(one, float(STAMPS[5]) - 0.012)
    np.testing.assert_allclose(tip.position, position[5], atol=1e-15)
    np.testing.assert_allclose(tip.columns, 1.0, atol=1e-8)
    assert tracker.observed_tip(lambda time: None if time < 0.38 else one(time), 0.4) is None


def test_without_averaging_the_filter_compares_with_the_tip_itself():
    tip = Tip(0.0, np.zeros(13), np.zeros((12, 1)))
    assert model().observed_tip(lambda time: tip, 0.0) is tip


def test_states_and_their_deviations_follow_the_robot_file():
    robot = load_robot("till2020_tissue")
    tracker = TrackerModel.of_robot(robot)
    assert sum(axes for _, axes in STATE_NAMES) == STATES == len(tracker.state_sigma)
    assert tracker.state_sigma[DELAY] == robot.tracker.delay.tolerance


def test_rotations_of_arrays_are_those_of_one():
    h = RNG.normal(size=(20, 4))
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    v = RNG.normal(size=(20, 3))
    np.testing.assert_allclose(
        rotate_rows(h, v), [matrix(q) @ x for q, x in zip(h, v, strict=True)], atol=1e-14
    )


@pytest.mark.parametrize("free", [0, 1, 2, 3])
def test_rows_of_differences_are_those_of_one_pose_and_forget_the_turn_that_is_not_measured(free):
    mask = np.ones(6, dtype=bool)
    if free:
        mask[2 + free] = False
    assert free_axis(mask) == free
    expected, measured = RNG.normal(size=(2, 9, 3))
    away, turns = 0.3 * RNG.normal(size=(9, 3)), np.zeros((9, 3))
    if free:
        away[:, free - 1] = 0.0
        turns[:, free - 1] = RNG.uniform(-3.0, 3.0, 9)
    there = np.stack([from_vector(r) for r in RNG.normal(size=(9, 3))])
    swung = multiply_rows(there, np.stack([from_vector(r) for r in away]))
    seen = multiply_rows(swung, np.stack([from_vector(r) for r in turns]))
    found = pose_differences(measured, seen, expected, there, free)
    np.testing.assert_allclose(found, np.hstack([measured - expected, away]), atol=1e-12)
    for k in range(9):
        one = pose_difference(measured[k], seen[k], expected[k], there[k], free)
        np.testing.assert_allclose(found[k], one, atol=1e-12)


def test_a_sensor_half_a_turn_away_has_a_finite_difference():
    there, seen = np.array([[1.0, 0.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0, 0.0]])
    found = pose_differences(np.zeros((1, 3)), seen, np.zeros((1, 3)), there, 3)
    np.testing.assert_allclose(np.abs(found[0, 3:]), [np.pi, 0.0, 0.0], atol=1e-9)


def test_two_rotation_axes_that_are_not_measured_leave_none_free():
    assert free_axis(np.array([True, True, True, False, False, True])) == 0
