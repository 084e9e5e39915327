"""What is added to the covariance of the twist: by the frequency of the motion, by vibrations that a load has left or that the noise of the encoders
excites, and by the tracker's frame."""

import numpy as np
import pytest

from ctr_dynamics.estimation.discretisation import VibrationErrors, discretise
from ctr_dynamics.estimation.filter.expected_tracker import ExpectedTracker
from ctr_dynamics.estimation.monitoring.twist_error import (
    EncoderVibration,
    FrameError,
    HiddenVibration,
    LoadVibration,
    MotionFrequency,
    UnseenVibration,
)
from ctr_dynamics.estimation.step_output import Modes
from ctr_dynamics.estimation.vibration_modes import lanes_of, modal_basis, tip_response
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.sensing import TrackerModel

SECOND = 1_000_000_000
MU = np.array([-0.5 + 30.0j, -2.0 + 900.0j])
TRACKER = ExpectedTracker(TrackerModel.of_robot(load_robot("till2020_tissue")))
FORCE = np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0])


def vibration_errors(phase_rate=(0.0, 0.0), tolerance=0.0, resolved=(True, True)):
    """Two modes that a force in y excites, along y and along z, and the first of two rotations likewise."""
    along = np.zeros((2, 6), complex)
    along[0, 1] = along[1, 2] = 1.0
    by_load = np.zeros((2, 6), complex)
    by_load[:, 1] = 0.01, 0.001
    by_rotation = np.array([[0.02j, 0.0], [0.001, 0.0]])
    return VibrationErrors(
        MU,
        along * MU[:, None],
        by_load,
        by_rotation,
        np.array(phase_rate),
        tolerance,
        np.array(resolved),
        np.array([0.2, 0.05]),
    )


def vibration(*of, **options):
    return LoadVibration(vibration_errors(*of, **options))


def added(found, at_s, lost=(0.0, 0.0)):
    covariance = np.zeros((12, 12))
    found.inflate(covariance, round(at_s * SECOND), np.array(lost))
    return covariance


def test_the_modes_together_give_the_static_response():
    """Twist, exponent and response to a load of all modes belong together: their displacements add up to the compliance of the tip."""
    model = Model(load_robot("till2020_tissue"), nodes=24)
    beta, alpha = np.array([-0.2521, -0.1977]), np.array([1.5708, 1.5708])
    rest = Statics(model, 1e-10).solve(beta, alpha, np.zeros(3), np.zeros(3))
    par = model.parameters.copy()
    par[model.layout["alpha"]], par[model.layout["beta"]] = alpha, beta
    basis = modal_basis(model, rest, par, beta, 8)
    response = tip_response(model, rest, par, model.sweep_buffers(rest.mesh, lanes_of(model).count))
    assert basis is not None
    assert response is not None
    m = len(basis.frequency_hz)
    by_load = (basis.by_inputs[:m] + 1j * basis.by_inputs[m:])[:, 4:]
    total = 2.0 * ((basis.twist / basis.exponent[:, None]).T @ by_load).real
    static = response[:, 4:]
    for rows in (slice(0, 3), slice(3, 6)):
        assert np.abs(total - static)[rows].max() < 0.02 * np.abs(static[rows]).max()


def test_a_mode_that_the_steps_do_not_resolve_counts_as_it_vibrates():
    found = vibration(resolved=(True, False))
    found.load_changed(0, 1, FORCE)  # at once
    covariance = added(found, 0.0)
    amplitude = 2 * 0.001 * 0.5  # m
    expected = np.zeros((12, 12))
    expected[2, 2] = amplitude**2 / 2
    expected[8, 8] = amplitude**2 / 2 * abs(MU[1]) ** 2
    expected[2, 8] = expected[8, 2] = amplitude**2 / 2 * MU[1].real
    np.testing.assert_allclose(covariance, expected, rtol=1e-4, atol=1e-12)
    later = added(found, 0.5)
    np.testing.assert_allclose(later, covariance * np.exp(2 * MU[1].real * 0.5), rtol=1e-6, atol=1e-15)


