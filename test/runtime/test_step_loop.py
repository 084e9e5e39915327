"""The stepping thread and its account, against scripted estimators and clocks."""

import gc
import math
import threading
import time
from functools import partial
from types import SimpleNamespace

import pytest

from ctr_dynamics.estimation.step_output import ERROR, OK, WARN
from ctr_dynamics.runtime.clock_offset import ClockOffset
from ctr_dynamics.runtime.node_diagnostics import clock_status, topics_status
from ctr_dynamics.runtime.step_loop import (
    CATCH_UP_NS,
    INBOX_BYTES,
    INBOX_LIMIT,
    PREFETCH_NS,
    PREFETCH_STEPS,
    STEP_NS,
    Clock,
    StepLoop,
)
from ctr_dynamics.runtime.timing import StepTiming

MS = 1_000_000


@pytest.fixture(autouse=True)
def _frozen():
    """As :meth:`StepLoop.run` does before its first round."""
    gc.freeze()


class Scripted:
    """Steps on time from `t0_ns` on, and notes when it was asked."""

    def __init__(self, t0_ns=None):
        self.t0_ns = t0_ns
        self.k = 0
        self.asked = []
        self.resets = self.pauses = 0
        self.fault = None
        self.correcting = False
        self.lead_ns = 0
        self.spare_s = None

    def do_idle_work(self):
        self.pauses += 1

    def advance(self, now_ns=None, spare_s=None, most=None, too_old=None):
        self.asked.append(now_ns)
        self.spare_s = spare_s()
        if self.fault is not None:
            fault, self.fault = self.fault, None
            raise fault
        steps = []
        while self.t0_ns is not None and now_ns is not None and self.t0_ns + self.k * STEP_NS <= now_ns:
            if len(steps) == most:
                break
            steps.append(SimpleNamespace(k=self.k, stamp_ns=self.t0_ns + self.k * STEP_NS))
            self.k += 1
        return steps

    def reset(self):
        self.resets += 1
        self.t0_ns, self.k = None, 0


def make_loop(estimator, clock, policy="predict", publish=None, gather_ns=0, prefetch=lambda: None):
    """A loop whose rounds the test calls itself; `published` holds the stamps."""
    published = []
    errors = []

    def note(step, by_now):
        published.append(step.stamp_ns)
        return True

    loop = StepLoop(
        estimator,
        publish or note,
        lambda now, pause: None,
        Clock(lambda: clock.now),
        StepTiming(policy, 100 * MS),
        errors.append,
        gather_ns=gather_ns,
        prefetch=prefetch,
    )
    return loop, published, errors


def noted_waits(loop):
    """The loop's waits (s) from here on, which end at once."""
    waits = []
    loop._wake = SimpleNamespace(
        is_set=lambda: False, wait=waits.append, clear=lambda: None, set=lambda: None
    )
    return waits


@pytest.fixture
def clock():
    return SimpleNamespace(now=1_000_000 * MS)


def test_inputs_are_taken_in_together_before_the_step(clock):
    estimator = Scripted()
    loop, published, _ = make_loop(estimator, clock)
    order = []
    loop.put(lambda: order.append("joints") or setattr(estimator, "t0_ns", clock.now))
    loop.put(lambda: order.append("tracker"))
    loop._round()
    assert order == ["joints", "tracker"]
    assert published == [clock.now]


def test_a_step_is_begun_as_long_before_its_stamp_as_the_estimator_asks(clock):
    estimator = Scripted(clock.now)
    estimator.lead_ns = MS
    loop, published, _ = make_loop(estimator, clock)
    t0 = clock.now
    loop._round()
    assert published == [t0]
    waits = noted_waits(loop)
    loop._sleep()
    assert waits == [pytest.approx(2e-3)]
    clock.now += 2 * MS - 1
    loop._round()
    assert published == [t0]
    clock.now += 1
    loop._round()
    assert published == [t0, t0 + STEP_NS]
    assert loop._spare_s() == pytest.approx(3e-3)  # until the next one is to be begun
    assert loop.timing.lateness.max_ns == 0
    loop._wall = False  # a clock of a simulation: it may stand still before the stamp
    clock.now += 2 * MS
    loop._round()
    assert len(published) == 2
    clock.now += 2 * MS
    loop._round()
    assert published == [t0, t0 + STEP_NS, t0 + 2 * STEP_NS]


