"""From `unknown` to a model: a force on the tip, learned from what a fit leaves of the bags, and kept only if it predicts others.

In: a problem, the fit whose rest is to be explained, and bags that were not fitted. Out: a fit with a learned force and its gain on those bags,
or the reason why there is none. Terms are chosen on the measured path (:mod:`ctr_dynamics.diagnosis.learned.guided_model`) by their evidence
(:mod:`ctr_dynamics.diagnosis.learned.sparse_terms`), with noise that is correlated. Their coefficients are then fitted to free simulations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from joblib import delayed
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.diagnosis.inference.discrepancy import CorrelatedNoise
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.gaussian_posterior import variances
from ctr_dynamics.diagnosis.inference.map_fit import Fit, fit
from ctr_dynamics.diagnosis.inference.sensitivities import off_nominal
from ctr_dynamics.diagnosis.learned.dictionary import (
    EFFECT,
    Features,
    dictionary,
    has_learned,
    memory_time,
    shaped_robot,
)
from ctr_dynamics.diagnosis.learned.guided_model import GuidedModel, measured_tip
from ctr_dynamics.diagnosis.learned.sparse_terms import Data, Noise, choose_terms
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.verdict.validation import Validation, validate
from ctr_dynamics.effects import EffectQuantity
from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.kinds import SIMD_WIDTH
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LearnedForce:
    """A learned force that predicts.

    Attributes:
        robot: the robot of the fit, whose file has the shape of the features. fit: with the force. terms: of it.
        validation: gain over the fit without it. held_out: what it was measured on, for people.
    """

    robot: Robot
    fit: Fit
    terms: tuple[EffectQuantity, ...]
    validation: Validation
    held_out: str


@dataclass(frozen=True)
class Learning:
    """Outcome of learning: the force, or None and a sentence that says why."""

    force: LearnedForce | None
    reason: str


def learn_force(
    problem: Problem, base: Fit, validation: Sequence[Recording], context: RunContext
) -> Learning:
    """Explain what ``base`` leaves of ``problem`` by a learned force.

    Args:
        validation: bags that were not fitted; empty keeps back the last part of every fitted bag.
    """
    o = problem.options.learned_force
    if has_learned(problem.robot):
        return Learning(None, "the robot file has a learned force already")
    context.report("learning the unexplained force")
    judged, held_out = list(validation), "bags that were not fitted"
    try:
        robot = _robot(problem, base)
        own = whole = on_robot(problem, robot)
        if not judged:
            recordings = [m.recording for m in problem.forward_models]
            ends = [o.fitted * r.duration for r in recordings]
            judged = [_after(r, end) for r, end in zip(recordings, ends, strict=True)]
            own = whole.until(ends)
            held_out = f"the last {100 * (1 - o.fitted):.0f} % of the fitted bags"
        terms, point = _terms(own.until([o.longest_s] * len(own.forward_models)), base, context)
    except InputError as error:
        return Learning(None, str(error))
    if not terms:
        return Learning(None, "no term of the dictionary is likelier than none")
    context.report("fit of the learned force")
    found = fit(own, (*base.causes, *terms), point, renewals=o.renewals)
    if found is not None:
        kept = _still_needed(own, base, found, terms)
        if kept and len(kept) < len(terms):
            found = fit(own, (*base.causes, *kept), found.point, renewals=o.renewals) or found
            terms = tuple(q for q in found.causes if q.effect == EFFECT)
    if found is None:
        return Learning(None, "the model cannot be simulated with the learned force")
    left, before = found.chi2 / own.size - 1.0, base.chi2 / problem.size - 1.0
    if left > (1.0 - problem.options.discrepancy.dominant) * before:
        return Learning(None, "a learned force leaves most of the misfit of the bags that it is fitted to")
    context.report("validation of the learned force")
    gain = validate(on_robot(problem, robot, judged), base, found)
    reason = rejection(gain, held_out)
    if gain is None or reason:
        return Learning(None, reason)
    if not validation:
        # what was fitted to a part, seen on the whole
        seen = fit(whole, found.causes, found.point, iterations=0, polish=False)
        if seen is None:
            return Learning(None, "the model cannot be simulated with the learned force")
        found = replace(seen, covariance=found.covariance)
    return Learning(LearnedForce(robot, found, terms, gain, held_out), "")


def rejection(gain: Validation | None, held_out: str) -> str:
    """Why a force with this ``gain`` is not kept; empty where it is: it predicts, and makes no bag worse."""
    if gain is None:
        return f"{held_out} cannot be simulated with the learned force"
    low, high = gain.interval
    if not low > 0.0:
        return f"a learned force does not predict {held_out}: gain {gain.gain:.2f} [{low:.2f}, {high:.2f}]"
    worse = [bag.name for bag in gain.bags if bag.extended > bag.recalibrated]
    return f"a learned force makes the prediction of {', '.join(worse)} worse" if worse else ""


def _after(recording: Recording, begin: float) -> Recording:
    """The same with the poses after ``begin`` (s) only."""
    late = recording.stamps > begin
    return replace(
        recording,
        stamps=recording.stamps[late],
        position=recording.position[late],
        quaternion=recording.quaternion[late],
    )


def _robot(problem: Problem, base: Fit) -> Robot:
    """The robot with features that suit the measured paths and those of ``base``."""
    positions, speeds = [], []
    for model in problem.forward_models:
        trajectory = model.predict(base.point).trajectory
        positions += [trajectory.tip[:, :3], measured_tip(model, base.point)[1]]
        speeds.append(np.linalg.norm(trajectory.tip[:, 7:10], axis=1))
    return shaped_robot(problem.robot, np.concatenate(positions), np.concatenate(speeds))


def on_robot(problem: Problem, robot: Robot, recordings: Sequence[Recording] | None = None) -> Problem:
    """The problem of ``robot`` on ``recordings``; None stands for those of ``problem``, with its steps and the error of the solver."""
    if recordings is not None:
        return problem.on(recordings, robot)
    other = problem.on([m.recording for m in problem.forward_models], robot)
    pairs = zip(other.forward_models, problem.forward_models, strict=True)
    models = [m.with_steps(before.steps) for m, before in pairs]
    return replace(other, forward_models=models, numerics=problem.numerics, offset=problem.offset)


def _terms(
    own: Problem, base: Fit, context: RunContext
) -> tuple[tuple[EffectQuantity, ...], dict[Key, float]]:
    """Terms that the evidence asks for, and the point where they and all else are likeliest on the measured path.

    The guidance weakens from round to round: a strong one keeps the model near the path while little of the force is known, a weak one shows
    what adds up over time.
    """
    o = own.options.learned_force
    every = dictionary(own.robot, _moving(own))
    remembering = [q for q in every if q.name.startswith("memory")]
    plain = [q for q in every if q not in remembering]
    columns = [*plain, *(q for _ in o.memory_s for q in remembering)]  # the memory with each delay
    alternatives = [
        np.array([*range(len(plain)), *(len(plain) + k * len(remembering) + np.arange(len(remembering)))])
        for k in range(len(o.memory_s))
    ]
    features = Features.of_robot(own.robot, [q.name for q in columns])
    active, variance = variances(own.nuisances, base.causes)
    off = np.array([q.off for q in active])
    reach = np.array([own.reach * q.tolerance if q.tolerance else np.inf for q in active])
    # nuisances that have left their tolerances imitate the force that is missing
    point = {q.key: base.point[q.key] for q in active}
    if off_nominal(own, base.point):
        point.update({q.key: q.off for q in own.nuisances if q not in base.causes})
    force = np.zeros(len(columns))
    noises = _noises(own)
    coarse = own.with_least_step(o.dt_s)
    models = [GuidedModel(m, base.point, features, o.memory_s) for m in coarse.forward_models]
    guided = replace(
        own,
        forward_models=list(models),
        numerics=np.zeros((own.size, 0)),
        offset=np.zeros(own.size),
        workers=1,
    )
    chosen: tuple[EffectQuantity, ...] = ()
    for strength in o.guidance:
        context.report(f"learning the unexplained force, guidance {strength:g}")
        found = _linearised(guided, point, active, strength, force, context)
        if found is None and not chosen:
            raise InputError("the model cannot be simulated on the measured path")
        if found is None:
            break
        residual, common, pressed = found
        data = Data(
            residual + pressed @ force,
            common,
            np.array([point[q.key] for q in active]) - off,
            variance,
            pressed,
            np.array([q.one_sided for q in columns]),
        )
        terms = choose_terms(data, noises, np.array(o.sizes), np.array(o.widths_N), alternatives=alternatives)
        departure = np.clip(terms.common, -reach, reach)
        point = {
            q.key: float(np.clip(q.off + d, q.low, q.high)) for q, d in zip(active, departure, strict=True)
        }
        force = np.zeros(len(columns))
        force[list(terms.chosen)] = terms.values
        chosen = tuple(columns[k] for k in terms.chosen)
        if not chosen:
            return (), point
    point.update({columns[k].key: float(force[k]) for k in np.flatnonzero(force)})
    if any(q in remembering for q in chosen):
        first = next(k for k in np.flatnonzero(force) if columns[k] in remembering)
        time = o.memory_s[(first - len(plain)) // len(remembering)]
        delay = replace(memory_time(own.robot), off=time)
        chosen = (*chosen, delay)
        point[delay.key] = time
    return chosen, point


def _linearised(
    guided: Problem,
    point: Mapping[Key, float],
    active: Sequence[EffectQuantity],
    strength: float,
    force: Floats,
    context: RunContext,
) -> tuple[Floats, Floats, Floats] | None:
    """Residual (m,) with guidance of ``strength`` and ``force`` at ``point``, and derivatives of the prediction by the ``active`` quantities (m, a)
    and by the coefficients of the force (m, d); None where it cannot be simulated."""
    models = [m for m in guided.forward_models if isinstance(m, GuidedModel)]
    for model in models:
        model.set_guidance(strength, force)
    half = len(force) // (2 * SIMD_WIDTH) * SIMD_WIDTH  # in whole batches of columns
    parts = (slice(0, half), slice(half, None))
    found, *pressed = context.run(
        [
            delayed(guided.linearise)(point, active),
            *(delayed(m.force_jacobian)(point, part) for m in models for part in parts),
        ]
    )
    if found is None or any(p is None for p in pressed):
        return None
    whole = [
        whiten(np.concatenate(halves, axis=2))
        for whiten, *halves in zip(guided.whiteners, pressed[::2], pressed[1::2], strict=True)
    ]
    return found[0], found[1], np.concatenate(whole)


def _still_needed(
    problem: Problem, base: Fit, found: Fit, terms: Sequence[EffectQuantity]
) -> tuple[EffectQuantity, ...]:
    """The ``terms`` that the evidence asks for where free simulations have brought them; the noise on the measured path may have chosen others."""
    o, columns = problem.options.learned_force, found.by_key
    coefficients = [q for q in terms if not q.parameter.shape]
    active, variance = variances(problem.nuisances, base.causes)
    point = found.point
    data = Data(
        found.residual + sum(columns[q.key] * point[q.key] for q in coefficients),
        np.stack([columns[q.key] for q in active], axis=1),
        np.array([point[q.key] - q.off for q in active]),
        variance,
        np.stack([columns[q.key] for q in coefficients], axis=1),
        np.array([q.one_sided for q in coefficients]),
    )
    chosen = choose_terms(data, _noises(problem), np.array(o.sizes), np.array(o.widths_N)).chosen
    kept = [coefficients[k] for k in chosen]
    shapes = [q for q in terms if q.parameter.shape and any(k.name.startswith("memory") for k in kept)]
    return (*kept, *shapes)


def _moving(problem: Problem) -> list[bool]:
    """Which translations move, (N,)."""
    n = problem.robot.n_tubes
    spans = [np.ptp(m.recording.joints[:, 1 + n : 1 + 2 * n], axis=0) for m in problem.forward_models]
    return list(np.max(spans, axis=0) > problem.options.learned_force.slide_m)


def _noises(problem: Problem) -> list[Noise]:
    """Correlation times of what is left, of which the evidence chooses; sizes are in deviations of the tracker's noise."""
    unit = max(problem.robot.tracker.noise.position.value, 1e-6)
    turn = 1.5 / problem.robot.exposed_length  # rad at the tip of a cantilever for each m of its deflection
    processes = [CorrelatedNoise(problem, time) for time in problem.options.discrepancy.times_s]
    units = [np.where(p.of_position, unit, unit * turn) for p in processes]
    return [Noise(p, each**2 * p.variance) for p, each in zip(processes, units, strict=True)]
