"""Sensitivities: what every candidate would do to the residual at one point.

In: a problem, a point and the candidates. Out: the residual there, and the columns of nuisances and candidates. A candidate whose derivative
at zero says little (backlash, clearance, contact) is tried at finite sizes; its sensitivity is the secant to the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from joblib import delayed
from numpy.typing import NDArray

from ctr_dynamics.chi_square import quantile
from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.effects import EFFECTS, EffectQuantity

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Trial:
    """A candidate at a finite size: coordinates beside the base point, and the residual (m,) there, as longer steps in time show it."""

    shift: dict[Key, float]
    residual: Floats


@dataclass
class Series:
    """Finite sizes of a candidate, in scales, that grow from zero on, all of one sign.

    Attributes:
        beside: coordinates of nuisances that are set there. squares: of the residual at zero and at each size.
    """

    candidate: Candidate
    beside: Mapping[Key, float]
    sizes: list[float]
    squares: list[float]

    def shift(self, size: float) -> dict[Key, float]:
        """Coordinates that differ from those of the base point."""
        q = self.candidate.quantities[0]
        return {**self.beside, **dict(self.candidate.start), q.key: q.off + size * q.scale}

    def goes_on(self, factor: float, least: float) -> bool:
        """Whether the last size leaves less than all before it by ``least``; one that is larger by ``factor`` is then appended."""
        q, size = self.candidate.quantities[0], self.sizes[-1] * factor
        falls = math.isfinite(self.squares[-1]) and self.squares[-1] < min(self.squares[:-1]) - least
        if falls and q.low <= q.off + size * q.scale <= q.high:
            self.sizes.append(size)
            return True
        return False


@dataclass
class Sensitivities:
    """Residual and columns of every candidate at one point.

    Attributes:
        residual: (m,) whitened.
        columns: (m,) of every quantity that has a derivative there.
        by_candidate: (m, quantities) of each candidate.
        trials: of candidates that were tried at finite sizes.
    """

    point: dict[Key, float]
    residual: Floats
    columns: dict[Key, Floats]
    by_candidate: dict[Candidate, Floats] = field(default_factory=dict)
    trials: dict[Candidate, list[Trial]] = field(default_factory=dict)

    def carried_to(self, fit: Fit) -> Sensitivities:
        """The same at a fit not far away: its residual and columns, and the candidates' sensitivities of here."""
        return Sensitivities(fit.point, fit.residual, {**self.columns, **fit.by_key}, self.by_candidate)

    def mapped(self, to: Callable[[Floats], Floats]) -> Sensitivities:
        """Residual and columns through a linear map ``to``, from one whitening to another; without the trials."""
        return Sensitivities(
            self.point,
            to(self.residual),
            {key: to(column) for key, column in self.columns.items()},
            {c: to(columns) for c, columns in self.by_candidate.items()},
        )

    def columns_of(self, c: Candidate) -> dict[Key, Floats]:
        """Columns of a candidate's quantities; empty where it has none."""
        own = self.by_candidate.get(c)
        return {} if own is None else {q.key: own[:, i] for i, q in enumerate(c.quantities)}


def sensitivities_at(
    problem: Problem,
    point: Mapping[Key, float],
    pool: Sequence[Candidate],
    context: RunContext,
    *,
    known: Mapping[Key, Floats] | None = None,
    again: Fit | None = None,
) -> Sensitivities | None:
    """Columns of nuisances and all candidates at ``point``.

    Args:
        known: columns of nuisances there, where they have been computed already.
        again: the fit whose ``point`` it is, when sensitivities are only compared with it: its columns serve, and one finite size of
            each candidate that needs such.
    Returns:
        None where the model cannot be simulated at ``point``.
    """
    plain, shaped, finite = _by_kind(problem, pool)
    known = again.by_key if again else dict(known or {})
    wanted = tuple(q for key, q in plain.items() if key not in known)
    groups = _compatible(shaped)
    at, members = groups[0] if groups else ({}, [])
    first = tuple(q for c in members for q in c.quantities)

    def columns(
        at: Mapping[Key, float], wanted: Sequence[EffectQuantity], more: Sequence[EffectQuantity] = ()
    ) -> tuple[Floats, Floats] | None:
        found = problem.linearise({**at, **point}, (*wanted, *more))
        return columns({}, wanted) if found is None and more else found

    # together: what has no room in one simulation has it in another
    jobs = [delayed(columns)(at, wanted, first)]
    jobs += [delayed(columns)(at, tuple(q for c in group for q in c.quantities)) for at, group in groups[1:]]
    done = context.run(jobs)
    if done[0] is None:
        return None
    residual, computed = again.residual if again else done[0][0], done[0][1]
    result = Sensitivities(
        dict(point), residual, {**known, **{q.key: computed[:, i] for i, q in enumerate(wanted)}}
    )
    outcomes = [(members, computed[:, len(wanted) :])] if computed.shape[1] > len(wanted) else []
    outcomes += [(m, o[1]) for (_, m), o in zip(groups[1:], done[1:], strict=True) if o is not None]
    for group, found in outcomes:
        last = 0
        for c in group:
            result.by_candidate[c] = found[:, last : last + len(c.quantities)]
            last += len(c.quantities)
    for c in pool:
        if c not in shaped and c not in finite:
            result.by_candidate[c] = np.stack([result.columns[q.key] for q in c.quantities], axis=1)
    sizes = {c: _finite_sizes(c)[:1] if again else _finite_sizes(c) for c in finite}
    result.trials = _tried(problem, result, sizes, context, compared=again is not None)
    _set_secants(result, finite)
    return result


