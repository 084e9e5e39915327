"""The frequency of what no cause explains."""

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import UnexplainedForceOptions
from ctr_dynamics.diagnosis.verdict.unexplained_force import _frequency

OPTIONS = UnexplainedForceOptions()


@pytest.mark.parametrize("rate_hz", [10.0, 12.0, 40.0, 200.0])
def test_the_frequency_is_none_of_its_aliases(rate_hz):
    """The alias lies on the grid of the whole range, the frequency itself does not."""
    grid = np.linspace(OPTIONS.lowest_hz, OPTIONS.highest_hz, OPTIONS.frequencies)
    true = grid[np.argmin(np.abs(grid - rate_hz - 3.0))] - rate_hz if rate_hz < 15.0 else 3.0
    t = np.arange(0.0, 12.0, 1.0 / rate_hz)
    found = _frequency(t, np.sin(2 * np.pi * true * t + 0.3), OPTIONS)
    assert found == pytest.approx(true, abs=0.01)


def test_samples_that_are_too_slow_show_no_frequency():
    t = np.arange(30.0)
    assert _frequency(t, np.sin(t), UnexplainedForceOptions(lowest_hz=0.5)) is None
