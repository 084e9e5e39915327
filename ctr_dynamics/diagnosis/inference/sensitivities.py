"""What every candidate would do to the residual at one point: signatures, what they would explain, and which are alike."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.inference.candidates import Candidate, causes_of, keys_of, tube_of
from ctr_dynamics.diagnosis.inference.map_fit import (
    INSIDE,
    Fit,
    Key,
    Problem,
    inside,
    posterior,
    prior_variance,
    variances,
)
from ctr_dynamics.effects import EFFECTS, Quantity

Floats = NDArray[np.float64]
PROBE_STEP = 0.005  # s: what a finite size changes is large against the error in time of what it changes


Try = tuple[Candidate, float, Mapping[Key, float]]  # a size in scales, and the nuisances beside it


@dataclass(frozen=True)
class Probe:
    """A candidate at a finite size: coordinates beside the base point, and the residual (m,) there, as longer steps in time show it."""

    shift: dict[Key, float]
    residual: Floats


@dataclass(frozen=True)
class Scored:
    """A candidate and the linear log evidence that it gains; ``probe``: from where it does, None for the base point."""

    gain: float
    candidate: Candidate
    probe: Probe | None


@dataclass
class Linearisation:
    """Residual and columns of every candidate at one point.

    Attributes:
        columns: of quantities that have a derivative there. signatures: (m, quantities) of each candidate. probes: of those that were
            tried at finite sizes; their signatures are the secants to the first. reference: the residual as the steps of the probes show it;
            None where these cannot be simulated.
    """

    point: dict[Key, float]
    residual: Floats
    columns: dict[Key, Floats]
    signatures: dict[Candidate, Floats] = field(default_factory=dict)
    probes: dict[Candidate, list[Probe]] = field(default_factory=dict)
    reference: Floats | None = None

    def carried(self, fit: Fit) -> Linearisation:
        """The same at a fit not far away: its residual and columns, and the signatures of here."""
        return Linearisation(fit.point, fit.residual, {**self.columns, **fit.by_key}, self.signatures)

    def own(self, c: Candidate) -> dict[Key, Floats]:
        """Columns of a candidate's quantities; empty where it has none."""
        signature = self.signatures.get(c)
        return {} if signature is None else {q.key: signature[:, i] for i, q in enumerate(c.quantities)}


def linearise(
    problem: Problem,
    point: Mapping[Key, float],
    pool: Sequence[Candidate],
    workers: int,
    *,
    again: Fit | None = None,
) -> Linearisation | None:
    """Columns of nuisances and all candidates at ``point``; those without a derivative by finite probes.

    Args:
        again: the fit whose ``point`` it is, when signatures are only compared with it: its columns serve, and one probe of each candidate.
    Returns:
        None where the model cannot be simulated at ``point``.
    """
    plain: dict[Key, Quantity] = {q.key: q for q in problem.nuisances}
    shaped: list[Candidate] = []
    rough: list[Candidate] = []
    for c in pool:
        if EFFECTS[c.effect].probes:
            rough.append(c)
        elif c.shapes or c.quantities[0].extended:
            shaped.append(c)
        else:
            plain.update({q.key: q for q in c.quantities})
    known = again.by_key if again else {}
    wanted = tuple(q for key, q in plain.items() if key not in known)
    groups = _compatible(shaped)
    at, members = groups[0] if groups else ({}, [])
    first = tuple(q for c in members for q in c.quantities)

    def columns(
        at: Mapping[Key, float], wanted: Sequence[Quantity], more: Sequence[Quantity] = ()
    ) -> tuple[Floats, Floats] | None:
        found = problem.linearise({**at, **point}, (*wanted, *more))
        return columns({}, wanted) if found is None and more else found

    jobs = [
        delayed(columns)(at, wanted, first)
    ]  # together: what has no room in one simulation has it in another
    jobs += [delayed(columns)(at, tuple(q for c in group for q in c.quantities)) for at, group in groups[1:]]
    if again:
        tries: list[Try] = [(c, _probed(c)[0], {}) for c in rough]
        jobs += _probing(problem, point, tries)
    else:
        coarse = problem.with_step(PROBE_STEP)
        tries = [(c, size, back) for back in _places(problem, point) for c in rough for size in _probed(c)]
        jobs += [*_probing(coarse, point, tries), delayed(coarse.residual)(point)]
    done = Parallel(workers, prefer="threads")(jobs)
    if done[0] is None:
        return None
    residual, computed = again.residual if again else done[0][0], done[0][1]
    result = Linearisation(
        dict(point), residual, {**known, **{q.key: computed[:, i] for i, q in enumerate(wanted)}}
    )
    outcomes = [(members, computed[:, len(wanted) :])] if computed.shape[1] > len(wanted) else []
    more = max(len(groups), 1)
    outcomes += [(m, o[1]) for (_, m), o in zip(groups[1:], done[1:more], strict=True) if o is not None]
    for group, found in outcomes:
        last = 0
        for c in group:
            result.signatures[c] = found[:, last : last + len(c.quantities)]
            last += len(c.quantities)
    for c in pool:
        if c not in shaped and c not in rough:
            result.signatures[c] = np.stack([result.columns[q.key] for q in c.quantities], axis=1)
    result.reference = residual if again else done[-1]
    result.probes = _probed_with(result, tries, done[more : more + len(tries)])
    _secants(result, rough)
    return result


