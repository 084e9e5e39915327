"""Discretisation error: the solver's own error, measured against finer solutions, corrected, and left free to vary.

In: a problem and a point. Out: its residual corrected by the differences, and these as directions of the covariance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from joblib import delayed
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_options import DiscretisationOptions, StepOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel, Key
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.step_choice import with_chosen_steps
from ctr_dynamics.diagnosis.whitening import Whitener

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Differences:
    """Differences from finer solutions.

    Attributes:
        directions: (m, 2) whitened, to the shortest step that was simulated and to twice the nodes; zero where none could be.
        rms: (2,) m, of what the last refinement of step and of nodes still changed; NaN where none could be simulated.
        first, second: whitened sizes of the differences to the first shorter step, and from there to half of that; the second is zero
            where the first is too small to ask.
        misfit: rms of the whitened residual, where that is above the noise; else 1.
    """

    directions: Floats
    rms: Floats
    first: float
    second: float
    misfit: float


def choose_nodes(problem: Problem, point: Mapping[Key, float], context: RunContext) -> None:
    """Twice the nodes, and twice again, as long as the data can see at ``point`` what more of them change, or fewer cannot be simulated.

    Nuisances that are fitted with too few nodes go where the error in space is least, and that is no place to go on from with more.
    """
    o = problem.options.discretisation
    while 2 * problem.forward_models[0].nodes <= o.most_nodes:
        done = context.run(
            job
            for e in problem.forward_models
            for job in (delayed(ForwardModel.residual_at)(e, point), delayed(with_more_nodes)(e, point))
        )
        pairs = list(zip(done[::2], done[1::2], strict=True))
        needed = any(base is None and finer is not None for base, (finer, _) in pairs)
        space = _whitened(problem, [_difference(base, *finer) for base, finer in pairs])
        if not needed and float(np.linalg.norm(space)) <= o.space_limit:
            return
        problem.forward_models = [e.resolved(2 * e.nodes, e.scheme.dt) for e in problem.forward_models]


def correct_discretisation(
    problem: Problem, point: Mapping[Key, float], context: RunContext
) -> dict[str, float]:
    """Compare with finer solutions at ``point``: correct the residual by the differences, and let them vary.

    The problem goes on with more nodes or half the step where :func:`_finer` says so.

    Returns:
        rms in m of what the last refinement changed: ``time_error_m`` (half the step), ``space_error_m`` (twice the nodes); NaN where it
        cannot be measured.
    """
    found = _refine(problem, point, context)
    problem.offset, problem.numerics = _correction(problem, found.directions)
    return {"time_error_m": float(found.rms[0]), "space_error_m": float(found.rms[1])}


def _refine(problem: Problem, point: Mapping[Key, float], context: RunContext) -> Differences:
    """Give ``problem`` the resolution that it needs at ``point``; the differences there."""
    while True:
        found = differences(problem, point, context)
        finer = _finer(problem, found)
        if finer is None:
            return found
        problem.forward_models = finer


def _finer(problem: Problem, found: Differences) -> list[ForwardModel] | None:
    """Models with twice the nodes where the data can see the error in space, else with half the step where that in time is large, or where they see
    what the correction leaves of it: a correction holds at one point only. None where the resolution will do.

    What is far below the misfit is not seen beside it. Nodes come first: with too few of them shorter steps solve another problem.
    """
    o = problem.options.discretisation
    first = problem.forward_models[0]
    nodes, dt = first.nodes, first.scheme.dt
    if (
        float(np.linalg.norm(found.directions[:, 1])) > o.space_limit * found.misfit
        and 2 * nodes <= o.most_nodes
    ):
        nodes *= 2
    elif (
        (found.first > o.time_limit * found.misfit or found.second > o.time_left * found.misfit)
        and 0.5 * dt >= o.shortest_s
        and np.isfinite(found.rms[0])
    ):
        dt *= 0.5
    else:
        return None
    return [e.resolved(nodes, dt) for e in problem.forward_models]


def renew_correction(problem: Problem, point: Mapping[Key, float], context: RunContext) -> Floats | None:
    """The same at a ``point`` that fits the data, with the resolution that suits it.

    A strong cause, as friction, can make an error that the nominal model does not have. A robot that does not move as the nominal one vibrates at
    other times, at which the steps may be long.

    Returns:
        Change (m,) of the whitened residual there; None where it is too small to count, and all is left as it was.
    """
    pairs = zip(problem.forward_models, problem.whiteners, strict=True)
    models = context.run(delayed(_with_steps_for)(e, w, point, problem.options.steps) for e, w in pairs)
    there = replace(problem, forward_models=models)
    D = _refine(there, point, context).directions
    offset, numerics = _correction(problem, D)
    if there.forward_models == problem.forward_models:
        small = float(np.linalg.norm(offset - problem.offset)) < problem.options.discretisation.renewed
        if small or not np.any(D[:, 0]):
            return None
    return change_solution(problem, there.forward_models, offset, numerics, point)


def change_solution(
    problem: Problem, models: list[ForwardModel], offset: Floats, numerics: Floats, point: Mapping[Key, float]
) -> Floats | None:
    """Go on with another resolution and another correction.

    Returns:
        Change (m,) of the whitened residual at ``point``; None where it cannot be simulated there, and all is left as it was.
    """
    change = offset - problem.offset
    if models != problem.forward_models:
        before, after = problem.residual(point), replace(problem, forward_models=models).residual(point)
        if before is None or after is None:
            return None
        change = change + before - after
    problem.forward_models, problem.offset, problem.numerics = models, offset, numerics
    return change


def _with_steps_for(
    model: ForwardModel, whiten: Whitener, point: Mapping[Key, float], options: StepOptions
) -> ForwardModel:
    """``model``, with other steps where its own are long at times and too long at ``point``."""
    return model if model.steps is None else with_chosen_steps(model, whiten, point, options)


def differences(problem: Problem, point: Mapping[Key, float], context: RunContext) -> Differences:
    """Differences to shorter steps and to twice the nodes at ``point``.

    A quarter of the step is simulated where the data can see the difference to half of it.
    """
    o = problem.options.discretisation
    models, whiteners = problem.forward_models, problem.whiteners
    jobs = [
        job
        for e in models
        for job in (
            delayed(ForwardModel.residual_at)(e, point),
            delayed(with_shorter_step)(e, point, o),
            delayed(with_more_nodes)(e, point),
        )
    ]
    done = context.run(jobs)
    base, half, finer = done[::3], done[1::3], done[2::3]
    time = [_difference(b, f, factor) for b, (f, factor) in zip(base, half, strict=True)]
    space = [_difference(b, f, factor) for b, (f, factor) in zip(base, finer, strict=True)]
    total = _whitened(problem, time)
    last, first, second = time, float(np.linalg.norm(total)), 0.0
    halved = all(f is not None and factor == 1.0 for f, factor in half)
    if halved and first > o.time_left:
        quarter = context.run(
            delayed(ForwardModel.residual_at)(e.resolved(e.nodes, 0.25 * e.scheme.dt), point) for e in models
        )
        if all(x is not None for x in quarter):
            last = [_difference(f, x, 1.0) for (f, _), x in zip(half, quarter, strict=True)]
            further = _whitened(problem, last)
            total, second = total + further, float(np.linalg.norm(further))
    rows = max(sum(int(w.used.sum()) for w in whiteners), 1)

    def rms(parts: list[Floats | None]) -> float:
        pairs = zip(parts, whiteners, strict=True)
        squares = (np.nan if d is None else float(np.sum(d[w.used][:, :3] ** 2)) for d, w in pairs)
        return math.sqrt(sum(squares) / rows)

    left = _whitened(problem, base)
    misfit = max(1.0, float(np.linalg.norm(left)) / math.sqrt(len(left)))
    return Differences(
        np.stack([total, _whitened(problem, space)], axis=1),
        np.array([rms(last), rms(space)]),
        first,
        second,
        misfit,
    )


def _difference(base: Floats | None, finer: Floats | None, factor: float) -> Floats | None:
    """(s, 6), None where a simulation failed."""
    return None if base is None or finer is None else factor * (base - finer)


def _whitened(problem: Problem, parts: list[Floats | None]) -> Floats:
    """(m,) of the differences of all recordings; zero where there is none."""
    return np.concatenate(
        [
            whiten(np.zeros((len(whiten.used), 6)) if d is None else d)
            for whiten, d in zip(problem.whiteners, parts, strict=True)
        ]
    )


def _correction(problem: Problem, D: Floats) -> tuple[Floats, Floats]:
    """Offset (m,) and free directions (m, 2) by the differences ``D`` (m, 2)."""
    return D.sum(axis=1), problem.options.discretisation.deviation * D


def with_shorter_step(
    forward_model: ForwardModel, point: Mapping[Key, float], options: DiscretisationOptions
) -> tuple[Floats | None, float]:
    """Residual (s, 6) by the shortest step that succeeds, and the factor from its difference to that of half a step."""
    for part, factor in options.shorter:
        found = forward_model.resolved(forward_model.nodes, part * forward_model.scheme.dt).residual_at(point)
        if found is not None:
            return found, factor
    return None, 0.0


def with_more_nodes(forward_model: ForwardModel, point: Mapping[Key, float]) -> tuple[Floats | None, float]:
    """Residual (s, 6) with twice the nodes, and the factor 1."""
    return forward_model.resolved(2 * forward_model.nodes, forward_model.scheme.dt).residual_at(point), 1.0
