"""The stamps of the steps: step k has the stamp t0 + k 3 ms, with t0 that of the first complete joint state."""

from __future__ import annotations

from dataclasses import dataclass

from ctr_dynamics.io.messages.topics import STEP_NS


def seconds(k: int) -> float:
    """s from t0 of step ``k``; multiplied in this order everywhere, as another rounding moves what is read of inputs by 1 ns."""
    return k * STEP_NS * 1e-9


DT = seconds(1)


@dataclass
class Timeline:
    """Where the estimator stands.

    Attributes:
        t0_ns: stamp of step 0; None before the first complete joint state.
        k: the last step that has been taken; -1 before the first.
    """

    t0_ns: int | None = None
    k: int = -1

    def clear(self) -> None:
        """Wait for the first joint state."""
        self.t0_ns, self.k = None, -1

    def stamp(self, k: int) -> int:
        """ns of step ``k``; there must be a first joint state."""
        assert self.t0_ns is not None
        return self.t0_ns + k * STEP_NS

    @property
    def taken_ns(self) -> int | None:
        """Stamp of the last step that has been taken; None before the first."""
        return None if self.t0_ns is None or self.k < 0 else self.t0_ns + self.k * STEP_NS
