"""From encoder positions to the bases of the tubes, and back: gain, offset, backlash and delay of every drive.

Positions are vectors (2 N,) or rows (s, 2 N): the rotations of all tubes (rad), then their translations (m). Three kinds of them occur:

    encoder    what the encoders report,
    drive      gain * encoder + offset for rotations, encoder + beta_offset for translations, then the corrections,
    actuator   what the tubes' bases do: rotations behind the backlash, and later than the drive by the delay; translations as the drive.

The estimator and diagnosis go from encoders to actuators, the simulation from the drive both ways.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.backlash import behind_backlash
from ctr_dynamics.robot import Robot
from ctr_dynamics.sensing.interpolation import Signal, ThreePoints

Floats = NDArray[np.float64]


class ActuatorCorrection(Protocol):
    """A further link between encoders and drives, without memory; it must be equal (``==``) to another one that does the same.

    All arguments and results are rows (s, 2 N) or one vector (2 N,): rotations in rad, then translations in m.
    """

    def forward(self, drive: Floats) -> Floats:
        """Drive positions from those that gain and offset alone give."""
        ...

    def inverse(self, drive: Floats) -> Floats:
        """Inverse of :meth:`forward`."""
        ...

    def derivative(self, drive: Floats) -> Floats:
        """Derivative of every entry that :meth:`forward` returns by the same entry of its argument."""
        ...


@dataclass(frozen=True, eq=False)
class ActuatorModel:
    """Drives of a robot with N tubes.

    Attributes:
        gain: (N,) angle of the drive over that of its encoder. offset: (N,) rad, added to it. backlash: (N,) rad, whole dead zone.
        beta_offset: (N,) m, true translation minus the encoder's. delay: s, by which rotations follow the drives.
        corrections: further links behind gain and offset, in order.
    """

    gain: Floats
    offset: Floats
    backlash: Floats
    beta_offset: Floats
    delay: float = 0.0
    corrections: tuple[ActuatorCorrection, ...] = ()

    @classmethod
    def of_robot(cls, robot: Robot) -> ActuatorModel:
        """Drives as a robot file describes them, without its extensions."""
        n = robot.n_tubes
        return cls(np.ones(n), np.full(n, robot.encoders.offset.value), np.zeros(n), np.zeros(n))

    @property
    def n(self) -> int:
        """Number of tubes."""
        return len(self.gain)

    def changed(self, **values: Any) -> ActuatorModel:
        """A copy with other attributes."""
        return replace(self, **values)

    def forward(self, encoder: Floats) -> Floats:
        """Drive positions where the encoders report the positions ``encoder``."""
        drive, n = np.array(encoder, dtype=float), self.n
        drive[..., :n] = self.gain * drive[..., :n] + self.offset
        drive[..., n:] += self.beta_offset
        for correction in self.corrections:
            drive = correction.forward(drive)
        return drive

    def inverse(self, drive: Floats) -> Floats:
        """What the encoders read where the drives stand at ``drive``."""
        encoder, n = np.array(drive, dtype=float), self.n
        for correction in reversed(self.corrections):
            encoder = correction.inverse(encoder)
        encoder[..., :n] = (encoder[..., :n] - self.offset) / self.gain
        encoder[..., n:] -= self.beta_offset
        return encoder

    def derivative(self, name: str, encoder: Floats) -> Floats:
        """Derivative of every drive position by the same tube's ``name`` ("gain", "offset" or "beta_offset"), at the positions ``encoder``."""
        n = self.n
        drive, columns = np.array(encoder, dtype=float), np.zeros(np.shape(encoder))
        if name == "gain":
            columns[..., :n] = drive[..., :n]
        elif name == "offset":
            columns[..., :n] = 1.0
        elif name == "beta_offset":
            columns[..., n:] = 1.0
        else:
            raise KeyError(f"no derivative by '{name}'")
        drive[..., :n] = self.gain * drive[..., :n] + self.offset
        drive[..., n:] += self.beta_offset
        for correction in self.corrections:
            columns, drive = columns * correction.derivative(drive), correction.forward(drive)
        return columns

    def behind_backlash(self, drive: Floats, before: Floats | None = None) -> Floats:
        """Positions behind the backlash while the drives pass the rows ``drive`` (s, 2 N).

        ``before`` (2 N,): position behind it before the first row; without it the first row stands in the middle of the dead zone.
        """
        if not self.backlash.any():
            return drive
        start = drive[0] if before is None else before
        found = drive.copy()
        for i in np.flatnonzero(self.backlash > 0.0):
            found[:, i] = behind_backlash(np.ascontiguousarray(drive[:, i]), self.backlash[i], start[i])
        return found

    @property
    def delay_ns(self) -> int:
        """The delay in ns."""
        return round(self.delay * 1e9)


