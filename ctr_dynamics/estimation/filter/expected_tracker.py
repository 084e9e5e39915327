"""What the filter counts on of the tracker: what the robot file says, until measurements show another delay or another response."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.sensing import TrackerModel
from ctr_dynamics.sensing.tracker import DELAY

Floats = NDArray[np.float64]
REFINED_S = 0.0045  # by which a response that was found may be refined: it stays of its kind, as less than 5 ms is none


def response_of(tracker: TrackerModel) -> float:
    """s, the response of ``tracker``: the mean age of what it shows. Negative for a mean over a window, positive for a low-pass filter."""
    return tracker.smoothing if tracker.smoothing else -0.5 * tracker.averaging


def averaging_and_smoothing(response: float) -> tuple[float, float]:
    """s, window of the mean and time constant of the low-pass filter of that ``response`` (s)."""
    return max(-2.0 * response, 0.0), max(response, 0.0)


class ExpectedTracker:
    """A tracker and its timing, as the filter begins with it.

    Args:
        model: by the robot file.

    Attributes:
        model: with the response that is known now. slower: the tracker whose response is slower by its deviation; None where nothing was found.
        delay: s, expected beyond the nominal one; delay_sigma: s, its deviation.
        jitter: s, by which stamps are found to scatter beyond what is stated of them.
    """

    def __init__(self, model: TrackerModel) -> None:
        self.model = model
        self.slower: TrackerModel | None = None
        self.delay, self.delay_sigma, self.jitter = 0.0, float(model.state_sigma[DELAY]), 0.0
        self._found, self._oldest = response_of(model), model.window[-1][0]

    @property
    def reach_s(self) -> float:
        """How much older than its stamp the oldest tip is that a measurement may show, s. A response that is refined does not change it."""
        return max(0.0, self.model.delay) + max(0.0, self.delay) + self._oldest

    @property
    def age(self) -> float:
        """How much older than its stamp a measurement is in the mean, s."""
        return self.model.age + self.delay

    def scatter(self, stamp_error_s: float) -> float:
        """s, deviation of a stamp of which ``stamp_error_s`` is stated, 1-sigma."""
        return math.hypot(self.jitter, stamp_error_s)

    def late_by(self, delay: float, sigma: float) -> None:
        """Another ``delay`` beyond the nominal one and its deviation ``sigma``, both s."""
        self.delay, self.delay_sigma = delay, max(sigma, float(self.model.state_sigma[DELAY]))

    @property
    def response(self) -> float:
        """s, see :func:`response_of`."""
        return response_of(self.model)

    def responds(self, response: float, sigma: float) -> None:
        """Another ``response`` and its deviation ``sigma``, both s; sigma is 0 where the tracker does not respond late any more."""
        self._found = response
        self._set(response, sigma)
        slowest = response + math.copysign(REFINED_S + max(sigma, REFINED_S), response) if sigma else response
        self._oldest = self._with(slowest).window[-1][0]

    def refine(self, response: float, sigma: float) -> None:
        """The same kind of response, better known, close to what was found."""
        self._set(min(max(response, self._found - REFINED_S), self._found + REFINED_S), min(sigma, REFINED_S))

    def _set(self, response: float, sigma: float) -> None:
        self.model = self._with(response)
        self.slower = self._with(response + math.copysign(sigma, response)) if sigma else None

    def _with(self, response: float) -> TrackerModel:
        averaging, smoothing = averaging_and_smoothing(response)
        return replace(self.model, averaging=averaging, smoothing=smoothing)

    def seen_of(self, frequency_hz: Floats) -> Floats:
        """(m,) parts of the amplitudes that vibrations of these frequencies (m,) certainly have in what the tracker shows."""
        gain = gain_at(self.model, frequency_hz)
        unsure = np.abs(gain_at(self.slower, frequency_hz) - gain) if self.slower else 0.0
        found: Floats = np.maximum(np.abs(gain) - unsure, 0.0)
        return found


def gain_at(tracker: TrackerModel, frequency_hz: Floats) -> NDArray[np.complex128]:
    """(m,) complex gain of ``tracker`` for vibrations of these frequencies (m,)."""
    ages, weights = (np.array(part) for part in zip(*tracker.window, strict=True))
    found: NDArray[np.complex128] = np.exp(-2j * np.pi * np.outer(frequency_hz, ages)) @ weights
    return found
