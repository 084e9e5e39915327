"""The tracker's delay after a start in motion, beside a vibration that the open-loop run lacks."""

import numpy as np
import pytest
from estimation_cases import Run, bag_messages, estimator, rms, truth_error

from ctr_dynamics.estimation.discretisation import VibrationErrors
from ctr_dynamics.estimation.monitoring.delay_search import DelaySearch
from ctr_dynamics.estimation.monitoring.moving_start import MovingStart

NOISE, LENGTH, REGISTERED, HERTZ = 2.5e-4, 0.25, 1e-3, 5.6
MODES = VibrationErrors.none()._replace(
    exponent=np.array([-1.0 + 2j * np.pi * HERTZ, -1.2 + 2.1j * np.pi * HERTZ, -4.0 + 2j * np.pi * 31.0])
)


def turning(t):
    return 0.02 * np.stack([np.sin(4.0 * t), np.sin(5.0 * t + 1.0), 0.3 * np.cos(3.0 * t)], axis=1)


def measured(search, delay, amplitude, seconds=1.5, hertz=HERTZ * 1.02, told=-6.0, path=turning):
    """Positions at 40 Hz, ``delay`` late, of a tip that vibrates by ``amplitude`` about the open-loop run."""
    rng, times = np.random.default_rng(5), np.arange(0.0, 0.5 + seconds + 0.1, 0.003)
    for k in range(round(40 * seconds)):
        t = 0.5 + 0.025 * k
        shown = np.array([t - delay])
        vibration = amplitude * np.exp(-shown) * np.cos(2 * np.pi * hertz * shown + 0.7) * [0.8, 0.6, 0.0]
        z = path(shown)[0] + vibration + [1e-3, 0.0, -2e-3] + NOISE * rng.standard_normal(3)
        known = times <= t
        search.add(round(t * 1e9), t, z, times[known], path(times[known]), (told, told))
    return search


def moving_start():
    return MovingStart(NOISE, 20.0, LENGTH, REGISTERED, MODES)


@pytest.mark.parametrize("amplitude", [0.0, 1e-3, 4e-3, 12e-3])
@pytest.mark.parametrize("delay", [0.03, 0.08, 0.2])
def test_a_delay_is_found_beside_a_vibration_of_any_size(delay, amplitude):
    found = measured(moving_start(), delay, amplitude).always(0.0)
    assert found is not None
    assert found[0] == pytest.approx(delay, abs=4.0 * found[1] + 1e-4)
    assert found[1] < 0.003


def test_without_looking_for_the_vibration_a_wrong_delay_would_be_certain():
    belief = measured(DelaySearch(NOISE, 20.0, LENGTH, REGISTERED), 0.08, 4e-3, seconds=0.5).belief(0.0)
    assert abs(belief.delay - 0.08) > 5.0 * belief.spread


@pytest.mark.parametrize("amplitude", [0.0, 4e-3])
def test_a_tracker_on_time_is_not_late(amplitude):
    search = measured(moving_start(), 0.0, amplitude, told=-2.0)
    assert search.always(0.0) is None
    assert search.belief(0.0).late < 0.01
    assert search.shows(0.0)
    assert not search.shows(0.08)


def test_a_vibration_alone_tells_nothing_of_a_delay():
    """What the delay moves, any phase explains."""
    search = measured(moving_start(), 0.08, 4e-3, told=-2.0, path=lambda t: np.zeros((len(t), 3)))
    assert search.belief(0.0).late < 0.05
    assert not search.shows(0.0)
    assert not moving_start().shows(0.0)


def test_the_vibration_is_over_when_it_is_less_than_is_measured():
    large, none = measured(moving_start(), 0.0, 12e-3), measured(moving_start(), 0.0, 0.0)
    left = 12e-3 * np.exp(-2.0) / np.sqrt(2.0)
    assert 0.5 * left < large.vibrates_m < 2.0 * left
    assert none.vibrates_m == 0.0
    assert moving_start().vibrates_m == np.inf, "it is not known yet"


def test_measurements_that_are_taken_again_count_once():
    search = measured(moving_start(), 0.05, 2e-3)
    before = search.belief(0.0)
    last = search._evidence[-1]
    again = search._evidence[-2].stamp_ns
    times = np.arange(0.0, 2.1, 0.003)
    for stamp in (again, last.stamp_ns):
        t = stamp * 1e-9
        search.add(
            stamp,
            t,
            turning(np.array([t - 0.05]))[0],
            times[times <= t],
            turning(times[times <= t]),
            (-6.0, -6.0),
        )
    assert len({e.stamp_ns for e in search._evidence}) == len(search._evidence)
    assert search.belief(0.0).delay == pytest.approx(before.delay, abs=2e-3)


@pytest.mark.parametrize("late_s", [0.0, 0.04, 0.08])
def test_a_start_in_motion_beside_a_late_tracker_is_got_over(late_s):
    made, out, begin = estimator({"output.policy": "wait"}), [], 4_150_000_000
    for message in sorted(bag_messages("clean_sweep", 7.5), key=lambda m: m.arrival):
        if message.stamp < begin:
            continue
        (message.shifted(late_s) if message.kind == "pose" else message).give(made)
        out += made.advance()
        made.do_idle_work()
    found = made.runs.fused.ekf.delay
    assert found == pytest.approx(late_s, abs=4e-3)
    valid = [step for step in out if step.valid]
    assert len(valid) > 0.6 * len(out)
    error, _ = truth_error(Run(valid[-300:], made), "clean_sweep", "p_trk", since=0.0)
    assert rms(error) < 0.6e-3
