"""Scenario files: what moves, what pulls, what is measured. YAML, SI units and radians, units in the keys."""

from __future__ import annotations

import hashlib
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat, PrivateAttr, ValidationError, model_validator

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.text_files import decode_text, read_bytes
from ctr_dynamics.io.yaml_files import read_yaml
from ctr_dynamics.robot.quantity import problem_line
from ctr_dynamics.simulation.motion_primitives import AnyPrimitive, Axis, Block, Seconds

Floats = NDArray[np.float64]
Vector = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Sigma = Annotated[FiniteFloat, Field(ge=0)]
Rate = Annotated[FiniteFloat, Field(gt=0, le=1000)]


class TubeMotion(Block):
    """Motions of one tube, as offsets from the robot's rest position.

    Rotation in rad, translation in m (positive: further out).
    """

    rotation: list[AnyPrimitive] = Field(default_factory=list)
    translation: list[AnyPrimitive] = Field(default_factory=list)


class Load(Block):
    """A constant wrench on the tip from ``start_s`` to ``end_s``, rising and falling linearly within
    ``rise_s`` and ``fall_s`` after these times.

    Attributes:
        force_N, torque_N_m: (3,) in base axes, the torque about the tip point.
        hung_mass_kg: a weight instead of a force; with ``below_tip_m`` it hangs that far beyond the tip along
        the static tangent.
        known: whether it is published on /ctr/tip_load; an unknown one acts all the same.
    """

    start_s: Annotated[FiniteFloat, Field(ge=0)] = 0.0
    end_s: Annotated[FiniteFloat, Field(ge=0)] | None = None
    rise_s: Sigma = 0.0
    fall_s: Sigma = 0.0
    force_N: Vector = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    torque_N_m: Vector = Field(default_factory=lambda: [0.0, 0.0, 0.0])
    hung_mass_kg: Annotated[FiniteFloat, Field(ge=0, le=10)] = 0.0
    below_tip_m: Annotated[FiniteFloat, Field(ge=-1, le=1)] = 0.0
    known: bool = True

    @model_validator(mode="after")
    def _check(self) -> Load:
        if self.end_s is not None and self.end_s < self.start_s + self.rise_s:
            raise ValueError(
                f"end_s {self.end_s:g} s is before start_s + rise_s {self.start_s + self.rise_s:g} s"
            )
        return self

    def corners(self) -> list[tuple[float, float]]:
        """(time s, factor) between which the factor is linear.

        A zero time of rise or fall takes a microsecond.
        """
        points = [] if self.start_s == 0 and self.rise_s == 0 else [(self.start_s, 0.0)]
        points.append((self.start_s + (max(self.rise_s, 1e-6) if points else 0.0), 1.0))
        if self.end_s is not None:
            points += [(self.end_s, 1.0), (self.end_s + max(self.fall_s, 1e-6), 0.0)]
        return points

    def factor(self, t: float) -> float:
        """Share of the wrench that acts at ``t`` s."""
        times, factors = zip(*self.corners(), strict=True)
        return float(np.interp(t, times, factors))


class Noise(Block):
    """1-sigma errors; what is not given is the robot file's."""

    encoder_rad: Sigma | None = None
    position_m: Sigma | None = None
    rotation_rad: Sigma | None = None
    drift_m: Sigma | None = None
    drift_time_s: Seconds | None = None


class Rates(Block):
    """Rates of the messages, Hz."""

    joints_hz: Rate = 100.0
    tracker_hz: Rate = 40.0
    load_hz: Rate = 100.0


class TrackerDelays(Block):
    """``delay_s``: how much older than its stamp a pose is, beside the robot file's; ``arrival_s``.

    From stamp to log time.
    """

    delay_s: Annotated[FiniteFloat, Field(ge=-1, le=1)] = 0.0
    arrival_s: Annotated[FiniteFloat, Field(ge=0, le=10)] = 0.0


class Solver(Block):
    """Steps of the simulation itself, finer than an estimator's."""

    scheme: Literal["backward_euler", "bdf2", "trapezoid", "bdf_alpha", "sdirk2", "sdirk3", "radau"] = "radau"
    dt_s: Annotated[FiniteFloat, Field(ge=1e-4, le=0.01)] = 0.001
    nodes: Annotated[int, Field(ge=8, le=1000)] = 60


class Scenario(Block):
    """A scenario. ``noise: false`` leaves every measurement exact; a seed gives the same noise again."""

    description: str = ""
    duration_s: Seconds
    # a stamp has 32 bits, and the run goes on from there
    start_stamp_s: Annotated[int, Field(ge=0, le=2_100_000_000)] = 1_700_000_000
    seed: Annotated[int, Field(ge=0)] = 0
    tubes: list[TubeMotion] = Field(default_factory=list)
    loads: list[Load] = Field(default_factory=list)
    noise: Noise | Literal[False] = Noise()
    rates: Rates = Rates()
    tracker: TrackerDelays = TrackerDelays()
    solver: Solver = Solver()

    _sha256: str = PrivateAttr("")
    _source: str = PrivateAttr("")

    @property
    def sha256(self) -> str:
        """SHA-256 of the file's bytes, hexadecimal; empty when built in memory."""
        return self._sha256

    @property
    def source(self) -> str:
        """Shipped name or path."""
        return self._source

    def axes(self, n: int) -> list[tuple[Axis, Axis]]:
        """(rotation, translation) of every tube.

        Raises:
            InputError: there are motions for more tubes than the robot has.
        """
        if len(self.tubes) > n:
            raise InputError(
                f"motions for {len(self.tubes)} tubes, the robot has {n}",
                do="remove some, innermost first",
                where="tubes",
            )
        still = [TubeMotion()] * (n - len(self.tubes))
        return [(Axis(tube.rotation), Axis(tube.translation)) for tube in [*self.tubes, *still]]


def scenario_names() -> tuple[str, ...]:
    """Names of the scenarios shipped with the package."""
    folder = resources.files("ctr_dynamics") / "config" / "scenarios"
    return tuple(sorted(p.name[:-5] for p in folder.iterdir() if p.name.endswith(".yaml")))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """A scenario by its shipped name or from a YAML file: motions of the tubes, loads on the tip, sensors, and how finely to step.

    Args:
        name_or_path: for example "release" or "my_scenario.yaml".

    Raises:
        InputError: no such file, not readable, or not a valid scenario.

    Example:
        >>> from ctr_dynamics import load_scenario
        >>> scenario = load_scenario("release")
        >>> scenario.loads[0].hung_mass_kg, scenario.loads[0].end_s  # a weight that is cut off, kg and s
        (0.06, 1.0)
    """
    name = str(name_or_path)
    path = Path(name_or_path)
    if name in scenario_names():
        data = (resources.files("ctr_dynamics") / "config" / "scenarios" / f"{name}.yaml").read_bytes()
    elif path.exists():
        data = read_bytes(path)
    else:
        known = ", ".join(scenario_names())
        raise InputError(
            f"scenario '{name}' is neither a shipped one ({known}) nor a file", do="check the path"
        )
    content = read_yaml(decode_text(data, name), name)
    if not isinstance(content, dict):
        raise InputError("scenario is not a mapping", do="see config/scenarios for examples", where=name)
    try:
        scenario = Scenario.model_validate(content)
    except ValidationError as error:
        raise InputError(problem_line(error), do="see config/scenarios for examples", where=name) from None
    scenario._sha256 = hashlib.sha256(data).hexdigest()
    scenario._source = name
    return scenario
