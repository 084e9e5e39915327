"""A departure from the model, found in how well it foretells measurements."""

import numpy as np
import pytest
from estimation_cases import bag_messages, check_outputs, play, rms, truth_error
from test_model_error import SHIFT_M, departure, shifted_poses

from ctr_dynamics.estimation.filter.filter_records import ModelErrorSize
from ctr_dynamics.estimation.monitoring.model_error_search import ModelErrorSearch
from ctr_dynamics.robot_files import load_robot

NOISE, ROTATION_NOISE, LENGTH, REGISTERED = 3e-4, 3e-3, 0.2, 5e-4
NONE = ModelErrorSize(0.0, 0.0, 1.0)
AT_REST = np.zeros(3), np.zeros(3)  # velocity and acceleration of the tip: jitter of stamps does not show
WELL = -1.7  # as a filter foretells whose model is right: 3 ln(1 + 1/4) / 2 and the innovation's square


def moving(k):
    """(3,) m, a tip that goes round in a circle."""
    return 0.05 * np.array([np.cos(0.05 * k), np.sin(0.05 * k), 0.0])


def search(departures, turn=0.0, predictive=(-20.0, -4.0), seed=1, tip=moving):
    """Positions at 40 Hz that lie ``departures`` (k, 3) m from the open-loop ``tip``, beside a filter of these ``predictive`` densities."""
    rng, found = (
        np.random.default_rng(seed),
        ModelErrorSearch(NOISE, ROTATION_NOISE, LENGTH, REGISTERED, 20.0),
    )
    for k, departure_m in enumerate(departures):
        turned = np.array([turn, turn, turn]) + ROTATION_NOISE * rng.standard_normal(3)
        residual = departure_m + NOISE * rng.standard_normal(3)
        found.add(25_000_000 * k, tip(k) + residual, residual, *AT_REST, turned, predictive)
    return found


def wandering(size, time, count, seed=2):
    """A Gauss-Markov process (count, 3) of deviation ``size`` and correlation ``time`` (s), at 40 Hz."""
    rng, remains = np.random.default_rng(seed), np.exp(-0.025 / time)
    found = np.zeros((count, 3))
    found[0] = size * rng.standard_normal(3)
    for k in range(1, count):
        found[k] = remains * found[k - 1] + size * np.sqrt(1.0 - remains**2) * rng.standard_normal(3)
    return found


@pytest.mark.parametrize(("size", "time"), [(1.2e-3, 1.0), (3e-3, 3.0), (3e-3, 0.3)])
def test_a_departure_is_found_with_its_size_and_rotation(size, time):
    found = search(wandering(size, time, 400), turn=0.05).found(NONE)
    assert found is not None
    assert size / 2.6 < found.position < 2.6 * size
    assert found.rotation == pytest.approx(0.05, rel=0.05)
    # the change from one measurement to the next is what foretells: size over the root of the time
    assert found.position / np.sqrt(found.time) == pytest.approx(size / np.sqrt(time), rel=0.7)


def test_nothing_is_found_beside_a_filter_that_foretells_well():
    assert search(np.zeros((400, 3)), predictive=(WELL, WELL)).probability(NONE) < 1e-3
    assert search(wandering(2e-3, 1.0, 400), predictive=(WELL, WELL)).found(NONE) is None


@pytest.mark.parametrize("departure_m", [0.0, 1e-3])
def test_a_robot_that_is_better_than_its_tolerances_has_no_model_error(departure_m):
    """The open-loop run foretells better than a filter that counts on the tolerances, beside a constant error of the registration too."""
    beyond = search(np.full((400, 3), departure_m), predictive=(-4.0, -4.0))
    assert beyond.found(NONE) is None
    assert beyond.probability(NONE) < 0.01


@pytest.mark.parametrize("moves_at", [(160,), (160, 240), (100, 200, 300)])
def test_a_tracker_that_is_moved_is_no_departure_of_the_robot(moves_at):
    """It begins at once, stays, and may end at once; however badly a filter foretells that has no state for a turned sensor."""
    departures = np.zeros((400, 3))
    for k in moves_at:
        departures[k:] = 2e-2 * np.random.default_rng(k).standard_normal(3)
    moved = search(departures, turn=0.3)
    assert moved.found(NONE) is None
    assert moved.probability(NONE) < 0.01


