"""The delay of a tracker, found in how measurements follow the open-loop run."""

import numpy as np
import pytest
from estimation_cases import bag_messages, play, truth_error

from ctr_dynamics.estimation.monitoring.delay_search import (
    CLOCK_BEHIND,
    DelaySearch,
    DelaySearchOptions,
)
from ctr_dynamics.estimation.monitoring.densities import allowance

NOISE, LENGTH, REGISTERED = 2.5e-4, 0.25, 1e-3


def search(
    path, delay, beside=(0.0, 0.0, 0.0), predictive=(-20.0, -2.0), seen=None, seconds=1.0, options=None
):
    """Positions at 40 Hz of a tip on ``path``, measured ``delay`` late by a tracker that sees ``seen``, or the same, beside a filter of these
    ``predictive`` densities, or those of a time (s): as if a force had changed."""
    rng, found = np.random.default_rng(3), DelaySearch(NOISE, 20.0, LENGTH, REGISTERED, options)
    times = np.arange(0.0, 0.9 + seconds + 0.1, 0.003)
    for k in range(round(40 * seconds)):
        t = 0.9 + 0.025 * k
        z = (seen or path)(np.array([t - delay]))[0] + np.array(beside) + NOISE * rng.standard_normal(3)
        known = times <= t
        told = predictive(t) if callable(predictive) else predictive
        found.add(round(t * 1e9), t, z, times[known], path(times[known]), told)
    return found


def moving(t):
    return 0.02 * np.stack([np.sin(5.0 * t), np.sin(8.0 * t + 1.0), 0.3 * np.cos(3.0 * t)], axis=1)


def vibrating(hertz):
    return lambda t: (
        0.01 * np.stack([np.sin(2 * np.pi * hertz * t), 0 * t, np.cos(2 * np.pi * hertz * t)], axis=1)
    )


WELL = (-2.0, -2.0)  # as a filter foretells whose model is right


@pytest.mark.parametrize("delay", [0.02, 0.04, 0.083, 0.25, -0.03, -0.08])
def test_a_delay_is_found_beside_a_wrong_registration(delay):
    options = DelaySearchOptions() if delay > 0.0 else CLOCK_BEHIND
    found = search(moving, delay, (0.01, 0.0, -0.02), options=options).found(0.0)
    assert found is not None
    assert found[0] == pytest.approx(delay, abs=3.0 * found[1] + 1e-4)
    assert found[1] < 0.002


def test_nothing_is_found_where_nothing_is_wrong():
    assert search(moving, 0.0).found(0.0) is None
    assert search(moving, 0.08).found(0.08) is None
    assert search(moving, 0.08, predictive=WELL).belief(0.0).late < 1e-2, "the filter has foretold it"
    still = search(lambda t: np.zeros((len(t), 3)), 0.08, predictive=WELL)
    assert still.belief(0.0).late < 0.05, "a robot at rest tells nothing"


def test_a_delay_that_changes_is_found_after_a_long_time_without():
    """Ten seconds in which the filter has foretold well do not speak against a change of the latency after them."""

    def seen(t):
        return moving(np.where(t < 10.0, t, t - 0.06))

    found = search(moving, 0.0, predictive=WELL, seen=seen, seconds=9.0)
    assert found.found(0.0) is None
    later = search(
        moving, 0.0, predictive=lambda t: WELL if t < 10.0 else (-20.0, -8.0), seen=seen, seconds=9.8
    ).found(0.0)
    assert later is not None
    assert later[0] == pytest.approx(0.06, abs=3.0 * later[1])


@pytest.mark.parametrize("hertz", [16.0, 58.0])
def test_a_strong_vibration_that_the_filter_follows_is_no_delay_at_any_time(hertz):
    """It passes every place again and again: some delay fits each pose by chance."""

    def shaken(hertz):
        return lambda t: 0.45 / hertz * vibrating(hertz)(t) / 0.01 + 0.001 * vibrating(3.7 * hertz)(t) / 0.01

    found, rng = DelaySearch(NOISE, 20.0, LENGTH, REGISTERED), np.random.default_rng(4)
    times = np.arange(0.0, 4.0, 0.003)
    tips, seen, likely = shaken(hertz)(times), shaken(0.985 * hertz), []
    for k in range(100):
        t = 0.9 + 0.025 * k
        known = times <= t
        z = seen(np.array([t]))[0] + NOISE * rng.standard_normal(3)
        found.add(round(t * 1e9), t, z, times[known], tips[known], WELL)
        likely.append(found.belief(0.0).late)
    assert max(likely) < 0.05


@pytest.mark.parametrize("seconds", [9.2, 9.3, 9.4])
def test_a_latency_that_grows_is_not_believed_to_have_jumped(seconds):
    """As positions of a frame that turns seem to."""

    def seen(t):
        return moving(t - 0.3 * np.maximum(t - 10.0, 0.0))

    told = lambda t: WELL if t < 10.0 else (-20.0, -8.0)  # noqa: E731
    assert search(moving, 0.0, predictive=told, seen=seen, seconds=seconds).found(0.0) is None


def test_a_free_vibration_whose_phase_is_wrong_is_no_delay():
    assert search(vibrating(5.6), 0.0, seen=lambda t: vibrating(5.6)(t - 0.05)).found(0.0) is None


def test_a_vibration_that_gets_out_of_phase_is_no_delay():
    slower = search(vibrating(5.6), 0.0, seen=vibrating(5.3), predictive=(-2.5, -2.5), seconds=3.0)
    assert slower.belief(0.0).late < 1e-3