def far_probes(
    problem: Problem, lin: Linearisation, pool: Sequence[Candidate], workers: int
) -> Linearisation:
    """``lin`` with probes at large sizes, of which the derivative says little, and of those in ``pool`` that it does not know yet."""
    new = [c for c in pool if EFFECTS[c.effect].probes and c not in lin.signatures]
    tries: list[Try] = [
        (c, size, back)
        for back in _places(problem, lin.point)
        for c in pool
        for size in (_probed(c) if c in new else EFFECTS[c.effect].far)
    ]
    jobs = _probing(problem.with_step(PROBE_STEP), lin.point, tries)
    found = _probed_with(lin, tries, Parallel(workers, prefer="threads")(jobs))
    probes = {c: lin.probes.get(c, []) + found.get(c, []) for c in (*lin.probes, *found)}
    result = replace(lin, signatures=dict(lin.signatures), probes=probes)
    _secants(result, new)
    return result


def _places(problem: Problem, point: Mapping[Key, float]) -> list[dict[Key, float]]:
    """Where finite sizes are tried: nuisances that have left their tolerances imitate a cause, so it is tried beside nominal ones too."""
    places: list[dict[Key, float]] = [{}]
    if strayed(problem, point):
        places.append({q.key: q.off for q in problem.nuisances})
    return places


def _shift(c: Candidate, size: float, back: Mapping[Key, float]) -> dict[Key, float]:
    """Coordinates of a candidate at a finite size, in scales, with nuisances at ``back``."""
    q = c.quantities[0]
    return {**back, **dict(c.start), q.key: q.off + size * q.scale}


def _probing(problem: Problem, point: Mapping[Key, float], tries: Sequence[Try]) -> list:
    """Jobs: the residual with each of ``tries`` at ``point``."""
    return [delayed(problem.residual)({**point, **_shift(*arguments)}) for arguments in tries]


def _probed_with(
    lin: Linearisation, tries: Sequence[Try], residuals: Sequence[Floats | None]
) -> dict[Candidate, list[Probe]]:
    """Probes with the residuals that :func:`_probing` found."""
    probes: dict[Candidate, list[Probe]] = {}
    for arguments, residual in zip(tries, residuals, strict=True):
        if residual is not None and lin.reference is not None:
            probe = Probe(_shift(*arguments), lin.residual + residual - lin.reference)
            probes.setdefault(arguments[0], []).append(probe)
    return probes


def _secants(lin: Linearisation, rough: Sequence[Candidate]) -> None:
    """Signatures of ``rough`` candidates: the secants to their first probes."""
    for c in rough:
        if c in lin.probes:
            q, probe = c.quantities[0], lin.probes[c][0]
            secant = (lin.residual - probe.residual) / (probe.shift[q.key] - q.off)
            lin.signatures[c] = secant[:, None]


def _probed(c: Candidate) -> tuple[float, ...]:
    """Finite sizes, in scales, at which a candidate without a derivative is looked at."""
    q = c.quantities[0]
    return tuple((size - q.off) / q.scale for size in c.sizes[:1]) or EFFECTS[c.effect].probes


def strayed(problem: Problem, point: Mapping[Key, float]) -> bool:
    """Whether a nuisance has left its tolerance: it then imitates a cause that is missing."""
    return any(abs(point.get(q.key, q.off) - q.off) > INSIDE * q.tolerance for q in problem.nuisances)


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


