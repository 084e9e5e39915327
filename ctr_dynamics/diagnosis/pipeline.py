"""From bags and a robot file to findings: the order of the work, and the verdict.

Numerics, re-calibration inside tolerance, screening, joint fits, further causes, whiteness of what is left, validation on other bags, separability
(docs/diagnosis.md). Nothing here knows files; :mod:`ctr_dynamics.diagnosis.output.findings` writes them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.configuration_mistakes import find_mistake
from ctr_dynamics.diagnosis.inference.candidates import Candidate, candidates
from ctr_dynamics.diagnosis.inference.discretisation_error import add_numerics
from ctr_dynamics.diagnosis.inference.hypotheses import Explanation
from ctr_dynamics.diagnosis.inference.hypothesis_search import (
    LEFT_NUMERICAL,
    LEFT_SHARE,
    Search,
    adequate,
    distinct,
)
from ctr_dynamics.diagnosis.inference.map_fit import Fit, Local, Problem, fit, make_problem
from ctr_dynamics.diagnosis.inference.search_stages import search, second_opinion
from ctr_dynamics.diagnosis.inference.sensitivities import Linearisation, linearise, observable, separation
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.verdict.residual_tests import Whiteness, block_bootstrap, rms, whiteness
from ctr_dynamics.diagnosis.verdict.unexplained_force import Unexplained, unexplained
from ctr_dynamics.effects import EFFECTS, quantities
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
Note = Callable[[str], None]
NOT_NOISE = 1e-4  # p below which what is left is no noise
# NIS per degree of freedom on validation bags up to which they are predicted down to the noise
PREDICTED = 1.15
PREDICTED_SHARE = 0.2  # of the misfit there that may be left
NAMED = 0.9  # probability from which a set of causes is named
CLEAN_GAIN = 4.0  # log evidence, priors included, that causes must gain over fewer or none
SEPARATION = 5.0  # whitened units: linear signatures that are nearer cannot be told apart
FITTED = 3.0  # the same between fits: the root of the difference of their costs, priors included
OBSERVABLE = 3.0  # whitened size of a signature at its prior scale from which a bag can see it
STRONG = 24.0  # size from which it can be told from most others
EXCITED = 0.2  # share of the catalogue that a bag must show strongly


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

    @property
    def confirms(self) -> bool:
        """Whether the extension predicts the bags down to the noise; a motion that hardly shows the misfit tells nothing of what removes it."""
        misfit = self.nis_before - 1.0
        return self.nis_after <= PREDICTED and self.nis_after - 1.0 <= PREDICTED_SHARE * misfit


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
    """All that findings and report are made of; see docs/diagnosis.md for the verdicts.

    ``left``, ``rest``: of every recording, the residuals (s, 6) of the re-calibrated and of the extended model.
    """

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
    left: list[Floats] = field(default_factory=list)
    rest: list[Floats] = field(default_factory=list)
    at_best: Linearisation | None = None
    unexplained: Unexplained | None = None


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
    catalogue = quantities(robot)
    forms = {name for effect in EFFECTS.values() for name in effect.form}  # free beside their effect alone
    nuisances = [q for q in catalogue if q.tolerance > 0.0 and q.effect not in forms]
    notes = [text for r in (*recordings, *validation) for text in r.notes]
    if mask is None:
        mask = measured_axes([*recordings, *validation], notes)
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
    result.nominal_rms = rms(np.concatenate(_residuals(problem, None))[:, :3])
    if not math.isfinite(result.nominal_rms):
        raise InputError(
            "the nominal model cannot be simulated on this bag",
            do="check the robot, the joints and the load with `ctr-dynamics info`",
        )
    note("re-calibration inside tolerance")
    clean = fit(problem, (), {}, polish=False)
    if clean is None:
        raise InputError(
            "the model cannot be simulated near the nominal robot", do="check the robot file and the bag"
        )
    note("numerics")
    result.numerics = add_numerics(problem, clean.point, workers)
    here = problem.residual(clean.point)
    known = None if here is None else Local(here, clean.by_key)
    clean = fit(problem, (), clean.point, known) or clean
    result.clean = result.best = clean
    result.tested += ["time_discretisation", "space_discretisation"]
    pool = candidates(
        catalogue, np.concatenate([r.position[np.isfinite(r.position).all(axis=1)] for r in recordings])
    )
    names = sorted({c.effect for c in pool})
    result.tested += names
    result.white_before = whiteness(problem, clean.whitened, len(clean.active))
    found = search(problem, pool, clean, note, workers)
    if found is None:
        raise InputError("the recalibrated model cannot be linearised", do="check the robot file and the bag")
    held_out = None
    if validation:
        nodes = problem.forward_models[0].nodes
        held_out = make_problem(robot, validation, nuisances, mask, nodes)
        if any(not _plain(problem, e) for e in found.explanations):
            note("second opinion of the validation bags")
            second_opinion(found, problem, held_out, workers)
    result.search = found
    seen = observable(problem, found.linearised)
    result.not_observable = [name for name in names if seen.get(name, 0.0) < OBSERVABLE]
    excited = sum(seen.get(name, 0.0) >= STRONG for name in names) >= EXCITED * len(names)
    _decide(result, problem, found, excited, held_out, note, workers)
    assert result.best is not None
    result.left = _residuals(problem, clean)
    result.rest = result.left if result.best is clean else _residuals(problem, result.best)
    result.seconds = time.perf_counter() - begin
    return result


def measured_axes(recordings: Sequence[Recording], notes: list[str]) -> NDArray[np.bool_]:
    """(6,) axes that carry information in every recording: a tracker that sends one and the same rotation has three degrees of freedom."""
    mask = np.ones(6, bool)
    if any(np.ptp(r.quaternion, axis=0).max(initial=0.0) < 1e-9 for r in recordings):
        mask[3:] = False
        notes.append(
            "the tracker sends no rotation (three degrees of freedom); causes are judged by position alone"
        )
    return mask


def _residuals(problem: Problem, fit: Fit | None) -> list[Floats]:
    """Residuals (s, 6) of every recording; ``fit`` None: of the nominal model."""
    point = fit.point if fit else {}
    return [e.residual(e.predict(point)) for e in problem.forward_models]


def _decide(
    result: Diagnosis,
    problem: Problem,
    found: Search,
    excited: bool,
    held_out: Problem | None,
    note: Note,
    workers: int,
) -> None:
    """Verdict, causes and their probabilities."""
    clean, best = found.clean, needed(found.explanations)
    result.best = best.fit
    result.white = whiteness(problem, best.fit.whitened, len(best.fit.active))
    dof = problem.size
    beyond = clean.fit.chi2 - dof
    left = (best.fit.chi2 - dof) / beyond if beyond > 3.0 * math.sqrt(2.0 * dof) else 0.0
    noise = result.white.p >= NOT_NOISE
    result.sets = cause_sets(found)
    if held_out is not None:
        note("validation")
        result.validation = validate(held_out, clean.fit, best.fit)
    predicted = result.validation is not None and result.validation.confirms
    unexplained_part = left > (LEFT_SHARE if best.resolved else LEFT_NUMERICAL)
    if not noise and (not best.members or _plain(problem, best) or (unexplained_part and not predicted)):
        result.verdict = "unknown"
        result.members = [Member(None, "unknown", 0.95, None, [])]
        result.unexplained = unexplained(problem.forward_models[0], clean.fit.point)
        if result.unexplained is not None:
            result.notes.append(result.unexplained.text)
        rest = [(s, 0.05 * p) for s, p in result.sets[:2] if s] if best.members else []
        result.sets = [(("unknown",), 0.95), *rest]
        return
    if best.members:
        note("separability")
        forms_once = [s.candidate for s in distinct(found.screened)]
        known = found.at_best if best is found.best else None
        result.at_best = known or linearise(problem, best.fit.point, forms_once, workers, again=best.fit)
        lin = result.at_best or found.linearised
        result.members = [_member(problem, found, best, c, lin) for c in best.members]
    apart = not any(m.rivals or m.separation < FITTED for m in result.members if m.separation is not None)
    # who names more names these too
    probability = sum(p for effects, p in result.sets if set(best.effects) <= set(effects))
    if not excited and not (best.members and apart and probability >= NAMED):
        result.verdict, result.members = "not_excited", []
    elif not best.members:
        result.verdict = "clean"
        if probability < NAMED:
            result.notes.append("small causes cannot be excluded; see the list of explanations")
    else:
        worse = result.validation is not None and result.validation.interval[1] < 0.0
        result.verdict = "named" if probability >= NAMED and apart and not worse else "ambiguous"
        if worse:
            result.notes.append(
                "the causes make the prediction of the validation bags worse: they are not named"
            )
        if not noise:
            result.notes.append(
                "something small is left that is not noise"
                if best.resolved
                else "what is left is of the size of the model's own error in time"
            )
            if not predicted and best.resolved:
                result.members.append(Member(None, "unknown", 0.6, None, []))


def _plain(problem: Problem, found: Explanation) -> bool:
    """Whether ``found`` leaves so much that it is not right, and that is not the model's error in time."""
    return found.resolved and not adequate(problem, found.fit)


