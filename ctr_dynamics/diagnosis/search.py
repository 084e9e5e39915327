"""Which causes explain the data: screening along signatures, joint fits, evidence, several causes, separability.

Explanations are sets of at most three candidates. Their probabilities follow from Laplace evidence with priors on causes and sizes, tempered
against overconfidence (docs/diagnosis.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from ctr_dynamics.effects import EFFECTS, Quantity

from .fit import Fit, Key, Problem, fit, inside, posterior, variances

Floats = NDArray[np.float64]

LOG_PRIOR_CLEAN = math.log(0.5)
PRIOR_SINGLE, PRIOR_PAIR, PRIOR_TRIPLE = 0.38, 0.1, 0.02
TEMPERATURE = 1.6  # of the log evidence: a judgement against overconfidence, not fitted to cases
SHORTLIST = 8  # candidates that are fitted in full
SECOND = 4  # second causes that are fitted beside a first
HOPELESS = 0.3  # of the misfit: two causes that leave more are not made right by a third
SECOND_EVIDENCE = 5.0  # log evidence that a further cause must add
SEPARATION = 5.0  # whitened units: below, two explanations cannot be told apart
PROBE = 0.7  # of the scale: finite probes of effects without a derivative at zero
MIN_SCREEN = 1.0  # log evidence by the linear estimate below which a candidate is not worth a fit


@dataclass(frozen=True)
class Candidate:
    """One way in which the model may be wrong.

    Attributes:
        effect: ID. quantities: free parameters that have an effect from zero on. shapes: parameters that are free once there is one.
        start: coordinates of the shape parameters to begin with.
    """

    effect: str
    quantities: tuple[Quantity, ...]
    shapes: tuple[Quantity, ...] = ()
    start: tuple[tuple[Key, float], ...] = ()

    @property
    def label(self) -> str:
        """Effect, and the parameter where there is a choice."""
        names = ",".join(q.name for q in self.quantities)
        return f"{self.effect}({names})"

    @property
    def keys(self) -> frozenset[Key]:
        """Its free parameters."""
        return frozenset(q.key for q in self.quantities + self.shapes)


def candidates(known: Sequence[Quantity], positions: Floats) -> list[Candidate]:
    """Every candidate of the catalogue.

    ``positions`` (s, 3) m of the tip say where springs are anchored to begin with, and where planes of contact may lie: on each of six sides,
    so that a tenth of the samples is behind.
    """
    anchor = positions.mean(axis=0)
    planes: list[Mapping[str, float]] = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            normal = dict.fromkeys(("nx", "ny", "nz"), 0.0)
            normal["n" + "xyz"[axis]] = sign
            planes.append({**normal, "offset_m": float(np.quantile(sign * positions[:, axis], 0.1))})
    found: list[Candidate] = []
    for name, effect in EFFECTS.items():
        if effect.nuisance:
            continue
        own = [q for q in known if q.effect == name]
        amplitudes = [q for q in own if not q.parameter.shape]
        shapes = [q for q in own if q.parameter.shape]
        groups: list[tuple[list[Quantity], list[Quantity]]]
        if effect.joint:
            groups = [(amplitudes, shapes)]
        else:
            groups = [([q], [s for s in shapes if _tube(s) == _tube(q)]) for q in amplitudes]
        for group, extra in groups:
            presets = effect.presets if name != "contact" else planes
            for preset in presets:
                start = {s.key: preset.get(s.parameter.name.split(".")[-1], s.off) for s in extra}
                for i, letter in enumerate("xyz"):
                    key = (name, f"anchor_{letter}_m")
                    if key in start:
                        start[key] = float(anchor[i])
                if all(math.isfinite(v) for v in start.values()):
                    shapes_here = tuple(replace(q, off=start[q.key]) for q in extra)
                    found.append(Candidate(name, tuple(group), shapes_here, tuple(start.items())))
    return found


def _tube(q: Quantity) -> str:
    return q.name.split(".")[0] if q.name.startswith("tube") else ""


@dataclass
class Explanation:
    """A set of candidates with its fit."""

    members: tuple[Candidate, ...]
    fit: Fit
    score: float = 0.0  # log posterior, up to a constant
    lin: Linearisation | None = None  # of everything else at its best point, where that was needed

    @property
    def effects(self) -> tuple[str, ...]:
        """Sorted effect IDs."""
        return tuple(sorted({c.effect for c in self.members}))

    @property
    def keys(self) -> frozenset[Key]:
        """Free parameters of its causes."""
        return frozenset().union(*(c.keys for c in self.members)) if self.members else frozenset()


@dataclass
class Linearisation:
    """Residual and columns of every candidate at one point."""

    point: dict[Key, float]
    residual: Floats
    quantities: tuple[Quantity, ...]
    columns: Floats
    signatures: dict[Candidate, Floats] = field(default_factory=dict)

    def columns_of(self, wanted: Sequence[Quantity]) -> Floats:
        """(m, len(wanted))."""
        where = {q.key: i for i, q in enumerate(self.quantities)}
        return self.columns[:, [where[q.key] for q in wanted]]


def log_prior(members: Sequence[Candidate], every: Sequence[Candidate]) -> float:
    """Log prior probability of an explanation; variants of an effect share its part."""
    if not members:
        return LOG_PRIOR_CLEAN
    effects = len({c.effect for c in every})
    mass = {1: PRIOR_SINGLE, 2: PRIOR_PAIR}.get(len(members), PRIOR_TRIPLE)
    count = math.comb(effects, len(members))
    variants = sum(math.log(max(1, sum(c.effect == m.effect for c in every))) for m in members)
    return math.log(mass / count) - variants


def linearise(
    problem: Problem, point: Mapping[Key, float], pool: Sequence[Candidate], note: Callable[[str], None]
) -> Linearisation | None:
    """Columns of nuisances and all candidates at ``point``; those without a derivative by finite probes."""
    smooth: dict[Key, Quantity] = {q.key: q for q in problem.nuisances}
    for c in pool:
        if EFFECTS[c.effect].smooth and not c.shapes and not c.quantities[0].extended:
            smooth.update({q.key: q for q in c.quantities})
    wanted = tuple(smooth.values())
    found = problem.linearise(point, wanted)
    if found is None:
        return None
    residual, columns = found
    result = Linearisation(dict(point), residual, wanted, columns)
    # effects with shape parameters or a kink need the shape, or a finite size
    note("probing effects that are not smooth")
    groups: dict[tuple, list[Candidate]] = {}
    for c in pool:
        if c.shapes and EFFECTS[c.effect].smooth:
            groups.setdefault(tuple(sorted(c.start)), []).append(c)
    merged: list[tuple[dict[Key, float], list[Candidate]]] = []
    for start, members in groups.items():
        for at, others in merged:  # presets of different effects go together
            if not ({k for k, _ in start} & set(at)):
                at.update(dict(start))
                others.extend(members)
                break
        else:
            merged.append((dict(start), list(members)))
    rest = [c for c in pool if EFFECTS[c.effect].smooth and not c.shapes and c.quantities[0].extended]
    merged = merged or [({}, [])]
    merged[0][1].extend(rest)
    for at, members in merged:
        quantities = tuple(q for c in members for q in c.quantities)
        here = {**at, **point}
        shaped_found = problem.linearise(here, quantities)
        if shaped_found is None:
            continue
        start_column = 0
        for c in members:
            width = len(c.quantities)
            result.signatures[c] = shaped_found[1][:, start_column : start_column + width]
            start_column += width
    rough = [c for c in pool if not EFFECTS[c.effect].smooth]

    def probe(c: Candidate) -> Floats | None:
        parts = []
        for q in c.quantities:
            size = PROBE * q.scale
            new = problem.residual({**point, **dict(c.start), q.key: q.off + size})
            if new is None:
                return None
            parts.append((residual - new) / size)
        return np.stack(parts, axis=1)

    for c, signature in zip(
        rough, Parallel(2, prefer="threads")(delayed(probe)(c) for c in rough), strict=True
    ):
        if signature is not None:
            result.signatures[c] = signature
    for c in pool:
        if c not in result.signatures and not c.shapes and EFFECTS[c.effect].smooth:
            result.signatures[c] = result.columns_of(c.quantities)
    return result


def screen(
    problem: Problem, lin: Linearisation, base: Sequence[Candidate], pool: Sequence[Candidate]
) -> list[tuple[float, Candidate]]:
    """Linear log evidence gained by each candidate beside ``base``, best first; one-sided causes of the wrong sign gain nothing."""
    fixed = tuple(q for c in base for q in c.quantities + c.shapes)
    active, variance = variances(problem.nuisances, fixed)
    columns = np.hstack([_column(lin, base, q) for q in active])
    values = np.array([lin.point.get(q.key, q.off) - q.off for q in active])
    before, spread, reference = posterior(lin.residual, columns, values, variance, problem.numerics)
    reference += inside(active, {q.key for q in fixed}, before, spread)
    scored = []
    taken = {c.effect + _tube(c.quantities[0]) for c in base}
    nuisance = {q.key: i for i, q in enumerate(active)}
    for c in pool:
        if c.effect + _tube(c.quantities[0]) in taken or c not in lin.signatures:
            continue
        signature = lin.signatures[c]
        wide, J = variance.copy(), columns
        new = [i for i, q in enumerate(c.quantities) if q.key not in nuisance]
        for q in c.quantities:
            if q.key in nuisance:
                wide[nuisance[q.key]] += q.scale**2
        if new:
            J = np.hstack([columns, signature[:, new]])
            wide = np.append(wide, [c.quantities[i].scale ** 2 for i in new])
        start = np.append(values, np.zeros(len(new)))
        departure, spread, evidence = posterior(lin.residual, J, start, wide, problem.numerics)
        evidence += inside(active, {q.key for q in (*fixed, *c.quantities)}, departure, spread)
        gain = evidence - reference
        for q, value in zip(c.quantities, _own(c, nuisance, new, departure, len(variance)), strict=True):
            if math.isfinite(q.low) and q.low == q.off and value < 0.0 and len(c.quantities) == 1:
                gain = -math.inf
        scored.append((gain, c))
    return sorted(scored, key=lambda item: -item[0])


def _own(
    c: Candidate, nuisance: Mapping[Key, int], new: Sequence[int], departure: Floats, count: int
) -> list[float]:
    """Departures of the candidate's own quantities."""
    out = []
    for i, q in enumerate(c.quantities):
        out.append(
            float(departure[nuisance[q.key]] if q.key in nuisance else departure[count + list(new).index(i)])
        )
    return out


