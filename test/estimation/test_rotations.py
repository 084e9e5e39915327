"""Small rotation helpers, input signals and joint names."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctr_dynamics.kernels.rotations import conjugate, from_vector, matrix, multiply, to_vector
from ctr_dynamics.sensing.interpolation import Signal, finite, joint_order

RNG = np.random.default_rng(7)


def scipy_of(h):
    return Rotation.from_quat(np.roll(h, -1))


@pytest.mark.parametrize("h", [*RNG.normal(size=(5, 4)), np.array([0.0, 0.0, 2.0, 0.0])])
def test_matrix_and_products(h):
    unit, other = h / np.linalg.norm(h), np.array([0.5, -0.5, 0.1, 0.7])
    assert np.allclose(matrix(h), scipy_of(h).as_matrix(), atol=1e-14)
    assert np.allclose(matrix(multiply(h, other)), matrix(h) @ matrix(other), atol=1e-14)
    assert np.allclose(matrix(conjugate(unit)), matrix(unit).T, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 0.3, 2.0, 3.1])
def test_rotation_vectors(angle):
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    h = from_vector(angle * axis)
    assert np.linalg.norm(h) == pytest.approx(1.0, abs=1e-12)
    assert np.allclose(matrix(h), Rotation.from_rotvec(angle * axis).as_matrix(), atol=1e-12)
    for sign in (1.0, -1.0, 3.0):  # q and -q are one rotation; the length does not count
        assert np.allclose(to_vector(sign * h), angle * axis, rtol=1e-9, atol=1e-15)


def test_rotation_vector_beyond_half_a_turn_is_the_shorter_way():
    assert np.allclose(to_vector(from_vector(np.array([0.0, 0.0, 4.0]))), [0.0, 0.0, 4.0 - 2 * np.pi])


# -- signals --


def ramp():
    signal = Signal(2)
    for stamp, value in ((0, 0.0), (10_000_000, 1.0), (30_000_000, 5.0)):
        assert signal.add(stamp, np.array([value, -value])) == "new"
    return signal


def test_signal_is_linear_between_stamps_and_held_before_and_after():
    signal = ramp()
    value, rate = signal.at(5_000_000)
    assert np.allclose(value, [0.5, -0.5])
    assert np.allclose(rate, [100.0, -100.0])
    assert np.allclose(signal.at(20_000_000)[0], [3.0, -3.0])
    for time, held in ((-5, 0.0), (30_000_000, 5.0), (90_000_000, 5.0)):
        value, rate = signal.at(time)
        assert np.array_equal(value, [held, -held])
        assert np.array_equal(rate, [0.0, 0.0]) or time == 30_000_000


def test_signal_extrapolates_by_its_last_rate_for_so_long_and_no_longer():
    signal = ramp()
    value, rate = signal.at(40_000_000, extrapolate_ns=20_000_000)
    assert np.allclose(value, [7.0, -7.0])
    assert np.allclose(rate, [200.0, -200.0])
    value, rate = signal.at(90_000_000, extrapolate_ns=20_000_000)
    assert np.allclose(value, [9.0, -9.0])
    assert np.array_equal(rate, [0.0, 0.0])
    single = Signal(1)
    single.add(0, np.ones(1))
    assert single.at(10, extrapolate_ns=100)[0] == 1.0


def test_signal_takes_late_and_rejects_known_stamps():
    signal = ramp()
    assert signal.add(20_000_000, np.array([0.0, 0.0])) == "late"
    assert np.allclose(signal.at(25_000_000)[0], [2.5, -2.5])
    assert signal.add(10_000_000, np.array([9.0, 9.0])) == "duplicate"
    assert np.allclose(signal.at(10_000_000)[0], [1.0, -1.0])
    assert signal.stamps == sorted(signal.stamps)


def test_signal_bends_where_its_rate_changes_by_more_than_the_least():
    signal = ramp()  # rates 0, 100, 200, and 0 when held
    least = np.array([90.0, np.inf])
    assert signal.slope_changes(-1, 40_000_000, least) == [0, 10_000_000, 30_000_000]
    assert signal.slope_changes(0, 30_000_000, least) == [10_000_000]  # strictly between
    assert signal.slope_changes(-1, 40_000_000, np.array([150.0, np.inf])) == [30_000_000]
    assert signal.slope_changes(-1, 40_000_000, np.full(2, 300.0)) == []


def test_signal_forgets_only_what_no_later_time_needs():
    shortened, whole = ramp(), ramp()
    shortened.forget(20_000_000)
    assert shortened.stamps == [10_000_000, 30_000_000]
    for time in (20_000_000, 25_000_000, 40_000_000):
        assert np.array_equal(shortened.at(time)[0], whole.at(time)[0])


def test_joint_order():
    names = ("tube2_translation", "x", "tube1_rotation", "tube2_rotation", "tube1_translation")
    assert joint_order(names, 2) == (2, 3, 4, 0)
    assert "lacks tube3_rotation, tube3_translation" in joint_order(names, 3)
    assert "tube1_rotation more than once" in joint_order((*names, "tube1_rotation"), 2)


def test_finite():
    assert finite([1, 2.0])
    assert not finite([1.0, float("inf")])
    assert not finite([float("nan")])
