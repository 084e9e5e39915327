"""When the covariance factor is propagated and reduced."""

import itertools

import pytest

from ctr_dynamics.estimation.filter.factor_schedule import FactorSchedule

KEY, OTHER = ((0,), (4,)), ((0, 1), (4, 4))


def started():
    schedule = FactorSchedule()
    schedule.start(KEY)
    schedule.most_skipped = 2
    return schedule


def run(steps, measured=lambda k: False, idle=lambda k: True, fraction=0.0):
    """Steps that are propagated, and those behind which the factor is reduced."""
    schedule, propagated, reduced = started(), [], []
    for k in range(1, steps + 1):
        if schedule.plan_step(KEY, KEY, False, measured(k), idle(k), fraction):
            propagated.append(k)
        if measured(k):
            schedule.since_correction = 0
        if schedule.reduction_due:
            reduced.append(k)
            schedule.reduction_due, schedule.since_reduction = False, 0
    return propagated, reduced


def test_every_third_step_is_propagated():
    assert run(9)[0] == [3, 6, 9]


def test_steps_with_a_measurement_or_other_sections_or_parts_are_propagated():
    assert run(8, measured=lambda k: k == 4)[0] == [3, 4, 7]
    schedule = started()
    assert schedule.plan_step(OTHER, OTHER, False, False, True, 0.0)
    assert not schedule.plan_step(OTHER, OTHER, False, False, True, 0.0)
    assert schedule.plan_step(OTHER, OTHER, True, False, True, 0.0)


def test_a_strong_force_is_followed_in_every_step_and_reduced_twice_as_often():
    propagated, reduced = run(60, fraction=0.5)
    assert propagated == list(range(1, 61))
    assert reduced == [14, 28, 42, 56]
    assert run(60)[1] == [28, 56]


@pytest.mark.parametrize("every", [8, 10])
def test_reductions_lie_some_steps_behind_a_correction(every):
    _, reduced = run(200, measured=lambda k: k % every == 0)
    assert len(reduced) > 8
    assert all(k % every >= 4 for k in reduced)
    assert all(14 <= b - a <= 28 for a, b in itertools.pairwise(reduced))


def test_reductions_wait_for_idle_time_but_not_for_ever():
    _, reduced = run(200, idle=lambda k: k % 10 == 0)
    assert reduced[0] == 30
    assert run(80, idle=lambda k: False)[1] == [36, 72]


def test_a_checkpoint_is_what_is_returned_to():
    schedule = started()
    schedule.plan_step(KEY, KEY, False, False, True, 0.0)
    stored = schedule.checkpoint()
    decisions = []
    for _ in range(2):
        schedule.restore(stored)
        decisions.append([schedule.plan_step(KEY, KEY, False, k == 5, True, 0.0) for k in range(9)])
    assert decisions[0] == decisions[1]
