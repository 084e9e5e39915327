"""Candidates: the ways in which a model may be wrong, and how likely each is before the data.

In: the quantities of the catalogue for one robot, and where its tip was. Out: candidates, and log prior probabilities of sets of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ctr_dynamics.diagnosis.diagnosis_options import PriorOptions
from ctr_dynamics.diagnosis.forward_model import Key
from ctr_dynamics.effects import EFFECTS, EffectQuantity

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Candidate:
    """One way in which the model may be wrong.

    Attributes:
        effect: ID. quantities: free parameters that have an effect from zero on. shapes: parameters that are free once there is one.
        start: coordinates of the shape parameters, and of the nuisances of its form, to begin with.
        sizes: coordinates of the first quantity to begin with, where the data tell; empty where screening does.
    """

    effect: str
    quantities: tuple[EffectQuantity, ...]
    shapes: tuple[EffectQuantity, ...] = ()
    start: tuple[tuple[Key, float], ...] = ()
    sizes: tuple[float, ...] = ()

    @property
    def label(self) -> str:
        """Effect, and the parameter where there is a choice."""
        names = ",".join(q.name for q in self.quantities)
        return f"{self.effect}({names})"

    @property
    def keys(self) -> frozenset[Key]:
        """Its free parameters."""
        return frozenset(q.key for q in self.quantities + self.shapes)


def candidates(
    known: Sequence[EffectQuantity], positions: Floats, options: PriorOptions | None = None
) -> list[Candidate]:
    """Every candidate of the catalogue.

    Args:
        known: quantities of the catalogue for the robot.
        positions: (s, 3) m of the tip. Springs are anchored at their mean to begin with. Contact planes lie on each of six sides, so
            that a tenth of the positions is behind.
    """
    options = options or PriorOptions()
    anchor = positions.mean(axis=0)
    planes: list[Mapping[str, float]] = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            normal = dict.fromkeys(("nx", "ny", "nz"), 0.0)
            normal["n" + "xyz"[axis]] = sign
            planes.append(
                {**normal, "offset_m": float(np.quantile(sign * positions[:, axis], options.behind_plane))}
            )
    found: list[Candidate] = []
    for name, effect in EFFECTS.items():
        if effect.nuisance or not effect.searched:
            continue
        own = [q for q in known if q.effect == name]
        amplitudes = [q for q in own if not q.parameter.shape]
        shapes = [q for q in own if q.parameter.shape]
        groups: list[tuple[list[EffectQuantity], list[EffectQuantity]]]
        if effect.joint:
            groups = [(amplitudes, shapes)]
        else:
            groups = [([q], [s for s in shapes if tube_of(s) == tube_of(q)]) for q in amplitudes]
        for group, extra in groups:
            presets = effect.presets if name != "contact" else planes
            for preset in presets:
                form = [q for q in known if q.effect in effect.form]
                start = {q.key: preset.get(q.parameter.name.split(".")[-1], q.off) for q in (*extra, *form)}
                for i, letter in enumerate("xyz"):
                    key = (name, f"anchor_{letter}_m")
                    if key in start:
                        start[key] = float(anchor[i])
                if all(math.isfinite(v) for v in start.values()):
                    shapes_here = tuple(replace(q, off=start[q.key]) for q in extra)
                    found.append(Candidate(name, tuple(group), shapes_here, tuple(start.items())))
    return found


def causes_of(members: Sequence[Candidate]) -> tuple[EffectQuantity, ...]:
    """Every free parameter of ``members``, shapes included."""
    return tuple(q for c in members for q in c.quantities + c.shapes)


def keys_of(members: Sequence[Candidate]) -> frozenset[Key]:
    """Free parameters of a set of candidates."""
    return frozenset().union(*(c.keys for c in members)) if members else frozenset()


def tube_of(q: EffectQuantity) -> str:
    """Tube of a quantity, empty where it belongs to none."""
    return q.name.split(".")[0] if q.name.startswith("tube") else ""


def log_prior(
    members: Sequence[Candidate],
    every: Sequence[Candidate],
    options: PriorOptions,
    point: Mapping[Key, float],
) -> float:
    """Log prior probability of a set of candidates among ``every``.

    The parameters that an effect may be tried with, as those of each tube, share its probability. Presets do not: they are where one search
    starts from, and together they are the prior of its shape.

    Args:
        point: coordinates of a fit; shapes that it does not hold are where they start.
    """
    if not members:
        return math.log(options.clean)
    effects = len({c.effect for c in every})
    mass = {1: options.single, 2: options.pair}.get(len(members), options.triple)
    total = math.log(mass / math.comb(effects, len(members)))
    for m in members:
        total -= math.log(max(1, len({c.keys for c in every if c.effect == m.effect})))
        total += _shape_gain(m, [c for c in every if c.keys == m.keys], point)
    return total


def _shape_gain(member: Candidate, forms: Sequence[Candidate], point: Mapping[Key, float]) -> float:
    """Log density of the shape of ``member`` by the priors around all presets, each as likely, over that around its own.

    A fit has the latter. Priors around presets that are near one another overlap, and more of them make no shape less likely.
    """
    starts = {tuple(q.off for q in c.shapes): c.shapes for c in (*forms, member)}
    if len(starts) < 2:
        return 0.0
    own = sum(((point.get(q.key, q.off) - q.off) / q.scale) ** 2 for q in member.shapes)
    squares = []
    for shapes in starts.values():
        departures = [point.get(q.key, m.off) - q.off for q, m in zip(shapes, member.shapes, strict=True)]
        turned = [
            math.remainder(d, q.parameter.period) if q.parameter.period else d
            for d, q in zip(departures, shapes, strict=True)
        ]
        squares.append(sum((d / q.scale) ** 2 for d, q in zip(turned, shapes, strict=True)))
    return float(logsumexp(-0.5 * np.array(squares))) - math.log(len(squares)) + 0.5 * own