class ActuatorSignal(Signal):
    """Actuator positions by stamp, from drive positions that come in one by one.

    Args:
        actuators: what lies between drives and tubes. The first drive position stands in the middle of the backlash.
    """

    def __init__(self, actuators: ActuatorModel) -> None:
        super().__init__(2 * actuators.n)
        self.actuators, self.n, self.delay_ns = actuators, actuators.n, actuators.delay_ns
        self._loose = bool(actuators.backlash.any())
        self._drive: list[Floats] = []  # positions before the backlash

    def add(self, stamp_ns: int, value: Floats) -> str:
        """Insert a drive position; those after a late one pass the backlash again."""
        kind = super().add(stamp_ns, value)
        if not self._loose or kind == "duplicate":
            return kind
        first = self.stamps.index(stamp_ns) if kind == "late" else len(self.stamps) - 1
        self._drive.insert(first, value)
        before = self.values[first - 1] if first else None
        self.values[first:] = list(self.actuators.behind_backlash(np.array(self._drive[first:]), before))
        return kind

    def drop(self, stamp_ns: int) -> None:
        """Take the drive position of that stamp away, if there is one; those after it pass the backlash again."""
        if stamp_ns not in self.stamps:
            return
        first = self.stamps.index(stamp_ns)
        super().drop(stamp_ns)
        if not self._loose:
            return
        del self._drive[first]
        if first < len(self._drive):
            before = self.values[first - 1] if first else None
            self.values[first:] = list(self.actuators.behind_backlash(np.array(self._drive[first:]), before))

    @property
    def drive_positions(self) -> list[Floats]:
        """Drive positions (2 N,) of all stamps, before the backlash."""
        return self._drive if self._loose else self.values

    @property
    def drive_position(self) -> Floats:
        """The last drive position (2 N,), before the backlash."""
        return self.drive_positions[-1]

    def forget(self, before_ns: int) -> None:
        """Drop samples that no time from ``before_ns`` on needs, delayed as they are."""
        super().forget(before_ns - max(self.delay_ns, 0))
        if self._loose:
            del self._drive[: len(self._drive) - len(self.values)]

    def at(self, time_ns: float, extrapolate_ns: int = 0) -> tuple[Floats, Floats]:
        """Actuator positions and their rates at a time; see :meth:`Signal.at`."""
        value, rate = super().at(time_ns, extrapolate_ns)
        if not self.delay_ns:
            return value, rate
        alpha, alpha_rate = super().at(time_ns - self.delay_ns, extrapolate_ns)
        n = self.n
        return np.concatenate([alpha[:n], value[n:]]), np.concatenate([alpha_rate[:n], rate[n:]])

    def around(self, first_ns: int, last_ns: int, extrapolate_ns: int = 0) -> ThreePoints | None:
        """See :meth:`Signal.around`; rotations that follow later than translations do not lie on their lines."""
        return None if self.delay_ns else super().around(first_ns, last_ns, extrapolate_ns)

    @property
    def known_until(self) -> int:
        """ns up to which actuators are known without extrapolation."""
        return self.stamps[-1] + min(self.delay_ns, 0)
