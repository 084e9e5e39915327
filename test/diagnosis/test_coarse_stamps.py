"""Stamps that a log has rounded: the device's even times come back, and what was not rounded stays as it is."""

import numpy as np
import pytest

from ctr_dynamics.diagnosis.coarse_stamps import evened
from ctr_dynamics.diagnosis.diagnosis_options import RecordingOptions

OPTIONS = RecordingOptions()
START_NS = 1_700_000_000_000_000_000


def rounded(times, resolution):
    """Stamps in ns of ``times`` (k,) s, cut to multiples of ``resolution`` (s)."""
    step = round(1e9 * resolution)
    return START_NS + np.floor(times / resolution).astype(np.int64) * step


@pytest.mark.parametrize(("period", "resolution"), [(0.10035, 0.01), (0.0123456, 0.001)])
def test_times_of_an_even_device_with_a_pause_come_back(period, resolution):
    true = 0.3 + period * np.arange(3000)
    true[2000:] += 7.4 * period
    stamps = rounded(true, resolution)
    times, step = evened(stamps, OPTIONS)
    assert step == round(1e9 * resolution)
    assert np.abs(times - (stamps - stamps[0])).max() <= 0.5 * step + 1.0
    error, before = (1e-9 * t - true for t in (times, stamps - stamps[0]))
    assert np.std(before) > 0.25 * resolution
    # what is left is a constant, which no clock would show, but for the ends of the even parts
    assert np.std(error) < 0.15 * np.std(before)
    jumps = np.abs(np.diff(error))
    assert np.sum(jumps > 0.05 * resolution) < 10


@pytest.mark.parametrize(
    "stamps",
    [
        START_NS + 25_000_000 * np.arange(200),  # even
        START_NS + 25_000_000 * np.delete(np.arange(200), [20, 21, 90]),  # even, with readings missing
        START_NS + np.cumsum(np.random.default_rng(0).integers(24_000_000, 26_000_000, 200)),  # not rounded
        rounded(0.0123456 * np.arange(200), 1e-4),  # finer than what counts
        rounded(np.cumsum(np.random.default_rng(5).uniform(0.06, 0.14, 400)), 0.01),  # uneven itself
        np.array([START_NS]),
        np.zeros(0, np.int64),
    ],
)
def test_other_stamps_stay_bit_by_bit(stamps):
    times, step = evened(stamps, OPTIONS)
    assert step == 0
    np.testing.assert_array_equal(times, stamps - (stamps[0] if len(stamps) else 0))
