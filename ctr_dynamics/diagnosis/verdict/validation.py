"""Validation: what the causes are worth on bags that were not fitted.

In: those bags as a problem, the re-calibrated and the extended fit. Out: errors with both and with the robot file, and the gain with its interval.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_options import ValidationOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel, Key
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.map_fit import Fit

Floats = NDArray[np.float64]


class BagErrors(NamedTuple):
    """Rms in m on one bag; NaN where the nominal model fails on it."""

    name: str
    recalibrated: float
    extended: float
    nominal: float = math.nan


@dataclass
class Validation:
    """Errors on bags that were not fitted, with the re-calibrated and the extended model.

    Attributes:
        gain: fraction of the squared error of the re-calibrated model that the extension removes. interval: of the gain, 95 %.
        nis_before, nis_after: whitened squares for each degree of freedom.
        bags: errors on each.
        rms_nominal: m, of the robot file as it is; NaN where it cannot be simulated.
    """

    rms_recalibrated: float
    rms_extended: float
    gain: float
    interval: tuple[float, float]
    nis_before: float
    nis_after: float
    bags: list[BagErrors] = field(default_factory=list)
    rms_nominal: float = math.nan

    @property
    def gain_over_nominal(self) -> float:
        """Fraction of the squared error of the robot file as it is that re-calibration and extension remove; NaN where that is not known."""
        return 1.0 - (self.rms_extended / self.rms_nominal) ** 2 if self.rms_nominal else math.nan

    def confirms(self, options: ValidationOptions) -> bool:
        """Whether the extension predicts the bags down to the noise; a motion that hardly shows the misfit confirms nothing."""
        misfit = self.nis_before - 1.0
        return self.nis_after <= options.predicted and self.nis_after - 1.0 <= options.left * misfit


def validate(held_out: Problem, recalibrated: Fit, extended: Fit) -> Validation | None:
    """Errors on ``held_out`` with both models; None where neither can be simulated.

    By half the step where that can be simulated: fits are corrected for their error in time as well.
    """
    squares: list[list[Floats]] = [[], [], []]
    stamps, bags = [], []
    nis = [0.0, 0.0, 0]
    shift = 0.0
    for forward_model, finer, whiten in zip(
        held_out.forward_models, held_out.finer.forward_models, held_out.whiteners, strict=True
    ):
        fitted = _residuals(forward_model, finer, (recalibrated.point, extended.point))
        if not all(np.isfinite(r).any() for r in fitted):
            continue
        nominal = _residuals(forward_model, finer, ({},))
        good = np.asarray(np.isfinite(np.hstack(fitted)).all(axis=1))
        for one, r in zip(squares, (*fitted, *nominal), strict=True):
            one.append(np.sum(r[good, :3] ** 2, axis=1))
        recording = forward_model.recording
        stamps.append(recording.stamps[good] + shift)
        shift += recording.duration + 1.0
        bags.append(BagErrors(recording.name, *(math.sqrt(one[-1].mean()) for one in squares)))
        if good[whiten.used].all():
            for i, r in enumerate(fitted):
                w = whiten(r)
                nis[i] += float(w @ w)
            nis[2] += whiten.size
    if not bags:
        return None
    a, b, as_in_the_file = (np.concatenate(one) for one in squares)
    return Validation(
        math.sqrt(a.mean()),
        math.sqrt(b.mean()),
        1.0 - float(b.sum() / a.sum()),
        block_bootstrap(a, b, np.concatenate(stamps), held_out.options.validation),
        nis[0] / nis[2] if nis[2] else math.nan,
        nis[1] / nis[2] if nis[2] else math.nan,
        bags,
        math.sqrt(as_in_the_file.mean()),
    )


def _residuals(
    forward_model: ForwardModel, finer: ForwardModel, points: Sequence[Mapping[Key, float]]
) -> list[Floats]:
    """(s, 6) at every point: with the ``finer`` steps if all can be simulated with them, else without; NaN where a simulation fails."""
    found = [left for point in points if (left := finer.residual_at(point)) is not None]
    if len(found) == len(points):
        return found
    return [forward_model.residual(forward_model.predict(point)) for point in points]


def block_bootstrap(
    before: Floats, after: Floats, stamps: Floats, options: ValidationOptions, seed: int = 0
) -> tuple[float, float]:
    """95 % interval of 1 - sum(after) / sum(before), squared errors (s,) at ``stamps`` (s,) s, over blocks of time."""
    block = np.floor(stamps / options.block_s).astype(int)
    groups = np.unique(block, return_inverse=True)[1]
    first, second = np.bincount(groups, before), np.bincount(groups, after)
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, len(first), (options.draws, len(first)))
    ratio = 1.0 - second[picks].sum(axis=1) / np.maximum(first[picks].sum(axis=1), 1e-30)
    low, high = np.percentile(ratio, [2.5, 97.5])
    return float(low), float(high)
