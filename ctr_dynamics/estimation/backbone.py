"""The published backbone: states at the nodes as rows in the tracker's registered frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.estimation.filter.ekf import RodEkf
from ctr_dynamics.kernels.filter_steps import backbone_rows, matrix
from ctr_dynamics.model.mesh import node_points, node_positions
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import State

Floats = NDArray[np.float64]
SHAPES = 8  # sections at a beta whose nodes are remembered


class Backbone:
    """Makes the rows of the backbone of one estimator."""

    def __init__(self, model: Model, fusion: RodEkf) -> None:
        self.model, self.fusion = model, fusion
        self._nodes: dict[tuple, tuple[Floats, NDArray[np.int64]]] = {}

    def rows(self, state: State) -> NDArray[np.float32]:
        """(P, 15) float32, see :class:`ctr_dynamics.estimation.step_output.StepOutput`."""
        key = (state.key, state.inputs.beta.tobytes())
        if key not in self._nodes:
            if len(self._nodes) > SHAPES:
                self._nodes.clear()
            self._nodes[key] = (
                node_positions(state.mesh, state.inputs.beta),
                node_points(state.mesh.sec_cells),
            )
        s, points = self._nodes[key]
        rows = np.empty((len(state.nodes), 15), np.float32)
        fusion = self.fusion
        inserted = fusion.insertion_fraction
        backbone_rows(
            s, state.nodes, state.fields, points, self.model.n, float(state.inputs.beta_rate[0]) * (1.0 - inserted),
            fusion.tracker.rotation, fusion.bias, fusion.factor.position_deviation(fusion.pi), rows,
        )  # fmt: skip
        rates = state.inputs.beta_rate
        if inserted and np.any(rates):
            # the model's velocities are those of the grid, which lies still at the plate and follows tube 1 at the tip only
            beta = state.inputs.beta
            grid = (node_positions(state.mesh, beta + 1e-4 * rates) - s) / 1e-4
            tangents = np.array([matrix(h)[:, 2] for h in state.nodes[:, 3:7]])
            rows[:, 8:11] += inserted * (rates[0] - grid)[:, None] * tangents
        return rows
