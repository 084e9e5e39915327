"""Static tips along samples: the model's side of an alignment or a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.calibration.tip_samples import TipSamples
from ctr_dynamics.effects import Plant
from ctr_dynamics.model.mesh import Key
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
NODES = 16  # the tip is right to 1 um; trackers are not


@dataclass
class Tips:
    """Static tips of samples.

    Attributes:
        pose: (s, 7) position m and unit quaternion wxyz; NaN where no equilibrium was found.
        unknowns: shooting unknowns of each, to start from; keys: their sections.
    """

    pose: Floats
    unknowns: list[Floats | None]
    keys: list[Key | None]

    @property
    def found(self) -> NDArray[np.bool_]:
        """(s,) whether there is an equilibrium."""
        return np.isfinite(self.pose[:, 0])


class StaticTips:
    """Solves the static model at the joints of samples, for any plant of a robot.

    A bag's samples are solved in the order of time, each from the one before: the robot stays on its branch.
    """

    def __init__(self, robot: Robot, samples: TipSamples, nodes: int = NODES) -> None:
        self.model = Model(robot, nodes=nodes)
        self.samples = samples
        self._statics = Statics(self.model)

    def solve(self, plant: Plant, delay: float, start: Tips | None = None) -> Tips:
        """Tips (s,) at the samples' stamps minus ``delay`` s, each from its place in ``start`` where that is given."""
        samples, n = self.samples, self.model.n
        times = samples.stamps - delay if samples.timed else samples.stamps
        drive = plant.actuators.forward(samples.encoders_at(times))
        if samples.timed and plant.actuators.delay:
            drive[:, :n] = plant.actuators.forward(samples.encoders_at(times - plant.actuators.delay))[:, :n]
        wrench = samples.loads_at(times - plant.load_delay if samples.timed else times)
        wrench[:, :3] += plant.tip_force
        pose = np.full((len(times), 7), np.nan)
        unknowns: list[Floats | None] = []
        keys: list[Key | None] = []
        guess: Floats | None = None
        key: Key | None = None
        for i, row in enumerate(drive):
            if start is not None:
                guess, key = start.unknowns[i], start.keys[i]
            elif not samples.timed:
                guess = None
            found = None
            if not self.model.robot.actuator_problem(row[n:]):
                found = self._statics.solve(
                    row[n:],
                    row[:n],
                    wrench[i, :3],
                    wrench[i, 3:],
                    guess=guess,
                    parameters=plant.block,
                    key=key,
                )
            if found is not None and found.converged:
                pose[i, :3], pose[i, 3:] = found.tip_position, found.tip_quaternion
                guess, key = found.x, found.key
            unknowns.append(guess)
            keys.append(key)
        return Tips(pose, unknowns, keys)