def _column(lin: Linearisation, base: Sequence[Candidate], q: Quantity) -> Floats:
    where = {x.key: i for i, x in enumerate(lin.quantities)}
    if q.key in where:
        return lin.columns[:, [where[q.key]]]
    for c in base:
        for i, x in enumerate(c.quantities):
            if x.key == q.key and c in lin.signatures:
                return lin.signatures[c][:, [i]]
    return np.zeros((len(lin.residual), 1))


def explain(
    problem: Problem, members: Sequence[Candidate], start: Mapping[Key, float], lin: Linearisation | None
) -> Explanation | None:
    """Fit of a set of candidates from ``start``; the first step uses the columns of ``lin`` where it stands at that point."""
    causes = tuple(q for c in members for q in c.quantities + c.shapes)
    point = dict(start)
    fresh = [c for c in members if not any(q.key in start for q in c.quantities)]
    for c in fresh:
        point.update(dict(c.start))
    nudged = False
    for c in fresh:
        if (
            c.shapes or not EFFECTS[c.effect].smooth
        ):  # shapes have no derivative until there is something to shape
            signature = lin.signatures.get(c) if lin is not None else None
            sizes = (
                _first_size(problem, lin, c, signature)
                if signature is not None and lin is not None
                else [0.3 * q.scale for q in c.quantities]
            )
            for q, size in zip(c.quantities, sizes, strict=True):
                point[q.key] = min(
                    max(q.off + size, q.low + 0.02 * q.scale if math.isfinite(q.low) else -math.inf), q.high
                )
            nudged = True
    extra = problem.nuisances
    if any(c.effect == "clearance" for c in members):
        extra = problem.nuisances + tuple(problem_share(problem))
    own = Problem(
        problem.robot, problem.experiments, problem.whiteners, extra, problem.numerics, problem.offset
    )
    known = None
    if lin is not None and not nudged and lin.point == point:
        known = (lin.residual, lin.columns, lin.quantities)
    result = fit(own, causes, point, known)
    return None if result is None else Explanation(tuple(members), result)


