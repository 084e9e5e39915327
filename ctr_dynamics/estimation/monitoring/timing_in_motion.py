"""The tracker's timing since a start in motion, in place of all searches of :mod:`ctr_dynamics.estimation.monitoring.tracker_timing`.

Those compare measurements with an open-loop run that moves as the robot does. Here it lacks a vibration, so delays alone are looked for, beside it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.expected_tracker import ExpectedTracker
from ctr_dynamics.estimation.monitoring.moving_start import MovingStart
from ctr_dynamics.estimation.monitoring.response_search import through
from ctr_dynamics.estimation.monitoring.tracker_timing import Found

Floats = NDArray[np.float64]


class TimingInMotion:
    """What :class:`~ctr_dynamics.estimation.monitoring.tracker_timing.TrackerTiming` answers, from ``search`` alone; its arguments are those."""

    def __init__(self, search: MovingStart) -> None:
        self._search = search

    def add(
        self, stamp_ns: int, time_s: float, position: Floats, tips: tuple[Floats, Floats], predictive: tuple[float, float],
        expected: ExpectedTracker, delay: float,
    ) -> None:  # fmt: skip
        """Take in a measured tip that the filter has met."""
        seen = through(expected.model, *tips)
        self._search.add(stamp_ns, time_s, position, *seen, predictive, delay)

    def other(self, expected: ExpectedTracker, delay: float) -> float:
        """Probability of something else than the filter counts on."""
        return self.changed(delay)

    def changed(self, delay: float) -> float:
        """Probability of another delay than ``delay`` (s)."""
        return self._search.belief(delay).late

    def found(self, expected: ExpectedTracker, delay: float) -> Found | None:
        """The delay that is believed instead of ``delay`` (s); None where none is."""
        late = self._search.always(delay)
        return late and Found(late[0], None, late[1])

    @property
    def apart(self) -> float:
        """m between the measurements and the open-loop run with the delay that brings them together most."""
        return self._search.apart

    def undecided(self, expected: ExpectedTracker, delay: float) -> bool:
        """Whether the tracker is late by a time that is not known yet."""
        return self._search.undecided(delay)

    def followed(self, found: Found) -> None:
        """The filter goes on from the open-loop run with what was ``found``."""
        assert found.delay is not None
        self._search.begin_again(found.delay)

    def begin_again(self, expected: ExpectedTracker, delay: float) -> None:
        """The filter goes on from the open-loop run with the delay that it has."""
        self._search.begin_again(delay)

    def on_time(self, delay: float) -> bool:
        """Whether measurements have shown that the tracker has that ``delay`` (s)."""
        return self._search.shows(delay)

    @property
    def lacking_m(self) -> float:
        """m, deviation of the tip by the vibration that the open-loop run lacks; 0 where it has died down."""
        return self._search.vibrates_m