def test_before_a_late_tracker_shows_the_first_motion_its_delay_is_unknown():
    def starts(t):
        return 0.02 * np.maximum(t - 1.5, 0.0)[:, None] * np.array([1.0, 2.0, 0.5])

    before = search(starts, 0.2, seconds=0.75)
    assert before.undecided(0.0)
    assert before.found(0.0) is None
    after = search(starts, 0.2, seconds=1.2)
    found = after.found(0.0)
    assert found is not None
    assert found[0] == pytest.approx(0.2, abs=0.01)
    assert not after.undecided(0.0)


def test_steps_that_are_taken_again_count_once():
    once, twice = search(moving, 0.08), search(moving, 0.08)
    times = np.arange(0.0, 2.0, 0.003)
    rng = np.random.default_rng(3)
    noise = NOISE * rng.standard_normal((40, 3))
    for k in range(35, 40):
        t = 0.9 + 0.025 * k
        z = moving(np.array([t - 0.08]))[0] + noise[k]
        known = times <= t
        twice.add(round(t * 1e9), t, z, times[known], moving(times[known]), (-20.0, -2.0))
    assert twice.belief(0.0) == pytest.approx(once.belief(0.0))


def test_another_estimate_lies_within_what_its_probability_allows():
    assert allowance(0.9) == 1.0
    assert allowance(0.0027) == pytest.approx(1.0 / 14.2, rel=0.01)  # three deviations in three dimensions
    assert allowance(1e-4) < allowance(1e-2) < allowance(0.4)


@pytest.mark.parametrize("late", [0.04, 0.12])
def test_the_estimate_follows_a_late_tracker(late):
    messages = [m.shifted(late) if m.kind == "pose" else m for m in bag_messages("clean_sweep", 3.0)]
    run = play(messages)
    assert "older than their stamps" in run.estimator.health.tracker["latency"].last
    errors, _ = truth_error(run, "clean_sweep", "p_trk", since=2.0)
    assert np.linalg.norm(errors, axis=-1).max() < 2e-3


def test_the_estimate_follows_a_tracker_whose_latency_jumps():
    messages = [
        m.shifted(0.06) if m.kind == "pose" and m.stamp > 4e9 else m for m in bag_messages("clean_sweep", 6.0)
    ]
    run = play(messages)
    assert "older than their stamps" in run.estimator.health.tracker["latency"].last
    errors, steps = truth_error(run, "clean_sweep", "p_trk", since=1.0)
    deviation = np.sqrt(run.column("tip_covariance")[steps][:, range(3), range(3)].sum(axis=1))
    honest = np.linalg.norm(errors, axis=-1) < np.maximum(3.0 * deviation, 3e-3)
    assert honest.all(), "until it is found, the covariance holds the error"
    errors, _ = truth_error(run, "clean_sweep", "p_trk", since=4.5)
    assert np.linalg.norm(errors, axis=-1).max() < 1e-3


def test_the_estimate_follows_a_tracker_whose_clock_is_behind():
    """Its poses come when they always came, with stamps of 40 ms before."""
    messages = [
        m.shifted(-0.04).late(0.04) if m.kind == "pose" else m for m in bag_messages("clean_sweep", 5.0)
    ]
    run = play(messages)
    assert "newer than their stamps" in run.estimator.health.tracker["latency"].last
    assert run.estimator.runs.fused.ekf.delay == pytest.approx(-0.04, abs=2e-3)
    errors, steps = truth_error(run, "clean_sweep", "p_trk", since=0.5)
    deviation = np.sqrt(run.column("tip_covariance")[steps][:, range(3), range(3)].sum(axis=1))
    assert (np.linalg.norm(errors, axis=-1) < np.maximum(3.0 * deviation, 3e-3)).all()
    errors, _ = truth_error(run, "clean_sweep", "p_trk", since=2.5)
    assert np.linalg.norm(errors, axis=-1).max() < 1e-3


def test_a_tracker_that_comes_back_is_not_late():
    """It jumps back by where the robot was 0.2 s ago. The filter foretells that badly, and the next poses, until it has found it."""
    back, along = 10.0, np.array([0.02, 0.015, 0.0])

    def straight(t):
        return t[:, None] * along

    def seen(t):
        return straight(t) + np.where(t < back, 0.2, 0.0)[:, None] * along

    told = lambda t: (-200.0, -14.0) if back <= t < back + 0.15 else WELL  # noqa: E731
    found = search(straight, 0.0, predictive=told, seen=seen, seconds=9.6)
    assert found.belief(0.0).late < 0.5
    assert found.found(0.0) is None


@pytest.mark.parametrize("late", [0.03, 0.06])
def test_a_latency_that_comes_and_goes_is_not_taken_for_a_force(late):
    messages = [
        m.shifted(late) if m.kind == "pose" and 3.5e9 < m.stamp < 5.0e9 else m
        for m in bag_messages("clean_sweep", 7.0)
    ]
    run = play(messages)
    errors, steps = truth_error(run, "clean_sweep", "p_trk", since=1.0)
    deviation = np.sqrt(run.column("tip_covariance")[steps][:, range(3), range(3)].sum(axis=1))
    off = np.linalg.norm(errors, axis=-1)
    assert (off < np.maximum(3.0 * deviation, 3e-3)).all()
    assert off.max() < 3e-3
    assert np.sqrt((off[-300:] ** 2).mean()) < 3e-4  # normal again
    assert run.estimator.runs.fused.ekf.delay == pytest.approx(0.0, abs=5e-3)