def problem_share(problem: Problem) -> list[Quantity]:
    """The model-form nuisance of clearance."""
    from ctr_dynamics.effects import quantities

    return [q for q in quantities(problem.robot) if q.effect == "play_kinematics"]


def _first_size(problem: Problem, lin: Linearisation, c: Candidate, signature: Floats) -> list[float]:
    """Linear estimate of a candidate's departures beside the nuisances."""
    variance = np.append([q.tolerance**2 for q in problem.nuisances], [q.scale**2 for q in c.quantities])
    J = np.hstack([lin.columns_of(problem.nuisances), signature])
    values = np.append(
        [lin.point.get(q.key, q.off) - q.off for q in problem.nuisances], np.zeros(len(c.quantities))
    )
    departure, _, _ = posterior(lin.residual, J, values, variance, problem.numerics)
    return [
        float(np.clip(d, -2.0 * q.scale, 2.0 * q.scale))
        for d, q in zip(departure[-len(c.quantities) :], c.quantities, strict=True)
    ]


@dataclass
class Search:
    """Outcome of a search.

    Attributes:
        explanations: all fitted, likeliest first, with ``score``; the clean one is among them.
        probabilities: of each. clean: the recalibrated fit. linearised: at the recalibrated point. screened: linear gains there.
    """

    explanations: list[Explanation]
    probabilities: Floats
    clean: Explanation
    linearised: Linearisation
    screened: list[tuple[float, Candidate]]
    pool: list[Candidate]

    @property
    def best(self) -> Explanation:
        """The likeliest."""
        return self.explanations[0]


