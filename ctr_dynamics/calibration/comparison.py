"""Static model against measured tips, row by row."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.calibration.tip_errors import TipErrors, tip_errors
from ctr_dynamics.calibration.tip_fit import TipModel
from ctr_dynamics.calibration.tip_samples import TipSamples
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
HEADER = (
    "at", "measured_x", "measured_y", "measured_z", "expected_x", "expected_y", "expected_z", "error", "angle"
)  # fmt: skip


@dataclass(frozen=True)
class Comparison:
    """Measured against expected tips.

    Attributes:
        samples: what was measured. residual: (s, 6) measured minus expected, NaN where the model has no solution. errors: their sizes.
    """

    samples: TipSamples
    residual: Floats
    errors: TipErrors


def compare(robot: Robot, samples: TipSamples, nodes: int) -> Comparison:
    """``samples`` against the static model of ``robot``, with its tracker's registration, lever arm and delay."""
    model = TipModel(robot, samples, nodes=nodes)
    residual = model.residual({}, model.tips({}))
    return Comparison(samples, residual, tip_errors(residual, model))


def table(found: Comparison, lines: tuple[int, ...]) -> Iterator[tuple[float, ...]]:
    """Rows under :data:`HEADER`: line of the table or time of the bag in s, positions and error in m, angle in rad."""
    samples, residual = found.samples, found.residual
    at = np.array(lines, dtype=float) if lines else samples.stamps
    for t, position, left in zip(at, samples.position, residual, strict=True):
        yield (
            t,
            *position,
            *(position - left[:3]),
            float(np.linalg.norm(left[:3])),
            float(np.linalg.norm(left[3:])),
        )
