"""What the model can be extended by: effects, their parameters, and how a parameter's value changes the plant.

An effect is declared once, with the names, units and signs under which findings and robot files know it. It acts on a
:class:`ctr_dynamics.effects.plant.Plant`: the model's parameters, the drives, or the tracker. At the off-values of its parameters it leaves the
plant as it is, bit for bit. How to write one: docs/extending.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.effects.plant import Plant
from ctr_dynamics.kernels.rotations import from_vector, multiply, to_vector
from ctr_dynamics.robot import Robot

Floats = NDArray[np.float64]
Values = Mapping[str, float]
Nominal = Callable[[Robot, int], float]  # of a robot and a tube (from 0)
Apply = Callable[[Plant, Values], None]
STRIKING_PARTS = 0.1
"""``form_error`` of laws for parts that strike: they shake high modes, whose frequency and damping no law of a joint knows. Two simulators with the
same clearance differ by 6 % of what it does (docs/diagnosis_evaluation.md)."""


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    Attributes:
        name: as in findings and robot files; N in ``tubeN`` stands for a tube's number from 1.
        unit: SI.
        off: value at which the effect does nothing; a function where the robot file says it. ``math.inf`` for parameters that act by their
            reciprocal.
        scale: 1-sigma of a plausible departure, in the parameter's coordinate (see :meth:`coordinate`); a function where it depends on the robot.
        tolerance: 1-sigma that the robot file allows, in the same coordinate.
        low, high: bounds of the coordinate, inclusive. least: a further lower bound, which the robot sets.
        text: what it is.
        power: the coordinate is value^power: -1 for a stiffness that acts as a compliance, -2 where the effect grows with its square.
        shape: True for a parameter that has no effect by itself (a speed, an axis, a place); its ``off`` is where a search starts.
        period: of an angle that means the same again, rad; findings tell it from 0 on. 0: none.
        unbounded: whether nothing bounds the size of a departure, as of the offset between two clocks: it may be many ``scale``.
    """

    name: str
    unit: str
    off: float | Nominal
    scale: float | Nominal
    tolerance: Nominal | None = None
    low: float = -math.inf
    high: float = math.inf
    text: str = ""
    power: int = 1
    shape: bool = False
    period: float = 0.0
    unbounded: bool = False
    least: Nominal | None = None

    def lowest(self, robot: Robot, tube: int = 0) -> float:
        """Lower bound of the coordinate for ``robot``."""
        return self.low if self.least is None else max(self.low, self.least(robot, tube))

    def coordinate(self, value: float) -> float:
        """The number in which the effect is nearly linear."""
        if self.power == 1:
            return value
        return 0.0 if math.isinf(value) else value**self.power

    def value(self, coordinate: float) -> float:
        """Inverse of :meth:`coordinate`."""
        if self.power == 1:
            return coordinate
        return math.inf if coordinate <= 0.0 else coordinate ** (1.0 / self.power)


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue; :func:`effect` makes it from the function that applies it.

    Attributes:
        name: its ID.
        parameters: what it takes.
        apply: changes a plant by values by name (all names present, ``tubeN`` expanded).
        text: what it models, one sentence. source: where the physics comes from.
        extended: whether it needs the extended kernels.
        finite_sizes: sizes, in scales, at which it is tried where its derivative at the off-value says little; empty where that serves.
        large_sizes: sizes, in scales, at which its first parameter is tried besides where the misfit is large: it changes a frequency, and in time a
            phase, or a damping, beyond what its derivative says.
        joint: parameters that are only tried together (a vector); else each is a variant of its own.
        presets: values of the shape parameters from which a search starts, by name; several are tried.
        nuisance: not a cause by itself: it adds to the uncertainty of others, and is not in the catalogue of findings.
        impacts: whether it strikes the robot: steps in time follow that to a limited degree only.
        searched: whether diagnosis looks for it among the causes; what is learned from the rest only is not.
        form: nuisances that are free only beside this effect, for what is uncertain in its form; presets may name their parameters.
        form_error: largest part of what it does that its law may miss whatever its parameters are, rms. 0: the law is exact.
        combine: what a value makes with one that the robot file has under ``extensions``: it is put in its place, added to it or multiplied with it.
            ``turn``: the parameters are a rotation vector about x, y and z, and it turns further.
    """

    name: str
    parameters: tuple[EffectParameter, ...]
    apply: Apply
    text: str
    source: str
    extended: bool = False
    finite_sizes: tuple[float, ...] = ()
    large_sizes: tuple[float, ...] = ()
    joint: bool = False
    presets: tuple[Mapping[str, float], ...] = ({},)
    nuisance: bool = False
    impacts: bool = False
    searched: bool = True
    form: tuple[str, ...] = ()
    form_error: float = 0.0
    combine: Literal["put", "add", "multiply", "turn"] = "put"

    def accepts(self, name: str) -> bool:
        """Whether ``name`` is one of its parameters."""
        return any(
            re.fullmatch(re.escape(p.name).replace("tubeN", "tube[1-9]"), name) for p in self.parameters
        )

    def find(self, name: str) -> EffectParameter:
        """The parameter called ``name``, with a tube's number or without."""
        generic = re.sub(r"^tube[1-9]", "tubeN", name)
        return next(p for p in self.parameters if p.name in (name, generic))


def effect(
    name: str, *parameters: EffectParameter, text: str, source: str, **options: Any
) -> Callable[[Apply], Effect]:
    """Declare a function that changes a plant as an :class:`Effect`.

    Args:
        name: ID of the effect, as in findings and robot files.
        parameters: what it takes.
        text: what it models, one sentence.
        source: where the physics comes from.
        options: the other attributes of :class:`Effect`.
    """
    return lambda apply: Effect(name, parameters, apply, text, source, **options)


