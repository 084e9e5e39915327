"""From bags and a robot file to findings: the order of the work, and the verdict.

Numerics, re-calibration inside tolerance, screening, joint fits, further causes, whiteness of what is left, validation on other bags, separability
(docs/diagnosis.md). Nothing here knows files; :mod:`ctr_dynamics.diagnosis.findings` writes them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.effects import EFFECTS, quantities
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot

from .checks import Whiteness, block_bootstrap, rms, whiteness
from .experiment import Experiment
from .fit import Fit, Problem, add_numerics, fit, make_problem
from .mistakes import find_mistake
from .noise import noise_floor
from .recording import Recording
from .search import (
    SEPARATION,
    Candidate,
    Explanation,
    Linearisation,
    Search,
    candidates,
    linearise,
    search,
    separation,
)

Floats = NDArray[np.float64]
Note = Callable[[str], None]
NOT_NOISE = 1e-4  # p below which what is left is no noise
LEFT_SHARE = 0.03  # of the misfit beyond noise that a named cause may leave before it is called unknown
NAMED = 0.9  # probability from which a set of causes is named
CLEAN_GAIN = 4.0  # log evidence, priors included, that a cause must gain over none
OBSERVABLE = 3.0  # whitened size of a signature at its prior scale from which a bag can see it
EXCITED = 0.45  # share of the catalogue that a bag must see


@dataclass
class Validation:
    """Bags that were not fitted, before and after; (s,) squared errors over all of them."""

    rms_recalibrated: float
    rms_extended: float
    gain: float
    interval: tuple[float, float]
    nis_before: float
    nis_after: float
    bags: list[tuple[str, float, float]] = field(default_factory=list)


@dataclass
class Member:
    """One cause of the verdict."""

    candidate: Candidate | None
    effect: str
    probability: float
    separation: float | None
    rivals: list[str]


@dataclass
class Diagnosis:
    """All that findings and report are made of; see docs/diagnosis.md for the verdicts."""

    robot: Robot
    recordings: list[Recording]
    verdict: str
    members: list[Member]
    sets: list[tuple[tuple[str, ...], float]]
    tested: list[str]
    not_observable: list[str]
    numerics: dict[str, float]
    problem: Problem | None
    clean: Fit | None
    best: Fit | None
    search: Search | None
    white: Whiteness | None
    white_before: Whiteness | None
    nominal_rms: float
    validation: Validation | None
    mistake: tuple[str, float, float] | None = None
    notes: list[str] = field(default_factory=list)
    seconds: float = 0.0
    at_best: Linearisation | None = None


def diagnose(
    robot: Robot,
    recordings: Sequence[Recording],
    validation: Sequence[Recording] = (),
    *,
    mask: NDArray[np.bool_] | None = None,
    note: Note = lambda text: None,
    workers: int = 2,
) -> Diagnosis:
    """Diagnose ``recordings`` of ``robot``; ``validation`` bags are predicted only.

    Args:
        mask: (6,) measured axes of the tracker: position, then rotation; None finds out which rotations are there.
        note: told of every stage.
        workers: fits at once.
    Raises:
        InputError: the nominal model cannot be simulated on a bag.
    """
    begin = time.perf_counter()
    known = quantities(robot)
    nuisances = [q for q in known if q.tolerance > 0.0 and q.effect != "play_kinematics"]
    notes = [text for r in (*recordings, *validation) for text in r.notes]
    if mask is None:
        mask = measured_axes(recordings, notes)
    result = Diagnosis(
        robot,
        list(recordings),
        "clean",
        [],
        [((), 1.0)],
        [],
        [],
        {},
        None,
        None,
        None,
        None,
        None,
        None,
        math.nan,
        None,
        notes=notes,
    )
    note("nominal model")
    result.mistake = find_mistake(recordings[0], robot, note)
    result.tested.append("config_mistake")
    if result.mistake is not None:
        result.verdict = "named"
        result.members = [Member(None, "config_mistake", 0.97, None, [])]
        result.sets = [(("config_mistake",), 0.97)]
        result.nominal_rms = result.mistake[1]
        result.seconds = time.perf_counter() - begin
        return result
    problem = make_problem(robot, recordings, nuisances, mask)
    result.problem = problem
    result.nominal_rms = _rms(problem, {})
    if not math.isfinite(result.nominal_rms):
        raise InputError(
            "the nominal model cannot be simulated on this bag",
            do="check the robot, the joints and the load with `ctr-dynamics info`",
        )
    note("re-calibration inside tolerance")
    clean = fit(problem, (), {})
    if clean is None:
        raise InputError(
            "the model cannot be simulated near the nominal robot", do="check the robot file and the bag"
        )
    note("numerics")
    result.numerics = add_numerics(problem, clean.point)
    clean = fit(problem, (), clean.point) or clean
    result.clean = result.best = clean
    result.tested += ["time_discretisation", "space_discretisation"]
    pool = candidates(
        known, np.concatenate([r.position[np.isfinite(r.position).all(axis=1)] for r in recordings])
    )
    result.tested += sorted({c.effect for c in pool})
    result.white_before = whiteness(problem, clean.whitened, len(clean.active))
    found = search(problem, pool, clean, note, workers)
    if found is None:
        raise InputError("the recalibrated model cannot be linearised", do="check the robot file and the bag")
    result.search = found
    seen = observable(problem, found)
    result.not_observable = sorted(
        {c.effect for c in pool} - {c.effect for c, size in seen.items() if size >= OBSERVABLE}
    )
    excited = len({c.effect for c, s in seen.items() if s >= OBSERVABLE}) / max(
        len({c.effect for c in pool}), 1
    )
    _decide(result, problem, found, excited, validation, note)
    result.seconds = time.perf_counter() - begin
    return result


def measured_axes(recordings: Sequence[Recording], notes: list[str]) -> NDArray[np.bool_]:
    """(6,) axes that carry information: a tracker that sends one and the same rotation has three degrees of freedom."""
    mask = np.ones(6, bool)
    if all(np.ptp(r.quaternion, axis=0).max(initial=0.0) < 1e-9 for r in recordings):
        mask[3:] = False
        notes.append(
            "the tracker sends no rotation (three degrees of freedom); causes are judged by position alone"
        )
    return mask


def observable(problem: Problem, found: Search) -> dict[Candidate, float]:
    """Whitened size of every candidate's signature at its prior scale, nuisances projected out."""
    lin = found.linearised
    J = np.hstack(
        [lin.columns_of(problem.nuisances) * [q.tolerance for q in problem.nuisances], problem.numerics]
    )
    factor = np.linalg.cholesky(np.eye(J.shape[1]) + J.T @ J)
    sizes = {}
    for c, signature in lin.signatures.items():
        S = signature * [q.scale for q in c.quantities]
        half = np.linalg.solve(factor, J.T @ S)
        left = S.T @ S - half.T @ half
        sizes[c] = math.sqrt(max(float(np.linalg.eigvalsh(left)[-1]), 0.0))
    return sizes


