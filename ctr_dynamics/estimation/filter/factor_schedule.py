"""When the covariance factor is propagated, and when it is reduced.

The factor changes little within one step, so it may skip steps. Process noise is added and the factor reduced some steps behind a correction:
randomness that is added just before a measurement has moved nothing yet that the measurement could show. The work is laid on steps that
have time for it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from ctr_dynamics.model.mesh import Key


@dataclass(frozen=True)
class ScheduleOptions:
    """Figures of the schedule, in steps.

    Attributes:
        fewest: between two reductions, where a correction lies between.
        most: between two reductions, without a correction. The drift and the tip force change little meanwhile.
        apart: between a correction and a reduction where measurements leave that room. Of the steps that one joint state covers none does both.
        strong: fraction of an innovation's variance. Where the tip force has more, every step is propagated and reductions come twice as often.
    """

    fewest: int = 14
    most: int = 28
    apart: int = 4
    strong: float = 0.25


class ScheduleState(NamedTuple):
    """What a checkpoint stores of a :class:`FactorSchedule`."""

    since_reduction: int
    since_correction: int
    skipped: int
    sections: Key
    reduction_due: bool


@dataclass(slots=True)
class FactorSchedule:
    """Counts steps and tells what is due.

    Attributes:
        since_reduction: steps. since_correction: steps; more than ``since_reduction`` where none has come since the last reduction.
        skipped: steps that the factor has not followed yet.
        sections: those of the last step that it has followed.
        reduction_due: whether process noise is to be added and the factor reduced before the next step.
        most_skipped: steps that the factor may skip (:mod:`ctr_dynamics.estimation.filter.rational_step`).
    """

    options: ScheduleOptions = field(default_factory=ScheduleOptions)
    since_reduction: int = 0
    since_correction: int = 1
    skipped: int = 0
    sections: Key = ((), ())
    reduction_due: bool = False
    most_skipped: int = 0

    def start(self, sections: Key) -> None:
        """Begin with a factor on ``sections`` that is reduced and follows all steps."""
        self.since_reduction, self.since_correction, self.skipped = 0, 1, 0
        self.sections, self.reduction_due = sections, False

    def plan_step(
        self, first: Key, last: Key, divided: bool, measured: bool, idle: bool, force_fraction: float
    ) -> bool:
        """Count a step; returns whether the factor is propagated over it. Whether a reduction is due is in ``reduction_due``.

        Args:
            first, last: sections in which the step begins and ends.
            divided: whether it was taken in parts.
            measured: whether a measurement is fused after it.
            idle: whether there is idle time behind it.
            force_fraction: of an innovation's variance, what the tip force had at the last measurement.
        """
        options = self.options
        self.since_reduction += 1
        self.since_correction += 1
        fewest, most = options.fewest, options.most
        strong = force_fraction > options.strong
        if strong:
            fewest, most = fewest // 2, most // 2
        corrected = self.since_correction <= self.since_reduction
        behind = corrected and (
            self.since_correction >= options.apart or self.since_reduction >= fewest + 2 * options.apart
        )
        crowded = measured or not (idle or strong)
        self.reduction_due = self.since_reduction >= (
            most + 2 * options.apart if crowded else fewest if behind else most
        )
        propagate = (
            strong
            or self.skipped >= self.most_skipped
            or measured
            or self.reduction_due
            or first != self.sections
            or divided
        )
        if propagate:
            self.skipped, self.sections = 0, last
        else:
            self.skipped += 1
        return propagate

    def checkpoint(self) -> ScheduleState:
        """What :meth:`restore` returns to."""
        return ScheduleState(
            self.since_reduction, self.since_correction, self.skipped, self.sections, self.reduction_due
        )

    def restore(self, state: ScheduleState) -> None:
        """Return to a checkpoint."""
        self.since_reduction, self.since_correction, self.skipped, self.sections, self.reduction_due = state
