"""Stamps: the clock that joint states tell, and each stamp once."""

from __future__ import annotations

import pytest

from ctr_dynamics.runtime.clock_offset import ClockOffset, RisingStamps

MS = 1_000_000
PERIOD = 10 * MS


def test_stamp_clock_follows_a_foreign_clock_after_three_stamps():
    clock = ClockOffset()
    clock.sample(1000 * MS, 1004 * MS)
    assert clock.agrees
    assert clock.at(7) == 7
    for count in range(3):
        assert clock.agrees, count
        clock.sample(10 * MS + count, 90_000 * MS + 5 - count)
    assert not clock.agrees
    assert clock.at(90_000 * MS) == 90_000 * MS - (89_990 * MS + 1)
    clock.sample(20 * MS, 90_005 * MS)  # arrives sooner after its stamp: a better estimate
    assert clock.offset_ns == 89_985 * MS
    for _ in range(3):
        clock.sample(90_100 * MS, 90_101 * MS)
    assert clock.agrees
    assert clock.offset_ns == 0


def test_a_recorders_clock_is_that_of_the_stamps_but_for_the_smallest_difference():
    clock = ClockOffset(own=False)
    assert not clock.known
    offset = 7_000 * MS
    at = []
    for i, delay in enumerate([4 * MS, MS, 3 * MS, 2 * MS]):
        arrival = i * PERIOD + offset + delay
        clock.sample(i * PERIOD, arrival)
        at.append(clock.at(arrival))
    # the first arrival defines the time; once a quicker one is known, slower ones are seen to be late
    assert at == [0, 10 * MS, 22 * MS, 31 * MS]


@pytest.mark.parametrize("own", [True, False])
def test_one_wild_stamp_changes_nothing_and_a_lasting_change_is_followed(own):
    clock = ClockOffset(own)
    clock.sample(0, 0)
    assert not clock.sample(10**18, PERIOD), "it is to be left out"
    assert "stamp 999999999.990 s ahead, limit 1 s" in clock.rejection(10**18, PERIOD)
    assert clock.at(PERIOD) == PERIOD
    assert clock.sample(2 * PERIOD, 2 * PERIOD)
    jump = 5_000 * MS
    kept = [clock.sample(t * PERIOD + jump, t * PERIOD) for t in (3, 4, 5)]
    assert kept == [False, False, True]
    assert clock.at(5 * PERIOD) == 5 * PERIOD + jump
    assert clock.sample(0, 6 * PERIOD), "far behind is the estimator's to judge"
    kept = [clock.sample(t * PERIOD, t * PERIOD) for t in (7, 8)]
    assert kept == [True, True]
    assert clock.at(8 * PERIOD) == 8 * PERIOD, "and back again"


def test_a_stamp_ahead_of_its_time_is_forgotten_and_a_drift_is_followed():
    clock = ClockOffset(own=False)
    for i in range(300):
        clock.sample(i * PERIOD + 500 * MS * (i == 20), i * PERIOD)
    assert clock.at(299 * PERIOD) == 299 * PERIOD
    drift = 1.001  # the log's clock is the faster one
    for i in range(300, 3000):
        clock.sample(i * PERIOD, round(i * PERIOD * drift))
    now = clock.at(round(2999 * PERIOD * drift))
    assert 0 <= now - 2999 * PERIOD < 2 * 100 * PERIOD * (drift - 1.0)


def test_each_stamp_passes_once():
    stamps = RisingStamps()
    assert [stamps.passes(t) for t in (0, 3, 3, 2, 6)] == [True, True, False, False, True]
    assert stamps.behind_ns == 0
    stamps.let_go_back()
    assert not stamps.passes(5), "not by less than a second"
    assert stamps.behind_ns == 1
    assert stamps.passes(6 - 1001 * MS)
    assert not stamps.passes(6 - 1001 * MS - 2000 * MS), "once for each reset"
    stamps.forget()
    assert stamps.passes(-(10**12))