def test_the_first_inputs_are_gathered_before_the_model_starts(clock, monkeypatch):
    passed_ns = 0  # by a clock that only sleeping moves

    def sleep(seconds):
        nonlocal passed_ns
        passed_ns += round(1e9 * seconds)

    monkeypatch.setattr(time, "monotonic_ns", lambda: passed_ns)
    estimator = Scripted()
    loop, published, _ = make_loop(estimator, clock, gather_ns=20 * MS)
    monkeypatch.setattr(loop._wake, "wait", sleep)
    loop._round()
    assert estimator.asked == [clock.now]  # nothing to gather for
    loop.put(lambda: setattr(estimator, "t0_ns", clock.now))
    loop._round()
    order = []
    loop.put(lambda: order.append("load"))
    loop._wake.clear()
    loop._round()
    assert (len(estimator.asked), order, published) == (1, ["load"], [])
    loop._sleep()  # until it may start
    assert passed_ns == 20 * MS
    passed_ns -= 1
    loop._round()
    assert published == []
    assert loop._gathering_ns() == 1  # no longer than that does it sleep
    passed_ns += 1
    loop._round()
    assert published == [clock.now]
    assert published[0] == estimator.t0_ns
    loop.reset()
    estimator.t0_ns = clock.now
    loop._round()
    assert len(published) == 1


def test_pauses_are_used_after_steps_are_out_and_not_while_inputs_wait(clock):
    estimator = Scripted(clock.now)
    loop, published, _ = make_loop(estimator, clock)
    loop._round()
    assert (published, estimator.pauses) == ([clock.now], 1)
    loop._round()  # nothing was due
    assert estimator.pauses == 1
    clock.now += STEP_NS
    loop._publish = lambda step, by_now: loop.put(lambda: None) or True  # an input comes meanwhile
    loop._round()
    assert estimator.pauses == 1


def test_a_flood_of_messages_is_rejected_beyond_a_limit_and_counted(clock):
    loop, _, _ = make_loop(Scripted(), clock)
    taken = []
    for k in range(INBOX_LIMIT + 3):
        loop.offer(partial(taken.append, k))
    assert loop.rejected == 3
    assert topics_status({}, {}, loop.rejected).level == ERROR
    loop._round()
    assert taken == list(range(INBOX_LIMIT))
    loop.offer(partial(taken.append, -1), INBOX_BYTES)
    loop.offer(partial(taken.append, -2), 1)
    assert loop.rejected == 4
    loop._round()
    loop.offer(partial(taken.append, -3), 1)
    loop._round()
    assert taken[INBOX_LIMIT:] == [-1, -3]


def test_a_backlog_is_published_step_by_step_and_nothing_is_skipped(clock):
    estimator = Scripted(clock.now)
    loop, published, _ = make_loop(estimator, clock)
    t0 = clock.now
    clock.now += 40 * STEP_NS
    while len(published) < 41:
        before = len(published)
        loop._round()
        assert before < len(published) <= before + 9
    assert published == [t0 + k * STEP_NS for k in range(41)]
    assert loop.timing.totals.skipped == 0
    assert all(b - a <= STEP_NS for a, b in zip(estimator.asked, estimator.asked[1:], strict=False))


def test_a_large_backlog_reinitialises(clock):
    estimator = Scripted(clock.now)
    loop, published, errors = make_loop(estimator, clock)
    loop._round()
    clock.now += CATCH_UP_NS + 2 * STEP_NS
    loop._round()
    assert estimator.resets == 1
    assert len(published) == 1
    assert "reinitialises" in errors[0]
    assert loop.timing.restarts == 1


