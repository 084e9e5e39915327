"""What a robot file holds: tubes, gravity, friction, sensors and the actuators' rest position."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from pydantic import Field, PrivateAttr, field_validator, model_validator

from ctr_dynamics.errors import InputError
from ctr_dynamics.parameters import axes_mask
from ctr_dynamics.robot.quantity import (
    Block,
    Floats,
    Number,
    Quantity,
    VectorQuantity,
    check_unit,
    number,
    problem,
    rule,
)
from ctr_dynamics.robot.tube import MAX_LENGTH, MILLIMETRES, Tube

MAX_TUBES = 8

_DEGREES = "a value in degrees is multiplied by pi/180"
Coulomb = Annotated[Quantity, rule("1", 0.0, 100.0)]
Viscous = Annotated[Quantity, rule("N m s/rad", 0.0, 1.0)]
Epsilon = Annotated[Quantity, rule("rad/s", 0.0, 1e5, above=True)]
Angle = Annotated[Quantity, rule("rad", -2 * math.pi, 2 * math.pi, hint=_DEGREES)]
AngleSigma = Annotated[Quantity, rule("rad", 0.0, math.pi, hint=_DEGREES)]
LengthSigma = Annotated[Quantity, rule("m", 0.0, MAX_LENGTH, hint=MILLIMETRES)]
Delay = Annotated[Quantity, rule("s", -1.0, 1.0, hint="a value in milliseconds is divided by 1000")]
Duration = Annotated[Quantity, rule("s", 0.0, 3600.0, above=True)]
RotationVector = Annotated[VectorQuantity, rule("rad", -2 * math.pi, 2 * math.pi, hint=_DEGREES)]
Translation = Annotated[VectorQuantity, rule("m", -100.0, 100.0, hint=MILLIMETRES)]
LeverArm = Annotated[VectorQuantity, rule("m", -1.0, 1.0, hint=MILLIMETRES)]
RotationSpeed = Annotated[Quantity, rule("rad/s", 0.0, 1e3, above=True, hint=_DEGREES)]
TranslationSpeed = Annotated[Quantity, rule("m/s", 0.0, 10.0, above=True, hint=MILLIMETRES)]


class Gravity(VectorQuantity):
    """Gravity acceleration in `ctr_base`, m/s^2.

    Attributes:
        direction_tolerance: 1-sigma of the direction about each of two axes across it, rad.
    """

    direction_tolerance: Number = 0.0

    @model_validator(mode="after")
    def _check(self) -> Gravity:
        if self.unit != "m/s^2":
            raise problem(f"unit '{self.unit}' must be 'm/s^2'; files hold SI units and radians only")
        size = float(np.linalg.norm(self.value))
        if size > 100:
            raise problem(f"gravity is {size:g} m/s^2, more than 100 m/s^2; give it in m/s^2")
        if not 0 <= self.direction_tolerance <= math.pi / 2:
            raise problem(
                f"direction_tolerance {self.direction_tolerance:g} rad is outside [0, 1.5708] rad; "
                "a value in degrees is multiplied by pi/180"
            )
        return self


class FrictionPair(Block):
    """Smoothed Coulomb coefficient mu' (torque per preload moment) and viscous coefficient (N m s/rad)."""

    coulomb: Coulomb
    viscous: Viscous


class Friction(Block):
    """Friction at the base plate (outermost tube) and between neighbouring tubes, paper (22)-(24).

    Attributes:
        epsilon: speed scale of the smoothed Coulomb law, rad/s.
    """

    base: FrictionPair
    tubes: FrictionPair
    epsilon: Epsilon


class Encoders(Block):
    """Rotary encoders, the same for every tube.

    Attributes:
        offset: true angle minus reading, rad; its tolerance holds for each tube on its own.
        noise: 1-sigma of a reading's white error, rad.
    """

    offset: Angle
    noise: AngleSigma


class TrackerNoise(Block):
    """1-sigma per axis: white position (m) and rotation (rad); drift (m) with correlation time (s)."""

    position: LengthSigma
    rotation: AngleSigma
    drift: LengthSigma
    drift_time: Duration


