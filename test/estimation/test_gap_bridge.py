"""Actuators over a gap of the joint states."""

import numpy as np
import pytest

from ctr_dynamics.estimation.inputs.gap_bridge import KnownActuators, bridge, end_rate

MS = 1_000_000


def motion(t):
    """(4,) of two tubes, rad and m, at about 0.7 Hz."""
    return np.array([np.sin(4.5 * t), 0.3 * t**2, 0.01 * np.cos(4.0 * t), 0.0])


@pytest.mark.parametrize("missing_ms", [150, 250])
def test_the_way_over_a_gap_is_that_of_a_smooth_motion(missing_ms):
    stamps = [k * 10 * MS for k in range(30)]
    values = [motion(1e-9 * stamp) for stamp in stamps]
    end = stamps[-1] + missing_ms * MS
    first, second = (KnownActuators(s, motion(1e-9 * s)) for s in (end, end + 10 * MS))
    points = bridge(stamps, values, first, second)
    assert [p.stamp_ns for p in points] == list(range(300 * MS, end, 10 * MS))
    line = np.array(
        [
            values[-1] + (first.value - values[-1]) * (p.stamp_ns - stamps[-1]) / (end - stamps[-1])
            for p in points
        ]
    )
    truth = np.array([motion(1e-9 * p.stamp_ns) for p in points])
    errors, of_line = (np.abs(way - truth).max(axis=0) for way in (np.array([p.value for p in points]), line))
    assert np.all(errors[:3] < 0.15 * of_line[:3])
    assert np.all(errors[3] == 0.0)


def test_the_rate_at_the_end_of_few_readings():
    assert np.all(end_rate([0], [motion(0.0)]) == 0.0)
    assert end_rate([0, 10 * MS], [np.zeros(2), np.full(2, 0.01)]) == pytest.approx(1.0)
