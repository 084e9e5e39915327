"""A tracker that averages or smooths: found in how measurements follow the open-loop run, and counted with from then on."""

from dataclasses import replace

import numpy as np
import pytest
from estimation_cases import BAGS, bag_messages, play, truth_error

from ctr_dynamics.estimation.filter.expected_tracker import ExpectedTracker, gain_at, response_of
from ctr_dynamics.estimation.monitoring.response_search import ResponseSearch, in_words, through, weights_of
from ctr_dynamics.estimation.monitoring.tracker_timing import Found, TrackerTiming
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.sensing import Tip, TrackerModel

NOISE, LENGTH, REGISTERED = 2.5e-4, 0.25, 1e-3
TRACKER = TrackerModel.of_robot(load_robot("till2020_tissue"))


def swinging(t):
    """A release at 1 s: 5 Hz, decaying, and a slow turn."""
    since = np.maximum(t - 1.0, 0.0)
    swing = 0.01 * np.exp(-0.8 * since) * np.where(t < 1.0, 1.0, np.cos(2 * np.pi * 5.0 * since))
    return np.stack([swing, 0.02 * np.sin(1.5 * t), 0.1 + 0.0 * t], axis=1)


def seen_through(path, response, t):
    """What a tracker of that response shows of `path` at `t` (s)."""
    window, tau = max(-2.0 * response, 0.0), max(response, 0.0)
    ages = (np.arange(4000) + 0.5) / 4000 * (window or 8.0 * tau)
    weights = np.ones(4000) if window else np.exp(-ages / tau)
    return (weights / weights.sum()) @ path(t - ages)


def timing(response=0.0, delay=0.0, predictive=(-20.0, -2.0), seconds=1.0, expected=None):
    """Positions at 40 Hz of a tracker of that response and delay, beside a filter of these `predictive` densities."""
    rng, found = np.random.default_rng(3), TrackerTiming(NOISE, 20.0, LENGTH, REGISTERED, TRACKER)
    times = np.arange(-1.0, 1.5 + seconds, 0.003)
    for k in range(round(40 * (seconds + 0.5))):
        t = 0.5 + 0.025 * k
        z = seen_through(swinging, response, t) if response else swinging(np.array([t - delay]))[0]
        known = times <= t
        tips = times[known], swinging(times[known])
        told = (-1.5, -1.5) if t < 1.0 else predictive
        z = z + np.array([1e-3, 0.0, 2e-3]) + NOISE * rng.standard_normal(3)
        found.add(round(t * 1e9), t, z, tips, told, expected or ExpectedTracker(TRACKER), 0.0)
    return found


@pytest.mark.parametrize("response", [-0.02, -0.05, 0.02, 0.06, 0.1])
def test_a_mean_and_a_low_pass_filter_are_found_beside_a_wrong_registration(response):
    found = timing(response).found(ExpectedTracker(TRACKER), 0.0)
    assert found is not None
    assert found.delay is None
    assert found.response == pytest.approx(response, abs=max(4.0 * found.deviation, 2e-3))
    assert in_words(found.response).startswith(
        "poses are means" if response < 0.0 else "poses lag as through a low-pass filter"
    )


def test_a_delay_is_not_taken_for_a_slow_response():
    found = timing(delay=0.06).found(ExpectedTracker(TRACKER), 0.0)
    assert found is not None
    assert found.response is None
    assert found.delay == pytest.approx(0.06, abs=2e-3)


def slowly(t):
    """A slow turn, as a delay and a mean of the same age show it alike."""
    return np.stack([0.02 * np.sin(2.0 * t), 0.03 * np.cos(3.1 * t), 0.1 + 0.0 * t], axis=1)


