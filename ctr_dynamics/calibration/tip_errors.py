"""How far the static model is from measured tips, in mm and in percent of the robot's length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.calibration.tip_fit import TipModel
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TipErrors:
    """Distances of expected from measured tips.

    Attributes:
        count: how many. unsolved: tips without an equilibrium of the model, which are left out.
        mean, rms, largest: m. length: m, mean length of the robot outside the base plate.
        angle: rad rms over the measured axes; None where none is measured.
    """

    count: int
    unsolved: int
    mean: float
    rms: float
    largest: float
    length: float
    angle: float | None

    def text(self) -> str:
        """In one line."""
        share = 100.0 / self.length
        words = (
            f"mean {1e3 * self.mean:.3f} mm, rms {1e3 * self.rms:.3f} mm, largest {1e3 * self.largest:.3f} mm "
            f"({share * self.mean:.2f} %, {share * self.rms:.2f} %, {share * self.largest:.2f} % of {1e3 * self.length:.1f} mm)"
        )
        if self.angle is not None:
            words += f", {np.degrees(self.angle):.2f} deg rms"
        return words + (f"; {self.unsolved} tips without an equilibrium" if self.unsolved else "")


def tip_errors(residual: Floats, model: TipModel) -> TipErrors:
    """Sizes of ``residual`` (s, 6), as :meth:`TipModel.residual` gives it; the robot's length is taken at the samples."""
    samples = model.samples
    found = np.isfinite(residual[:, 0])
    size = np.linalg.norm(residual[found][:, :3], axis=1)
    turned = samples.axes[3:].any() and found.any()
    if not found.any():
        size = np.array([np.nan])
    return TipErrors(
        count=int(found.sum()),
        unsolved=int((~found).sum()),
        mean=float(size.mean()),
        rms=float(np.sqrt(np.mean(size**2))),
        largest=float(size.max()),
        length=exposed_length(model.robot, samples.encoders_at(samples.stamps)),
        angle=float(np.sqrt(np.mean(np.sum(residual[found][:, 3:] ** 2, axis=1)))) if turned else None,
    )


def exposed_length(robot: Robot, readings: Floats) -> float:
    """Mean length (m) of tube 1 outside the plate at ``readings`` (s, 2N)."""
    return float(robot.lengths[0] + np.mean(readings[:, robot.n_tubes]))
