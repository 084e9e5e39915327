"""Validation: what the causes are worth on bags that were not fitted.

In: those bags as a problem, the re-calibrated and the extended fit. Out: errors with both, and the gain with its interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.diagnosis.diagnosis_options import ValidationOptions
from ctr_dynamics.diagnosis.inference.fit_problem import Problem
from ctr_dynamics.diagnosis.inference.map_fit import Fit

Floats = NDArray[np.float64]


@dataclass
class Validation:
    """Errors on bags that were not fitted, with the re-calibrated and the extended model.

    Attributes:
        gain: fraction of the squared error that the extension removes. interval: of the gain, 95 %.
        nis_before, nis_after: whitened squares for each degree of freedom.
        bags: name, and rms in m with either model.
    """

    rms_recalibrated: float
    rms_extended: float
    gain: float
    interval: tuple[float, float]
    nis_before: float
    nis_after: float
    bags: list[tuple[str, float, float]] = field(default_factory=list)

    def confirms(self, options: ValidationOptions) -> bool:
        """Whether the extension predicts the bags down to the noise; a motion that hardly shows the misfit confirms nothing."""
        misfit = self.nis_before - 1.0
        return self.nis_after <= options.predicted and self.nis_after - 1.0 <= options.left * misfit


def validate(held_out: Problem, recalibrated: Fit, extended: Fit) -> Validation | None:
    """Errors on ``held_out`` with both models; None where neither can be simulated.

    By half the step where that can be simulated: fits are corrected for their error in time as well.
    """
    before, after, stamps, bags = [], [], [], []
    nis = [0.0, 0.0, 0]
    shift = 0.0
    points = (recalibrated.point, extended.point)
    for forward_model, finer, whiten in zip(
        held_out.forward_models, held_out.finer.forward_models, held_out.whiteners, strict=True
    ):
        residuals = [left for point in points if (left := finer.residual_at(point)) is not None]
        if len(residuals) < len(points):
            residuals = [forward_model.residual(forward_model.predict(point)) for point in points]
        if not all(np.isfinite(r).any() for r in residuals):
            continue
        good = np.isfinite(residuals[0]).all(axis=1) & np.isfinite(residuals[1]).all(axis=1)
        squares = [np.sum(r[good, :3] ** 2, axis=1) for r in residuals]
        before.append(squares[0])
        after.append(squares[1])
        recording = forward_model.recording
        stamps.append(recording.stamps[good] + shift)
        shift += recording.duration + 1.0
        bags.append((recording.name, math.sqrt(squares[0].mean()), math.sqrt(squares[1].mean())))
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
        block_bootstrap(a, b, np.concatenate(stamps), held_out.options.validation),
        nis[0] / nis[2] if nis[2] else math.nan,
        nis[1] / nis[2] if nis[2] else math.nan,
        bags,
    )


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