def search(
    problem: Problem, pool: list[Candidate], clean: Fit, note: Callable[[str], None], workers: int = 2
) -> Search | None:
    """Find the explanations that deserve probability, from the recalibrated fit ``clean`` on."""
    base = Explanation((), clean)
    note("signatures of all candidates")
    lin = linearise(problem, clean.point, pool, note)
    if lin is None:
        return None
    screened = screen(problem, lin, (), pool)
    found = [base]
    first = _distinct([c for gain, c in screened if gain > MIN_SCREEN][: SHORTLIST + 3])[:SHORTLIST]
    note(f"fitting {len(first)} single causes")
    # one start from the recalibrated point and, where that is far away, it is reached by the fit's own steps
    found += _fits(problem, [((c,), clean.point, lin) for c in first], workers)
    _score(found, pool)
    top = found[0]
    if top.members:
        found += _seconds(problem, pool, found, clean, note, workers)
        _score(found, pool)
    return Search(found, _probabilities(found, problem), base, lin, screened, pool)


def _seconds(
    problem: Problem,
    pool: list[Candidate],
    found: list[Explanation],
    clean: Fit,
    note: Callable[[str], None],
    workers: int,
) -> list[Explanation]:
    """Two causes, and three where that pays: what each of the best leaves is screened again."""
    out: list[Explanation] = []
    tried: set[frozenset[str]] = set()
    leaders = [e for e in found if e.members][:2]
    much = _leftover(problem, leaders[0].fit) > 4.0
    leaders = [e for e in leaders if e.score > leaders[0].score - (60.0 if much else 3.0)]
    for _ in range(2):
        new: list[Explanation] = []
        for leader in leaders:
            note(f"what {', '.join(leader.effects)} leaves")
            leader.lin = linearise(problem, leader.fit.point, pool, note)
            if leader.lin is None:
                continue
            gains = [
                c for g, c in screen(problem, leader.lin, leader.members, pool) if g > SECOND_EVIDENCE - 2.0
            ]
            jobs = []
            for c in _distinct(gains)[:SECOND]:
                names = frozenset(x.label for x in (*leader.members, c))
                if names not in tried:
                    tried.add(names)
                    jobs.append(((*leader.members, c), leader.fit.point, leader.lin))
            enough = leader.fit.log_evidence + SECOND_EVIDENCE
            new += [e for e in _fits(problem, jobs, workers) if e.fit.log_evidence > enough]
        if not new:
            break
        out += new
        _score(new, pool)
        leaders = new[:1]
        if _leftover(problem, new[0].fit) > HOPELESS * _leftover(problem, clean):
            break  # a third cause would not save it: it is outside the catalogue
    return out


