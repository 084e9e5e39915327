"""Evidence: from fitted hypotheses to probabilities.

In: hypotheses, and bags that were not fitted, if any. Out: the hypotheses in order of their posterior, with probabilities. Laplace evidence
with priors on causes and sizes, tempered against overconfidence, plus the log likelihood of what a hypothesis predicts of the bags that were
not fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from joblib import delayed
from numpy.typing import NDArray
from scipy.special import logsumexp

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions, EvidenceOptions
from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.diagnosis.inference.candidates import Candidate, log_prior
from ctr_dynamics.diagnosis.inference.discrepancy import (
    CorrelatedNoise,
    discrepancy_of,
    every_process,
    refitted,
)
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.gaussian_posterior import posterior
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis, fit_exactly
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.inference.screening import Screened
from ctr_dynamics.diagnosis.inference.sensitivities import Sensitivities
from ctr_dynamics.diagnosis.inference.separation import separation
from ctr_dynamics.diagnosis.inference.tolerance_factors import credible, log_gain, under_factors, with_factor
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.effects import EFFECTS

Floats = NDArray[np.float64]
IMPOSSIBLE = -1e9  # log likelihood of bags that a hypothesis cannot simulate


@dataclass
class WeighedHypotheses:
    """Outcome of a hypothesis search.

    Attributes:
        hypotheses: all that were fitted, likeliest first; the one without causes is among them.
        probabilities: of each.
        no_cause: the hypothesis without causes.
        sensitivities: at the re-calibrated point. screened: what candidates gain there by the linear estimate.
        pool: all candidates, with the contact plane that was found.
        at_best: sensitivities at the likeliest hypothesis; None where there was no need of them.
        plane_sought: whether a contact plane has been looked for.
    """

    hypotheses: list[Hypothesis]
    probabilities: Floats
    no_cause: Hypothesis
    sensitivities: Sensitivities
    screened: list[Screened]
    pool: list[Candidate]
    at_best: Sensitivities | None = None
    plane_sought: bool = False

    @property
    def best(self) -> Hypothesis:
        """The likeliest."""
        return self.hypotheses[0]

    def pooled(self, problem: Problem, needed: Hypothesis) -> list[tuple[tuple[str, ...], float]]:
        """All sets of effects with their probabilities, likeliest first.

        Args:
            needed: whose causes, if it has any, stand for those of every hypothesis that has more of them without need.
        """
        least = needed_gain(problem, needed)
        total: dict[tuple[str, ...], float] = {}
        for e, p in zip(self.hypotheses, self.probabilities, strict=True):
            without_need = needed.members and needed.keys < e.keys and e.gain_over(needed) < least
            effects = needed.effects if without_need else e.effects
            total[effects] = total.get(effects, 0.0) + float(p)
        return sorted(total.items(), key=lambda item: -item[1])

    def probability_of(self, effect: str) -> float:
        """Sum of the probabilities of all hypotheses that hold ``effect``."""
        every = zip(self.hypotheses, self.probabilities, strict=True)
        return min(float(sum(p for e, p in every if effect in e.effects)), 1.0)


def likeliest_sets(
    pooled: Sequence[tuple[tuple[str, ...], float]], options: EvidenceOptions
) -> list[tuple[tuple[str, ...], float]]:
    """Of sets with their probabilities the likeliest, as few as hold the probability of the options."""
    out, held = [], 0.0
    for effects, p in sorted(pooled, key=lambda item: -item[1]):
        out.append((effects, p))
        held += p
        if held >= options.set_probability:
            break
    return out


def needed_gain(problem: Problem, fewer: Hypothesis) -> float:
    """Log posterior that further causes must gain over those of ``fewer``.

    What the laws of those may miss, further causes could collect: squares of a part ``form_error`` of the separation of each.
    """
    missed = sum(
        (error * separation(problem, fewer.fit, (m,))) ** 2
        for m in fewer.members
        if (error := EFFECTS[m.effect].form_error) > 0.0
    )
    return max(problem.options.verdict.needed_gain, 0.5 * missed)


def weigh(found: list[Hypothesis], pool: Sequence[Candidate], options: DiagnosisOptions) -> None:
    """Sort by log posterior; the better of two fits of the same set stays."""
    best: dict[frozenset[Key], Hypothesis] = {}
    for e, evidence in zip(found, _evidence(found), strict=True):
        prior = log_prior(e.members, pool, options.prior, e.fit.point)
        e.score, e.fitted_score = evidence + prior, e.fit.log_evidence + prior
        if e.keys not in best or best[e.keys].score < e.score:
            best[e.keys] = e
    found[:] = sorted(best.values(), key=lambda e: -e.score)


def probabilities(found: Sequence[Hypothesis], problem: Problem) -> Floats:
    """Of each hypothesis, likeliest first: softmax of the tempered score, with the noise that the best one leaves."""
    inflation = max(1.0, found[0].fit.chi2 / problem.size)
    evidence = np.array(_evidence(found))
    prior = np.array([e.score for e in found]) - evidence
    scores = evidence / (problem.options.evidence.temperature * inflation) + prior
    weights = np.exp(scores - scores.max())
    return weights / weights.sum()


def _evidence(found: Sequence[Hypothesis]) -> list[float]:
    """Log evidence of each with that of its prediction; a hypothesis that was not asked predicts no better than the worst."""
    worst = min((e.predicted for e in found if e.predicted is not None), default=0.0)
    return [e.fit.log_evidence + (worst if e.predicted is None else e.predicted) for e in found]


@dataclass(frozen=True)
class WithDiscrepancy:
    """Probabilities where a discrepancy competes with causes; together they are one.

    Attributes:
        alone: of sets of causes that explain all, likeliest first. beside: of sets with a discrepancy beside them; () is one alone.
        leading: the likeliest hypothesis of all, with a discrepancy or without.
    """

    alone: list[tuple[tuple[str, ...], float]]
    beside: list[tuple[tuple[str, ...], float]]
    leading: Hypothesis

    def of(self, effects: tuple[str, ...]) -> float:
        """Sum for all sets that hold ``effects``, with a discrepancy or without."""
        return min(sum(p for names, p in (*self.alone, *self.beside) if set(effects) <= set(names)), 1.0)

    @property
    def discrepancy(self) -> float:
        """Of a discrepancy, whatever is beside it."""
        return min(sum(p for _, p in self.beside), 1.0)


def weigh_discrepancy(found: WeighedHypotheses, problem: Problem, context: RunContext) -> WithDiscrepancy:
    """Let a discrepancy of unknown size compete with the likeliest hypotheses, by itself and beside each of them.

    The likeliest hypothesis and that without causes are asked with every process, the others with those that came out. Hypotheses of one cause
    are among them: beside a discrepancy fewer causes may do. Only the fitted bags choose: those that were not fitted are left to judge.
    """
    o = problem.options
    first = [found.best] if found.best is found.no_cause else [found.best, found.no_cause]
    rest = [e for e in found.hypotheses if e not in first]
    others = [e for i, e in enumerate(rest) if i < o.discrepancy.hypotheses or len(e.members) == 1]
    processes = every_process(problem, context)

    def ask(those: Sequence[Hypothesis], models: Sequence[CorrelatedNoise]) -> None:
        answers = context.run(delayed(discrepancy_of)(problem, e.fit, models, len(processes)) for e in those)
        for e, answer in zip(those, answers, strict=True):
            e.discrepancy = answer

    ask(first, processes)
    ask(others, list(dict.fromkeys(e.discrepancy.process for e in first if e.discrepancy is not None)))
    asked = [*first, *others]
    priors = np.array([log_prior(e.members, found.pool, o.prior, e.fit.point) for e in asked])
    count = len(asked)
    counts = np.where(take_away(asked, o.discrepancy.dominant), 0.0, -np.inf)
    _refit_likeliest(asked, priors + counts, problem, len(processes), context)
    outside, temperature = o.prior.discrepancy, o.evidence.temperature
    plain = np.array([e.fitted_score for e in asked]) - priors
    scores = np.concatenate(
        [
            plain / temperature + priors + np.log(1.0 - outside),
            _beside(asked) / temperature + priors + counts + np.log(outside),
        ]
    )
    weights = np.exp(scores - scores.max())
    weights /= weights.sum()
    pooled: list[dict[tuple[str, ...], float]] = [{}, {}]
    for i, p in enumerate(weights):
        part, effects = pooled[i // count], asked[i % count].effects
        part[effects] = part.get(effects, 0.0) + float(p)
    alone, with_it = (sorted(part.items(), key=lambda item: -item[1]) for part in pooled)
    return WithDiscrepancy(alone, with_it, asked[int(np.argmax(weights)) % count])


def take_away(asked: Sequence[Hypothesis], dominant: float) -> NDArray[np.bool_]:
    """Which of ``asked`` leave less than the rest of the fraction ``dominant`` of what each smaller set of their causes leaves.

    Beside a discrepancy a further cause may gain much evidence by the finest details of the model's own error, whose covariance nobody knows. It
    counts where it takes away what remains.
    """
    left = [np.nan if e.discrepancy is None else e.discrepancy.rms_m**2 for e in asked]
    return np.array(
        [
            not any(
                part.keys < e.keys and mine > (1.0 - dominant) * its
                for part, its in zip(asked, left, strict=True)
            )
            for e, mine in zip(asked, left, strict=True)
        ]
    )


def _beside(asked: Sequence[Hypothesis]) -> Floats:
    """Log evidence of each with a discrepancy beside it."""
    return np.array([-np.inf if e.discrepancy is None else e.discrepancy.log_evidence for e in asked])


def _refit_likeliest(
    asked: Sequence[Hypothesis], priors: Floats, problem: Problem, among: int, context: RunContext
) -> None:
    """Fit the likeliest again with their discrepancy.

    A fit to white noise that leaves much more follows the model's own error, and the evidence beside it is that of a linear model far from the
    place where both are likeliest. What leaves about the noise is at its best already.
    """
    enough = problem.options.search.acceptable * problem.size
    done = {i for i, e in enumerate(asked) if e.fit.chi2 <= enough}
    for _ in range(problem.options.discrepancy.refitted):
        scores = np.where(np.isin(np.arange(len(asked)), list(done)), -np.inf, _beside(asked) + priors)
        i = int(np.argmax(scores))
        before = asked[i].discrepancy
        if before is None or not np.isfinite(scores[i]) or context.out_of_time:
            return
        asked[i].discrepancy = refitted(problem, before, among)
        done.add(i)


def weigh_by_prediction(
    found: WeighedHypotheses, problem: Problem, held_out: Problem, context: RunContext
) -> None:
    """Let the likeliest hypotheses predict ``held_out``, recordings that were not fitted, and weigh them by both.

    What imitates a cause in one motion does not in another. Hypotheses that are farther behind than a prediction down to the noise would
    make good are not asked.
    """
    o, contenders = problem.options.evidence, problem.options.search.contenders
    every, first = found.hypotheses, found.best

    def ask(those: Sequence[Hypothesis]) -> None:
        new = [e for e in those if e.predicted is None]
        answers = context.run(delayed(log_prediction)(held_out, e.fit, problem.numerics) for e in new)
        for e, answer in zip(new, answers, strict=True):
            e.predicted = answer

    for turn in range(contenders + 1):  # an exact fit of one may put another first
        best = every[0]
        ask([best, found.no_cause])
        assert best.predicted is not None
        room = o.outvoted + max(0.0, -0.5 * held_out.size - best.predicted)
        ask([e for e in every[: o.predictions] if e.members and e.fitted_score > best.fitted_score - room])
        weigh(every, found.pool, problem.options)
        if not every[0].members or every[0].exact or turn == contenders:
            break
        fit_exactly(problem, every[0])
        every[0].predicted = None
    if every[0] is not first:
        found.at_best = None
    found.probabilities = probabilities(every, problem)


def log_prediction(held_out: Problem, result: Fit, numerics: Floats) -> float:
    """Log likelihood of ``held_out``, up to a constant, with the posterior of ``result``: what fitted bags leave open is no wrong prediction.

    Args:
        numerics: (m, d) of the problem that was fitted.
    """
    found = held_out.linearise(result.point, result.active)
    if found is None:
        return IMPOSSIBLE
    residual, columns = found
    departure = result.values - np.array([q.off for q in result.active])
    causes = {q.key for q in result.causes}
    factors = under_factors(
        result.active,
        causes,
        result.residual,
        result.columns,
        departure,
        numerics,
        held_out.options,
        relative_to=result.tolerance_factor,
    )
    own = with_factor(factors, result.tolerance_factor)
    factors = credible(factors, own)
    logs = []
    for one in factors:  # a limit of the fit, where it met one, holds for every factor
        size, axes = np.linalg.eigh(one.covariance)
        free = columns @ (axes * np.sqrt(np.maximum(size, 0.0)))  # by coefficients of unit deviation
        there = residual - columns @ (one.departure - own.departure)
        _, _, evidence = posterior(there, free, np.zeros(len(size)), np.ones(len(size)), held_out.numerics)
        logs.append(one.log_weight + evidence)
    return float(logsumexp(logs)) - log_gain(factors)
