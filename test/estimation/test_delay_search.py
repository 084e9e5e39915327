"""The delay of a tracker, found in how measurements follow the open-loop run."""

import numpy as np
import pytest
from estimation_cases import bag_messages, play, truth_error

from ctr_dynamics.estimation.monitoring.delay_search import DelaySearch

NOISE = 2.5e-4


def search(path, delay, beside=(0.0, 0.0, 0.0), sound=False, seen=None):
    """One second at 40 Hz of a tip on ``path``, measured ``delay`` late by a tracker that sees ``seen``, or the same."""
    rng, found = np.random.default_rng(3), DelaySearch(NOISE)
    times = np.arange(0.0, 2.0, 0.003)
    for k in range(40):
        t = 0.9 + 0.025 * k
        z = (seen or path)(np.array([t - delay]))[0] + np.array(beside) + NOISE * rng.standard_normal(3)
        known = times <= t
        found.add(round(t * 1e9), t, z, times[known], path(times[known]))
        found.explained(sound)
    return found


def moving(t):
    return 0.02 * np.stack([np.sin(5.0 * t), np.sin(8.0 * t + 1.0), 0.3 * np.cos(3.0 * t)], axis=1)


def vibrating(hertz):
    return lambda t: (
        0.01 * np.stack([np.sin(2 * np.pi * hertz * t), 0 * t, np.cos(2 * np.pi * hertz * t)], axis=1)
    )


@pytest.mark.parametrize("delay", [0.04, 0.083, 0.25])
def test_a_delay_is_found_beside_a_wrong_registration(delay):
    assert search(moving, delay, (0.01, 0.0, -0.02)).found(0.0) == pytest.approx(delay, abs=0.003)


def test_nothing_is_found_where_nothing_is_wrong():
    assert search(moving, 0.0).found(0.0) is None
    assert search(moving, 0.08).found(0.08) is None
    assert search(moving, 0.08, sound=True).found(0.0) is None, "the filter has explained it"
    assert search(lambda t: np.zeros((len(t), 3)), 0.08).found(0.0) is None, "a robot at rest tells nothing"


def test_a_free_vibration_whose_phase_is_wrong_is_no_delay():
    assert search(vibrating(5.6), 0.0, seen=lambda t: vibrating(5.6)(t - 0.05)).found(0.0) is None


@pytest.mark.parametrize("late", [0.04, 0.12])
def test_the_estimate_follows_a_late_tracker(late):
    messages = [m.shifted(late) if m.kind == "pose" else m for m in bag_messages("clean_sweep", 3.0)]
    run = play(messages)
    assert "older than their stamps" in run.estimator.health.tracker["latency"].last
    errors, _ = truth_error(run, "clean_sweep", "p_trk", since=2.0)
    assert np.linalg.norm(errors, axis=-1).max() < 2e-3
