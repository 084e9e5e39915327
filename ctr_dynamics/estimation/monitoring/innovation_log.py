"""Innovations of processed measurements: each is counted and published once, however often its measurement is fused again."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.monitoring.measurement_record import MeasurementRecord
from ctr_dynamics.estimation.step_output import Innovation

REMEMBERED_NS = 10_000_000_000  # of reported stamps: corrections reach back over a window of 2 s and a gap of the joints of 3 s at most


class Mark(NamedTuple):
    """A place in the log: how many innovations waited there, and the record of measurements."""

    waiting: int
    record: MeasurementRecord


class InnovationLog:
    """Innovations from the update to the next output.

    Args:
        health: counts them, and watches their consistency.
    """

    def __init__(self, health: Health) -> None:
        self._health = health
        self._waiting: list[Innovation] = []  # for the next output
        self._reported: deque[int] = deque()  # stamps, ns
        self._unjudged: deque[Innovation] = deque()  # by the consistency monitor
        self._newest_ns = self._published_ns = 0  # newest stamp of all, and of those before the last clearing

    def clear(self) -> None:
        """Forget everything; what has been counted stays."""
        self._published_ns = self._newest_ns
        self._waiting.clear()
        self._reported.clear()
        self._unjudged.clear()

    def add(self, innovation: Innovation) -> None:
        """Take in the innovation of a measurement, fused or not."""
        self._newest_ns = max(self._newest_ns, innovation.stamp_ns)
        self._count(innovation)
        self._waiting.append(innovation)

    def take(self) -> list[Innovation]:
        """The innovations for the next output."""
        waiting, self._waiting = self._waiting, []
        self._reported.extend(innovation.stamp_ns for innovation in waiting)
        while self._reported and self._reported[0] < self._newest_ns - REMEMBERED_NS:
            self._reported.popleft()
        self._unjudged.extend(waiting)
        for innovation in waiting:
            if not innovation.dof:
                text = (
                    f"the pose of stamp {innovation.stamp_ns} ns could not be compared: {innovation.reason}"
                )
                self._health.note("tracker", "not compared", text)
        return waiting

    def judge(self) -> None:
        """Hand what has been published to the consistency monitor."""
        while self._unjudged:
            self._health.consistency.add(self._unjudged.popleft())

    def pass_over(self) -> None:
        """What has been published is not judged: that the model does not know the robot's motion yet is no misfit."""
        self._unjudged.clear()

    # -- corrections --

    def mark(self) -> Mark:
        """The present place, for :meth:`discard` or :meth:`keep_new`."""
        return Mark(len(self._waiting), self._health.measurements.copy())

    def discard(self, mark: Mark) -> None:
        """Take back what has come since ``mark``: those measurements will be fused again."""
        self._recount(mark, [])

    def keep_new(self, mark: Mark) -> None:
        """Of what has come since ``mark``, take back the innovations of measurements that have been counted before."""
        again = self._waiting[mark.waiting :]
        if again:
            counted = {*self._reported, *(i.stamp_ns for i in self._waiting[: mark.waiting])}
            self._recount(mark, [i for i in again if i.stamp_ns not in counted])

    def _recount(self, mark: Mark, new: Sequence[Innovation]) -> None:
        del self._waiting[mark.waiting :]
        self._health.measurements = mark.record.copy()
        for innovation in new:
            self._count(innovation)
        self._waiting.extend(new)

    def _count(self, innovation: Innovation) -> None:
        again = innovation.stamp_ns <= self._published_ns
        self._health.measurements.add(innovation, self._health.fusing, again)
