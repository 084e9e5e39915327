"""A tracker that has been moved, or is back from where it was: what the filter needs some time to find.

Meanwhile it foretells badly, and whatever fits these few measurements by chance would seem right for long: another delay, or a frame that moves. So
the open-loop run with a new constant departure competes from the move on, and the filter may go on from it. A forecaster that may change between two
experts at a constant rate is that of Herbster and Warmuth (1998).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.adapted_variances import AdaptationOptions
from ctr_dynamics.estimation.monitoring.densities import log_changed, log_density
from ctr_dynamics.estimation.monitoring.prequential_evidence import DRIFT_S

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MovedTrackerOptions:
    """How moves are looked for.

    Attributes:
        sound_s: s, mean time after which a tracker is moved. found_s: mean time in which the filter finds that.
        drift_s: s, in which the open-loop run goes astray by about the tracker's noise.
    """

    sound_s: float = AdaptationOptions.sound_s
    found_s: float = AdaptationOptions.fault_s
    drift_s: float = DRIFT_S


class Moved(NamedTuple):
    """What measurements say of a tracker that has been moved.

    Attributes:
        level: (3,) m, how far they lie from the open-loop run since then. variance: m^2, of it per axis.
        evidence: logarithm, at the time of the move that speaks most for it.
    """

    level: Floats
    variance: float
    evidence: float


class MovedTracker:
    """Evidence for a tracker that has been moved.

    Args:
        noise: m per axis, deviation of a measured position.
        length: m, of the robot outside the base plate at most. registered: m per axis, tolerance of the registration at the tip.
        options: how moves are looked for.
    """

    def __init__(
        self, noise: float, length: float, registered: float, options: MovedTrackerOptions | None = None
    ) -> None:
        self.options = options or MovedTrackerOptions()
        self._noise = noise**2
        self._places = length**2 + noise**2, registered**2 + noise**2  # anywhere, and where it is registered

    def begin(self, residual: Floats) -> Moved:
        """What the first measurement says, which lies ``residual`` (3,) m from the open-loop tip."""
        return Moved(residual, self._noise, -math.inf)

    def add(
        self, last: Moved, residual: Floats, elapsed: float, decay: float, before: float, now: float
    ) -> Moved:
        """What the measurements say with another one, ``elapsed`` s after the ``last``.

        Args:
            residual: (3,) m, measured minus open-loop tip.
            decay: part of the evidence so far that counts.
            before: logarithm of the evidence of a tracker that had not been moved yet, as it counts now.
            now: that of the filter, with this measurement.
        """
        # 1. It has been moved before.
        walked = last.variance + self._noise * elapsed / self.options.drift_s
        stays = residual - last.level
        on = decay * last.evidence + log_density(stays @ stays, walked + self._noise, self._noise)
        # 2. Or since the last one; or it is where it was, and a fault that is over has led the filter astray.
        moves = log_changed(elapsed, self.options.sound_s)
        there = [log_density(residual @ residual, square, self._noise) for square in self._places]
        begins = moves + max(before + float(np.logaddexp(*there)) - math.log(len(there)), now)
        if begins > on:
            return Moved(residual, self._noise, begins)
        gain = walked / (walked + self._noise)
        return Moved(last.level + gain * stays, walked * (1.0 - gain), on)

    def filter_goes_on(self, filter_before: float, fault: float, elapsed: float, decay: float) -> float:
        """Logarithm of the evidence of the filter before a measurement, ``elapsed`` s after the last, if it may have got over a fault since then.

        ``filter_before``: up to the last one; ``fault``: likewise, of the fault of the tracker.
        """
        over = log_changed(elapsed, self.options.found_s)
        return float(np.logaddexp(decay * filter_before, decay * fault + over))
