"""Whether a driver that gives a reading again has measured again: noisy encoders at rest give no reading twice."""

from __future__ import annotations

from ctr_dynamics.sensing.checks.value_trains import Values

ENOUGH = 30  # changes of direction at rest without an equal reading: of coarse encoders that waver by one count, one in a hundred shows that


class FrozenEncoders:
    """Learns from readings at rest whether encoders are noisy. A slow motion is none: it keeps its direction."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start again: other encoders may come."""
        self._change: Values = ()
        self._turns = 0
        self._equal = False

    @property
    def noisy(self) -> bool:
        """Whether readings at rest have always differed: an equal one is then no measurement."""
        return self._turns >= ENOUGH and not self._equal

    def take(self, before: Values, values: Values) -> None:
        """A reading at rest, and the one before."""
        change = tuple(b - a for a, b in zip(before, values, strict=True))
        if not any(change):
            self._equal = True
        elif any(a * b < 0.0 for a, b in zip(self._change, change, strict=False)):
            self._turns += 1
        self._change = change
