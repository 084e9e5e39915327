"""Buffers of collocation for each set of sections, with their cuts; and unknowns to start from there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.collocation import ONE_RUN
from ctr_dynamics.kernels.complex_rates import COMPLEX
from ctr_dynamics.kernels.coupling import STAGES, table_size
from ctr_dynamics.kernels.kinds import (
    Lanes,
    RobotKind,
    cut_size,
    first_cut_row,
    segment_lanes,
)
from ctr_dynamics.kernels.layout import parameter_rows, unknown_rows
from ctr_dynamics.kernels.segmented_jacobian import complex_segment_lanes
from ctr_dynamics.kernels.shooting import aligned_zeros
from ctr_dynamics.kernels.structures import (
    CollocationSolver,
    SegmentedSolver,
    StagePoint,
    SweepBuffers,
    SystemFactors,
)
from ctr_dynamics.model.mesh import Key, Mesh, node_positions
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.segments import CONDENSED, Segments, segments_of, unknown_units
from ctr_dynamics.model.time_scheme import Collocation

Floats = NDArray[np.float64]
STEP = 1e-7  # of a Jacobian's perturbations, in the unknowns' units: a segment lets them grow by e^4, and their square stays small
SWEEPS = 60  # of one solve: a jump of the load within a step takes up to 40


class Workspace(NamedTuple):
    """Buffers for the sections of one key: of the mesh with its cuts, for collocation, and for the rescue; whether Jacobians are ``condensed``, and
    the shapes of their factors."""

    segments: Segments
    condensed: bool
    factor_shapes: Sequence[tuple[int, ...]]
    solver: CollocationSolver
    rescue: SegmentedSolver

    def new_factors(self) -> Floats:
        """Room for the factors of a run."""
        return aligned_zeros(sum(math.prod(shape) for shape in self.factor_shapes))

    def factors_in(self, block: Floats) -> SystemFactors:
        """Views of such room as factors."""
        parts, start = [], 0
        for shape in self.factor_shapes:
            size = math.prod(shape)
            parts.append(block[start : start + size].reshape(shape))
            start += size
        return SystemFactors(*parts)


class Workspaces:
    """Buffers of one run, or of several in the same sweeps.

    Args:
        model: the robot.
        scheme: of the whole steps.
        tolerance: largest residual, in units.
        lanes: those of the stages of all runs.
    """

    def __init__(self, model: Model, scheme: Collocation, tolerance: float, lanes: Lanes = ONE_RUN) -> None:
        self.model, self.scheme, self.tolerance, self.lanes = model, scheme, tolerance, lanes
        self._known: dict[Key, Workspace] = {}
        self._dt_of: dict[Key, float] = {}  # s, steps whose units the buffers hold

    def of(self, key: Key, mesh: Mesh, beta: Floats, scheme: Collocation) -> Workspace:
        """Buffers for the sections ``key`` of ``mesh`` at the translations ``beta`` (N,) m, with the units of steps by ``scheme``."""
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = self._make(key, mesh, beta)
        elif self.model.moving_precurvature:
            segments = segments_of(self.model, key, mesh, beta, self.scheme.coefficients.rates)
            known = known._replace(segments=segments)
        if self._dt_of.get(key) != scheme.dt:
            point, self._dt_of[key] = known.solver.point, scheme.dt
            units, residuals = unknown_units(self.model, len(known.segments.nodes), scheme.rate)
            point.units[:], point.residual_units[:] = units, residuals
        return known

    def _make(self, key: Key, mesh: Mesh, beta: Floats) -> Workspace:
        model, kind = self.model, self.model.kind
        segments = segments_of(model, key, mesh, beta, self.scheme.coefficients.rates)
        cuts = len(segments.nodes)
        mt = model.unknown_count + cuts * cut_size(kind)
        lanes = self.lanes.count
        stages = model.sweep_buffers(mesh, lanes, cuts)
        fields = len(stages.history) // lanes + len(stages.base_history) // lanes
        L = complex_segment_lanes(kind).count
        all_lanes, batch = model.sweep_buffers(mesh, L, cuts), COMPLEX.width
        wide = SweepBuffers(
            all_lanes.workspace, all_lanes.parameters, all_lanes.section_lengths, all_lanes.unknowns,
            all_lanes.history[: len(all_lanes.history) // L * batch],
            all_lanes.base_history[: len(all_lanes.base_history) // L * batch],
            all_lanes.fields[:0], all_lanes.base_fields[: len(all_lanes.base_fields) // L * batch],
            all_lanes.nodes[:0], all_lanes.residual,
        )  # fmt: skip
        point = StagePoint(
            np.zeros(parameter_rows(model.n).size), np.zeros(len(mesh.sec_cells)), np.zeros(mt),
            np.zeros(fields), np.zeros(fields), np.ones(mt), np.ones(mt), STEP,
        )  # fmt: skip
        solver = CollocationSolver(
            stages,
            aligned_zeros(table_size(model.n, self.lanes.width)),
            wide,
            np.zeros((2, mt, mt)),
            point,
            self.tolerance,
            SWEEPS,
        )
        rescue = SegmentedSolver(
            model.sweep_buffers(mesh, 1, cuts), model.sweep_buffers(mesh, segment_lanes(kind).count, cuts),
            np.ones(mt), np.ones(mt), STEP, self.tolerance, SWEEPS,
        )  # fmt: skip
        condensed = segments.growth < CONDENSED
        return Workspace(segments, condensed, _factor_shapes(kind, cuts, condensed), solver, rescue)


def _factor_shapes(kind: RobotKind, cuts: int, condensed: bool) -> Sequence[tuple[int, ...]]:
    """Shapes of the arrays of :class:`SystemFactors`, with that many ``cuts``."""
    m, size, E = unknown_rows(kind.tubes).size, cut_size(kind), STAGES // 2
    if condensed:
        return (E, cuts, 2, size, size), (E, cuts, 2, m, size), (E, 2, m, size), (E, 2, m, m), (E, 2, 0, 0)
    mt = m + cuts * size
    return (E, 0, 2, 0, 0), (E, 0, 2, 0, 0), (E, 2, 0, 0), (E, 2, 0, 0), (E, 2, mt, mt)


def starts_at(model: Model, unknowns: Floats, nodes: Floats, segments: Segments) -> Floats:
    """(mt,) unknowns of multiple shooting: the first 5 + N of ``unknowns``, and at the cuts the states of the ``nodes`` (P, S)."""
    states = nodes[segments.nodes, first_cut_row(model.kind) :]
    return np.concatenate([unknowns[: model.unknown_count], states.ravel()])


def resampled(nodes: Floats, old: Mesh, old_beta: Floats, new: Mesh, beta: Floats) -> Floats:
    """(P, S) node states of the mesh ``old`` at the nodes of ``new``, to look for unknowns from."""
    at, s = node_positions(new, beta), node_positions(old, old_beta)
    at = at * (s[-1] / at[-1])
    return np.stack([np.interp(at, s, column) for column in nodes.T], axis=1)