def with_large_sizes(
    problem: Problem, known: Sensitivities, pool: Sequence[Candidate], context: RunContext
) -> Sensitivities:
    """``known`` with trials at large sizes, of which the derivative says little, and at finite ones where these have not been tried."""
    new = [c for c in pool if EFFECTS[c.effect].finite_sizes and c not in known.trials]
    sizes = {c: _finite_sizes(c) if c in new else EFFECTS[c.effect].large_sizes for c in pool}
    found = _tried(problem, known, sizes, context)
    trials = {c: known.trials.get(c, []) + found.get(c, []) for c in (*known.trials, *found)}
    result = replace(known, by_candidate=dict(known.by_candidate), trials=trials)
    _set_secants(result, new)
    return result


def off_nominal(problem: Problem, point: Mapping[Key, float]) -> bool:
    """Whether the nuisances imitate a cause that is missing: one has left its tolerance, or together they are farther off than is likely.

    Estimates are nearer to the robot file than true values, whose squares in tolerances follow a chi-square distribution.
    """
    o = problem.options.calibration
    off = np.array([(point.get(q.key, q.off) - q.off) / q.tolerance for q in problem.nuisances])
    likely = quantile(o.likely_together, max(len(off), 1))
    return bool(np.any(np.abs(off) > o.tolerance_limit) or float(off @ off) > likely)


def _by_kind(
    problem: Problem, pool: Sequence[Candidate]
) -> tuple[dict[Key, EffectQuantity], list[Candidate], list[Candidate]]:
    """Quantities that one linearisation of the plain model gives; candidates that need a shape or the extended model; those of finite sizes."""
    plain: dict[Key, EffectQuantity] = {q.key: q for q in problem.nuisances}
    shaped: list[Candidate] = []
    finite: list[Candidate] = []
    for c in pool:
        if EFFECTS[c.effect].finite_sizes:
            finite.append(c)
        elif c.shapes or c.quantities[0].extended:
            shaped.append(c)
        else:
            plain.update({q.key: q for q in c.quantities})
    return plain, shaped, finite


def _compatible(shaped: Sequence[Candidate]) -> list[tuple[dict[Key, float], list[Candidate]]]:
    """Candidates in groups whose shape parameters can be set at the same time: (shapes, members)."""
    groups: list[tuple[dict[Key, float], list[Candidate]]] = []
    for c in shaped:
        start = dict(c.start)
        for at, members in groups:
            if all(at.get(key, value) == value for key, value in start.items()):
                at.update(start)
                members.append(c)
                break
        else:
            groups.append((start, [c]))
    return groups


def _nuisance_places(problem: Problem, point: Mapping[Key, float]) -> list[dict[Key, float]]:
    """Coordinates of nuisances at which finite sizes are tried: as they are, and nominal ones where some imitate the cause."""
    places: list[dict[Key, float]] = [{}]
    if off_nominal(problem, point):
        places.append(problem.nominal)
    return places


def _finite_sizes(c: Candidate) -> tuple[float, ...]:
    """Finite sizes, in scales, at which a candidate without a useful derivative is tried."""
    q = c.quantities[0]
    return tuple((size - q.off) / q.scale for size in c.sizes[:1]) or EFFECTS[c.effect].finite_sizes


def _tried(
    problem: Problem,
    known: Sensitivities,
    sizes: Mapping[Candidate, Sequence[float]],
    context: RunContext,
    *,
    compared: bool = False,
) -> dict[Candidate, list[Trial]]:
    """Trials at ``sizes``, in scales, by longer steps in time. As long as the last of a series leaves least, the series goes on.

    Nuisances are as they are and, where they imitate a cause, nominal as well. ``compared``: trials are only compared with a fit, so that
    these sizes alone count, with its steps and nuisances.
    """
    o = problem.options.screening
    model = problem if compared else problem.with_least_step(o.finite_size_dt_s)
    places = [{}] if compared else _nuisance_places(problem, known.point)
    at_zero = (
        [known.residual]
        if compared
        else context.run([delayed(model.residual)({**known.point, **beside}) for beside in places])
    )
    base, trials = at_zero[0], dict[Candidate, list[Trial]]()
    if base is None:
        return trials
    series = [
        Series(c, beside, own, [_squares(zero)])
        for beside, zero in zip(places, at_zero, strict=True)
        for c, every in sizes.items()
        for own in ([z for z in every if z > 0.0], sorted((z for z in every if z < 0.0), reverse=True))
        if own
    ]
    for _ in range(1 if compared else 1 + o.larger_sizes):
        shifts = [(s, s.shift(size)) for s in series for size in s.sizes[len(s.squares) - 1 :]]
        done = context.run([delayed(model.residual)({**known.point, **shift}) for _, shift in shifts])
        for (s, shift), residual in zip(shifts, done, strict=True):
            s.squares.append(_squares(residual))
            if residual is not None:  # only the change that a size makes counts
                trials.setdefault(s.candidate, []).append(Trial(shift, known.residual + residual - base))
        series = [s for s in series if s.goes_on(o.size_growth, math.sqrt(2.0 * problem.size))]
    return trials


def _squares(residual: Floats | None) -> float:
    """Sum of the squares; infinite where a simulation has failed."""
    return math.inf if residual is None else float(residual @ residual)


def _set_secants(result: Sensitivities, finite: Sequence[Candidate]) -> None:
    """Sensitivities of candidates of finite sizes: the secants to their first trials."""
    for c in finite:
        if c in result.trials:
            q, trial = c.quantities[0], result.trials[c][0]
            secant = (result.residual - trial.residual) / (trial.shift[q.key] - q.off)
            result.by_candidate[c] = secant[:, None]
