"""The plant: everything that a prediction needs of a robot. Effects act on it, and the model is built from it.

Data flows one way: robot file, plant, model, estimator. The plant holds the parameter block of the model, the drives, and the sensors.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.layout import RowNumbers, parameter_rows
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing import (
    SENSORS,
    ActuatorCorrection,
    ActuatorModel,
    Measurement,
    TrackerCorrection,
    TrackerModel,
)

Floats = NDArray[np.float64]
CLEARANCE_MOMENT = 0.01  # N m at which 70 % of the clearance between two tubes is taken up


@dataclass
class Plant:
    """Numbers behind a prediction, SI units; effects change them.

    Attributes:
        robot: where they come from.
        layout, block: rows and values of the model's parameters; actuators and tip wrench are 0 in it.
        actuators: from encoders to the tubes' bases.
        sensors: by name; :attr:`tracker` is the one of the tip.
        load_delay: s, known loads act this much later than stamped.
        tip_force: (3,) N, unknown constant force in base axes.
        extended: whether an effect has asked for the extended kernels.
    """

    robot: Robot
    layout: RowNumbers
    block: Floats
    actuators: ActuatorModel
    sensors: dict[str, Measurement]
    load_delay: float
    tip_force: Floats
    extended: bool = False

    @classmethod
    def of_robot(cls, robot: Robot) -> Plant:
        """Plant of a robot file without its extensions."""
        layout = parameter_rows(robot.n_tubes)
        return cls(
            robot=robot,
            layout=layout,
            block=plain_block(robot, layout),
            actuators=ActuatorModel.of_robot(robot),
            sensors={name: kind.of_robot(robot) for name, kind in SENSORS.items()},
            load_delay=0.0,
            tip_force=np.zeros(3),
        )

    @property
    def n(self) -> int:
        """Number of tubes."""
        return self.robot.n_tubes

    @property
    def tracker(self) -> TrackerModel:
        """The tip tracker."""
        return cast(TrackerModel, self.sensors["tracker"])

    def change_actuators(self, **values: Any) -> None:
        """Give the actuator model other attributes."""
        self.actuators = self.actuators.changed(**values)

    def change_tracker(self, **values: Any) -> None:
        """Give the tracker model other attributes."""
        self.sensors["tracker"] = self.tracker.changed(**values)

    def correct_actuators(self, correction: ActuatorCorrection) -> None:
        """Put a further link behind gain and offset of the encoders."""
        self.change_actuators(corrections=(*self.actuators.corrections, correction))

    def correct_tracker(self, correction: TrackerCorrection) -> None:
        """Put a further link behind the registration of the tracker."""
        self.change_tracker(corrections=(*self.tracker.corrections, correction))

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

    def copy(self) -> Plant:
        """An independent copy."""
        other = copy.copy(self)
        other.block, other.tip_force = self.block.copy(), self.tip_force.copy()
        other.sensors = dict(self.sensors)
        return other

    def has_inputs_of(self, other: Plant) -> bool:
        """Whether actuators and loads of both follow alike from the same measurements."""
        return all(
            same(getattr(self, name), getattr(other, name))
            for name in ("actuators", "load_delay", "tip_force")
        )


def same(a: Any, b: Any) -> bool:
    """Whether two parts of a plant hold the same bits."""
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)
    if is_dataclass(a) and type(a).__eq__ is object.__eq__:
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return bool(a == b)


def plain_block(robot: Robot, layout: RowNumbers) -> Floats:
    """Parameter block of a robot file without its extensions; actuators and tip wrench are 0."""
    bodies = [tube.end_body for tube in robot.tubes]
    inertia = np.array([body.inertia.value if body else (0.0, 0.0, 0.0) for body in bodies])
    return layout.pack(
        bending_stiffness=[tube.bending_stiffness for tube in robot.tubes],
        torsional_stiffness=[tube.torsion_stiffness for tube in robot.tubes],
        mass_per_length=[tube.density.value * tube.area for tube in robot.tubes],
        inertia_per_length=[tube.density.value * tube.second_moment for tube in robot.tubes],
        bending_damping=[tube.bending_damping.value for tube in robot.tubes],
        torsion_damping=[tube.torsion_damping.value for tube in robot.tubes],
        precurvature=1.0,
        body_mass=[body.mass.value if body else 0.0 for body in bodies],
        body_inertia_x=inertia[:, 0],
        body_inertia_y=inertia[:, 1],
        body_inertia_z=inertia[:, 2],
        gravity=robot.gravity.value,
        tube_coulomb=robot.friction.tubes.coulomb.value,
        tube_viscous=robot.friction.tubes.viscous.value,
        epsilon=robot.friction.epsilon.value,
        base_coulomb=robot.friction.base.coulomb.value,
        base_viscous=robot.friction.base.viscous.value,
        clearance_moment=CLEARANCE_MOMENT,
        clearance_kinematics=1.0,
        learned_dry_speed=1.0,
    )
