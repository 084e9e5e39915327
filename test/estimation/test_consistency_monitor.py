"""The consistency monitor: silent on what a consistent filter leaves, loud on bias, excess and correlation, and the right cause in its list."""

import math

import numpy as np
import pytest

from ctr_dynamics.effects import EFFECTS
from ctr_dynamics.estimation.monitoring.consistency_monitor import (
    ConsistencyLimits,
    ConsistencyMonitor,
    ljung_box,
)
from ctr_dynamics.estimation.monitoring.likely_causes import SENSITIVITIES, CauseRegression
from ctr_dynamics.estimation.step_output import OK, WARN, Innovation, MotionPoint
from ctr_dynamics.kernels.rotations import from_vector, matrix

INTERVAL_NS = 25_000_000
NOISE = 0.35e-3
GRAVITY = np.array([0.0, -9.81, 0.0])


def innovation(i, white, point=None):
    white = np.asarray(white, dtype=float)
    measured = white[np.isfinite(white)]
    return Innovation(
        i * INTERVAL_NS,
        white,
        np.ones(6),
        float(measured @ measured),
        len(measured),
        True,
        0.0,
        white=white,
        motion=point,
    )


def fed(whites, monitor=None):
    monitor = monitor or ConsistencyMonitor()
    for i, white in enumerate(whites):
        monitor.add(innovation(i, white))
    return monitor


def white_noise(seconds, seed):
    return np.random.default_rng(seed).standard_normal((round(40 * seconds), 6))


@pytest.mark.parametrize("seed", [1, 2])
def test_white_innovations_raise_no_alarm(seed):
    monitor = fed(white_noise(300, seed))
    assert monitor.alarms == 0
    status = monitor.status()
    assert (status.name, status.level) == ("misfit", OK)
    assert 0.9 < monitor.nis < 1.1


def test_axes_that_are_not_measured_do_not_count():
    whites = white_noise(120, 3)
    whites[:, 3:] = np.nan
    monitor = fed(whites)
    assert monitor.alarms == 0
    assert math.isfinite(monitor.whiteness)


@pytest.mark.parametrize(
    ("made", "word"),
    [
        (lambda w: 1.6 * w, "CUSUM of NIS"),
        (lambda w: 1.2 * w, "mean NIS"),
        (lambda w: w + [1.5, 0, 0, 0, 0, 0], "autocorrelation"),
        (
            lambda w: np.column_stack([0.8 * np.roll(w[:, 0], 1) + 0.6 * w[:, 0], w[:, 1:]]),
            "autocorrelation",
        ),
    ],
    ids=["excess", "small excess", "bias", "autocorrelated"],
)
def test_what_is_not_white_raises_the_alarm_with_value_and_limit(made, word):
    monitor = fed(np.vstack([white_noise(30, 4), made(white_noise(20, 5))]))
    assert monitor.alarms == 1
    status = monitor.status()
    assert status.level == WARN
    assert word in status.message
    assert "limit" in status.message
    assert "no cause of the list explains it" in status.message  # there was no residual to explain


def test_the_alarm_ends_a_window_after_the_last_excess_and_counts_again():
    quiet, loud = white_noise(60, 6), 2.0 * white_noise(2, 7)
    monitor = fed(np.vstack([quiet, loud, quiet, loud]))
    assert monitor.alarms == 2
    monitor = fed(np.vstack([quiet, loud, quiet]))
    assert not monitor.alarm
    assert monitor.alarms == 1


def test_innovations_far_smaller_than_predicted_are_no_misfit():
    smooth = 0.1 * np.sin(np.arange(1200)[:, None] / 50 + np.arange(6))
    assert fed(smooth).alarms == 0


def test_a_gap_starts_again():
    monitor = fed(3.0 * white_noise(5, 8))
    assert monitor.alarm
    monitor.add(innovation(10_000, np.ones(6)))
    assert not monitor.alarm
    assert math.isnan(monitor.nis)


def test_ljung_box_is_one_for_white_noise_and_what_its_definition_says():
    whites = white_noise(10, 9)
    k, lags = len(whites), 3
    total = 0.0
    for axis in whites.T:
        size = max(sum(x * x for x in axis), k)
        for lag in range(1, lags + 1):
            rho = sum(axis[i] * axis[i - lag] for i in range(lag, k)) / size
            total += k * (k + 2) * rho**2 / (k - lag)
    assert ljung_box(whites, lags) == pytest.approx(total / (6 * lags), rel=1e-12)
    assert 0.5 < ljung_box(white_noise(100, 10)) < 1.6


def test_a_consistent_filter_alarms_less_than_once_in_ten_hours():
    # the distribution of the CUSUM in closed form of its own walk, over twenty hours
    limits = ConsistencyLimits()
    nis = np.random.default_rng(11).chisquare(6, 20 * 3600 * 40)
    walk = np.concatenate([[0.0], nis - 6 * (1 + limits.slack)]).cumsum()
    assert (walk - np.minimum.accumulate(walk)).max() < limits.cusum
    window = round(40 * limits.window)
    total = np.concatenate([[0.0], nis.cumsum()])
    for size in (limits.fewest, window):
        limit = max(limits.nis, 1 + 6 * math.sqrt(2 / (6 * size)))
        assert (total[size:] - total[:-size]).max() / (6 * size) < limit


# Causes.