def _leftover(problem: Problem, result: Fit) -> float:
    """Deviations by which the residual's squares exceed what noise gives."""
    dof = problem.size
    return (result.chi2 - dof) / math.sqrt(2.0 * dof)


def _fits(problem: Problem, jobs: list, workers: int) -> list[Explanation]:
    results = Parallel(workers, prefer="threads")(
        delayed(explain)(problem, members, start, lin) for members, start, lin in jobs
    )
    return [e for e in results if e is not None]


def _distinct(found: list[Candidate]) -> list[Candidate]:
    """One preset for each set of parameters: the first."""
    seen: set[frozenset[Key]] = set()
    out = []
    for c in found:
        if c.keys not in seen:
            seen.add(c.keys)
            out.append(c)
    return out


def _score(found: list[Explanation], pool: Sequence[Candidate]) -> None:
    """Sort by log posterior; the better of two fits of the same set stays."""
    best: dict[frozenset[Key], Explanation] = {}
    for e in found:
        e.score = e.fit.log_evidence + log_prior(e.members, pool)
        if e.keys not in best or best[e.keys].score < e.score:
            best[e.keys] = e
    found[:] = sorted(best.values(), key=lambda e: -e.score)


def _probabilities(found: Sequence[Explanation], problem: Problem) -> Floats:
    """Of each explanation: softmax of the tempered score, with the noise that the best one leaves."""
    inflation = max(1.0, found[0].fit.chi2 / problem.size)
    scores = np.array(
        [e.fit.log_evidence / (TEMPERATURE * inflation) + (e.score - e.fit.log_evidence) for e in found]
    )
    weights = np.exp(scores - scores.max())
    return weights / weights.sum()


def separation(
    problem: Problem, explanation: Explanation, member: Candidate, rival: Candidate | None, lin: Linearisation
) -> float:
    """d_sep of one cause: the size of its signature, whitened, with nuisances, other causes and the rival projected out."""
    result = explanation.fit
    own = {q.key for q in member.quantities}
    off = {q.key: q.off for q in member.quantities}
    values = np.array(
        [v - off[q.key] if q.key in own else 0.0 for q, v in zip(result.active, result.values, strict=True)]
    )
    signature = result.columns @ values
    names = {q.key for q in problem.nuisances}
    others = [
        i
        for i, q in enumerate(result.active)
        if q.key not in member.keys or (q.key in names and q.key not in own)
    ]
    wide = {q.key for q in result.causes}
    prior = {q.key: q.tolerance**2 + (q.scale**2 if q.key in wide else 0.0) for q in result.active}
    parts = [result.columns[:, i] * math.sqrt(prior[result.active[i].key]) for i in others]
    if rival is not None and rival in lin.signatures:
        parts += [lin.signatures[rival][:, k] * q.scale for k, q in enumerate(rival.quantities)]
    J = np.stack(parts, axis=1)
    if problem.numerics.size:
        J = np.hstack([J, problem.numerics])
    rhs = J.T @ signature
    left = float(signature @ signature - rhs @ np.linalg.solve(np.eye(J.shape[1]) + J.T @ J, rhs))
    return math.sqrt(max(left, 0.0))
