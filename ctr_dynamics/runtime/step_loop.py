"""The stepping thread: takes in what arrived, advances the estimator on absolute deadlines, hands out steps.

Free of ROS: messages come as callables in an inbox, steps leave through one function, the clock is a
function. Timers of an executor drop ticks; here the stamps decide which steps are due (`Estimator.advance`),
and the thread sleeps until the next one is, or until a message wakes it.
"""

from __future__ import annotations

import gc
import math
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

from ctr_dynamics.io.messages.topics import STEP_NS
from ctr_dynamics.runtime.clock_offset import ClockOffset
from ctr_dynamics.runtime.timing import StepTiming

CATCH_UP_NS = 5_000_000_000
"""A backlog longer than this is given up: the estimator reinitialises."""
SLICE_STEPS = 8
"""Steps of a backlog that are taken between two looks at the inbox."""
INBOX_LIMIT = 20_000
"""Messages that may wait: minutes of a robot's, and what keeps a flood from filling the memory."""
INBOX_BYTES = 64 * 2**20
"""Bytes of them that may wait: a message of a robot has some hundred, but nothing says how large one is that comes over the network."""
IDLE_NS = 50_000_000
RETRY_NS = 1_000_000
COLLECT_NS = 1_000_000_000
COLLECT_SLACK_NS = 1_500_000
GATHER_NS = 4_000_000
"""So long after the first joints the model starts: a load of the same time comes a moment later, and starting takes longer than that."""
IDLE_WORK_NS = 1_000_000
"""Idle work takes about as long."""
PREFETCH_NS = 2_500_000
"""So long before joints are expected that several steps wait for, a step is computed without effect. Earlier would be in vain: caches forget."""
PREFETCH_STEPS = 3
"""Steps without effect: every third computes the covariance."""


class Steps(Protocol):
    """What the thread needs of an estimator."""

    @property
    def t0_ns(self) -> int | None: ...
    @property
    def lead_ns(self) -> int: ...
    @property
    def correcting(self) -> bool: ...
    def advance(
        self,
        now_ns: int | None = None,
        spare_s: Callable[[], float] | None = None,
        most: int | None = None,
        too_old: Callable[[int], str] = ...,
    ) -> Sequence[Any]: ...
    def do_idle_work(self) -> None: ...
    def reset(self) -> None: ...


class Clock(NamedTuple):
    """A node's clock: its current time in ns, 0 while it has none, and whether it runs at the rate of the wall clock, so that one may sleep
    until a stamp."""

    now_ns: Callable[[], int]
    wall: bool = True


class Call:
    """A function to be run by the stepping thread, for its caller to wait for."""

    def __init__(self, function: Callable[[], Any]) -> None:
        self.function = function
        self.result: Any = None
        self.error: Exception | None = None
        self.done = threading.Event()

    def __call__(self) -> None:
        try:
            self.result = self.function()
        except Exception as error:
            self.error = error
        self.done.set()