def needed(explanations: Sequence[Explanation]) -> Explanation:
    """The first of ``explanations``, likeliest first, without causes that gain less than ``CLEAN_GAIN`` together, by all bags or by the fitted alone:
    bags that were not fitted can speak against a cause, but not for one that the others do not show."""
    best = explanations[0]
    fewer = [
        e
        for e in explanations
        if e.keys <= best.keys and min(best.score - e.score, best.fitted - e.fitted) < CLEAN_GAIN
    ]
    return min(fewer, key=lambda e: (len(e.members), -e.score))


def _member(problem: Problem, found: Search, best: Explanation, c: Candidate, lin: Linearisation) -> Member:
    """A cause with its nearest rivals: candidates that could stand in its place.

    Where a rival has been fitted in its place, the difference of the costs counts; it knows what linear signatures do not.
    """
    near: dict[str, tuple[float, float]] = {}  # effect: distance and the one that is needed
    own = {m.effect for m in best.members}
    for rival in lin.signatures:
        if rival.effect not in own:
            d = separation(problem, best.fit, (c,), rival, lin)
            near[rival.effect] = min((d, SEPARATION), near.get(rival.effect, (math.inf, SEPARATION)))
    rest = best.keys - c.keys
    fitted: dict[str, tuple[float, float]] = {}
    for e in found.explanations:
        others = [m for m in e.members if not m.keys <= rest]
        if len(others) == 1 and e.keys - others[0].keys == rest and others[0].effect not in own:
            more = e.fit.cost - best.fit.cost
            if e.held_out is not None and best.held_out is not None:
                more += 2.0 * (best.held_out - e.held_out)
            d = math.sqrt(max(more, 0.0))
            fitted[others[0].effect] = min((d, FITTED), fitted.get(others[0].effect, (math.inf, FITTED)))
    near.update(fitted)
    probability = float(
        sum(p for e, p in zip(found.explanations, found.probabilities, strict=True) if c.effect in e.effects)
    )
    rivals = sorted((d, name) for name, (d, needed) in near.items() if d < needed)
    nearest = min((d for d, _ in near.values()), default=math.inf)
    alone = separation(problem, best.fit, (c,), None, lin)
    return Member(c, c.effect, probability, min(nearest, alone), [name for _, name in rivals])


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