def test_a_phase_error_grows_with_time_to_that_of_an_unknown_phase():
    found = vibration(phase_rate=(0.0, 3.0))
    found.load_changed(0, 1, FORCE)
    lost = 0.0, 100.0  # not kept by the columns
    assert not added(found, 0.0).any()
    for at_s, square in ((0.1, 0.3**2), (0.3, 0.9**2), (1.0, 2.0)):
        size = np.exp(MU[1].real * at_s) * 1e-3
        assert added(found, at_s, lost)[2, 2] == pytest.approx(square * size**2 / 2, rel=1e-3)


def test_tolerances_count_as_far_as_the_columns_lose_the_mode():
    sizes = []
    for lost in (0.0, 2.0, 1e3):
        found = vibration(tolerance=1e-3)
        found.load_changed(0, 1, FORCE)
        sizes.append(added(found, 0.25, (0.0, lost))[2, 2])
    assert sizes[0] == 0.0
    assert sizes[1] == pytest.approx(0.25 * sizes[2], rel=1e-6)  # half of the error, not of its variance
    phase = abs(MU[1]) * 1e-3 * 0.25
    assert sizes[2] == pytest.approx(phase**2 * (np.exp(MU[1].real * 0.25) * 1e-3) ** 2 / 2, rel=1e-3)


def test_of_a_mode_that_the_columns_keep_old_errors_are_corrected():
    found = vibration(phase_rate=(1e-3, 0.0))
    found.load_changed(0, 1, FORCE)
    half, much = added(found, 0.5)[1, 1], added(found, 2.0)[1, 1]
    assert much == pytest.approx(half * np.exp(2 * MU[0].real * 1.5), rel=1e-6)


def test_a_slow_change_excites_less_and_none_nothing():
    sizes = []
    for duration_s in (1e-9, 0.01, 0.1):
        found = vibration(resolved=(True, False))
        found.load_changed(0, round(duration_s * SECOND), FORCE)
        sizes.append(added(found, duration_s)[2, 2])
    assert sizes[0] > 20 * sizes[1] > 100 * sizes[2] > 0.0
    found = vibration(resolved=(False, False))
    found.load_changed(1_700_000_000 * SECOND, 1_700_000_001 * SECOND, 0.0 * FORCE)
    assert not added(found, 1_700_000_002.0).any()


def test_a_change_and_its_reverse_of_one_period_cancel():
    found = vibration(resolved=(False, True))
    period_ns = round(2 * np.pi / MU[0].imag * SECOND)
    found.load_changed(0, 1, FORCE)
    once = added(found, period_ns * 1e-9)[1, 1]
    found.load_changed(period_ns, period_ns + 1, -FORCE)
    assert added(found, period_ns * 1e-9)[1, 1] < 0.02 * once


def test_what_has_decayed_is_over():
    found = vibration(resolved=(False, False))
    found.load_changed(0, 1, FORCE)
    assert added(found, 1.0).any()
    assert not added(found, 60.0).any()
    assert not added(found, 1.0).any()


def test_without_modes_nothing_is_added():
    found = LoadVibration(VibrationErrors.none())
    found.load_changed(0, 1, FORCE)
    covariance = np.zeros((12, 12))
    found.inflate(covariance, SECOND, np.zeros(0))
    assert not covariance.any()


def test_the_frequency_is_that_of_the_motion():
    omega, size = 14.0, 0.01
    motion = MotionFrequency()
    for k in range(2000):
        t = 0.003 * k
        motion.add(
            round(t * SECOND),
            np.array([0.05 + size * np.sin(omega * t), 0.0, 0.1]),
            np.array([size * omega * np.cos(omega * t), 0.0, 0.0]),
        )
    assert motion.square(0.0) == pytest.approx(omega**2, rel=0.1)
    rng = np.random.default_rng(0)
    rows, root = rng.normal(0.0, 1e-4, (6, 9)), rng.normal(size=(9, 9))
    pose = rows @ root @ root.T @ rows.T
    covariance = np.zeros((12, 12))
    motion.inflate(covariance, rows, root @ root.T)
    np.testing.assert_allclose(covariance[6:, 6:], motion.square(pose[:3, :3].trace()) * pose)
    assert not covariance[:6].any()


def test_a_robot_at_rest_has_no_frequency():
    motion = MotionFrequency()
    assert motion.square(0.0) == 0.0
    for k in range(100):
        motion.add(3_000_000 * k, np.array([0.05, 0.0, 0.1]), np.full(3, 1e-9))
    assert motion.square(1e-8) < 1e-9


