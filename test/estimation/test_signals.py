"""Input signals: all stages of a step at once against one after another, and what drives both runs."""

import numpy as np
import pytest

from ctr_dynamics.estimation.signals import Drives, Signal

MS = 1_000_000
RNG = np.random.default_rng(5)


def line(before, after, begin, end, times):
    """Values and rates (times, size) on the line between two samples."""
    rate = (after - before) * (1e9 / (end - begin))
    ahead = (np.array(times) - begin) * 1e-9
    return before + ahead[:, None] * rate, np.tile(rate, (len(times), 1))


def signal(make):
    """Seven samples of four values, 10 ms apart."""
    made = make()
    for k in range(7):
        made.add(10 * k * MS, RNG.normal(size=4))
    return made


@pytest.fixture(params=["plain", "played", "delayed"])
def sampled(request):
    makes = {
        "plain": lambda: Signal(4),
        "played": lambda: Drives(2, np.array([0.3, 0.0]), 0),
        "delayed": lambda: Drives(2, np.zeros(2), 4 * MS),
    }
    return signal(makes[request.param])


@pytest.mark.parametrize(
    ("first", "extrapolate"),
    [
        (-9, 0),
        (-1, 0),
        (0, 0),
        (2, 0),
        (7, 0),
        (9, 0),
        (9.5, 0),
        (13.5, 0),
        (10, 0),
        (58, 0),
        (59.5, 30),
        (58, 30),
        (70, 30),
        (70, 5),
    ],
)
def test_stages_together_are_the_stages_alone(sampled, first, extrapolate):
    times = [round((first + part) * MS) for part in (0.4359, 0.718, 1.0)]
    values, rates = sampled.rows(times, extrapolate * MS)
    assert values.shape == rates.shape == (3, 4)
    for k, time in enumerate(times):
        value, rate = sampled.at(time, extrapolate * MS)
        np.testing.assert_array_equal(values[k], value)
        np.testing.assert_array_equal(rates[k], rate)


def test_stages_between_two_samples_lie_on_their_line():
    made = signal(lambda: Signal(4))
    times = [21 * MS, 24 * MS, 30 * MS]
    values, rates = made.rows(times)
    wanted = line(made.values[2], made.values[3], 20 * MS, 30 * MS, times)
    np.testing.assert_allclose(values, wanted[0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(rates, wanted[1], rtol=1e-15)
