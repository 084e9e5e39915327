"""Stamps that scatter: how their jitter is found, what it does to a measurement, and when it is over."""

import math

import numpy as np
import pytest
from estimation_cases import bag_messages, play, truth_error

from ctr_dynamics.estimation.filter.jitter_noise import jitter_noise
from ctr_dynamics.estimation.monitoring.end_of_jitter import ODDS, EndOfJitter
from ctr_dynamics.estimation.monitoring.stamp_jitter import StampJitter
from ctr_dynamics.kernels.jitter_update import correct_departures

NOISE, REGISTERED, HERTZ = 2.5e-4, 1e-3, 5.6
FREQUENCY = 2.0 * math.pi * HERTZ


def tip(t):
    """(k, 3) m, a tip that vibrates; its velocity and acceleration."""
    phase = FREQUENCY * np.asarray(t)
    place = 0.008 * np.stack([np.sin(phase), np.zeros_like(phase), np.cos(phase)], axis=-1)
    velocity = 0.008 * FREQUENCY * np.stack([np.cos(phase), np.zeros_like(phase), -np.sin(phase)], axis=-1)
    return place, velocity, -(FREQUENCY**2) * place


def fed(jitter, outliers=0.0, count=80, seed=2):
    """What is known of jitter after poses at 40 Hz, a part of which are ``outliers`` of 3 mm."""
    found, rng = StampJitter(NOISE, REGISTERED), np.random.default_rng(seed)
    for k in range(count):
        t = 0.025 * k
        place, velocity, acceleration = tip(t)
        seen = tip(t - jitter * rng.standard_normal())[0] + NOISE * rng.standard_normal(3)
        if rng.random() < outliers:
            direction = rng.standard_normal(3)
            seen = seen + 3e-3 * direction / np.linalg.norm(direction)
        found.add(round(t * 1e9), seen - place, velocity, acceleration)
    return found


def by_size(found):
    """Logarithm of the evidence of every size, over its drifts."""
    sizes = np.unique(found.sizes)
    return sizes, np.array([np.logaddexp.reduce(found.evidence[found.sizes == s]) for s in sizes])


@pytest.mark.parametrize("jitter", [0.002, 0.005, 0.012])
def test_jitter_is_found_with_its_size(jitter):
    sizes, evidence = by_size(fed(jitter))
    assert 0.5 * jitter <= sizes[evidence.argmax()] <= 2.0 * jitter
    assert evidence.max() - evidence[0] > 20.0


@pytest.mark.parametrize("outliers", [0.0, 0.1, 0.5])
def test_outliers_are_no_jitter(outliers):
    _, evidence = by_size(fed(0.0, outliers))
    assert np.logaddexp.reduce(evidence[1:]) - evidence[0] < 2.0


def test_measurements_that_are_taken_again_count_once():
    once, again = fed(0.005), fed(0.005)
    rng = np.random.default_rng(9)
    for k in (78, 79):
        again.add(round(25e6 * k), 1e-3 * rng.standard_normal(3), *tip(0.025 * k)[1:])
    before = fed(0.005, count=78)
    assert len(again._known) == len(once._known)
    np.testing.assert_array_equal(again._known[77].evidence, before._known[77].evidence)


def test_what_a_wrong_stamp_does_to_a_measurement():
    """Mean and covariance against draws, where the tip's way in time is a parabola."""
    velocity, acceleration = np.array([0.4, -0.1, 0.0]), np.array([3.0, 20.0, -8.0])
    tau = 0.008 * np.random.default_rng(4).standard_normal(400_000)
    drawn = -tau[:, None] * velocity + 0.5 * tau[:, None] ** 2 * acceleration
    mean, covariance = jitter_noise(0.008, velocity, acceleration)
    np.testing.assert_allclose(mean, drawn.mean(axis=0), atol=2e-5)
    np.testing.assert_allclose(covariance, np.cov(drawn.T), atol=0.01 * covariance.max())


