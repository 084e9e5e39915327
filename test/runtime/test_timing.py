"""The account of punctuality: lateness, its quantiles, and its status."""

import numpy as np
import pytest

from ctr_dynamics.estimation.step_output import ERROR, OK, WARN
from ctr_dynamics.runtime.node_diagnostics import timing_status
from ctr_dynamics.runtime.timing import RECENT_STEPS, Histogram, StepTiming

MS = 1_000_000


def test_lateness_under_predict_is_against_the_stamp():
    timing = StepTiming("predict", 100 * MS)
    timing.published(0, 0, 30 * MS)  # the start has been solved by now
    timing.published(10, 30 * MS, 31 * MS)
    timing.published(11, 33 * MS, 34 * MS)
    timing.published(12, 36 * MS, 36 * MS + 3 * MS + 1)
    timing.published(15, 45 * MS, 45 * MS + 20 * MS + 1)
    report = timing.report()
    assert report["start"] == {"steps": 2, "max_ms": 30.0}
    assert report["steps"] == 3
    assert report["late_over_3ms"] == 2
    assert report["late_over_20ms"] == 1
    assert report["skipped"] == 9 + 2
    assert report["worst"][0]["k"] == 15


def test_lateness_under_wait_is_against_the_covering_input_or_the_timeout():
    timing = StepTiming("wait", 100 * MS)
    timing.arrived(0, 2 * MS)
    timing.published(0, 0, 3 * MS)
    timing.arrived(10 * MS, 14 * MS)
    timing.arrived(9 * MS, 15 * MS)  # does not bring the stamps forward
    assert timing.published(2, 6 * MS, 16 * MS) == 2 * MS
    assert timing.published(3, 9 * MS, 18 * MS) == 4 * MS
    assert timing.published(4, 12 * MS, 113 * MS) == 1 * MS  # no input: due when the wait was over
    assert timing.totals.late == 1


def test_a_restart_begins_a_new_count():
    timing = StepTiming("predict", 100 * MS)
    timing.published(0, 0, 0)
    timing.published(1, 3 * MS, 3 * MS)
    timing.restarted()
    timing.published(0, 900 * MS, 910 * MS)
    assert timing.report()["skipped"] == 0
    assert timing.report()["restarts"] == 1


def test_histogram_quantiles_are_upper_edges_and_the_maximum_is_exact():
    histogram = Histogram()
    assert histogram.quantile(0.5) == 0.0
    for value in (1_000, 11_000, 21_000, 31_000, 12_345_678):
        histogram.add(value)
    assert histogram.quantile(0.5) == pytest.approx(22e-3)
    assert histogram.quantile(0.8) == pytest.approx(32e-3)
    assert histogram.quantile(1.0) == pytest.approx(12.345678)
    assert histogram.summary()["max"] == round(12.345678, 4)


@pytest.mark.parametrize("median_ms", [0.002, 0.3, 3.0, 70.0, 4_000.0, 9e7])
def test_histogram_quantiles_are_near_at_any_size(median_ms):
    histogram = Histogram()
    for share in np.linspace(0.0, 2.0, 2001):
        histogram.add(round(share * median_ms * 1e6))
    assert histogram.quantile(0.5) == pytest.approx(median_ms, rel=0.02, abs=2e-3)
    assert histogram.quantile(0.99) == pytest.approx(1.98 * median_ms, rel=0.02, abs=2e-3)
    assert histogram.quantile(1.0) == pytest.approx(2.0 * median_ms)


def test_the_status_of_the_timing_judges_the_last_seconds():
    timing, k = StepTiming("predict", 100 * MS), 0

    def steps(count, late_ns):
        nonlocal k
        for _ in range(count):
            k += 1
            timing.published(k, k * 3 * MS, k * 3 * MS + late_ns)

    def found():
        status = timing_status(timing, 0, "")
        return status.level, status.message

    steps(1, 0)  # the start
    steps(20, 30 * MS)
    assert found() == (
        WARN,
        "20 of the last 20 steps were published later than 3 ms, 20 later than 20 ms; limits 0.1 % and 0",
    )
    steps(RECENT_STEPS - 400, 0)
    assert found()[0] == WARN
    steps(401, 0)
    assert found() == (OK, f"{RECENT_STEPS + 21} steps, the last 3018 of them on time")
    assert timing_status(timing, 0, "").values["later than 20 ms"] == "20"
    k += 3
    steps(1, 0)
    assert found() == (WARN, "3 steps were skipped among the last 3019, none should be")
    steps(RECENT_STEPS, 0)
    assert found()[0] == OK
    assert timing_status(timing, 0, "").values["skipped"] == "3"
    assert timing_status(timing, 1, "x").level == ERROR


def test_the_next_joints_are_expected_in_the_rhythm_of_their_stamps():
    timing = StepTiming("wait", 100 * MS)
    assert timing.next_arrival_ns is None
    timing.arrived(10 * MS, 11 * MS)
    assert timing.next_arrival_ns is None
    timing.arrived(20 * MS, 24 * MS)
    assert timing.next_arrival_ns == 34 * MS
    timing.arrived(15 * MS, 25 * MS)  # late: it covers nothing new
    assert timing.next_arrival_ns == 34 * MS
    timing.restarted()
    assert timing.next_arrival_ns is None
