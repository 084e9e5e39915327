"""Figures of the estimator that no parameter sets."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EstimatorOptions:
    """Figures of the estimator's time line; no user needs to tune them.

    Attributes:
        stability_every: steps between looks at the elastic stability, 0.1 s: a tenth of the warning time of a snap.
        modes_every: steps between refreshes of the vibration modes, 0.4 s.
        jacobian_every: steps between two of the tip's Jacobian, 0.1 s.
        longest_without_idle: steps after which idle work is done without idle time, 0.2 s.
        retry_every: steps between starts while there is no equilibrium. Looking for one in vain takes longer than a step.
        deviation_fraction: of tube 1's length: outputs with a larger deviation of the tip are invalid, where no parameter says otherwise.
        unseen_fraction: of that limit: deviation of the tip of a robot that may move when the model starts. Three of it are half the limit.
        vibrating_fraction: of tube 1's length: largest deviation of the tip of a robot that is known to vibrate. It is as large as that limit, or as
            far as measurements lie apart: with a prior that is too narrow they would be rejected.
        largest_gap: steps to catch up with at once, 3 s. Beyond, the model is reinitialised at the newest joints.
        lead_ns: what a live step takes, from waking to its messages.
        backwards: joint states in a row whose time ran backwards, after which the clock was set back or another bag begins.
    """

    stability_every: int = 33
    modes_every: int = 132
    jacobian_every: int = 33
    longest_without_idle: int = 66
    retry_every: int = 33
    deviation_fraction: float = 0.05
    unseen_fraction: float = 1.0 / 6.0
    vibrating_fraction: float = 0.2
    largest_gap: int = 1000
    lead_ns: int = 1_000_000
    backwards: int = 3