def test_less_jitter_is_noticed_and_the_same_is_not():
    rng, velocity, deviation = np.random.default_rng(6), 0.3, 0.008

    def density(value, sigma):
        variance = NOISE**2 + (sigma * velocity) ** 2
        return -0.5 * (value**2 / variance + math.log(variance))

    for true, less in ((deviation, False), (0.0, True)):
        ends = EndOfJitter()
        for k in range(200):
            value = NOISE * rng.standard_normal() + true * velocity * rng.standard_normal()
            ends.add(25_000_000 * k, density(value, 0.5 * deviation) - density(value, deviation))
        assert ends.less == less
    assert ODDS > 200


def test_the_kernel_is_its_numpy_twin():
    rng, sizes, noise, freedom = np.random.default_rng(7), np.array([0.0, 0.004, 0.02]), NOISE**2, 3.0
    level, factor = 1e-3 * rng.standard_normal((3, 3)), 1e-3 * rng.standard_normal((3, 3, 3))
    covariance = factor @ factor.transpose(0, 2, 1)
    residual, velocity, acceleration = motion = rng.standard_normal((3, 3)) * [[1e-3], [0.3], [20.0]]
    found_level, found_covariance, density = level.copy(), covariance.copy(), np.empty(3)
    correct_departures(found_level, found_covariance, sizes, motion, noise, freedom, density)
    for s, P, m, d, new_P, new_m in zip(
        sizes, covariance, level, density, found_covariance, found_level, strict=True
    ):
        mean, more = jitter_noise(s, velocity, acceleration)
        N, change = noise * np.eye(3) + more, residual - m - mean
        square = change @ np.linalg.solve(P + N, change)
        log_det = np.linalg.slogdet((P + N) / noise)[1]
        assert d == pytest.approx(-0.5 * (log_det + (freedom + 3.0) * np.log1p(square / freedom)))
        K = P @ np.linalg.inv(P + N * (freedom + square) / (freedom + 3.0))
        np.testing.assert_allclose(new_m, m + K @ change)
        np.testing.assert_allclose(new_P, P - K @ P, atol=1e-14)


@pytest.mark.parametrize("jitter", [0.003, 0.01])
def test_the_estimate_follows_a_tracker_whose_stamps_scatter(jitter):
    """On the vibrations of a release, which the filter would take for forces."""
    rng = np.random.default_rng(5)
    messages = [
        m.shifted(float(jitter * rng.standard_normal())) if m.kind == "pose" else m
        for m in bag_messages("clean_release", 5.0)
    ]
    run = play(messages)
    assert "stamps scatter" in run.estimator.health.tracker["jitter"].last
    errors, steps = truth_error(run, "clean_release", "p_trk", since=2.5)
    errors = np.linalg.norm(errors, axis=-1)
    assert np.sqrt((errors**2).mean()) < 1e-3
    deviation = np.sqrt(run.column("tip_covariance")[steps][:, range(3), range(3)].sum(axis=1))
    assert (errors < np.maximum(3.0 * deviation, 3e-3)).all()


def test_jitter_that_ends_is_forgotten():
    rng = np.random.default_rng(5)
    messages = [
        m.shifted(float(0.008 * rng.standard_normal())) if m.kind == "pose" and m.stamp < 2.5e9 else m
        for m in bag_messages("clean_release", 5.0)
    ]
    run = play(messages)
    assert "stamps scatter" in run.estimator.health.tracker["jitter"].last
    assert run.estimator.runs.fused.ekf.expected.jitter < 0.003


def test_a_stamp_of_stated_error_counts_less_where_the_tip_moves():
    """As a pose does whose time had to be guessed, since it was handed over with others."""
    messages = bag_messages("clean_sweep", 1.2)

    def stated(made):
        add = made.add_tracker_pose
        made.add_tracker_pose = lambda *arguments: add(*arguments, stamp_error_s=0.02)

    variances = []
    for prepare in (lambda made: None, stated):
        run = play(messages, prepare=prepare)
        found = [i.variance[:3].sum() for out in run.outputs for i in out.innovations]
        variances.append(np.array(found))
        assert run.estimator.health.tracker.get("jitter") is None
    assert variances[1].max() > 4.0 * variances[0].max()
