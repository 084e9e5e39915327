"""Known loads that change where nobody sees it: in a gap of the joints, as where a part of a recording is lost."""

from __future__ import annotations

from ctr_dynamics.estimation.discretisation import VibrationErrors
from ctr_dynamics.estimation.inputs.input_buffer import JointGap, LoadChange
from ctr_dynamics.estimation.monitoring.settling import Settling


class UnseenLoad:
    """A known load that has changed in a gap of the joints: nobody knows when, so the vibration that it left is not known.

    Args:
        modes: tell how far a load moves the tip.
        noise: m per axis, deviation of a measured position. A smaller movement does not count.
    """

    def __init__(self, modes: VibrationErrors, noise: float) -> None:
        self._modes, self._noise = modes, noise
        self._gap: JointGap | None = None
        self._change: LoadChange | None = None

    def look(
        self, settling: Settling, *, gap: JointGap | None = None, change: LoadChange | None = None
    ) -> None:
        """Take in the last ``gap`` of the joints or ``change`` of the load; where they belong together, outputs wait by ``settling``."""
        gap, change = gap or self._gap, change or self._change
        self._gap, self._change = gap, change
        if gap is None or change is None or change.begin_ns >= gap.until_ns or change.end_ns <= gap.from_ns:
            return
        if self._modes.deflection(change.difference) > self._noise:
            self._change = None
            settling.begin(gap.until_ns, f"{gap.words} while the known load on the robot changed")
