"""The tip's Jacobian against actuators and its compliance, at the equilibrium that belongs to the present actuators and load.

It is found now and then as idle work, by the tangent of the static equations. Between two times it turns with the tubes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.step_output import NO_JACOBIAN
from ctr_dynamics.estimation.vibration_modes import lanes_of, tip_response
from ctr_dynamics.kernels.output_rows import turned
from ctr_dynamics.kernels.structures import SweepBuffers
from ctr_dynamics.model.mesh import Key
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.state import State, at_inputs
from ctr_dynamics.model.statics import Statics

Floats = NDArray[np.float64]
TOLERANCE = 1e-6  # of the equilibrium's residual


class JacobianTracker:
    """The static Jacobian of one robot's tip, (6, 2N + 6).

    Rows are the position (m) and the rotation (rad) of the tip about the base axes. Columns are rotations (rad) and translations (m) of all tubes at
    constant load, then force (N) and torque (N m) on the tip, base axes, with the actuators held.

    Args:
        model: the robot, on a mesh that is fine enough for its static shape.
        every: steps between two that are computed.
    """

    def __init__(self, model: Model, every: int) -> None:
        self.model, self._every = model, every
        self._buffers: dict[Key, SweepBuffers] = {}
        self.clear()

    def clear(self) -> None:
        """Have none."""
        self._found: tuple[Floats, Floats] | None = None  # alpha (N,) and the Jacobian there
        self._age = self._every

    def refresh(self, state: State, parameters: Floats) -> bool:
        """Compute it about ``state`` with the parameter block (NP,), if it is old; returns whether it was."""
        if self._age < self._every:
            return False
        self._age = 0
        now, model = state.inputs, self.model
        equilibrium = Statics(model, TOLERANCE).solve_at(
            now, guess=state.unknowns_at_base, parameters=parameters
        )
        if not equilibrium.converged:
            self._found = None
            return True
        if equilibrium.key not in self._buffers:
            self._buffers[equilibrium.key] = model.sweep_buffers(equilibrium.mesh, lanes_of(model).count)
        jacobian = tip_response(
            model, equilibrium, at_inputs(model, parameters, now), self._buffers[equilibrium.key]
        )
        self._found = None if jacobian is None else (now.alpha.copy(), jacobian)
        return True

    def measure(self, state: State) -> Floats:
        """(6, 2N + 6) at the actuators of ``state``; (6, 0) while there is none. To be called once a step."""
        self._age += 1
        if self._found is None:
            return NO_JACOBIAN
        alpha, jacobian = self._found
        turn = float(np.add.reduce(state.inputs.alpha - alpha)) / self.model.n
        return turned(jacobian, turn) if turn else jacobian
