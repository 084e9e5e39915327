"""A tracker that responds late: it averages over some time, or its driver smooths what it sends, as many do against noise.

It shows less of a vibration than there was. The filter would take the robot to be as still. So responses compete with the filter as delays do
(:mod:`ctr_dynamics.estimation.monitoring.delay_search`), by how the open-loop run looks through them. One number tells both kinds: its size is the
mean age of what a pose shows, and it is negative for an average and positive for a low-pass filter.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.expected_tracker import averaging_and_smoothing, response_of
from ctr_dynamics.estimation.monitoring.delay_search import (
    Belief,
    DelaySearch,
    DelaySearchOptions,
    tips_at,
)
from ctr_dynamics.estimation.timeline import DT
from ctr_dynamics.sensing.tracker import SMOOTHED, TrackerModel

Floats = NDArray[np.float64]
# A mean and a low-pass filter of one age may both explain what was seen so far: the likelier one is near enough until more is seen. The first
# tenths of a second of a vibration, of which a slow tracker shows little, leave it open by a fifth. In slow motion a response is like a delay; it
# is taken for one unless it is a hundred times as likely. A tracker does not begin to smooth while it runs; joints that are suddenly wrong look so.
RESPONSES = DelaySearchOptions(
    earliest_s=0.075, longest_s=0.12, near=0.5, settles_s=0.2, prior=0.01 * DelaySearchOptions.prior, changes=False,
)  # fmt: skip
LOOKED_BACK = SMOOTHED + 1.0  # time constants
PARTS = 20  # of a step, to which the integral of a response is taken


def in_words(response: float) -> str:
    """What poses of that ``response`` (s) are."""
    averaging, smoothing = averaging_and_smoothing(response)
    if averaging:
        return f"poses are means over {1e3 * averaging:.0f} ms; switch the averaging off, or tell it by the effect tracker_averaging"
    if smoothing:
        return (
            f"poses lag as through a low-pass filter of {1e3 * smoothing:.0f} ms; switch it off: it hides vibrations. Where the tracker has none, "
            "the joint states may be commands that the motors follow late, or the latency is not known: measure it with ctr-dynamics align"
        )
    return "poses are neither averaged nor smoothed any more"


def weights_of(response: float, steps: int) -> Floats:
    """(steps,) what tips 0, 1, 2 .. steps of 3 ms ago, with straight lines between them, count in a pose of that ``response`` (s)."""
    weights = np.zeros(steps)
    window, tau = averaging_and_smoothing(response)
    if abs(response) < 0.5 * DT:
        weights[0] = 1.0
        return weights
    ages = (np.arange(PARTS * (steps - 1)) + 0.5) * DT / PARTS
    density = (ages < window).astype(float) if window else np.exp(-ages / tau)
    weights[-1] = 0.0 if window else math.exp(-(steps - 1) * DT / tau)  # and what is older
    density *= (1.0 - weights[-1]) / density.sum()
    before = ages / DT
    i = before.astype(int)
    np.add.at(weights, i, density * (1.0 - (before - i)))
    np.add.at(weights, i + 1, density * (before - i))
    return weights


class ResponseSearch(DelaySearch):
    """Evidence for every response of the tracker against that of the filter; the arguments are those of :class:`DelaySearch`.

    What that calls a delay is a response here.

    Attributes:
        reach_s: s, how far into the past the slowest looks.
    """

    def __init__(self, noise: float, change_s: float, length: float, registered: float) -> None:
        super().__init__(noise, change_s, length, registered, RESPONSES)
        steps = 1 + math.ceil(LOOKED_BACK * RESPONSES.longest_s / DT)
        self._weights = np.stack([weights_of(u, steps) for u in np.round(self.delays, 6)])
        self._ages = DT * np.arange(steps)
        self.reach_s = float(self._ages[-1])
        self._finest_s = RESPONSES.spacing_s / math.sqrt(12.0)  # what the grid leaves open

    def newest(self, time_s: float) -> float:
        """The newest time (s) of the open-loop run that a measurement of ``time_s`` may show."""
        return time_s

    def shown(self, time_s: float, stamps: Floats, tips: Floats) -> Floats | None:
        """(d, 3) m of the open-loop run, that measurements of ``time_s`` (s) show with every response; None where that is not known."""
        times = time_s - self._ages
        if len(stamps) < 2 or times[-1] < stamps[0]:
            return None
        found: Floats = self._weights @ tips_at(times, stamps, tips)
        return found

    def _judge(self, present_s: float) -> Belief:
        """As of delays, but a response that is slower than all that are tried is left as it is."""
        if self.delays[0] <= present_s <= self.delays[-1]:
            return super()._judge(present_s)
        return Belief(0.0, present_s, 0.0, 0.0)

    def found(self, present_s: float) -> tuple[float, float] | None:
        """The response that is believed instead of ``present_s``, and its deviation, s; None where there is none."""
        found = super().found(present_s)
        return found and (found[0], max(found[1], self._finest_s))

    def undecided(self, present_s: float) -> bool:
        """Whether another response is believed, which has yet to settle; to be asked where none is :meth:`found`."""
        return self.belief(present_s).late > self.options.believed

    def refined(self, present_s: float) -> tuple[float, float]:
        """The response around ``present_s`` and its deviation (s), by all measurements."""
        near = np.abs(self.delays - present_s) <= self.options.least_s
        if not (self._evidence and near.any()):
            return present_s, self.options.least_s
        values, evidence = self.delays[near], self._evidence[-1].delays[near]
        weights = np.exp(evidence - evidence.max())
        weights /= weights.sum()
        mean = float(weights @ values)
        return mean, max(math.sqrt(float(weights @ (values - mean) ** 2)), self._finest_s)


def through(tracker: TrackerModel, stamps: Floats, tips: Floats) -> tuple[Floats, Floats]:
    """Stamps (k,) s, evenly, and positions (k, 3) m of the tips as ``tracker`` shows them: those of which enough of the past is known."""
    response = response_of(tracker)
    if abs(response) < 0.5 * DT or len(stamps) < 2:
        return stamps, tips
    window, tau = averaging_and_smoothing(response)
    steps = 2 + math.ceil((window or LOOKED_BACK * tau) / DT)
    count = 1 + math.floor((stamps[-1] - stamps[0]) / DT + 1e-6)
    if count < steps:
        return stamps[:0], tips[:0]
    even = stamps[-1] - DT * np.arange(count)[::-1]  # steps that failed are missing
    weights = weights_of(response, steps)
    seen = [np.convolve(path, weights, "valid") for path in tips_at(even, stamps, tips).T]
    return even[steps - 1 :], np.stack(seen, axis=1)
