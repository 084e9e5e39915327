"""Fits to growing parts of the recordings: the way to a frequency that is a little off, and so out of phase by turns after seconds.

In: a problem, causes and a start. Out: the fit to the whole, and how much of the recordings was explained on the way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.fit_quality import is_acceptable
from ctr_dynamics.diagnosis.inference.map_fit import Fit, fit
from ctr_dynamics.effects import EffectQuantity


@dataclass
class Explained:
    """What fits to growing parts have come to.

    Attributes:
        part: of the recordings' durations that is explained at ``point``; 0 where none is. fit: to the whole, where that is explained.
    """

    part: float = 0.0
    point: dict[Key, float] = field(default_factory=dict)
    fit: Fit | None = None


def part_of(problem: Problem, part: float) -> Problem:
    """The first ``part`` of every recording."""
    return problem.until([part * m.recording.duration for m in problem.forward_models])


def explain_growing_parts(
    problem: Problem,
    causes: Sequence[EffectQuantity] = (),
    start: Mapping[Key, float] | None = None,
    *,
    first_part: float | None = None,
    limit: float = math.inf,
) -> Explained:
    """Fit ``causes`` and nuisances to more and more of the recordings, from ``start`` on, as long as fits can follow.

    A part grows by less where the next one is not explained, and again by more where it is. Where the least growth does not help, what is
    left is no matter of phases.

    Args:
        first_part: to begin with, where not that of the options. limit: cost beyond which a fit to the whole is given up.
    """
    o = problem.options.calibration
    done = Explained(point=dict(start or {}))
    reached, part, growth = 0.0, o.first_part if first_part is None else first_part, o.growth
    while growth > o.least_growth:
        whole = part >= 1.0
        own = problem if whole else part_of(problem, part)
        found = (
            fit(own, causes, done.point, polish=False, limit=limit if whole else math.inf)
            if own.size
            else None
        )
        if found is not None and is_acceptable(own, found):
            done = Explained(part, found.point, found if whole else None)
            if whole:
                return done
            reached, growth = part, min(growth**2, o.growth)
        elif own.size:
            growth = math.sqrt(growth)
        else:  # nothing is measured so early
            reached = part
        part = min(reached * growth, 1.0) if reached else 0.5 * part
    return done


def fit_growing(
    problem: Problem,
    causes: Sequence[EffectQuantity] = (),
    start: Mapping[Key, float] | None = None,
    *,
    limit: float = math.inf,
) -> Fit | None:
    """The fit to the whole recordings to which growing parts lead; None where no part is explained. Arguments: see :func:`explain_growing_parts`."""
    done = explain_growing_parts(problem, causes, start, limit=limit)
    if not causes:
        problem.explained = done.part, done.point
    if done.fit is not None or not done.part:
        return done.fit
    return fit(problem, causes, done.point, polish=False, limit=limit)
