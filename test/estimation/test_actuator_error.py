"""What is not known of actuators between and after joint states, from their largest acceleration of late."""

import numpy as np
import pytest

from ctr_dynamics.estimation.inputs.actuator_error import ActuatorError, largest_acceleration
from ctr_dynamics.sensing.interpolation import Signal

STAMPS = [10_000_000 * k for k in range(101)]  # 1 s at 100 Hz


def signal(turned_s, acceleration=0.0):
    """A tube that turns at 1 rad/s until ``turned_s`` and at 2 rad/s from then on, beside a constant ``acceleration``; and one that rests."""
    t = 1e-9 * np.array(STAMPS)
    place = t + np.maximum(t - turned_s, 0.0) + 0.5 * acceleration * t**2
    return [np.array([value, 0.3]) for value in place]


@pytest.mark.parametrize(("ago_s", "seen"), [(0.06, True), (0.1, True), (0.25, False), (0.5, False)])
def test_only_the_last_sixth_of_a_second_counts(ago_s, seen):
    found = largest_acceleration(STAMPS, signal(1.0 - ago_s))
    assert found[1] == 0.0
    assert (found[0] > 5.0) == seen
    assert seen or found[0] < 1e-6


def test_a_constant_acceleration_is_its_own_largest():
    np.testing.assert_allclose(largest_acceleration(STAMPS, signal(2.0, 3.0)), [3.0, 0.0], atol=1e-6)


def test_two_readings_tell_no_acceleration():
    np.testing.assert_array_equal(largest_acceleration(STAMPS[:2], signal(0.0)[:2]), [0.0, 0.0])


@pytest.mark.parametrize("since_last_ms", [-30, -13, 4, 25])
def test_what_straight_lines_leave_out_of_a_parabola_is_told(since_last_ms):
    spacing_ns, joints = 50_000_000, Signal(2)
    for k in range(20):
        joints.add(k * spacing_ns, np.array([1.5 * (1e-9 * k * spacing_ns) ** 2, 0.3]))
    time_ns = joints.stamps[-1] + since_last_ms * 1_000_000
    driven, _ = joints.at(time_ns, spacing_ns)
    left_out = abs(1.5 * (1e-9 * time_ns) ** 2 - driven[0])
    np.testing.assert_allclose(ActuatorError(joints).at(time_ns), [left_out, 0.0], atol=1e-9)


def test_lines_between_dense_joint_states_leave_nothing_out():
    joints = Signal(2)
    for stamp, value in zip(STAMPS, signal(2.0, 3.0), strict=True):
        joints.add(stamp, value)
    assert not ActuatorError(joints).at(STAMPS[-1] - 4_000_000).any()
