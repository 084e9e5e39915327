"""From a robot file to everything a prediction needs: parameter block, actuator chain, tracker chain.

Readings become actuators as alpha = play(gain * reading(t - delay) + offset), beta = reading + offset; a tracker reports
R_reg (scale (p + R lever)) + t_reg + drift * t, averaged over a window, of a time that its stamp misses by delay and skew.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.effects.registry import apply_effects
from ctr_dynamics.kernels.rotations import from_vector
from ctr_dynamics.robot import Robot

if TYPE_CHECKING:
    from ctr_dynamics.kernels.layout import Layout
    from ctr_dynamics.model.model import Model

Floats = NDArray[np.float64]


@dataclass
class Setup:
    """Numbers behind a prediction, SI units; written to by effects.

    Attributes:
        robot: where they come from. layout, block: the model's parameters.
        gain, offset, backlash: (N,) of the encoders, -, rad, rad. beta_offset: (N,) m. actuator_delay: s. load_shift: s, known loads come later
            by this much. tip_force: (3,) N, unknown constant force in base axes.
        rotation: (4,) wxyz of R_reg; translation, lever, drift: (3,) m, m, m/s; delay, averaging: s; skew: s/s; tracker_scale: -.
        extended: whether an effect has asked for the extended kernels.
    """

    robot: Robot
    layout: Layout
    block: Floats
    gain: Floats
    offset: Floats
    backlash: Floats
    beta_offset: Floats
    actuator_delay: float
    load_shift: float
    tip_force: Floats
    rotation: Floats
    translation: Floats
    lever: Floats
    drift: Floats
    delay: float
    averaging: float
    skew: float
    tracker_scale: float
    extended: bool = False

    @property
    def n(self) -> int:
        """Number of tubes."""
        return self.robot.n_tubes

    def scale(self, group: str, tube: int | None, factor: float) -> None:
        """Multiply a group of the parameter block, for one tube (from 0) or all."""
        rows = self.layout[group]
        self.block[rows if tube is None else rows.start + tube] *= factor

    def add(self, group: str, change: float | Floats, index: int = 0) -> None:
        """Add to the rows of a group from ``index`` on."""
        start = self.layout[group].start + index
        self.block[start : start + np.size(change)] += change

    def put(self, group: str, value: float | Floats, index: int = 0) -> None:
        """Set rows of a group from ``index`` on."""
        start = self.layout[group].start + index
        self.block[start : start + np.size(value)] = value

    def extend(self, group: str, value: float | Floats, index: int = 0) -> None:
        """:meth:`put` rows that only the extended kernels read, and ask for these."""
        self.put(group, value, index)
        self.extended = True

    def copy(self) -> Setup:
        """An independent copy."""
        other = copy.copy(self)
        for name in (
            "block",
            "gain",
            "offset",
            "backlash",
            "beta_offset",
            "tip_force",
            "rotation",
            "translation",
            "lever",
            "drift",
        ):
            setattr(other, name, getattr(self, name).copy())
        return other


def make_setup(model: Model, extensions: bool = True) -> Setup:
    """Setup of ``model``'s robot file, with the effects that it names under ``extensions`` unless told otherwise."""
    robot = model.robot
    n, tracker = robot.n_tubes, robot.tracker
    setup = Setup(
        robot=robot,
        layout=model.layout,
        block=model.plain_parameters.copy(),
        gain=np.ones(n),
        offset=np.full(n, robot.encoders.offset.value),
        backlash=np.zeros(n),
        beta_offset=np.zeros(n),
        actuator_delay=0.0,
        load_shift=0.0,
        tip_force=np.zeros(3),
        rotation=from_vector(np.array(tracker.registration_rotation.value)),
        translation=np.array(tracker.registration_translation.value),
        lever=np.array(tracker.lever_arm.value),
        drift=np.zeros(3),
        delay=tracker.delay.value,
        averaging=0.0,
        skew=0.0,
        tracker_scale=1.0,
    )
    if extensions:
        apply_effects(setup, robot.extensions)
    return setup