def motion(t):
    """A tip that turns with two tubes, which turn to and fro at different rates and stand still in between."""
    alpha = np.array([1.2 * math.sin(0.9 * t) + 0.4 * math.sin(2.3 * t), 0.9 * math.sin(1.4 * t + 1.0)])
    rate = np.array([1.08 * math.cos(0.9 * t) + 0.92 * math.cos(2.3 * t), 1.26 * math.cos(1.4 * t + 1.0)])
    angle = alpha.sum() / 2

    def place(a, s):
        return np.array([0.06 * math.cos(a) + s, 0.05 * math.sin(a) - s, 0.2 + 0.01 * math.cos(a)])

    h, arate = 1e-4, rate.sum() / 2
    sw = [0.004 * math.sin(15 * (t + d)) for d in (-h, 0, h)]
    a, b, c = (
        place(angle + arate * d, s) for d, s in zip((-h, 0, h), sw, strict=True)
    )  # to first order in the turn
    return MotionPoint(
        np.zeros(3),
        b,
        from_vector(np.array([0.3, 0.2, angle])),
        (c - a) / (2 * h),
        (c - 2 * b + a) / h**2,
        alpha,
        rate,
        np.zeros(2),
    )


def causes_of(residual_of, seconds=12.0, seed=0, gravity=GRAVITY):
    rng = np.random.default_rng(seed)
    regression = CauseRegression(10.0, NOISE, gravity)
    for t in np.arange(0.0, seconds, 0.025):
        point = motion(t)
        residual = residual_of(t, point) + NOISE * rng.standard_normal(3)
        regression.add(float(t), point._replace(residual=residual))
    return regression.causes()


def turn(m):
    return np.array([-m.position[1], m.position[0], 0.0])


@pytest.mark.parametrize(
    ("effect", "residual"),
    [
        ("tracker_latency", lambda t, m: -0.02 * m.velocity),
        ("registration_translation", lambda t, m: np.array([0.002, -0.001, 0.002])),
        ("registration_rotation", lambda t, m: np.cross([0.01, 0.02, 0.01], m.position)),
        ("tracker_lever_arm", lambda t, m: matrix(m.quaternion) @ [0.003, 0.001, 0.002]),
        ("encoder_offset", lambda t, m: 0.05 * turn(m)),
        ("encoder_gain", lambda t, m: 0.05 * m.alpha[0] * turn(m)),
    ],
)
def test_the_cause_that_made_the_residual_is_listed_first(effect, residual):
    found = causes_of(residual)
    assert found[0].effect == effect
    assert found[0].explained > 0.8
    assert len(found) <= 3


@pytest.mark.parametrize("direction", [(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.6, -0.8)])
def test_a_payload_shows_along_gravity_wherever_that_points(direction):
    gravity = 9.81 * np.array(direction)
    found = causes_of(lambda t, m: 2e-4 * (gravity - m.acceleration), gravity=gravity)
    assert found[0].effect == "payload_mass"


def test_causes_that_this_motion_cannot_tell_apart_are_listed_together():
    found = causes_of(lambda t, m: 0.05 * np.sign(m.alpha_rate[1]) * turn(m))
    assert {cause.effect for cause in found if not cause.added} == {"backlash", "base_coulomb"}


def test_two_causes_are_both_listed():
    found = causes_of(lambda t, m: -0.02 * m.velocity + np.array([0.004, -0.002, 0.004]))
    assert {"tracker_latency", "registration_translation"} <= {cause.effect for cause in found}


def test_noise_and_a_motion_of_its_own_have_no_cause():
    assert causes_of(lambda t, m: np.zeros(3)) == []
    assert causes_of(lambda t, m: 0.003 * np.array([0, 0, math.sin(40 * t)])) == []
    assert CauseRegression(10.0, NOISE, GRAVITY).causes() == []


def test_every_sensitivity_is_an_effect_of_the_catalogue():
    names = [sensitivity.effect for sensitivity in SENSITIVITIES]
    assert set(names) <= set(EFFECTS)
    assert len(set(names)) == len(names)


# Replays.


@pytest.mark.parametrize("name", ["clean_release", "clean_protocol", "clean_sweep"])
def test_a_clean_bag_is_silent(replayed, name):
    monitor = replayed(name).estimator.health.consistency
    assert monitor.alarms == 0
    assert monitor.status().level == OK


def test_a_wrong_delay_that_no_search_finds_is_noticed_and_named(replayed):
    monitor = replayed("clean_sweep", tracker__delay_s=0.12).estimator.health.consistency
    status = monitor.status()
    assert status.level == WARN
    assert "tracker_latency" in status.message
    assert monitor.causes()[0].effect in ("tracker_latency", "actuator_latency")


def test_a_delay_that_was_set_wrongly_is_found(replayed):
    estimator = replayed("clean_sweep", tracker__delay_s=0.03).estimator
    assert estimator.runs.fused.ekf.delay == pytest.approx(-0.03, abs=0.002)


def test_an_unknown_delay_of_the_tracker_is_found_and_is_no_misfit_then(replayed):
    estimator = replayed("latency_sweep").estimator
    assert estimator.runs.fused.ekf.delay == pytest.approx(0.02, abs=0.001)
    assert "older than their stamps" in estimator.health.tracker["latency"].last
    assert estimator.health.consistency.alarms == 0
    told = replayed("latency_sweep", tracker__delay_s=0.018).estimator
    assert told.health.consistency.alarms == 0
    assert "latency" not in told.health.tracker


def test_a_heavier_payload_is_noticed_and_listed(replayed):
    monitor = replayed("payload_protocol").estimator.health.consistency
    assert monitor.alarms > 0
    assert "payload_mass" in [cause.effect for cause in monitor.causes()]