class StepLoop(threading.Thread):
    """Runs an estimator against a clock.

    Args:
        estimator: see `Steps`; touched by this thread alone once started.
        publish: called with every step in order of its stamp and a function that gives the step as it is by now: invalid once it is too old.
            Returns False when the stamp was withheld.
        housekeeping: called after each round with the current time and whether there is time to spare; publishes diagnostics when they are due.
        clock: the node's.
        timing: the account of punctuality.
        log_error: takes one line for the log.
        gather_ns: how long the first inputs are gathered.
        prefetch: computes a step without effect; called a moment before joints that several steps wait for.
        max_age_ns: a step whose stamp is older than this when it goes out is made invalid: who acts on it acts on the past.
    """

    def __init__(
        self,
        estimator: Steps,
        publish: Callable[[Any, Callable[[Any], Any]], bool],
        housekeeping: Callable[[int, bool], None],
        clock: Clock,
        timing: StepTiming,
        log_error: Callable[[str], Any],
        gather_ns: int = GATHER_NS,
        prefetch: Callable[[], object] = lambda: None,
        max_age_ns: int | None = None,
    ) -> None:
        super().__init__(name="stepping", daemon=True)
        self.estimator = estimator
        self.timing = timing
        self.clock_offset = ClockOffset()
        self.inbox: deque[Callable[[], None]] = deque()
        self.rejected = 0
        self._offered_bytes = self._taken_bytes = 0  # each is written by one thread alone
        self.faults = 0
        self.last_fault = ""
        self._publish = publish
        self._housekeeping = housekeeping
        self._clock_ns = clock.now_ns
        self._log_error = log_error
        self._wall = clock.wall
        self._gather_ns = gather_ns
        self._prefetch_step = prefetch
        self.max_age_ns = max_age_ns
        self._took_steps = False
        # a step was due in this round and the estimator did not take it: it wants an input
        self._starved = False
        self._idle_work_due = False
        self._prefetched_ns: int | None = None  # for the joints that were expected then
        self._wake = threading.Event()
        self._stopping = False
        self._last: tuple[int, int] | None = None  # k and stamp of the last step taken
        self._joints_since_ns: int | None = None  # monotonic time since when a start has been possible
        self._next_collection_ns = 0

    # Called from other threads.

    def put(self, item: Callable[[], None]) -> None:
        """Have `item` run by the stepping thread before its next step; returns at once."""
        self.inbox.append(item)
        self._wake.set()

    def offer(self, item: Callable[[], None], size: int = 0) -> None:
        """The same for a message of ``size`` bytes: beyond ``INBOX_LIMIT`` or ``INBOX_BYTES`` that wait it is rejected, and counted."""
        if len(self.inbox) < INBOX_LIMIT and self._offered_bytes - self._taken_bytes + size <= INBOX_BYTES:
            self._offered_bytes += size
            self.put(partial(self._take, item, size))
        else:
            self.rejected += 1

    def _take(self, item: Callable[[], None], size: int) -> None:
        self._taken_bytes += size
        item()

    def call(self, function: Callable[[], Any], timeout_s: float = 5.0) -> Any:
        """Run `function` in the stepping thread and return its result.

        Raises:
            TimeoutError: the thread did not come to it in time.
            Exception: whatever the function raised.
        """
        call = Call(function)
        self.put(call)
        if not call.done.wait(timeout_s):
            raise TimeoutError(f"the stepping thread did not answer within {timeout_s:g} s")
        if call.error is not None:
            raise call.error
        return call.result

    def wake(self) -> None:
        self._wake.set()

    def stop(self) -> None:
        """End the thread after the round in progress; join it afterwards."""
        self._stopping = True
        self._wake.set()

    # The thread's own.

    def swap(self, estimator: Steps) -> None:
        """Go on with another estimator, which starts at its next joint state."""
        self.estimator = estimator
        self._forget()

    def reset(self) -> None:
        self.estimator.reset()
        self._forget()

    def _forget(self) -> None:
        self._last = self._joints_since_ns = None
        self.timing.restarted()

    def run(self) -> None:
        # What exists at the start is never garbage. The rest is collected between deadlines, so that no
        # collection falls into a step.
        gc.collect()
        gc.freeze()
        gc.disable()
        try:
            while not self._stopping:
                self._wake.clear()
                self._round()
                self._sleep()
        finally:
            gc.enable()
            gc.unfreeze()

    def _round(self) -> None:
        self._took_steps = self._starved = False
        try:
            while self.inbox:
                self.inbox.popleft()()
            self._advance()
            if self._took_steps:
                self._idle_work_due = True
            if not self.estimator.correcting:
                if self._idle_work_due and not self.inbox and self._idle():
                    self._idle_work_due = False
                    self.estimator.do_idle_work()
            elif self._took_steps:
                self._wake.set()  # now there is time for it
            self._prefetch()
        except Exception as error:
            # The node stays up whatever a message provokes: the fault is shown, the estimator reinitialises.
            self._fault(error, "the estimator reinitialises")
            self.reset()
        try:
            self._housekeeping(self._clock_ns(), self._idle())
        except Exception as error:
            self._fault(error, "steps go on")
        self._collect()

    def _fault(self, error: Exception, what: str) -> None:
        self.faults += 1
        self.last_fault = f"{type(error).__name__}: {error}; {what}"
        self._log_error(f"fault in the stepping thread, {what}\n{traceback.format_exc()}")

    def _prefetch_ns(self) -> int | None:
        """When to compute steps without effect; None where that has been done, or where an input covers hardly more than one step."""
        expected_ns = self.timing.next_arrival_ns
        if expected_ns is None or expected_ns == self._prefetched_ns or self._last is None or not self._wall:
            return None
        several = self.timing.policy != "predict" and self.timing.period_ns > 2 * STEP_NS
        return expected_ns - PREFETCH_NS if several else None

    def _prefetch(self) -> None:
        """Compute steps without effect a moment before several will be due at once, so that these meet warm caches."""
        due_ns = self._prefetch_ns()
        if due_ns is None or self._now_ns() < due_ns:
            return
        self._prefetched_ns = self.timing.next_arrival_ns
        for _ in range(PREFETCH_STEPS):
            if self.inbox or self._now_ns() > due_ns + PREFETCH_NS:
                return
            self._prefetch_step()

    def _idle(self) -> bool:
        """Whether there is time for what no output waits for."""
        return self._spare_s() * 1e9 > IDLE_WORK_NS

    def _spare_s(self) -> float:
        """Time until the next step falls due, s; infinite where nothing tells."""
        due_ns = self._next_due_ns()
        return math.inf if due_ns is None or not self._wall else (due_ns - self._begin_ns()) * 1e-9

    def _advance(self) -> None:
        """Take what is due, and correct what inputs have changed while there is time."""
        if self._gathering_ns() > 0:
            return
        predicting = self.timing.policy == "predict"
        for _ in range(SLICE_STEPS):
            until_ns, more = self._until(self._begin_ns())
            corrects = self.estimator.correcting
            due_ns = self._next_due_ns()
            begin = time.perf_counter_ns()
            steps = self.estimator.advance(until_ns, self._spare_s, None if predicting else 1, self._too_old)
            spent_ns = time.perf_counter_ns() - begin
            self._starved = not steps and due_ns is not None and until_ns is not None and until_ns >= due_ns
            if steps:
                self._took_steps = True
                self.timing.stepped(len(steps), spent_ns)
            elif corrects:
                self.timing.corrected(spent_ns)
            for step in steps:
                if self._last is not None and step.k <= self._last[0]:
                    self.timing.restarted()  # the estimator has reinitialised itself
                self._last = (step.k, step.stamp_ns)
                if self._publish(step, self._not_too_old):
                    self.timing.published(step.k, step.stamp_ns, self._now_ns())
                else:
                    self.timing.withheld += 1
            if self._stopping or not more or not steps:
                return
        self._wake.set()  # there is more to take, after a look at the inbox

    def _not_too_old(self, step: Any) -> Any:
        """The step, invalid where it comes so late that the robot may be elsewhere by now; the caller asks just before it sends."""
        reason = self._too_old(step.stamp_ns) if step.valid else ""
        return step._replace(valid=False, reason=reason) if reason else step

    def _too_old(self, stamp_ns: int) -> str:
        """Why an output of that stamp comes too late for anyone to act on it; empty where it does not. Counts those that do."""
        now_ns = self._now_ns()
        if self.max_age_ns is None or now_ns <= 0 or now_ns - stamp_ns <= self.max_age_ns:
            return ""
        self.timing.too_old += 1
        age_s, limit_s = (now_ns - stamp_ns) * 1e-9, self.max_age_ns * 1e-9
        return f"output is {age_s:.3f} s old when it goes out, limit {limit_s:g} s (output.max_age_s): the node is held up, or joints come late"

    def _gathering_ns(self) -> int:
        """How much longer the first inputs are gathered before the model starts; 0 once it may."""
        if self._last is not None or self.estimator.t0_ns is None:
            return 0
        now_ns = time.monotonic_ns()
        if self._joints_since_ns is None:
            self._joints_since_ns = now_ns
        return max(self._joints_since_ns + self._gather_ns - now_ns, 0)

    def _now_ns(self) -> int:
        """Time on the clock of the stamps; 0 while there is no clock."""
        now_ns = self._clock_ns()
        return self.clock_offset.at(now_ns) if now_ns > 0 else 0

    def _begin_ns(self) -> int:
        """The stamp whose step is to be begun now, so that it is out when it is due; 0 while there is no clock."""
        now_ns = self._now_ns()
        return now_ns + self.estimator.lead_ns if now_ns > 0 and self._wall else now_ns

    def _until(self, now_ns: int) -> tuple[int | None, bool]:
        """The time up to which to advance, and whether more steps are due behind it."""
        if now_ns <= 0:
            return None, False  # without a clock only what the inputs cover is taken
        next_ns = self._last[1] + STEP_NS if self._last is not None else self.estimator.t0_ns
        if next_ns is None:
            return now_ns, False
        if now_ns - next_ns > CATCH_UP_NS:
            self._log_error(
                f"steps are {(now_ns - next_ns) * 1e-9:.1f} s behind, limit {CATCH_UP_NS * 1e-9:g} s: "
                "the estimator reinitialises"
            )
            self.reset()
            return now_ns, False
        if self.timing.policy == "predict" and now_ns >= next_ns + STEP_NS:
            return next_ns, True  # one by one, so that each is out as soon as it can be
        return now_ns, self.timing.policy != "predict"  # an input covers several

    def _sleep(self) -> None:
        if self._stopping or self._wake.is_set():
            return
        wait_ns = self._gathering_ns() or IDLE_NS
        due_ns = self._next_due_ns()
        if due_ns is not None and self._wall:
            wait_ns = min(due_ns - self._begin_ns(), IDLE_NS)
            if wait_ns <= 0 and self._starved:
                wait_ns = RETRY_NS  # do not spin
        prefetch_ns = self._prefetch_ns()
        if prefetch_ns is not None:
            wait_ns = min(wait_ns, prefetch_ns - self._now_ns())
        if wait_ns > 0:
            self._wake.wait(wait_ns * 1e-9)

    def _next_due_ns(self) -> int | None:
        """When the next step falls due at the latest; None when only a message can make one due."""
        if self.estimator.t0_ns is None or self._last is None:
            return None
        timeout_ns = 0 if self.timing.policy == "predict" else self.timing.input_timeout_ns
        return self._last[1] + STEP_NS + timeout_ns

    def _collect(self) -> None:
        now = time.monotonic_ns()
        if now < self._next_collection_ns:
            return
        due_ns = self._next_due_ns()
        tight = self._wall and due_ns is not None and due_ns - self._begin_ns() < COLLECT_SLACK_NS
        if tight and now < self._next_collection_ns + COLLECT_NS:
            return  # a longer pause may come, but do not wait for it for ever
        gc.collect()
        self._next_collection_ns = now + COLLECT_NS