class Tracker(Block):
    """Tip tracker: it reports R_reg (p_tip + R_tip lever) + t_reg, and R_reg R_tip R_mount, `delay` seconds late.

    A file may give both parts of the registration as ``registration: {value: [4 rows of 4], unit: m, tolerance: .., rotation_tolerance: ..}``.

    Attributes:
        registration_rotation: (3,) rotation vector of R_reg, rad.
        registration_translation: (3,) t_reg, m.
        lever_arm: (3,) sensor position in the tip frame, m.
        delay: how much older than its stamp a pose is, s.
        noise: of the reported pose.
        mount_rotation: (3,) rotation vector of R_mount, the sensor in the tip frame, rad; None where its axes are those of the tip.
        axes: measured axes, a subset of "xyzrpy" (rotations about the tip's axes); None: all.
    """

    registration_rotation: RotationVector
    registration_translation: Translation
    lever_arm: LeverArm
    delay: Delay
    noise: TrackerNoise
    mount_rotation: RotationVector | None = None
    axes: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _registration_from_matrix(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "registration" not in data:
            return data
        for key in ("registration_rotation", "registration_translation"):
            if key in data:
                raise problem(f"both registration and {key} are given; keep one of them")
        others = {key: value for key, value in data.items() if key != "registration"}
        return {**others, **_registration(data["registration"])}

    @field_validator("axes")
    @classmethod
    def _axes_known(cls, axes: str | None) -> str | None:
        if axes is not None:
            try:
                axes_mask(axes)
            except InputError:
                raise problem(
                    f"'{axes}' is not a subset of 'xyzrpy' in that order; write for example xyz or xyzrp"
                ) from None
        return axes


def _registration(data: Any) -> dict[str, Any]:
    """Rotation and translation of a rigid motion that a file gives as a matrix of four by four."""
    check_unit(data, "m")
    known = {"value", "unit", "tolerance", "rotation_tolerance"}
    if set(data) - known:
        raise problem(
            f"registration: unknown key '{min(set(data) - known)}'; known keys are {', '.join(sorted(known))}"
        )
    rows = data.get("value")
    if (
        not isinstance(rows, (list, tuple))
        or [len(r) if isinstance(r, (list, tuple)) else 0 for r in rows] != [4] * 4
    ):
        raise problem("registration: value is no matrix; write four rows of four numbers")
    motion = np.array([[number(x) for x in row] for row in rows])
    turn = motion[:3, :3]
    error = float(np.abs(turn @ turn.T - np.eye(3)).max())
    if error > 1e-3 or np.linalg.det(turn) < 0.0 or np.abs(motion[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
        raise problem(
            f"registration: no rigid motion (rows of the rotation miss orthonormality by {error:.2g}, limit 0.001, "
            f"determinant {np.linalg.det(turn):.3g}); write [R t; 0 0 0 1] with t in m"
        )
    from scipy.spatial.transform import Rotation  # takes long to import, and few files need it

    vector = Rotation.from_matrix(turn).as_rotvec()
    return {
        "registration_rotation": {
            "value": vector.tolist(),
            "unit": "rad",
            "tolerance": data.get("rotation_tolerance", 0.0),
        },
        "registration_translation": {
            "value": motion[:3, 3].tolist(),
            "unit": "m",
            "tolerance": data.get("tolerance", 0.0),
        },
    }


class Actuators(Block):
    """What the actuators can do; a reading that jumps faster is a fault.

    Attributes:
        rotation_speed: rad/s. translation_speed: m/s. None: what actuators of this size reach.
    """

    rotation_speed: RotationSpeed | None = None
    translation_speed: TranslationSpeed | None = None


class ModelError(Block):
    """What the model still gets wrong with the right parameters: position and rotation of the tip, slowly changing (Gauss-Markov).

    Attributes:
        position, rotation: 1-sigma of each axis, m and rad.
        time: correlation time, s.
    """

    position: LengthSigma
    rotation: AngleSigma
    time: Duration


class ActuatorVector(Block):
    """One number per tube, innermost first."""

    value: tuple[Number, ...] = Field(min_length=1)
    unit: str


class Rest(Block):
    """Nominal actuator configuration.

    Attributes:
        beta: (N,) positions of the tubes' bases, <= 0, m.
        alpha: (N,) actuator angles at beta, rad.
    """

    beta: ActuatorVector
    alpha: ActuatorVector

    @model_validator(mode="after")
    def _units(self) -> Rest:
        for key, unit in (("beta", "m"), ("alpha", "rad")):
            given = getattr(self, key).unit
            if given != unit:
                raise problem(f"{key} unit '{given}' must be '{unit}'; files hold SI units and radians only")
        return self


class Robot(Block):
    """A concentric tube robot; tubes innermost first, everything in SI units and radians.

    ``actuators`` holds the speeds that they reach at most; None where nothing is known of them.
    ``model_error`` holds what the model itself gets wrong; None: nothing.
    ``extensions`` holds values of effects by name and parameter. Which effects there are is not known here; who reads a robot file checks them.
    """

    name: str = Field(min_length=1)
    description: str = ""
    gravity: Gravity
    tubes: tuple[Tube, ...] = Field(min_length=1, max_length=MAX_TUBES)
    friction: Friction
    encoders: Encoders
    tracker: Tracker
    rest: Rest
    actuators: Actuators | None = None
    model_error: ModelError | None = None
    extensions: dict[str, dict[str, Any]] = Field(default_factory=dict)

    _source: str = PrivateAttr("")
    _sha256: str = PrivateAttr("")

    @model_validator(mode="after")
    def _check(self) -> Robot:
        names = [tube.name for tube in self.tubes]
        if len(set(names)) < len(names):
            raise problem(f"tube names {names} are not all different; give each tube its own name")
        for i, (inside, outside) in enumerate(zip(self.tubes, self.tubes[1:], strict=False)):
            if outside.inner_radius.value < inside.outer_radius.value:
                raise problem(
                    f"tubes[{i + 1}].inner_radius {outside.inner_radius.value:g} m does not fit around "
                    f"tubes[{i}].outer_radius {inside.outer_radius.value:g} m; list tubes innermost first, "
                    "radii in metres"
                )
        for key in ("beta", "alpha"):
            count = len(getattr(self.rest, key).value)
            if count != len(self.tubes):
                raise problem(f"rest.{key} has {count} numbers for {self.n_tubes} tubes; give one per tube")
        reason = self.actuator_problem(self.rest.beta.value, self.rest.alpha.value)
        if reason:
            raise problem(f"rest.{reason}")
        return self

    def __eq__(self, other: object) -> bool:
        """Same contents; where they were loaded from does not count."""
        return isinstance(other, Robot) and self.model_dump() == other.model_dump()

    __hash__ = None  # type: ignore[assignment]

    @property
    def n_tubes(self) -> int:
        """Number of tubes."""
        return len(self.tubes)

    @property
    def lengths(self) -> Floats:
        """(N,) tube lengths, m."""
        return np.array([tube.length for tube in self.tubes])

    @property
    def exposed_length(self) -> float:
        """Length of tube 1 in front of the base plate, m, at rest; no tube reaches farther."""
        return float(self.lengths[0] + self.rest.beta.value[0])

    def with_tracker(self, **values: float | tuple[float, ...]) -> Robot:
        """The robot with other values of its tracker's quantities, by their names; units and tolerances stay."""
        tracker = self.tracker
        changed = {
            name: getattr(tracker, name).model_copy(update={"value": value}) for name, value in values.items()
        }
        return self.model_copy(update={"tracker": tracker.model_copy(update=changed)})

    def with_mount(self, rotation: tuple[float, ...]) -> Robot:
        """The robot with its tracker's sensor turned by the rotation vector (3,) rad in the tip frame."""
        mount = VectorQuantity.model_validate({"value": rotation, "unit": "rad"})
        return self.model_copy(update={"tracker": self.tracker.model_copy(update={"mount_rotation": mount})})

    @property
    def source(self) -> str:
        """Shipped name or path the robot was loaded from; empty when built in memory."""
        return self._source

    @property
    def sha256(self) -> str:
        """SHA-256 of the file's bytes, hexadecimal; empty when built in memory."""
        return self._sha256

    def actuator_problem(self, beta: Any, alpha: Any = None) -> str | None:
        """Why actuator positions cannot be used, with value, limit and unit; None when they can.

        Args:
            beta: (N,) m. Tubes must hold -L_i <= beta_1 <= ... <= beta_N <= 0 and each tube must end
                beyond or at the end of the next outer one.
            alpha: (N,) rad, only checked to be finite.
        """
        if len(beta) != self.n_tubes:
            return f"beta has {len(beta)} numbers for {self.n_tubes} tubes; give one per tube"
        if alpha is not None and not all(math.isfinite(a) for a in alpha):
            return "alpha holds a number that is not finite; give angles in rad"
        lengths = [tube.length for tube in self.tubes]
        for i, (b, length) in enumerate(zip(beta, lengths, strict=True)):
            if not math.isfinite(b):
                return f"beta[{i}] = {b} is not finite; give a position in m"
            if b > 0:
                return f"beta[{i}] = {b:g} m is above 0 m; tubes are held behind the base plate, beta <= 0"
            if b + length <= 0:
                return (
                    f"beta[{i}] = {b:g} m pulls the tube of {length:g} m wholly behind the base plate; "
                    f"keep it above {-length:g} m, and give metres"
                )
        for i in range(1, self.n_tubes):
            if beta[i - 1] > beta[i]:
                return (
                    f"beta[{i - 1}] = {beta[i - 1]:g} m lies before beta[{i}] = {beta[i]:g} m; inner tubes "
                    "are held further back: beta_1 <= beta_2 <= ... <= 0"
                )
            # The two sums of a tube flush with the next differ by rounding.
            inner, outer = beta[i - 1] + lengths[i - 1], beta[i] + lengths[i]
            if outer > inner + 1e-9:
                return (
                    f"beta[{i}] = {beta[i]:g} m brings the end of tube {i + 1} to {outer:g} m, beyond "
                    f"tube {i}'s {inner:g} m; an inner tube ends at or beyond the next outer one"
                )
        return None