def test_a_delay_in_place_of_a_response_that_is_followed_comes_back():
    """A mean over 0.12 s is followed, and the robot begins to vibrate: poses 60 ms late show all of that."""
    rng, found = np.random.default_rng(5), TrackerTiming(NOISE, 20.0, LENGTH, REGISTERED, TRACKER)
    known, delay, times = ExpectedTracker(TRACKER), 0.06, np.arange(-1.0, 4.0, 0.003)

    def path(t):
        return slowly(t) + 2e-3 * np.sin(2 * np.pi * 7.0 * np.maximum(t - 2.0, 0.0))[:, None]

    for k in range(130):
        t = 0.5 + 0.025 * k
        seen = path(np.array([t - delay]))[0] + NOISE * rng.standard_normal(3)
        tips = times[times <= t], path(times[times <= t])
        found.add(round(t * 1e9), t, seen, tips, (-1.5, -1.5) if t < 2.0 else (-9.0, -4.0), known, 0.0)
        if k == 40:  # whatever has made it believe so
            known.responds(-0.06, 1e-3)
            found.followed(Found(None, -0.06, 1e-3))
            assert found.instead is not None
    again = found.found(known, 0.0)
    assert again is not None
    assert again.delay == pytest.approx(delay, abs=3e-3)
    assert again.response == response_of(TRACKER)
    found.followed(again)
    assert found.instead is None
    known.responds(again.response, 0.0)
    assert found.found(known, again.delay) is None


def test_delays_and_responses_are_compared_by_what_both_have_counted():
    """A response counts later, as it looks farther back. What delays have counted before speaks for neither."""
    found = timing(delay=0.06)
    assert not found.response.explains_better(found.late)
    shorter = timing(response=0.06)
    assert shorter.response.explains_better(shorter.late)
    first = shorter.late._evidence[0]
    shorter.late._evidence.appendleft(
        first._replace(stamp_ns=first.stamp_ns - 10**9, delays=first.delays + 1e3)
    )
    assert shorter.response.explains_better(shorter.late)
    assert not ResponseSearch(NOISE, 20.0, LENGTH, REGISTERED).explains_better(found.late)


def test_nothing_is_found_where_the_filter_foretells_well_or_the_response_is_known():
    well = timing(0.06, predictive=(-1.5, -1.5))
    assert well.found(ExpectedTracker(TRACKER), 0.0) is None
    assert well.other(ExpectedTracker(TRACKER), 0.0) < 0.5
    known = ExpectedTracker(TRACKER)
    known.responds(0.06, 1e-3)
    assert timing(0.06, expected=known).found(known, 0.0) is None


def test_a_response_that_is_followed_is_known_better_with_every_pose():
    known = ExpectedTracker(TRACKER)
    known.responds(0.058, 2e-3)
    short, long = (timing(0.06, seconds=s, expected=known).response.refined(0.058) for s in (0.2, 1.5))
    assert long[0] == pytest.approx(0.06, abs=1e-3)
    assert long[1] < short[1] < 2e-3
    forgotten = timing(0.06, expected=known)
    forgotten.clear()
    assert forgotten.response.refined(0.058) == (0.058, forgotten.response.options.least_s)


def test_a_release_shows_the_response_soon_and_what_it_is_0_2_s_later():
    expected = ExpectedTracker(TRACKER)
    begun, soon, settled = (timing(0.1, seconds=s) for s in (0.05, 0.2, 0.4))
    assert begun.other(expected, 0.0) < 0.5
    assert soon.found(expected, 0.0) is None
    assert soon.undecided(expected, 0.0)
    assert settled.found(expected, 0.0).response == pytest.approx(0.1, rel=0.05)


def test_while_a_late_tracker_shows_no_motion_nothing_is_followed():
    expected = ExpectedTracker(TRACKER)
    before = timing(delay=0.2, seconds=0.15)
    assert before.found(expected, 0.0) is None
    assert before.undecided(expected, 0.0)
    after = timing(delay=0.2, seconds=0.5)
    assert after.found(expected, 0.0).delay == pytest.approx(0.2, abs=5e-3)


def test_odds_are_finite_where_a_moved_tracker_explains_all():
    late = timing(delay=0.06).late
    last = late._evidence.pop()
    late._evidence.append(last._replace(moved=last.moved._replace(evidence=last.filter + 2000.0)))
    late._belief = None
    belief = late.belief(0.0)
    assert belief.late == 0.0
    assert -np.inf < belief.odds < -745.0, "its exponential is below all numbers"


def test_what_is_followed_is_no_news_any_more():
    found = timing(0.06)
    first = found.found(ExpectedTracker(TRACKER), 0.0)
    found.followed(first)
    known = ExpectedTracker(TRACKER)
    known.responds(first.response, first.deviation)
    assert found.found(known, 0.0) is None
    late = timing(delay=0.06)
    second = late.found(ExpectedTracker(TRACKER), 0.0)
    late.followed(second)
    assert late.found(ExpectedTracker(TRACKER), second.delay) is None, (
        "a delay that is followed leaves no response to be found"
    )