def test_without_a_clock_only_covered_steps_are_asked_for(clock):
    estimator = Scripted(clock.now)
    clock.now = 0
    loop, published, _ = make_loop(estimator, clock)
    loop._round()
    assert estimator.asked == [None]
    assert published == []


def test_a_fault_is_shown_and_the_estimator_reinitialises(clock):
    estimator = Scripted(clock.now)
    estimator.fault = ZeroDivisionError("no")
    loop, _, errors = make_loop(estimator, clock)
    loop._round()
    assert loop.faults == 1
    assert loop.last_fault == "ZeroDivisionError: no; the estimator reinitialises"
    assert estimator.resets == 1
    assert "ZeroDivisionError" in errors[0]


def test_faults_beside_the_steps_do_not_end_them(clock):
    estimator = Scripted(clock.now)
    loop, published, errors = make_loop(estimator, clock)

    def fails(*_):
        raise OSError("no room")

    loop._housekeeping = estimator.do_idle_work = fails
    for _ in range(2):
        loop._round()
        clock.now += STEP_NS
    assert published
    assert loop.faults == 3
    assert loop.last_fault == "OSError: no room; steps go on"
    assert estimator.resets == 1, "of the pause; diagnostics have nothing to do with the estimator"
    assert all("no room" in error for error in errors)


def test_corrections_are_told_how_much_time_there_is(clock):
    estimator = Scripted(clock.now)
    loop, published, _ = make_loop(estimator, clock)
    loop._round()
    assert estimator.spare_s == math.inf  # before the first step nothing is due
    clock.now += STEP_NS // 4
    loop._round()
    assert estimator.spare_s == pytest.approx(0.75 * STEP_NS * 1e-9)
    clock.now += STEP_NS
    loop._round()
    assert estimator.spare_s == pytest.approx(-0.25 * STEP_NS * 1e-9)
    assert len(published) == 2


def test_a_step_that_falls_due_during_a_correction_is_taken_at_once(clock):
    estimator = Scripted(clock.now)
    loop, published, _ = make_loop(estimator, clock)
    loop._round()
    take = estimator.advance

    def correct(now_ns=None, spare_s=None, most=None, too_old=None):
        steps = take(now_ns, spare_s, most, too_old)
        clock.now += STEP_NS  # the correction took until after the next step was due
        return steps

    waits = noted_waits(loop)
    estimator.advance = correct
    clock.now += STEP_NS // 2
    loop._round()
    loop._sleep()
    assert len(published) == 1
    assert waits == []
    estimator.advance = take
    loop._round()
    assert len(published) == 2


def test_a_step_that_is_due_and_not_taken_is_not_asked_for_all_the_time(clock):
    estimator = Scripted(clock.now)
    loop, _, _ = make_loop(estimator, clock)
    loop._round()
    waits = noted_waits(loop)
    estimator.advance = lambda now_ns=None, spare_s=None, most=None, too_old=None: []
    clock.now += 2 * STEP_NS
    loop._round()
    loop._sleep()
    assert waits == [pytest.approx(1e-3)]


def test_housekeeping_is_told_whether_there_is_time_to_spare(clock):
    loop, _, _ = make_loop(Scripted(clock.now), clock)
    told = []
    loop._housekeeping = lambda now, pause: told.append(pause)
    loop._round()
    clock.now += STEP_NS // 2
    loop._round()
    clock.now += STEP_NS // 2 - STEP_NS // 10
    loop._round()
    assert told == [True, True, False]


def test_a_correction_that_waits_goes_before_idle_work(clock):
    estimator = Scripted(clock.now)
    loop, _, _ = make_loop(estimator, clock)
    loop._round()
    assert estimator.pauses == 1
    estimator.correcting = True
    clock.now += STEP_NS
    loop._round()
    assert estimator.pauses == 1
    assert loop._wake.is_set()  # the next round begins at once


