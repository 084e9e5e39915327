"""The published backbone: states at the nodes as rows in the tracker's registered frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.ekf import RodEkf
from ctr_dynamics.kernels.compiled_rotations import matrix
from ctr_dynamics.kernels.output_rows import backbone_rows
from ctr_dynamics.model.mesh import node_points, node_positions
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import State

Floats = NDArray[np.float64]
REMEMBERED = 8  # sections at a beta whose nodes are remembered: while the tubes only turn, there is one
SMALL_STEP = 1e-4  # s, over which nodes are followed for their own velocity


class Backbone:
    """Makes the rows of the backbone of one estimator.

    Args:
        model: the robot.
        ekf: filter of the fused run, for the registration's error and the deviations.
    """

    def __init__(self, model: Model, ekf: RodEkf) -> None:
        self.model, self.ekf = model, ekf
        self._nodes: dict[tuple, tuple[Floats, NDArray[np.int64]]] = {}

    def rows(self, state: State) -> NDArray[np.float32]:
        """(P, 15) float32, see :class:`ctr_dynamics.estimation.step_output.StepOutput`."""
        key = (state.key, state.inputs.beta.tobytes())
        if key not in self._nodes:
            if len(self._nodes) > REMEMBERED:
                self._nodes.clear()
            self._nodes[key] = (
                node_positions(state.mesh, state.inputs.beta),
                node_points(state.mesh.sec_cells),
            )
        s, points = self._nodes[key]
        rows = np.empty((len(state.nodes), 15), np.float32)
        ekf, rates = self.ekf, state.inputs.beta_rate
        in_model = ekf.insertion_fraction
        backbone_rows(
            s, state.nodes, state.fields, points, self.model.n, float(rates[0]) * (1.0 - in_model),
            ekf.tracker.rotation, ekf.bias, ekf.factor.position_deviation(ekf.pi), rows,
        )  # fmt: skip
        if in_model and np.any(rates):
            # the model's velocities are those of the grid, which lies still at the plate and follows tube 1 at the tip only
            beta = state.inputs.beta
            grid = (node_positions(state.mesh, beta + SMALL_STEP * rates) - s) / SMALL_STEP
            tangents = np.array([matrix(h)[:, 2] for h in state.nodes[:, 3:7]])
            rows[:, 8:11] += in_model * (rates[0] - grid)[:, None] * tangents
        return rows