@pytest.mark.parametrize("response", [0.0, -0.03, 0.05])
def test_weights_are_those_of_the_response(response):
    weights, ages = weights_of(response, 150), 0.003 * np.arange(150)
    assert weights.sum() == pytest.approx(1.0)
    assert weights @ ages == pytest.approx(abs(response), rel=0.02)
    if response > 0.0:
        gain = weights @ np.exp(-2j * np.pi * 4.0 * ages)
        assert gain == pytest.approx(1.0 / (1.0 + 2j * np.pi * 4.0 * response), abs=0.01)


@pytest.mark.parametrize(("averaging", "smoothing"), [(0.0, 0.0), (0.06, 0.0), (0.0, 0.04), (0.03, 0.02)])
def test_the_mean_age_is_that_of_what_is_shown(averaging, smoothing):
    tracker = replace(TRACKER, averaging=averaging, smoothing=smoothing)
    assert sum(weight for _, weight in tracker.window) == pytest.approx(1.0)
    assert tracker.delay + sum(age * weight for age, weight in tracker.window) == pytest.approx(tracker.age)


@pytest.mark.parametrize(("averaging", "smoothing"), [(0.06, 0.0), (0.0, 0.04), (0.03, 0.02)])
@pytest.mark.parametrize("hertz", [2.0, 16.0, 40.0])
def test_the_tracker_model_shows_vibrations_as_a_mean_or_filter_does(averaging, smoothing, hertz):
    w = 2j * np.pi * hertz
    mean = -np.expm1(-w * averaging) / (w * averaging) if averaging else 1.0
    tail = np.exp(-4.0 * (1.0 + w * smoothing))  # the oldest 2 % are at their mean age
    slow = (1.0 - tail) / (1.0 + w * smoothing) + np.exp(-4.0 - 5.0 * w * smoothing) if smoothing else 1.0
    tracker = replace(TRACKER, averaging=averaging, smoothing=smoothing)
    assert gain_at(tracker, np.array([hertz]))[0] == pytest.approx(mean * slow, abs=2e-3)
    seen = tracker.observed_tip(
        lambda t: Tip(t, np.array([np.cos(w.imag * t), 0, 0, 1.0, *np.zeros(9)]), np.zeros((12, 1))), 0.7
    )
    assert seen.mean[0] == pytest.approx((mean * slow * np.exp(w * 0.7)).real, abs=2e-3)
    assert seen.mean[3] == pytest.approx(1.0)


def test_tips_through_a_response_are_those_that_the_tracker_shows():
    tracker = replace(TRACKER, averaging=0.0, smoothing=0.04)
    times = np.arange(0.0, 2.0, 0.003)
    stamps, tips = through(tracker, times, swinging(times))
    assert response_of(tracker) == 0.04
    k = len(stamps) // 2
    assert tips[k] == pytest.approx(seen_through(swinging, 0.04, stamps[k]), abs=4e-4)
    assert len(through(tracker, times[:10], swinging(times[:10]))[0]) == 0


def test_of_a_vibration_that_the_tracker_may_not_show_nothing_is_certain():
    expected = ExpectedTracker(TRACKER)
    assert expected.seen_of(np.array([5.0, 90.0])) == pytest.approx([1.0, 1.0])
    expected.responds(-0.03, 0.0)
    assert expected.seen_of(np.array([1e-6, 1.0 / 0.06])) == pytest.approx([1.0, 0.0], abs=1e-4)
    expected.responds(-0.03, 1e-3)
    unsure = expected.seen_of(np.array([12.0]))[0]
    expected.responds(-0.03, 0.0)
    assert 0.0 < unsure < expected.seen_of(np.array([12.0]))[0]


def test_a_response_that_is_refined_keeps_its_kind_and_needs_no_other_window():
    expected = ExpectedTracker(TRACKER)
    file = expected.reach_s
    expected.responds(0.006, 1e-3)
    found = expected.reach_s
    assert found > file
    for response, kept in ((0.2, 0.0105), (-0.2, 0.0015), (0.007, 0.007)):
        expected.refine(response, 0.01)
        assert expected.response == pytest.approx(kept)
        assert expected.reach_s == found
        assert expected.slower.window[-1][0] <= found
    expected.responds(0.0, 0.0)
    assert expected.slower is None
    assert expected.reach_s == file