EFFECTS: dict[str, Effect] = {}
"""The catalogue by ID, in the order in which effects were registered."""


def register(*effects: Effect) -> None:
    """Make effects known to robot files, simulation, estimator and diagnosis.

    Raises:
        ValueError: another effect has the name.
    """
    for entry in effects:
        if EFFECTS.setdefault(entry.name, entry) is not entry:
            raise ValueError(f"effect '{entry.name}' is registered twice")


@dataclass(frozen=True)
class EffectQuantity:
    """One parameter of one effect for one robot: what diagnosis estimates.

    Attributes:
        effect: ID. name: parameter, tube expanded. off: coordinate at which the robot is as its file says. tolerance, scale: 1-sigma in the
            coordinate. low, high: bounds of the coordinate.
    """

    effect: str
    name: str
    off: float
    tolerance: float
    scale: float
    low: float
    high: float
    parameter: EffectParameter = field(compare=False)

    @property
    def key(self) -> tuple[str, str]:
        """(effect, name)."""
        return self.effect, self.name

    @property
    def extended(self) -> bool:
        """Whether it needs the extended kernels."""
        return EFFECTS[self.effect].extended

    @property
    def one_sided(self) -> bool:
        """Whether it departs from its off-value to one side only."""
        return math.isfinite(self.low) and self.low == self.off


def _number(x: float | Nominal, robot: Robot, tube: int) -> float:
    return float(x(robot, tube)) if callable(x) else float(x)


def _expanded(p: EffectParameter, robot: Robot) -> list[tuple[str, int]]:
    """Names of a parameter with the tube (from 0) that each is for; 0 where it is for none."""
    tubes = range(robot.n_tubes) if p.name.startswith("tubeN") else [0]
    return [(p.name.replace("tubeN", f"tube{tube + 1}"), tube) for tube in tubes]


def effect_quantities(robot: Robot) -> list[EffectQuantity]:
    """Every parameter of every registered effect for ``robot``, tubes expanded; coordinates are on top of the robot file's extensions."""
    found = []
    for entry in EFFECTS.values():
        for p in entry.parameters:
            for name, tube in _expanded(p, robot):
                scale = _number(p.scale, robot, tube)
                if scale <= 0.0:
                    continue
                off = p.coordinate(_number(p.off, robot, tube))
                low, high = p.lowest(robot, tube), p.high
                before = robot.extensions.get(entry.name, {}).get(name)
                if before is not None:
                    off, low, high = _on_top(entry, p, float(before), off, low, high)
                tolerance = p.tolerance(robot, tube) if p.tolerance else 0.0
                found.append(EffectQuantity(entry.name, name, off, tolerance, scale, low, high, p))
    return found


def _on_top(
    entry: Effect, p: EffectParameter, before: float, off: float, low: float, high: float
) -> tuple[float, float, float]:
    """Off-value and bounds of a coordinate where the robot file has the value ``before``: bounds hold for what both make together."""
    if entry.combine == "put":
        return p.coordinate(before), low, high
    if entry.combine == "add":
        return off, low - before, high - before
    if entry.combine == "multiply" and before > 0.0:
        return off, low / before, high / before
    return off, low, high


def combined(robot: Robot, given: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, Any]]:
    """The extensions of ``robot`` with values ``given`` on top, by effect and parameter; each effect says what the two make together."""
    out = {name: dict(values) for name, values in robot.extensions.items()}
    for name, values in given.items():
        before = out.setdefault(name, {})
        kind = EFFECTS[name].combine
        if kind == "turn" and before:
            keys = [p.name for p in EFFECTS[name].parameters]
            first, second = (
                from_vector(np.array([float(v.get(key, 0.0)) for key in keys])) for v in (before, values)
            )
            before.update(zip(keys, to_vector(multiply(second, first)).tolist(), strict=True))
            continue
        for key, value in values.items():
            if key in before and kind == "add":
                value = float(before[key]) + value
            elif key in before and kind == "multiply":
                value = float(before[key]) * value
            before[key] = value
    return out


def apply_effects(plant: Plant, given: Mapping[str, Mapping[str, Any]]) -> None:
    """Change ``plant`` by effects and values by name, in the order of the catalogue; parameters that are not given stay at their off-values.

    Raises:
        KeyError: no such effect or parameter (robot files are checked when they are loaded).
    """
    place = {name: i for i, name in enumerate(EFFECTS)}
    # what is uncertain in an effect's form comes after the effect
    for name in sorted(given, key=lambda one: (EFFECTS[one].nuisance, place[one])):
        entry, values = EFFECTS[name], given[name]
        full = {
            expanded: _number(p.off, plant.robot, tube)
            for p in entry.parameters
            for expanded, tube in _expanded(p, plant.robot)
        }
        unknown = set(values) - set(full)
        if unknown:
            raise KeyError(f"{name} has no parameter {sorted(unknown)}")
        full.update({k: float(v) for k, v in values.items()})
        entry.apply(plant, full)


def make_plant(robot: Robot, given: Mapping[str, Mapping[str, float]] | None = None) -> Plant:
    """Plant of a robot file with the effects that it names under ``extensions``, and with values ``given`` on top of these."""
    plant = Plant.of_robot(robot)
    apply_effects(plant, combined(robot, given or {}))
    return plant


def per_tube(plant: Plant, values: Values, name: str) -> Floats:
    """(N,) values of the parameter ``tubeN.name``."""
    return np.array([values[f"tube{i + 1}.{name}"] for i in range(plant.n)])
