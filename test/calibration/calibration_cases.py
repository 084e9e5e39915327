"""Tips of a known robot in slow motion, as a tracker would report them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_dynamics.calibration.tip_samples import TipSamples
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.robot import Robot

COUNT, PERIOD_S = 240, 0.1


def motion(robot: Robot, t):
    """Readings (k, 2N) of slow turns and slides about the rest."""
    n = robot.n_tubes
    beta, alpha = np.array(robot.rest.beta.value), np.array(robot.rest.alpha.value)
    turns = [alpha[i] + 0.9 * np.sin(2 * np.pi * (0.05 + 0.03 * i) * t) for i in range(n)]
    slides = [beta[i] + 0.008 * np.sin(2 * np.pi * 0.06 * t) for i in range(n)]
    return np.stack([*turns, *slides], axis=1)


def tips_of(
    robot: Robot,
    *,
    lag: float = 0.0,
    registration: Rotation | None = None,
    shift=(0.0, 0.0, 0.0),
    mount: Rotation | None = None,
    roll: bool = True,
    noise: float = 0.0,
    seed: int = 1,
) -> TipSamples:
    """What a tracker whose poses are ``lag`` s old reports of ``robot``, solved by the plain static solver.

    ``noise`` is in m for the position; the rotation's in rad is a hundred times that.
    """
    rng = np.random.default_rng(seed)
    stamps = PERIOD_S * np.arange(COUNT)
    joints = np.column_stack([stamps, motion(robot, stamps)])
    statics, n = Statics(Model(robot, nodes=40)), robot.n_tubes
    seen = np.stack([np.interp(stamps - lag, stamps, column) for column in joints[:, 1:].T], axis=1)
    position, quaternion = np.zeros((COUNT, 3)), np.zeros((COUNT, 4))
    guess = None
    for i, row in enumerate(seen):
        found = statics.solve(row[n:], row[:n], guess=guess)
        assert found.converged
        guess = found.x
        turn = Rotation.from_quat(np.roll(found.tip_quaternion, -1))
        turn = (registration or Rotation.identity()) * turn
        if not roll:  # the sensor's roll is arbitrary, and not measured
            turn = turn * Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
        turn = turn * (mount or Rotation.identity())
        turn = turn * Rotation.from_rotvec(100.0 * noise * rng.normal(size=3))
        position[i] = (registration or Rotation.identity()).apply(found.tip_position) + shift
        position[i] += noise * rng.normal(size=3)
        quaternion[i] = np.roll(turn.as_quat(), 1)
    axes = np.array([True] * 5 + [roll])
    return TipSamples(joints, stamps, position, quaternion, np.zeros((0, 7)), axes)