def screen(
    problem: Problem, lin: Linearisation, base: Fit, members: Sequence[Candidate], pool: Sequence[Candidate]
) -> list[Scored]:
    """Linear log evidence gained by each candidate beside ``members``, best first; one-sided causes of the wrong sign gain nothing.

    ``base`` is the fit of ``members``, where ``lin`` stands.
    """
    fixed = causes_of(members)
    active, variance = variances(problem.nuisances, fixed)
    known = {**base.by_key, **lin.columns}
    columns = np.stack([known[q.key] for q in active], axis=1)
    values = np.array([lin.point.get(q.key, q.off) - q.off for q in active])
    before, spread, reference = posterior(lin.residual, columns, values, variance, problem.numerics)
    reference += inside(active, {q.key for q in fixed}, before, spread)

    def evidence_at(probe: Probe, c: Candidate) -> float:
        there = np.array([{**lin.point, **probe.shift}.get(q.key, q.off) - q.off for q in active])
        departure, spread, evidence = posterior(probe.residual, columns, there, variance, problem.numerics)
        q = c.quantities[0]
        evidence -= 0.5 * ((probe.shift[q.key] - q.off) / q.scale) ** 2
        evidence -= math.log1p(q.scale * float(np.linalg.norm(lin.signatures[c][:, 0])))  # the size is free
        return evidence + inside(active, {x.key for x in fixed}, departure, spread)

    taken = {c.effect + tube_of(c.quantities[0]) for c in members}
    place = {q.key: i for i, q in enumerate(active)}
    scored = []
    for c in pool:
        if c.effect + tube_of(c.quantities[0]) in taken or c not in lin.signatures:
            continue
        wide, J, start = variance.copy(), columns, values
        where = []
        for i, q in enumerate(c.quantities):
            if q.key in place:
                wide[place[q.key]] += q.scale**2
                where.append(place[q.key])
            else:
                where.append(J.shape[1])
                J = np.hstack([J, lin.signatures[c][:, [i]]])
                wide, start = np.append(wide, q.scale**2), np.append(start, 0.0)
        departure, spread, evidence = posterior(lin.residual, J, start, wide, problem.numerics)
        evidence += inside(active, {q.key for q in (*fixed, *c.quantities)}, departure, spread)
        gain = evidence - reference
        if len(where) == 1 and c.quantities[0].one_sided and departure[where[0]] < 0.0:
            gain = -math.inf
        best = Scored(gain, c, None)
        for probe in lin.probes.get(c, ()):
            best = max(best, Scored(evidence_at(probe, c) - reference, c, probe), key=lambda item: item.gain)
        scored.append(best)
    return sorted(scored, key=lambda item: -item.gain)


def separation(
    problem: Problem, fit: Fit, members: Sequence[Candidate], rival: Candidate | None, lin: Linearisation
) -> float:
    """d_sep of a cause, or of several together: the size of what they do, whitened, with nuisances, other causes and the rival projected out."""
    own = {q.key for c in members for q in c.quantities}
    gone = keys_of(members)
    departure = np.array(
        [v - q.off if q.key in own else 0.0 for q, v in zip(fit.active, fit.values, strict=True)]
    )
    wide = {q.key for q in fit.causes}
    parts = [
        fit.columns[:, i] * math.sqrt(prior_variance(q, q.key in wide))
        for i, q in enumerate(fit.active)
        if q.key not in gone
    ]
    if rival is not None and rival in lin.signatures:
        parts += [lin.signatures[rival][:, k] * q.scale for k, q in enumerate(rival.quantities)]
    J = np.hstack([np.stack(parts, axis=1), problem.numerics])
    return float(left_over(J, (fit.columns @ departure)[:, None])[0])


def observable(problem: Problem, lin: Linearisation) -> dict[str, float]:
    """Whitened size of every effect's strongest signature at its prior scale, nuisances projected out."""
    J = np.hstack(
        [
            np.stack([lin.columns[q.key] * q.tolerance for q in problem.nuisances], axis=1),
            problem.numerics,
        ]
    )
    sizes: dict[str, float] = {}
    for c, signature in lin.signatures.items():
        size = left_over(J, signature * [q.scale for q in c.quantities])[0]
        sizes[c.effect] = max(float(size), sizes.get(c.effect, 0.0))
    return sizes


def left_over(J: Floats, signature: Floats) -> Floats:
    """Sizes, largest first, of signatures (m, k) that columns J (m, a) with coefficients of unit prior deviation do not explain."""
    half = np.linalg.solve(np.linalg.cholesky(np.eye(J.shape[1]) + J.T @ J), J.T @ signature)
    squares = np.linalg.eigvalsh(signature.T @ signature - half.T @ half)[::-1]
    return np.sqrt(np.maximum(squares, 0.0))
