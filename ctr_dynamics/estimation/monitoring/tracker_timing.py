"""When measurements show the robot: on time, late by a delay, newer than their stamps, or through a slow response.

All are compared with the same open-loop run. What explains the measurements best is followed; a delay that fits by chance does not come before a
response that fits better. While none is sure, the tracker is not fused.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.expected_tracker import ExpectedTracker, response_of
from ctr_dynamics.estimation.monitoring.delay_search import CLOCK_BEHIND, DelaySearch
from ctr_dynamics.estimation.monitoring.response_search import ResponseSearch, through
from ctr_dynamics.sensing import TrackerModel

Floats = NDArray[np.float64]
NONE_OF_THEM = math.inf  # a delay that is not tried: what the filter counts on is a response instead


class Found(NamedTuple):
    """Another ``delay`` beyond the nominal one or another ``response``, s, and its ``deviation``; None where that stays as it is.

    A delay in place of a response that was followed comes with the response of the robot file.
    """

    delay: float | None
    response: float | None
    deviation: float


class TrackerTiming:
    """Evidence for every delay and response of the tracker against that of the filter.

    Args:
        noise: m per axis, deviation of a measured position.
        change_s: mean time between two changes of the unknown force. The filter may have met one with every measurement.
        length: m, of the robot outside the base plate at most. registered: m per axis, tolerance of the registration at the tip.
        file: tracker by the robot file.

    Attributes:
        late, behind: delays beside the response that the filter counts on. response: responses without a delay.
        instead: delays in place of a response that was found; None where none is.
    """

    def __init__(
        self, noise: float, change_s: float, length: float, registered: float, file: TrackerModel
    ) -> None:
        self._moves, self._file = (noise, change_s, length, registered), file
        self.instead: DelaySearch | None = None
        self.late, self.behind = DelaySearch(*self._moves), DelaySearch(*self._moves, CLOCK_BEHIND)
        self.response = ResponseSearch(*self._moves)

    @property
    def reach_s(self) -> float:
        """How far into the past of the open-loop run the searches look at most, s."""
        return float(self.late.delays[-1] - self.behind.delays[0]) + self.response.reach_s

    @property
    def _all(self) -> list[DelaySearch]:
        return [self.late, self.behind, self.response, *([self.instead] if self.instead else [])]

    def clear(self) -> None:
        """Forget all measurements."""
        for search in self._all:
            search.clear()

    def add(
        self, stamp_ns: int, time_s: float, position: Floats, tips: tuple[Floats, Floats], predictive: tuple[float, float],
        expected: ExpectedTracker, delay: float,
    ) -> None:  # fmt: skip
        """Take in a measured tip that the filter has met.

        Args:
            stamp_ns: of its header. time_s: the newest time that it shows with the nominal delay, s from the first step.
            position: (3,) m, base axes.
            tips: stamps (k,) s and positions (k, 3) m of the open-loop run.
            predictive: logarithms of the densities that the filter predicted; see :class:`~ctr_dynamics.estimation.filter.filter_records.Update`.
            expected, delay: the tracker and its delay beyond the nominal one (s), with which the filter has met it.
        """
        self.response.add(stamp_ns, time_s, position, *tips, predictive, expected.response)
        if self.instead:
            self.instead.add(
                stamp_ns, time_s, position, *through(self._file, *tips), predictive, NONE_OF_THEM
            )
        seen = through(expected.model, *tips)
        for search in (self.late, self.behind):
            search.add(stamp_ns, time_s, position, *seen, predictive, delay)

    def other(self, expected: ExpectedTracker, delay: float) -> float:
        """Probability of something else than the filter counts on."""
        instead = self.instead.belief(NONE_OF_THEM).late if self.instead else 0.0
        response = self.response.belief(expected.response)
        return max(self.late.belief(delay).late, self.behind.belief(delay).late, response.late, instead)

    def changed(self, delay: float) -> float:
        """Probability of another delay than ``delay`` (s), beside the response that the filter counts on."""
        return max(self.late.belief(delay).late, self.behind.belief(delay).late)

    def found(self, expected: ExpectedTracker, delay: float) -> Found | None:
        """What is believed instead of the ``expected`` tracker with the estimated ``delay`` (s); None where nothing is."""
        if self.instead and not self.response.explains_better(self.instead):
            late = self.instead.always(NONE_OF_THEM)
            if late is not None:
                return Found(late[0], response_of(self._file), late[1])
        for search in (self.late, self.behind):
            late = search.found(delay)
            if late is not None and not self.response.explains_better(search):
                return Found(late[0], None, late[1])
        slow = self.response.found(expected.response)
        if slow is not None and all(
            self.response.explains_better(search) for search in (self.late, self.behind)
        ):
            responds_at_once = abs(slow[0]) <= self.response.options.least_s
            return Found(None, 0.0, 0.0) if responds_at_once else Found(None, *slow)
        return None

    @property
    def apart(self) -> float:
        """m between the measurements and the open-loop run with the delay or response that brings them together most."""
        return min((search.apart for search in (self.late, self.response) if search.knows), default=0.0)

    def undecided(self, expected: ExpectedTracker, delay: float) -> bool:
        """Whether the tracker has been late since the start, nobody knows yet in which way; to be asked where nothing is :meth:`found`."""
        return self.late.undecided(delay) or self.response.undecided(expected.response)

    def followed(self, found: Found) -> None:
        """The filter goes on from the open-loop run with what was ``found``."""
        if found.delay is None:
            assert found.response is not None
            gain = self.response.begin_again(found.response)
            beside = self.instead or self.late
            beside.foretells_better(gain)
            if found.response == response_of(self._file):
                self.late, self.instead = beside, None
            else:
                self.late, self.instead = DelaySearch(*self._moves), beside
            self.behind.clear()
            return
        if found.response is not None:
            assert self.instead is not None
            self.late, self.instead = self.instead, None
            self.behind.clear()
        gains = [search.begin_again(found.delay) for search in (self.late, self.behind)]
        self.response.foretells_better(max(gains))

    def begin_again(self, expected: ExpectedTracker, delay: float) -> None:
        """The filter goes on from the open-loop run with the delay and response that it has."""
        for search in (self.late, self.behind):
            search.begin_again(delay)
        gain = self.response.begin_again(expected.response)
        if self.instead:
            self.instead.foretells_better(gain)

    def on_time(self, delay: float) -> bool:
        """Whether measurements have shown that the tracker has that ``delay`` (s): nothing makes it doubtful."""
        return True

    @property
    def lacking_m(self) -> float:
        """m, deviation of the tip by vibrations that the open-loop run lacks."""
        return 0.0
