"""Noise of encoders, taken off recorded joints: what vibrates goes, what moves stays."""

import numpy as np
import pytest

from ctr_dynamics.sensing.encoder_noise import noise_of, without_noise

SIGMA = 2e-4  # rad
PERIOD_S = 0.01


def motion(t):
    """Two tubes (s, 2): one swings, one stands, turns at once and stands again."""
    return np.column_stack([0.5 * np.sin(2.0 * np.pi * 0.4 * t), np.clip(t - 4.0, 0.0, 3.0) * 0.5])


def spectrum(t, x, low, high):
    """rms (n,) of what x (s, n) has between two frequencies (Hz)."""
    f = np.fft.rfftfreq(len(t), np.median(np.diff(t)))
    power = np.abs(np.fft.rfft(x * np.hanning(len(t))[:, None], axis=0)) ** 2
    return np.sqrt(power[(f > low) & (f < high)].mean(axis=0))


@pytest.fixture
def noise():
    return np.random.default_rng(0).normal(0.0, SIGMA, (1500, 2))


def test_noise_goes_where_robots_vibrate_and_the_motion_stays(noise):
    t = PERIOD_S * np.arange(1500)
    left = without_noise(t, motion(t) + noise, SIGMA) - motion(t)
    assert np.all(spectrum(t, left, 10.0, 50.0) < 0.4 * spectrum(t, noise, 10.0, 50.0))
    assert np.all(left.std(axis=0) < 0.7 * SIGMA)
    # also at the beginning and the end of the turn, and of the recording
    assert np.abs(left).max() < 6.0 * SIGMA


def test_stamps_need_not_be_even(noise):
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.5, 1.5, 1500) * PERIOD_S)
    left = without_noise(t, motion(t) + noise, SIGMA) - motion(t)
    assert np.all(left.std(axis=0) < 0.7 * SIGMA)


def test_a_step_stays_as_sharp_as_it_is(noise):
    t = PERIOD_S * np.arange(1500)
    step = np.where(t > 7.0, 0.1, 0.0)[:, None] * np.ones(2)
    assert np.abs(without_noise(t, step + noise, SIGMA) - step).max() < 6.0 * SIGMA


@pytest.mark.parametrize("stated", [0.0, SIGMA])
def test_readings_without_noise_are_left_as_they_are(stated):
    """Whatever the file says: of encoders that are better than stated, and of commands that are held."""
    t = PERIOD_S * np.arange(1500)
    exact, held = motion(t), motion(np.floor(t * 10.0) / 10.0)
    assert np.abs(without_noise(t, exact, stated) - exact).max() < 0.02 * SIGMA
    assert np.array_equal(without_noise(t, held, stated), held)


def test_noise_that_is_smaller_than_stated_is_found(noise):
    t = PERIOD_S * np.arange(1500)
    assert noise_of(motion(t) + 0.1 * noise) == pytest.approx([0.1 * SIGMA] * 2, rel=0.15)


@pytest.mark.parametrize("count", [1, 2, 4, 6])
def test_few_readings_are_a_recording_too(count):
    t = PERIOD_S * np.arange(count)
    out = without_noise(t, motion(t), SIGMA)
    assert out.shape == (count, 2)
    assert np.all(np.isfinite(out))
