"""The open-loop run: the model driven by actuators and known load alone, never corrected by the tracker."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.tip_window import TipWindow, TipWindowState, insertion_fraction
from ctr_dynamics.estimation.inputs.run_inputs import RunInputs
from ctr_dynamics.estimation.timeline import DT
from ctr_dynamics.model.simulator import Simulator, State
from ctr_dynamics.sensing import Tip, TrackerModel

Floats = NDArray[np.float64]


class OpenLoopState(NamedTuple):
    """What a checkpoint stores of the :class:`OpenLoopRun`."""

    state: State
    tips: TipWindowState


class OpenLoopRun:
    """One simulation without corrections, and the tips of its last steps.

    Args:
        simulator: of this run alone.
        inputs_at: actuators and load without estimated parameters.
        steps: tips that are stored.

    Attributes:
        state: after the last step; None before the start.
        tips: of the last steps, without columns.
    """

    def __init__(self, simulator: Simulator, inputs_at: RunInputs, steps: int) -> None:
        self.simulator, self.inputs_at = simulator, inputs_at
        self.tips = TipWindow(steps)
        self.state: State | None = None
        self._insertion_left = 1.0 - insertion_fraction(simulator.model)
        self._no_columns = np.zeros((16 + 3 * simulator.model.n, 1))

    def clear(self) -> None:
        """Have no state."""
        self.state = None
        self.tips.clear(1)

    def start(self, state: State, t: float) -> None:
        """Go on from ``state`` at the time ``t`` (s)."""
        self.state = state
        self.tips.clear(1)
        self.append_tip(t)

    def append_tip(self, t: float) -> None:
        """Store the tip of the step that ends at ``t`` (s)."""
        assert self.state is not None
        rate = float(self.state.inputs.beta_rate[0]) * self._insertion_left
        self.tips.append(t, self.state.nodes[-1], self._no_columns, rate)

    def observed(self, tracker: TrackerModel, t: float) -> tuple[Tip, Floats] | None:
        """What ``tracker`` sees of this run at ``t`` (s): tip, and its acceleration (3,) m/s^2 over two steps; None outside the window."""

        def at(time: float) -> Tip | None:
            return self.tips.at(time, DT, columns=False)

        tip = tracker.observed_tip(at, t)
        if tip is None:
            return None
        earlier = tracker.observed_tip(at, t - 2 * DT) or tip
        return tip, (tip.velocity - earlier.velocity) / (2 * DT)

    def checkpoint(self) -> OpenLoopState:
        """What :meth:`restore` returns to."""
        assert self.state is not None
        return OpenLoopState(self.state.copy(), self.tips.checkpoint())

    def restore(self, stored: OpenLoopState) -> None:
        """Return to a checkpoint."""
        self.state = stored.state.copy_into(self.state)
        self.tips.restore(stored.tips)