def _rms(problem: Problem, point: dict) -> float:
    parts = [e.residual(e.predict(point))[:, :3] for e in problem.experiments]
    return rms(np.concatenate(parts))


def _decide(
    result: Diagnosis,
    problem: Problem,
    found: Search,
    excited: float,
    validation: Sequence[Recording],
    note: Note,
) -> None:
    """Verdict, causes and their probabilities."""
    assert result.clean is not None
    clean_p = next(
        (p for e, p in zip(found.explanations, found.probabilities, strict=True) if not e.members), 0.0
    )
    best = found.best
    clean = next(e for e in found.explanations if not e.members)
    if best.members and best.score - clean.score < CLEAN_GAIN:
        best = clean
    white = whiteness(problem, best.fit.whitened, len(best.fit.active))
    result.white, result.best = white, best.fit
    dof = problem.size
    beyond = result.clean.chi2 - dof
    left = (best.fit.chi2 - dof) / beyond if beyond > 3.0 * math.sqrt(2.0 * dof) else 0.0
    noise = white.p >= NOT_NOISE
    result.sets = cause_sets(found)
    if best.members:
        note("separability")
        result.at_best = best.lin or linearise(problem, best.fit.point, found.pool, lambda text: None)
        lin = result.at_best or found.linearised
        for c in best.members:
            result.members.append(_member(problem, found, best, c, lin))
    if validation:
        note("validation")
        result.validation = validate(problem, result.clean, best.fit, validation)
    if not best.members:
        result.verdict = "clean" if noise else "unknown"
        if noise and excited < EXCITED:
            result.verdict = "not_excited"
        if not noise:
            result.members = [Member(None, "unknown", 0.95, None, [])]
            result.sets = [(("unknown",), 0.95)]
        elif clean_p < NAMED and result.verdict == "clean":
            result.notes.append("small causes cannot be excluded; see the list of explanations")
        return
    if not noise and left > LEFT_SHARE:
        result.verdict = "unknown"
        result.members = [Member(None, "unknown", 0.95, None, [])]
        result.sets = [(("unknown",), 0.95), *[(s, 0.05 * p) for s, p in result.sets[:2]]]
        result.best = best.fit
        return
    worse = result.validation is not None and result.validation.interval[1] < 0.0
    probability = dict(result.sets).get(best.effects, 0.0)
    apart = all(m.separation is None or m.separation >= SEPARATION for m in result.members)
    result.verdict = "named" if probability >= NAMED and apart and not worse else "ambiguous"
    if worse:
        result.notes.append("the causes make the prediction of the validation bags worse: they are not named")
    if not noise:
        result.members.append(Member(None, "unknown", 0.6, None, []))
        result.notes.append("something small is left that is not noise")