def test_what_the_filter_counts_on_already_is_not_found_again():
    wanders = search(wandering(2e-3, 1.0, 400))
    found = wanders.found(NONE)
    wanders.begin_again()
    assert wanders.found(found) is None
    assert wanders.probability(found) < 0.5


def test_a_vibration_is_no_slow_departure():
    """That of a wrong stiffness: the filter that knows the motion foretells it, though not to the noise."""
    t = 0.025 * np.arange(400)
    vibration = 3e-3 * np.stack([np.sin(35.0 * t), np.cos(35.0 * t), 0.0 * t], axis=1)
    assert search(vibration, predictive=(-4.0, -4.0)).found(NONE) is None


def test_a_departure_is_believed_after_seconds_only_and_likely_before():
    """A deflection at rest may be a force, and how a vibration begins is no slow departure."""
    early, late = search(wandering(3e-3, 1.0, 80)), search(wandering(3e-3, 1.0, 160))
    assert early.probability(NONE) > 0.99
    assert early.found(NONE) is None
    assert late.found(NONE) is not None


def test_what_the_filter_foretells_while_it_learns_does_not_count():
    departures = np.full((200, 3), 2e-3)
    found = search(departures[:16], predictive=(-50.0, -30.0))
    assert found.probability(NONE) < 0.02
    rng = np.random.default_rng(4)
    for k in range(16, 200):
        residual = departures[k] + NOISE * rng.standard_normal(3)
        found.add(25_000_000 * k, moving(k) + residual, residual, *AT_REST, np.zeros(3), (WELL, WELL))
    assert found.found(NONE) is None


def test_measurements_that_are_taken_again_count_once():
    departures = wandering(2e-3, 1.0, 60)
    once, twice = search(departures), search(departures[:50])
    rng = np.random.default_rng(1)
    for k, departure_m in enumerate(departures):
        turned, noise = ROTATION_NOISE * rng.standard_normal(3), NOISE * rng.standard_normal(3)
        if k >= 30:
            residual = departure_m + noise
            twice.add(25_000_000 * k, moving(k) + residual, residual, *AT_REST, turned, (-20.0, -4.0))
    assert twice.probability(NONE) == pytest.approx(once.probability(NONE), abs=1e-9)


def test_a_robot_that_departs_from_its_file_is_followed():
    """As with a stated error, though the file states none."""
    messages = bag_messages("clean_sweep", 5.0)
    run = play(shifted_poses(messages, load_robot("till2020_tissue").tracker))
    check_outputs(run)
    error = run.estimator.health.model_error
    assert error is not None
    assert error.position > SHIFT_M / 5.0
    left, steps = truth_error(run, "clean_sweep", "p_trk", since=3.5)
    left = left - np.array([departure(t)[0] for t in run.t[steps]])
    assert rms(left) < 0.2 * SHIFT_M * np.sqrt(3.0)
    assert run.estimator.runs.fused.ekf.model_error == error


def test_a_filter_that_has_lost_the_robot_is_astray_within_a_second_whatever_was_before():
    """Ten measurements of the time in which it foretells badly tell it from one that foretells well."""
    departures = wandering(1e-3, 1.0, 440)
    found, rng = search(departures[:400], predictive=(WELL, WELL)), np.random.default_rng(5)
    assert not found.astray
    taken = 0
    while not found.astray and taken < 40:
        residual = departures[400 + taken] + NOISE * rng.standard_normal(3)
        position = moving(400 + taken) + residual
        found.add(25_000_000 * (400 + taken), position, residual, *AT_REST, np.zeros(3), (-8.0, -8.0))
        taken += 1
    assert 3 <= taken <= 12
    found.forgive()
    assert not found.astray


def test_a_filter_that_foretells_as_it_says_is_never_astray():
    """Beside a model that departs as far as tolerances have it, for ten minutes."""
    assert not search(wandering(1e-3, 1.0, 24_000), predictive=(WELL, WELL)).astray


def test_a_robot_at_rest_says_nothing_of_the_filter():
    """Wherever the open-loop run is: a constant departure foretells a robot that rests, as the position before does."""
    resting = search(np.full((4000, 3), 6e-3), predictive=(-8.0, -8.0), tip=lambda k: np.zeros(3))
    assert not resting.astray
