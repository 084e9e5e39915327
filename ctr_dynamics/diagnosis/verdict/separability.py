"""Separability: which rivals could stand in the place of a cause, and what the bags can show at all.

In: weighed hypotheses and sensitivities. Out: causes with their probability, separation and rivals; effects that are not observable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ctr_dynamics.diagnosis.diagnosis_options import VerdictOptions
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.evidence import WeighedHypotheses
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities
from ctr_dynamics.diagnosis.inference.separation import observable_sizes, separation


@dataclass
class Cause:
    """One cause of a verdict.

    Attributes:
        probability: None where none can be given.
        candidate: None for a configuration mistake and for a cause outside the catalogue.
        separation: from the nearest rival, in whitened units; None where there is no candidate.
        rivals: effects that cannot be told from it, nearest first.
        less_plausible: effects that could stand in its place by the data, but only with a size that is less plausible before them.
    """

    candidate: Candidate | None
    effect: str
    probability: float | None
    separation: float | None = None
    rivals: list[str] = field(default_factory=list)
    less_plausible: list[str] = field(default_factory=list)

    def is_apart(self, options: VerdictOptions) -> bool:
        """Whether it is told from every rival."""
        return self.separation is None or not (self.rivals or self.separation < options.separation_fitted)


@dataclass(frozen=True)
class Observability:
    """What the bags can show: effects that they cannot, and whether they excite the robot enough for a verdict."""

    not_observable: list[str]
    excited: bool


def observability(problem: Problem, effects: list[str], sensitivities: Sensitivities) -> Observability:
    """Which of ``effects`` the bags of ``problem`` can show, by ``sensitivities`` at the re-calibrated point."""
    o = problem.options.verdict
    sizes = observable_sizes(problem, sensitivities)
    strong = sum(sizes.get(name, 0.0) >= o.strong for name in effects)
    return Observability(
        [name for name in effects if sizes.get(name, 0.0) < o.observable], strong >= o.excited * len(effects)
    )


def cause_with_rivals(
    problem: Problem,
    found: WeighedHypotheses,
    best: Hypothesis,
    candidate: Candidate,
    sensitivities: Sensitivities,
) -> Cause:
    """A cause of ``best`` with its nearest rivals: effects that could stand in its place.

    Where a rival has been fitted in its place, the difference of the costs counts; it knows what linear sensitivities do not, and how plausible
    the sizes are. Beside a discrepancy ``problem`` and ``best`` are those with it, and the evidence with it counts in place of costs.
    """
    o = problem.options.verdict
    near: dict[str, tuple[float, float]] = {}  # effect: distance and the one that is needed
    own = {m.effect for m in best.members}
    for rival in sensitivities.by_candidate:
        if rival.effect not in own:
            d = separation(problem, best.fit, (candidate,), rival, sensitivities)
            near[rival.effect] = min((d, o.separation), near.get(rival.effect, (math.inf, o.separation)))
    alike = {name for name, (d, needed) in near.items() if d < needed}
    near.update(_fitted_rivals(found, best, candidate, o))
    rivals = sorted((d, name) for name, (d, needed) in near.items() if d < needed)
    nearest = min((d for d, _ in near.values()), default=math.inf)
    by_itself = separation(problem, best.fit, (candidate,))
    return Cause(
        candidate,
        candidate.effect,
        found.probability_of(candidate.effect),
        min(nearest, by_itself),
        [name for _, name in rivals],
        sorted(alike - {name for _, name in rivals}),
    )


def _fitted_rivals(
    found: WeighedHypotheses, best: Hypothesis, candidate: Candidate, options: VerdictOptions
) -> dict[str, tuple[float, float]]:
    """Distance of every effect that was fitted in the place of ``candidate``, and the one that is needed."""
    own = {m.effect for m in best.members}
    rest = best.keys - candidate.keys
    fitted: dict[str, tuple[float, float]] = {}
    for e in found.hypotheses:
        others = [m for m in e.members if not m.keys <= rest]
        if len(others) == 1 and e.keys - others[0].keys == rest and others[0].effect not in own:
            more = e.fit.cost - best.fit.cost
            if best.discrepancy is not None and best.beside:
                if e.discrepancy is None:
                    continue
                more = 2.0 * (best.discrepancy.log_evidence - e.discrepancy.log_evidence)
            elif e.predicted is not None and best.predicted is not None:
                more += 2.0 * (best.predicted - e.predicted)
            d, needed = math.sqrt(max(more, 0.0)), options.separation_fitted
            fitted[others[0].effect] = min((d, needed), fitted.get(others[0].effect, (math.inf, needed)))
    return fitted