def _member(problem: Problem, found: Search, best: Explanation, c: Candidate, lin: Linearisation) -> Member:
    """A cause with its nearest rivals: candidates that could stand in its place.

    Where a rival has been fitted in its place, the difference of the costs counts; it knows what linear signatures do not.
    """
    distances: dict[str, float] = {}
    own = {m.effect for m in best.members}
    for rival in lin.signatures:
        if rival.effect not in own:
            d = separation(problem, best, c, rival, lin)
            distances[rival.effect] = min(d, distances.get(rival.effect, math.inf))
    rest = best.keys - c.keys
    swaps: dict[str, float] = {}
    for e in found.explanations:
        others = [m for m in e.members if not m.keys <= rest]
        if len(others) == 1 and e.keys - others[0].keys == rest and others[0].effect not in own:
            d = math.sqrt(max(e.fit.cost - best.fit.cost, 0.0))
            swaps[others[0].effect] = min(d, swaps.get(others[0].effect, math.inf))
    distances.update(swaps)
    probability = float(
        sum(p for e, p in zip(found.explanations, found.probabilities, strict=True) if c.effect in e.effects)
    )
    nearest = min(distances.values(), default=separation(problem, best, c, None, lin))
    rivals = sorted((d, name) for name, d in distances.items() if d < SEPARATION)
    return Member(c, c.effect, probability, nearest, [name for _, name in rivals])


def cause_sets(found: Search) -> list[tuple[tuple[str, ...], float]]:
    """Sets of effects with their probabilities, likeliest first, as few as hold 95 %."""
    total: dict[tuple[str, ...], float] = {}
    for e, p in zip(found.explanations, found.probabilities, strict=True):
        total[e.effects] = total.get(e.effects, 0.0) + float(p)
    out, held = [], 0.0
    for effects, p in sorted(total.items(), key=lambda item: -item[1]):
        out.append((effects, p))
        held += p
        if held >= 0.95:
            break
    return out


def validate(problem: Problem, clean: Fit, best: Fit, recordings: Sequence[Recording]) -> Validation | None:
    """Errors on bags that were not fitted, with the recalibrated and with the extended model; None where neither can be simulated."""
    before, after, stamps, bags = [], [], [], []
    nis = [0.0, 0.0, 0]
    shift = 0.0
    own = make_problem(problem.robot, recordings, problem.nuisances, problem.whiteners[0].mask)
    for experiment, whiten in zip(own.experiments, own.whiteners, strict=True):
        residuals = []
        for point in (clean.point, best.point):
            prediction = experiment.predict(point)
            residuals.append(experiment.residual(prediction))
        if not all(np.isfinite(r).any() for r in residuals):
            continue
        good = np.isfinite(residuals[0]).all(axis=1) & np.isfinite(residuals[1]).all(axis=1)
        squares = [np.sum(r[good, :3] ** 2, axis=1) for r in residuals]
        before.append(squares[0])
        after.append(squares[1])
        stamps.append(experiment.recording.stamps[good] + shift)
        shift += experiment.recording.duration + 1.0
        bags.append((experiment.recording.name, math.sqrt(squares[0].mean()), math.sqrt(squares[1].mean())))
        if good.all():
            for i, r in enumerate(residuals):
                w = whiten(r)
                nis[i] += float(w @ w)
            nis[2] += whiten.size
    if not before:
        return None
    a, b = np.concatenate(before), np.concatenate(after)
    return Validation(
        math.sqrt(a.mean()),
        math.sqrt(b.mean()),
        1.0 - float(b.sum() / a.sum()),
        block_bootstrap(a, b, np.concatenate(stamps)),
        nis[0] / nis[2] if nis[2] else math.nan,
        nis[1] / nis[2] if nis[2] else math.nan,
        bags,
    )


def floor(robot: Robot) -> float:
    """3-D rms of the tracker's own noise, m."""
    return noise_floor(robot)


def texts(effect: str) -> str:
    """What an effect says, in one sentence."""
    return EFFECTS[effect].text if effect in EFFECTS else ""


__all__ = ["Diagnosis", "Experiment", "Member", "Validation", "diagnose", "floor", "texts"]