def validate(held_out: Problem, clean: Fit, best: Fit) -> Validation | None:
    """Errors on bags that were not fitted, with the recalibrated and with the extended model; None where neither can be simulated.

    By half the step where that can be simulated: fits are corrected for their error in time as well.
    """
    before, after, stamps, bags = [], [], [], []
    nis = [0.0, 0.0, 0]
    shift = 0.0
    for forward_model, finer, whiten in zip(
        held_out.forward_models, held_out.finer.forward_models, held_out.whiteners, strict=True
    ):
        points = (clean.point, best.point)
        residuals = [left for point in points if (left := finer.residual_at(point)) is not None]
        if len(residuals) < len(points):
            residuals = [forward_model.residual(forward_model.predict(point)) for point in points]
        if not all(np.isfinite(r).any() for r in residuals):
            continue
        good = np.isfinite(residuals[0]).all(axis=1) & np.isfinite(residuals[1]).all(axis=1)
        squares = [np.sum(r[good, :3] ** 2, axis=1) for r in residuals]
        before.append(squares[0])
        after.append(squares[1])
        stamps.append(forward_model.recording.stamps[good] + shift)
        shift += forward_model.recording.duration + 1.0
        bags.append(
            (forward_model.recording.name, math.sqrt(squares[0].mean()), math.sqrt(squares[1].mean()))
        )
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