def test_responses_that_are_shorter_than_a_step_or_slower_than_all_are_left_alone():
    assert weights_of(1e-5, 10)[0] == weights_of(-1e-5, 10)[0] == 1.0
    times = np.arange(0.0, 1.0, 0.003)
    same = through(replace(TRACKER, averaging=1e-5), times, swinging(times))
    np.testing.assert_array_equal(same[1], swinging(times))
    slow = ExpectedTracker(replace(TRACKER, averaging=0.3))
    assert timing(-0.15, expected=slow).response.belief(slow.response).late == 0.0


def test_steps_that_failed_do_not_shift_what_the_tracker_shows():
    tracker = replace(TRACKER, averaging=0.0, smoothing=0.03)
    times = np.arange(0.0, 2.0, 0.003)
    some = np.delete(times, [300, 301, 302, 500])
    stamps, tips = through(tracker, some, swinging(some))
    expected = np.array([seen_through(swinging, 0.03, t) for t in stamps[-50:]])
    np.testing.assert_allclose(tips[-50:], expected, atol=3e-4)


def smoothed(messages, time_s, name):
    """The poses as a low-pass filter of that time constant leaves them; of the positions' noise, as it is added behind the filter."""
    truth = np.load(BAGS / "truth" / f"{name}.npz")
    poses = [m for m in messages if m.kind == "pose"]
    turns = np.array([m.content[1] for m in poses])
    turns *= np.cumprod(np.sign(np.sum(turns * np.vstack([turns[:1], turns[:-1]]), axis=1)))[:, None]
    t, stamps = np.arange(0.0, truth["t"][-1], 1e-3), [1e-9 * m.stamp for m in poses]
    path = np.array([np.interp(t, truth["t"], truth["p_trk"][:, i]) for i in range(3)])
    now = np.vstack([path, [np.interp(t, stamps, turns[:, i]) for i in range(4)]]).T
    slow = now.copy()
    for i in range(1, len(t)):
        slow[i] = slow[i - 1] - np.expm1(-1e-3 / time_s) * (now[i] - slow[i - 1])

    def through_filter(m):
        i = min(round(m.stamp * 1e-6), len(t) - 1)
        position, turn = np.add(m.content[0], (slow - now)[i, :3]), slow[i, 3:]
        return replace(m, content=(tuple(position), tuple(turn / np.linalg.norm(turn)), *m.content[2:]))

    return [through_filter(m) if m.kind == "pose" else m for m in messages]


def test_the_estimate_follows_a_tracker_that_smooths():
    """The fused tip was 22 mm off where the filter knew nothing of that."""
    run = play(smoothed(bag_messages("clean_protocol", 5.0), 0.06, "clean_protocol"))
    assert "low-pass" in run.estimator.health.tracker["response"].last
    assert run.estimator.runs.fused.ekf.expected.response == pytest.approx(0.06, abs=6e-3)
    errors, steps = truth_error(run, "clean_protocol", "p_trk")
    deviation = np.sqrt(run.column("tip_covariance")[steps][:, range(3), range(3)].sum(axis=1))
    broken = np.linalg.norm(errors, axis=-1) > np.maximum(3.0 * deviation, 3e-3)
    assert broken.mean() < 0.02
    assert np.linalg.norm(truth_error(run, "clean_protocol", "p_trk", since=3.5)[0], axis=-1).max() < 2e-3


def test_a_response_that_was_found_stays_over_a_reset():
    messages = smoothed(bag_messages("clean_protocol", 3.0), 0.06, "clean_protocol")
    run = play([m for m in messages if m.stamp < 2.5e9])
    made = run.estimator
    assert made.runs.fused.ekf.expected.slower is not None
    made.reset()
    for message in messages:
        if message.stamp >= 2.5e9:
            message.give(made)
    outputs = made.finish()
    assert any(out.valid for out in outputs)
    assert made.runs.fused.ekf.expected.response == pytest.approx(0.06, abs=8e-3)