def test_fast_modes_of_a_shipped_robot_are_among_the_errors():
    errors = discretise(load_robot("three_tube"), 12, 5e-5).vibration
    assert (~errors.resolved).any()
    assert errors.resolved[:4].all()
    assert np.all(errors.exponent.real <= 0.0)
    assert 0.001 < errors.tolerance < 0.05


def test_the_noise_of_encoders_makes_the_model_vibrate_as_much_as_said():
    """Against many runs of both modes, driven by straight lines between noisy readings; the slower mode decays within the runs."""
    noise, period, readings, runs = 3e-4, 0.01, 400, 4000
    modes = vibration_errors()
    turned = np.random.default_rng(0).normal(0.0, noise, (runs, readings))
    turned[:, [0, -1]] = 0.0  # what a reading turns the tubes itself is no vibration
    z = np.zeros((runs, 2), complex)
    for change in np.diff(turned, axis=1, prepend=turned[:, :1]).T:
        excited = -np.expm1(MU * period) / (MU * period) * modes.by_rotation[:, 0]
        z = z * np.exp(MU * period) + change[:, None] * excited
    twist = 2.0 * (z @ modes.twist).real
    found = EncoderVibration(modes, noise)
    for k in range(round(readings * period / 0.003)):
        found.add(round(k * 0.003 * SECOND), period)
    covariance = np.zeros((12, 12))
    found.inflate(covariance)
    assert np.diag(covariance)[7:9] == pytest.approx(twist.var(axis=0)[1:3], rel=0.1)
    assert np.diag(covariance)[1:3] == pytest.approx(twist.var(axis=0)[1:3] / np.abs(MU) ** 2, rel=0.1)


def test_encoders_without_noise_and_robots_without_modes_add_nothing():
    for modes, noise in ((vibration_errors(), 0.0), (VibrationErrors.none(), 1e-3)):
        found = EncoderVibration(modes, noise)
        for k in range(10):
            found.add(k * SECOND, 0.01)
        covariance = np.zeros((12, 12))
        found.inflate(covariance)
        assert not covariance.any()


def test_registration_and_lever_arm_turn_and_move_the_twist():
    """Against the twist about a frame that is turned, and at a point beside the tip, by many draws of both."""
    rng = np.random.default_rng(1)
    rotation, lever = np.array([1e-3, 2e-3, 3e-3]), np.array([2e-4, 5e-4, 1e-4])
    twist = np.array([0.1, -0.3, 0.2, 1.0, 2.0, -0.5])
    half = np.array([np.cos(0.4), 0.0, np.sin(0.4), 0.0])  # 0.8 rad about y
    R = np.array([[np.cos(0.8), 0.0, np.sin(0.8)], [0.0, 1.0, 0.0], [-np.sin(0.8), 0.0, np.cos(0.8)]])
    turns, moves = rng.normal(size=(20_000, 3)) * rotation, rng.normal(size=(20_000, 3)) * lever
    linear = np.cross(turns, twist[:3]) + np.cross(twist[3:], moves @ R.T)
    seen = np.hstack([linear, np.cross(turns, twist[3:])])
    covariance = np.zeros((12, 12))
    FrameError(rotation, lever).inflate(covariance, twist, half)
    expected = np.cov(seen.T)
    assert covariance[6:, 6:] == pytest.approx(expected, abs=0.03 * np.abs(expected).max())
    assert not covariance[:6].any()


def filter_of_a_sine(omega, deviation, amplitude, noise, period_s, poses, runs=400):
    """Extended Kalman filters of phase and frequency of a sine: mean squares of their errors, and their variances of the sine's value."""
    rng = np.random.default_rng(3)
    away = rng.normal(0.0, deviation, runs)
    phase, faster = np.zeros(runs), np.zeros(runs)
    P, F = np.zeros((runs, 2, 2)), np.array([[1.0, period_s], [0.0, 1.0]])
    P[:, 1, 1] = deviation**2
    squares, variances = [], []
    for k in range(1, poses):
        phase, P = phase + (omega + faster) * period_s, F @ P @ F.T
        error = amplitude * (np.sin((omega + away) * k * period_s) - np.sin(phase))
        slope = amplitude * np.cos(phase)
        variance = slope**2 * P[:, 0, 0]
        squares.append(error**2)
        variances.append(variance)
        gain = P[:, :, 0] * (slope / (variance + noise**2))[:, None]
        P = P - np.einsum("ri,rj->rij", gain, gain) * (variance + noise**2)[:, None, None]
        seen = error + rng.normal(0.0, noise, runs)
        phase, faster = phase + gain[:, 0] * seen, faster + gain[:, 1] * seen
    return np.mean(squares), np.mean(variances)


