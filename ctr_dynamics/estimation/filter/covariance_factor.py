"""The covariance in low rank: a factor V of the errors of fields and parameters, and a small covariance of its coefficients.

The error of the fields and the uncertain parameters is V a, with V (fields + parameters, r) and a of covariance Pi_aa. Tracker states b stay in
full beside a, so that P = [V 0; 0 I] Pi [V 0; 0 I]^T. The columns of V move with the tangent of the step. Process noise of the tip force appends
columns, and the weakest directions in an energy norm are dropped (Verlaan and Heemink 1997, reduced-rank square-root filter).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ctr_dynamics.estimation.energy_norm import EnergyNorm
from ctr_dynamics.estimation.filter.factor_reduction import BasisChange
from ctr_dynamics.estimation.filter.parameter_priors import ModelUncertainty
from ctr_dynamics.estimation.filter.rational_step import FRACTIONS
from ctr_dynamics.kernels.complex_linearise import complex_unknown_lanes
from ctr_dynamics.kernels.complex_rates import COMPLEX
from ctr_dynamics.kernels.covariance import position_deviations
from ctr_dynamics.kernels.factor_operations import sparse_product
from ctr_dynamics.kernels.kinds import SIMD_WIDTH, Lanes, lanes_for, lanes_free, unknown_lanes
from ctr_dynamics.kernels.layout import input_rows, state_rows
from ctr_dynamics.kernels.linearise import linearise
from ctr_dynamics.kernels.structures import (
    Derivatives,
    FiniteDifferences,
    PartialFractions,
    RationalBuffers,
    Solution,
    SolvedStep,
)
from ctr_dynamics.kernels.tangent import rational_tangent
from ctr_dynamics.model.mesh import Key, Mesh, build_mesh
from ctr_dynamics.model.mesh_interpolation import MeshInterpolation, coarse_key, mesh_interpolation
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.remeshing import remap_columns
from ctr_dynamics.model.simulator import Record

Floats = NDArray[np.float64]
FACTOR_NODES = 12  # of the factor's sections: fused errors of a model with 100 nodes change by less than 1 um
EPSILON = 1e-6  # of one standard deviation: small against the curvature of the step, large against rounding


def carried(matrix: csr_array, values: Floats) -> Floats:
    """Product (rows, k) of a sparse matrix with ``values`` (columns, k), or (rows,) with (columns,)."""
    product = sparse_product(matrix.indptr, matrix.indices, matrix.data, values.reshape(len(values), -1))
    return product.reshape(-1, *values.shape[1:])


class SolvedStage(NamedTuple):
    """What a solved stage is known by: sections, rates of the fields (fields,), unknowns (5 + N,) and inputs (inputs,)."""

    key: Key
    rates: Floats
    unknowns: Floats
    inputs: Floats

    def between(self, other: SolvedStage | None) -> SolvedStage:
        """Halfway to ``other``; itself where the sections are others, or there is none."""
        if other is None or other.key != self.key:
            return self
        pairs = zip(self[1:], other[1:], strict=True)
        return SolvedStage(self.key, *(0.5 * (a + b) for a, b in pairs))


class Vibrating(NamedTuple):
    """Vibrations of unknown size and phase: their ``fields`` (fields, v) for one deviation each, on the sections of ``mesh``."""

    fields: Floats
    mesh: Mesh


class FactorState(NamedTuple):
    """What a checkpoint stores of a :class:`CovarianceFactor`, attribute by attribute. Arrays are references: later steps go on with others."""

    key: Key
    mesh: Mesh | None
    interpolation: MeshInterpolation | None
    beta: Floats
    theta: Floats
    fields: Floats
    dnodes: Floats
    dx: Floats
    linearised: SolvedStage | None


class CovarianceFactor:
    """V, and what follows linearly from its coefficients.

    Args:
        model: the robot.
        uncertainty: the uncertain parameters.
        rank: columns that V has at least after a reduction.

    Attributes:
        fields: (fields, r) rows of the fields.
        fraction: the rational function by which it follows the model.
        theta: (n_theta, r) rows of the parameters.
        dnodes: (nodes * S, r) rows of the node states after the last step.
        dx: (5 + N, r) rows of the shooting's unknowns after the last step.

    The fields' rows live on sections of at most ``FACTOR_NODES`` nodes: a covariance does not need the model's own resolution.
    """

    def __init__(self, model: Model, uncertainty: ModelUncertainty, rank: int) -> None:
        self.model, self.uncertainty = model, uncertainty
        # lanes that would idle beside them in the tangent's sweep carry columns too
        self.rank = rank + lanes_free(1 + model.unknown_count + rank)
        self._effect = csr_array(uncertainty.effect)
        self._work: dict[tuple[Key, int], RationalBuffers] = {}
        self._lanes = Lanes(unknown_lanes(model.kind).count + SIMD_WIDTH, SIMD_WIDTH)
        self.fraction: PartialFractions = FRACTIONS[3]
        self._differences = FiniteDifferences(EPSILON, model.tangent_perturbation)
        self._coarse: dict[Key, tuple[Key, Mesh, MeshInterpolation | None]] = {}
        self.interpolation: MeshInterpolation | None = None
        self._norm = EnergyNorm(model)
        self.key: Key = ((), ())
        self.mesh: Mesh | None = None
        self.beta = np.zeros(model.n)
        self._deviation: tuple[Floats, Floats, Floats] | None = None  # dnodes, pi, and what follows from them
        self._linearised: SolvedStage | None = None  # at the end of what V has followed
        self._lent = False  # whether a checkpoint holds `fields`
        self._spare = self._nothing = np.empty((0, 0))  # room for the next `fields`

    def start(
        self, key: tuple, mesh: Mesh, beta: Floats, alpha: Floats, par: Floats, x: Floats, vibrating: Vibrating | None = None
    ) -> Floats:  # fmt: skip
        """The static equilibrium's derivative by every uncertain parameter times its deviation; returns Pi_aa (r, r).

        At an equilibrium that cannot be linearised (a fold) the fields' rows begin at zero and fill while the robot moves.

        Args:
            key, mesh: sections of the model.
            beta, alpha: (N,) m and rad, actuators.
            par: (NP,) parameter block with the load.
            x: (5 + N,) unknowns of the equilibrium.
            vibrating: what the robot may do about it; None where it rests. The tip's rows know it from the first step on.
        """
        model, unc = self.model, self.uncertainty
        own, mesh, interpolation = self._coarse_sections(key, mesh, beta)
        count = len(unc.names)
        m = model.unknown_count
        lanes = lanes_for(1 + m + count)
        sweep = model.sweep_buffers(mesh, lanes.count)
        main, base = len(sweep.history) // lanes.count, len(sweep.base_history) // lanes.count
        par = par.copy()
        par[model.layout["alpha"]], par[model.layout["beta"]], par[model.layout["alpha_rate"]] = (
            alpha,
            beta,
            0.0,
        )
        scale = np.where(unc.sigma > 0, unc.sigma, 1e-3)
        dx, fields = np.zeros((m, count)), np.zeros((main + base, count))
        dnodes = np.zeros((len(sweep.nodes) // lanes.count, count))
        solution = Solution(par, x, np.zeros(main), np.zeros(base))
        if not linearise(
            model.kind, lanes, 0.0, mesh, solution, unc.effect * scale, np.zeros((main + base, count)),
            FiniteDifferences(1e-4, model.tangent_perturbation), sweep, Derivatives(np.zeros((m, m)), dx, fields, dnodes),
        ):  # fmt: skip
            dx[:], fields[:], dnodes[:] = 0.0, 0.0, 0.0  # some may have been written
        self.key, self.mesh, self.interpolation = own, mesh, interpolation
        self.beta, self._linearised = beta.copy(), None
        more = 0 if vibrating is None else vibrating.fields.shape[1]
        wide = max(count + more, self.rank)
        self.theta = np.zeros((count, wide))
        self.theta[:, :count] = np.diag(scale)
        self.fields = np.zeros((main + base, wide))
        self.fields[:, :count] = fields
        if vibrating is not None:
            columns = remap_columns(model.n, vibrating.fields[None], vibrating.mesh, beta, mesh, beta)[0]
            self.fields[:, count : count + more] = columns
        self.dnodes, self.dx = np.zeros((len(dnodes), wide)), np.zeros((m, wide))
        self.dnodes[:, :count], self.dx[:, :count] = dnodes, dx
        variance = np.zeros(wide)
        variance[:count] = np.where(unc.sigma > 0, 1.0, 0.0)
        variance[count : count + more] = 1.0
        return np.diag(variance)

    def _coarse_sections(
        self, key: Key, mesh: Mesh, beta: Floats
    ) -> tuple[Key, Mesh, MeshInterpolation | None]:
        """The factor's sections for the model's: key, mesh, and the interpolation between them (None where they are the same)."""
        if key not in self._coarse or self.model.moving_precurvature:
            own = coarse_key(key, FACTOR_NODES)
            if own == key:
                self._coarse[key] = key, mesh, None
                return self._coarse[key]
            coarse = build_mesh(self.model.segments, beta, own, mesh.base_cells)
            known = self._coarse.get(key)
            self._coarse[key] = (
                own,
                coarse,
                known[2] if known else mesh_interpolation(self.model.n, mesh, coarse),
            )
        return self._coarse[key]

    def _remap(self, mesh: Mesh, beta: Floats) -> None:
        """Carry the fields' rows to another set of sections."""
        assert self.mesh is not None
        self.fields = remap_columns(self.model.n, self.fields[None], self.mesh, self.beta, mesh, beta)[0]

    def propagate(self, record: Record, par: Floats, over_s: float) -> bool:
        """Move V over ``over_s`` (s), up to the end of the solved (sub)step ``record``.

        The dynamics are linearised halfway between that end and the one at which this was last called. ``par`` (NP,): the parameter block.
        Returns False where that cannot be linearised, and V then stays.
        """
        model, m = self.model, self.model.unknown_count
        beta = record.inputs[-1, input_rows(model.n)["beta"]]
        key, mesh, interpolation = self._coarse_sections(record.key, record.mesh, beta)
        if key != self.key:
            self._remap(mesh, beta)
        self.key, self.mesh, self.interpolation, self.beta = key, mesh, interpolation, beta
        # copies: corrections write into what a record holds
        now = SolvedStage(
            record.key, record.rates[-1].copy(), record.found[-1].copy(), record.inputs[-1].copy()
        )
        middle = now.between(self._linearised)
        rates = middle.rates
        if interpolation is not None:
            rates = carried(interpolation.restrict, rates)
        # not in place: where the step cannot be linearised, V stays as it is
        fields = self._spare if self._spare.shape == self.fields.shape else np.empty_like(self.fields)
        buffers, columns = self._buffers(key, mesh), self.fields.shape[1]
        dx, dnodes = np.empty((m, columns)), np.empty((len(buffers.far.nodes) // COMPLEX.count, columns))
        if not rational_tangent(
            model.kind, self._lanes, mesh, self.fraction, over_s,
            SolvedStep(par.copy(), middle.inputs[None], middle.unknowns[None], record.before, rates[None], record.after),
            carried(self._effect, self.theta), self.fields, self._differences, buffers,
            Derivatives(np.empty((m, m)), dx, fields, dnodes),
        ):  # fmt: skip
            self._spare = fields
            return False
        self._spare = self._nothing if self._lent else self.fields
        self.fields, self.dx, self.dnodes, self._lent = fields, dx, dnodes, False
        self._linearised = now
        return True

    def _buffers(self, key: Key, mesh: Mesh) -> RationalBuffers:
        """Buffers of the tangent for the columns on the sections ``key``, ``mesh``."""
        at = key, self.fields.shape[1]
        if at not in self._work:
            model = self.model
            counts = 1, self._lanes.count, complex_unknown_lanes(model.kind).count, COMPLEX.count
            single, real, near, far = (model.sweep_buffers(mesh, count) for count in counts)
            self._work[at] = RationalBuffers(single, real, near, far, np.zeros(self.fields.shape))
        return self._work[at]

    def fields_change(self, a: Floats) -> Floats:
        """(fields,) change of the model's fields by the coefficients ``a`` (r,)."""
        change = self.fields @ a
        return change if self.interpolation is None else carried(self.interpolation.prolong, change)

    def nodes_change(self, a: Floats) -> Floats:
        """(nodes, S) change of the model's node states by the coefficients ``a`` (r,)."""
        change = (self.dnodes @ a).reshape(-1, state_rows(self.model.n).size)
        return change if self.interpolation is None else carried(self.interpolation.nodes, change)

    def position_deviation(self, pi: Floats) -> Floats:
        """(nodes,) deviation of the position per axis in m at the model's nodes, with the coefficients' covariance ``pi`` (r, r) or more.

        The last result is given again while neither the rows nor ``pi`` are other arrays.
        """
        if self._deviation is None or self._deviation[0] is not self.dnodes or self._deviation[1] is not pi:
            deviation = position_deviations(self.dnodes, state_rows(self.model.n).size, pi)
            if self.interpolation is not None:
                deviation = carried(self.interpolation.nodes, deviation)
            self._deviation = self.dnodes, pi, deviation
        return self._deviation[2]

    def change_basis(self, change: BasisChange) -> None:
        """Go over to other coefficients."""
        self.theta = change(self.theta)
        self.fields = change(self.fields)
        self.dnodes, self.dx = change(self.dnodes), change(self.dx)

    def energy(self) -> Floats:
        """(r, r) V^T W V in the energy norm, J."""
        assert self.mesh is not None
        return self._norm.gram(self.fields, self.key, self.mesh, self.beta)

    def checkpoint(self) -> FactorState:
        """What :meth:`restore` returns to."""
        self._lent = True
        return FactorState(
            self.key,
            self.mesh,
            self.interpolation,
            self.beta,
            self.theta.copy(),
            self.fields,
            self.dnodes,
            self.dx,
            self._linearised,
        )

    def restore(self, state: FactorState) -> None:
        """Return to a checkpoint."""
        (
            self.key, self.mesh, self.interpolation, self.beta, theta, self.fields, self.dnodes, self.dx, self._linearised,
        ) = state  # fmt: skip
        self._lent = True
        self.theta = theta.copy()