def test_calls_run_in_the_thread_and_hand_back_result_or_error(clock):
    loop, _, _ = make_loop(Scripted(), clock)
    loop.start()
    try:
        assert loop.call(lambda: threading.current_thread().name) == "stepping"
        with pytest.raises(KeyError):
            loop.call(lambda: {}["missing"])
    finally:
        loop.stop()
        loop.join(60)
    assert not loop.is_alive()
    with pytest.raises(TimeoutError, match="did not answer"):
        loop.call(lambda: None, timeout_s=0.01)


def test_joints_that_are_old_at_arrival_are_said_where_steps_are_without_them():
    clock = ClockOffset()
    for k in range(5):
        clock.sample(10 * k * MS, (10 * k + 400 + k) * MS)
    assert clock.agrees
    status = clock_status(clock, 1, False, 100 * MS)
    assert (status.level, clock.age_ns) == (WARN, 400 * MS)
    assert "0.400 s behind the node's clock at arrival, limit 0.1 s" in status.message
    assert clock_status(clock, 1, False, None).level == OK
    assert clock_status(clock, 1, False, 500 * MS).level == OK


def test_under_wait_every_step_is_out_before_the_next_is_taken(clock):
    estimator = Scripted(t0_ns=clock.now - 5 * STEP_NS)
    taken = []

    def publish(step, by_now):
        taken.append((step.k, estimator.k))
        return True

    loop, _, _ = make_loop(estimator, clock, policy="wait", publish=publish)
    loop._round()
    assert taken == [(k, k + 1) for k in range(6)]


def test_steps_are_prefetched_once_a_moment_before_joints_that_several_wait_for(clock):
    class Waiting(Scripted):
        """Takes the steps that joints cover."""

        def advance(self, now_ns=None, spare_s=None, most=None, too_old=None):
            return super().advance(min(now_ns, self.covered_ns), spare_s, most, too_old)

    estimator = Waiting(clock.now)
    prefetched = []
    loop, _, _ = make_loop(estimator, clock, policy="wait", prefetch=lambda: prefetched.append(clock.now))
    waits = noted_waits(loop)
    for _ in range(2):
        estimator.covered_ns = clock.now
        loop.timing.arrived(clock.now, clock.now)
        for _ in range(4):
            loop._round()
        clock.now += 10 * MS
    begin = clock.now - 10 * MS  # of the second joint state; the third is expected 10 ms behind it
    clock.now = begin + 1 * MS
    loop._sleep()
    assert waits.pop() == pytest.approx(1e-9 * (9 * MS - PREFETCH_NS))
    loop._round()
    assert prefetched == []
    clock.now = begin + 10 * MS - PREFETCH_NS
    loop._round()
    assert prefetched == [clock.now] * PREFETCH_STEPS
    loop._round()
    loop._sleep()
    assert len(prefetched) == PREFETCH_STEPS
    assert waits.pop() > 1e-9 * PREFETCH_NS
    # joints that came early: what waits for them goes first
    loop.timing.arrived(begin + 10 * MS, begin + 10 * MS)
    clock.now = begin + 20 * MS - PREFETCH_NS
    loop.inbox.append(lambda: None)
    loop._prefetch()
    assert len(prefetched) == PREFETCH_STEPS


@pytest.mark.parametrize(("policy", "period_ns"), [("predict", 10 * MS), ("wait", 4 * MS)])
def test_nothing_is_prefetched_where_steps_come_one_by_one(clock, policy, period_ns):
    estimator = Scripted(clock.now)
    prefetched = []
    loop, _, _ = make_loop(estimator, clock, policy=policy, prefetch=lambda: prefetched.append(clock.now))
    for _ in range(40):
        if (clock.now - estimator.t0_ns) % period_ns == 0:
            loop.timing.arrived(clock.now, clock.now)
        loop._round()
        clock.now += MS
    assert estimator.k > 10
    assert prefetched == []