@pytest.mark.parametrize("deviation", [0.3, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("amplitude", [1e-4, 2e-4, 5e-4])
def test_a_linear_filter_errs_by_as_much_as_is_added_for_a_phase_that_it_does_not_hold(deviation, amplitude):
    """Too little to say by itself where the phase is hardly known; with what is added, neither too little nor much too much."""
    omega, noise, period = 578.0, 3.5e-4, 0.025
    square, variance = filter_of_a_sine(omega, deviation, amplitude, noise, period, 400)
    found = HiddenVibration(deviation / omega, noise)
    values = np.array([0.6 * amplitude]), np.array([0.8 * amplitude * omega])  # at some phase
    direction = np.array([[0.0, 0.6, 0.8]])
    covariance = np.zeros((12, 12))
    found.inflate(
        covariance, Modes(np.array([omega / (2 * np.pi)]), np.zeros(1), *values, direction), period, TRACKER
    )
    added = covariance[:3, :3].trace()
    assert 0.45 * (variance + added) < square < 1.3 * (variance + added)
    np.testing.assert_allclose(covariance[:3, :3], added * np.outer(direction, direction))
    np.testing.assert_allclose(covariance[6:9, 6:9], omega**2 * covariance[:3, :3])
    if deviation == 4.0 and amplitude == 2e-4:
        assert square > 2.0 * variance


def test_a_robot_that_may_move_when_the_model_starts_is_off_by_as_much_as_is_asked():
    covariance = np.zeros((12, 12))
    found = UnseenVibration(vibration_errors(), 3e-3)
    found.inflate(covariance, 0.0)
    assert covariance[:3, :3].trace() == pytest.approx(9e-6)
    # of the same energy, modes move the tip by their reach: 0.2 along y and 0.05 along z
    assert covariance[1, 1] == pytest.approx(16.0 * covariance[2, 2])
    assert covariance[7, 7] == pytest.approx(np.abs(MU[0]) ** 2 * covariance[1, 1])
    unknown = np.zeros((12, 12))
    UnseenVibration(VibrationErrors.none(), 3e-3).inflate(unknown, 1e-3)
    np.testing.assert_allclose(unknown[:3, :3], 3e-6 * np.eye(3))
    farther = np.zeros((12, 12))
    found.inflate(farther, 6e-3)
    np.testing.assert_allclose(farther, 4.0 * covariance)


def test_a_phase_that_is_certain_or_measured_exactly_adds_nothing_nor_does_a_mode_too_fast_for_the_steps():
    slow = Modes(np.array([20.0, 90.0]), np.zeros(2), np.zeros(2), np.array([1e-2, 0.0]), np.eye(3)[:2])
    fast = slow._replace(frequency_hz=np.array([200.0, 300.0]))
    for tolerance, noise, modes in ((0.0, 3e-4, slow), (0.01, 0.0, slow), (0.01, 3e-4, fast)):
        covariance = np.zeros((12, 12))
        HiddenVibration(tolerance, noise).inflate(covariance, modes, 0.025, TRACKER)
        assert np.abs(covariance).max() < 1e-30


def test_what_the_tracker_hides_stays_while_no_modes_are_known():
    found = HiddenVibration(0.01, 3.5e-4)
    modes = Modes(np.array([20.0]), np.zeros(1), np.array([1e-3]), np.zeros(1), np.array([[0.0, 1.0, 0.0]]))
    hidden = ExpectedTracker(TRACKER.model)
    hidden.responds(-0.025, 0.0)  # a mean over one period
    first, then, sound = (np.zeros((12, 12)) for _ in range(3))
    found.inflate(first, modes, 0.025, hidden)
    assert first[1, 1] == pytest.approx(1e-6)  # of an unknown phase, as much as it vibrates
    found.inflate(then, Modes.none(), 0.025, hidden)
    np.testing.assert_array_equal(then, first)
    found.inflate(sound, modes, 0.025, TRACKER)
    assert sound[1, 1] < 0.01 * first[1, 1]
