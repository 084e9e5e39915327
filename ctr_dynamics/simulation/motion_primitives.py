"""Motion primitives of one actuator axis. They follow one another, each from where the last one ended.

After the last the axis holds.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, FiniteFloat, model_validator

from ctr_dynamics.robot import quantity

Floats = NDArray[np.float64]
Seconds = Annotated[FiniteFloat, Field(gt=0, le=3600)]


class Block(quantity.Block):
    """Part of a scenario file: no unknown keys, no conversion of text to numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Primitive(Block):
    """A stretch of motion. ``value`` is what the axis adds to its rest position, in rad or m."""

    duration_s: Seconds

    @abstractmethod
    def value(self, t: float, start: float) -> float:
        """Position at ``t`` in [0, duration_s] s after the primitive's begin, from ``start``."""


class Hold(Primitive):
    """Stay."""

    kind: Literal["hold"]

    def value(self, t: float, start: float) -> float:
        return start


class Ramp(Primitive):
    """Go to ``to``, with the smooth start and end of least jerk, or at a constant rate when ``smooth`` is
    false.
    """

    kind: Literal["ramp"]
    to: FiniteFloat
    smooth: bool = True

    def value(self, t: float, start: float) -> float:
        x = t / self.duration_s
        share = x**3 * (10.0 - 15.0 * x + 6.0 * x * x) if self.smooth else x
        return start + (self.to - start) * share


class Tapered(Primitive):
    """A motion about the start that grows from and returns to zero over ``fade_s``, so that it begins and ends at the start
    without a jump of speed.
    """

    fade_s: Annotated[FiniteFloat, Field(ge=0)] = 0.0

    @model_validator(mode="after")
    def _check(self) -> Tapered:
        if 2 * self.fade_s > self.duration_s:
            raise ValueError(
                f"fade_s {self.fade_s:g} s is more than half of duration_s {self.duration_s:g} s"
            )
        return self

    def envelope(self, t: float) -> float:
        """Factor in [0, 1]."""
        edge = min(t, self.duration_s - t)
        return 0.5 - 0.5 * math.cos(math.pi * edge / self.fade_s) if edge < self.fade_s else 1.0


class Sine(Tapered):
    """``amplitude`` times a sine of ``frequency_hz``."""

    kind: Literal["sine"]
    amplitude: FiniteFloat
    frequency_hz: Annotated[FiniteFloat, Field(gt=0, le=50)]

    def value(self, t: float, start: float) -> float:
        return start + self.envelope(t) * self.amplitude * math.sin(2 * math.pi * self.frequency_hz * t)


class Multisine(Tapered):
    """Sum of sines with amplitudes, frequencies and phases of their own (zero when not given)."""

    kind: Literal["multisine"]
    amplitudes: list[FiniteFloat] = Field(min_length=1, max_length=100)
    frequencies_hz: list[Annotated[FiniteFloat, Field(gt=0, le=50)]] = Field(min_length=1)
    phases_rad: list[FiniteFloat] = Field(default_factory=list)

    @model_validator(mode="after")
    def _lengths(self) -> Multisine:
        counts = {
            len(self.amplitudes),
            len(self.frequencies_hz),
            len(self.phases_rad) or len(self.amplitudes),
        }
        if len(counts) > 1:
            raise ValueError("amplitudes, frequencies_hz and phases_rad need equal lengths")
        return self

    def value(self, t: float, start: float) -> float:
        phases = self.phases_rad or [0.0] * len(self.amplitudes)
        total = sum(
            a * (math.sin(2 * math.pi * f * t + p) - math.sin(p))
            for a, f, p in zip(self.amplitudes, self.frequencies_hz, phases, strict=True)
        )
        return start + self.envelope(t) * total


class Table(Primitive):
    """Linear between (times_s, values); the first time is 0 and the last at most duration_s.

    Values are positions, not steps.
    """

    kind: Literal["table"]
    times_s: list[FiniteFloat] = Field(min_length=2, max_length=100_000)
    values: list[FiniteFloat] = Field(min_length=2)

    @model_validator(mode="after")
    def _check(self) -> Table:
        if len(self.times_s) != len(self.values):
            raise ValueError(f"times_s has {len(self.times_s)} numbers and values has {len(self.values)}")
        if self.times_s[0] != 0 or any(b <= a for a, b in zip(self.times_s, self.times_s[1:], strict=False)):
            raise ValueError("times_s must begin at 0 and rise")
        if self.times_s[-1] > self.duration_s:
            raise ValueError(
                f"times_s ends at {self.times_s[-1]:g} s, after duration_s {self.duration_s:g} s"
            )
        return self

    def value(self, t: float, start: float) -> float:
        return float(np.interp(t, self.times_s, self.values))


AnyPrimitive = Annotated[Hold | Ramp | Sine | Multisine | Table, Field(discriminator="kind")]


class Axis:
    """Position and rate of one axis over time from its primitives."""

    def __init__(self, primitives: Sequence[Hold | Ramp | Sine | Multisine | Table]) -> None:
        self.parts: list[tuple[float, float, Hold | Ramp | Sine | Multisine | Table]] = []
        begin = value = 0.0
        for primitive in primitives:
            self.parts.append((begin, value, primitive))
            begin += primitive.duration_s
            value = primitive.value(primitive.duration_s, value)
        self.end_s, self.last = begin, value

    def value(self, t: float) -> float:
        """Offset from the rest position at ``t`` s."""
        if t >= self.end_s:
            return self.last
        for begin, start, primitive in reversed(self.parts):
            if t >= begin:
                return primitive.value(t - begin, start)
        return self.parts[0][2].value(0.0, 0.0) if self.parts else 0.0

    def rate(self, t: float, step: float = 1e-5) -> float:
        """Its derivative by central difference, 1/s; where a rate jumps, the mean of both sides."""
        before = max(t - step, 0.0)
        return (self.value(t + step) - self.value(before)) / (t + step - before)
