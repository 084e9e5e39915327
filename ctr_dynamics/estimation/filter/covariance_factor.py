"""The covariance in low rank: columns of field and parameter perturbations with a small covariance of their coefficients.

The error of the fields and the uncertain parameters is V a, with V (fields + parameters, r) and a of covariance Pi_aa; tracker states b are kept in
full beside a, so that P = [V 0; 0 I] Pi [V 0; 0 I]^T. Columns move with the tangent of the step; process noise of the tip force appends columns,
and the weakest directions in an energy norm are dropped (Verlaan and Heemink 1997, reduced-rank square-root filter).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ctr_dynamics.estimation.filter.parameter_priors import ModelUncertainty
from ctr_dynamics.estimation.filter.reduction import Change
from ctr_dynamics.kernels.covariance import position_deviations
from ctr_dynamics.kernels.filter_steps import sparse_product
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.shooting import lanes_for, lanes_free
from ctr_dynamics.kernels.tangent import linearise, theta_tangent
from ctr_dynamics.model.mesh import Key, Mesh, build_mesh
from ctr_dynamics.model.mesh_interpolation import Transfer, coarse_key, transfer
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Record, remap_columns

Floats = NDArray[np.float64]
COLUMN_NODES = 12
MOVED = 1e-3  # m: the energy norm is renewed where a translation has changed by more
EPSILON = 5e-9  # of one standard deviation: small against the curvature of the step, large against rounding


def carried(matrix: csr_array, values: Floats) -> Floats:
    """Product (rows, k) of a sparse matrix with ``values`` (columns, k), or (rows,) with (columns,)."""
    product = sparse_product(matrix.indptr, matrix.indices, matrix.data, values.reshape(len(values), -1))
    return product.reshape(-1, *values.shape[1:])


def field_weights(model: Model, mesh: Mesh, beta: Floats) -> Floats:
    """(fields,) weights of the energy norm: half the sum of weight times field squared is energy in J."""
    n, layout, par = model.n, model.layout, model.parameters
    F = 7 + 2 * n
    seclen = np.zeros(len(mesh.sec_cells))
    section_lengths(mesh.bp_tube, mesh.bp_offset, beta, seclen)
    EI, GJ = par[layout["bending_stiffness"]], par[layout["torsional_stiffness"]]
    RA, RI = par[layout["mass_per_length"]], par[layout["inertia_per_length"]]
    rows = []
    for k, cells in enumerate(mesh.sec_cells):
        present = int(mesh.sec_tubes[k])
        density = np.zeros(F)
        density[0:3] = RA[:present].sum()
        density[3:5] = RI[:present].sum()
        density[5] = 2 * RI[:present].sum()
        density[6:8] = EI[:present].sum()
        density[8] = GJ[0]
        density[9 : 9 + present - 1] = GJ[1:present]
        density[8 + n : 8 + n + present - 1] = 2 * RI[1:present]
        step = seclen[k] / cells
        stage = np.tile(np.array([1.0, 2.0, 2.0, 1.0]) / 6.0 * step, cells)
        rows.append((np.append(stage, 0.0)[:, None] * density).ravel())
    base_points = 4 * mesh.base_cells + 1
    for i in range(n):
        step = -beta[i] / mesh.base_cells
        stage = np.append(np.tile(np.array([1.0, 2.0, 2.0, 1.0]) / 6.0 * step, mesh.base_cells), 0.0)
        rows.append((stage[:, None] * np.array([2 * RI[i], GJ[i]])).ravel())
        assert len(stage) == base_points
    rows.append(np.zeros(4 * n))  # what only the extended model moves at the tubes' bases and ends
    weights = np.concatenate(rows)
    body = par[layout["body_mass"]][0]
    main = sum((4 * c + 1) * F for c in mesh.sec_cells)
    weights[main - F : main - F + 3] += body  # the payload's kinetic energy, at the last point
    return weights


def energy_rows(model: Model, mesh: Mesh, beta: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Fields (k,) that the energy norm of columns is taken from, and the roots (k, 1) of their weights.

    The two middle stages of a cell stand for one place, and so do the last of a cell and the first of the next: one of each two is taken,
    with the weights of both.
    """
    alike: list[NDArray[np.int64]] = []
    begin = 0
    for cells, size in [(c, 7 + 2 * model.n) for c in mesh.sec_cells] + [(mesh.base_cells, 2)] * model.n:
        points = np.arange(4 * cells + 1)
        points[2::4] -= 1
        points[3::4] += 1
        alike.append((begin + size * points[:, None] + np.arange(size)).ravel())
        begin += size * len(points)
    weights = field_weights(model, mesh, beta)
    places = np.concatenate(alike)
    whole = np.bincount(places, weights[: len(places)])
    rows = np.flatnonzero(whole)
    return rows, np.sqrt(whole[rows])[:, None]


class Columns:
    """V and its parts.

    Attributes:
        stored: (2, fields, r) columns of the fields and of their rates.
        theta: (n_theta, r) parameter parts.
        dnodes: (nodes * S, r) columns of the node states after the last step.
        dx: (5 + N, r) columns of the unknowns after the last step.

    The columns live on sections of at most ``COLUMN_NODES`` nodes: a covariance does not need the model's own resolution.
    """

    def __init__(self, model: Model, uncertainty: ModelUncertainty, rank: int) -> None:
        self.model, self.uncertainty = model, uncertainty
        # what else would idle beside them in the sweep of the tangent carries columns too
        self.rank = rank + lanes_free(6 + model.n + rank)
        self._effect = csr_array(uncertainty.effect)
        self._work: dict[tuple, tuple] = {}
        self._coarse: dict[Key, tuple[Key, Mesh, Transfer | None]] = {}
        self.transfer: Transfer | None = None
        self._weights: dict[Key, tuple[Floats, NDArray[np.int64], Floats]] = {}
        self.key: Key = ((), ())
        self.mesh: Mesh | None = None
        self.beta = np.zeros(model.n)
        self._deviation: tuple[Floats, Floats, Floats] | None = None  # of columns, with their covariance
        self._lent = False  # whether a snapshot holds `stored`
        self._spare = self._nothing = np.empty((0, 0, 0))  # room for the next `stored`

    def start(self, key: tuple, mesh: Mesh, beta: Floats, alpha: Floats, par: Floats, x: Floats) -> Floats:
        """Columns of the static equilibrium's dependence on the uncertain parameters; returns Pi_aa (r, r).

        At an equilibrium that cannot be linearised (a fold) the fields' columns begin at zero and fill while the robot moves."""
        model, unc = self.model, self.uncertainty
        own, mesh, moved = self._own(key, mesh, beta)
        count = len(unc.names)
        lanes = lanes_for(6 + model.n + count)
        big = model.buffers(mesh, 8 * len(lanes))
        main, base = len(big[4]) // (8 * len(lanes)), len(big[5]) // (8 * len(lanes))
        m = 5 + model.n
        par = par.copy()
        par[model.layout["alpha"]], par[model.layout["beta"]], par[model.layout["alpha_rate"]] = (
            alpha,
            beta,
            0.0,
        )
        scale = np.where(unc.sigma > 0, unc.sigma, 1e-3)
        dx, fields = np.zeros((m, count)), np.zeros((main + base, count))
        dnodes = np.zeros((len(big[8]) // (8 * len(lanes)), count))
        if not linearise(
            model.tubes, lanes, mesh, 0.0, par, unc.effect * scale, x, np.zeros(main), np.zeros(base),
            np.zeros((main + base, count)), 1e-4, model.tangent_step, big, np.zeros((m, m)), dx, fields, dnodes,
        ):  # fmt: skip
            dx[:], fields[:], dnodes[:] = 0.0, 0.0, 0.0  # some may have been written
        self.key, self.mesh, self.transfer = own, mesh, moved
        self.beta = beta.copy()
        r = self.rank
        wide = max(count, r)
        self.theta = np.zeros((count, wide))
        self.theta[:, :count] = np.diag(scale)
        self.stored = np.zeros((2, main + base, wide))
        self.stored[0, :, :count] = fields
        self.dnodes, self.dx = np.zeros((len(dnodes), wide)), np.zeros((m, wide))
        self.dnodes[:, :count], self.dx[:, :count] = dnodes, dx
        variance = np.zeros(wide)
        variance[:count] = np.where(unc.sigma > 0, 1.0, 0.0)
        return np.diag(variance)

    @property
    def fields(self) -> Floats:
        """(fields, r) columns of the fields."""
        return self.stored[0]

    def _own(self, key: Key, mesh: Mesh, beta: Floats) -> tuple[Key, Mesh, Transfer | None]:
        """The columns' sections for the model's: key, mesh, and the transfer between them (None where they are the same)."""
        if key not in self._coarse or self.model.moving_precurvature:
            own = coarse_key(key, COLUMN_NODES)
            if own == key:
                self._coarse[key] = key, mesh, None
                return self._coarse[key]
            coarse = build_mesh(self.model.segments, beta, own, mesh.base_cells)
            kept = self._coarse.get(key)
            self._coarse[key] = own, coarse, kept[2] if kept else transfer(self.model.n, mesh, coarse)
        return self._coarse[key]

    def _remap(self, key: Key, mesh: Mesh, beta: Floats) -> None:
        """Carry the columns to another set of sections."""
        assert self.mesh is not None
        self.stored = remap_columns(self.model.n, self.stored, self.mesh, self.beta, mesh, beta)

    def propagate(self, records: tuple[Record, ...], par: Floats, behind: float = 0.0) -> bool:
        """Move the columns over the solved (sub)steps in ``records`` and ``behind`` (s) of steps before that they have not followed yet; False
        where a stage cannot be linearised (columns then stay)."""
        model = self.model
        m = 5 + model.n
        dpar = carried(self._effect, self.theta)
        for record in records:
            beta = record.inputs[-1, 2 * model.n : 3 * model.n]
            key, mesh, moved = self._own(record.key, record.mesh, beta)
            if key != self.key:
                self._remap(key, mesh, beta)
            self.key, self.mesh, self.transfer, self.beta = key, mesh, moved, beta
            after, rate = record.after, record.rates[-1]
            if moved is not None:
                after, rate = carried(moved.restrict, after), carried(moved.restrict, rate)
            columns = self.theta.shape[1]
            work_key = (key, columns)
            if work_key not in self._work:
                lanes = lanes_for(1 + m + columns)
                L = 8 * len(lanes)
                big = model.buffers(mesh, L)
                main, base = len(big[4]) // L, len(big[5]) // L
                self._work[work_key] = (
                    lanes, big, (np.zeros(main), np.zeros(base), np.zeros((main + base, columns))), np.zeros((m, m)),
                    (len(big[8]) // L, columns),
                )  # fmt: skip
            lanes, big, work, inverse, shape = self._work[work_key]
            # not in place: where a stage cannot be linearised, the columns stay as they are
            stored = self._spare if self._spare.shape == self.stored.shape else np.empty_like(self.stored)
            dx, dnodes = np.empty((m, columns)), np.empty(shape)
            ok = theta_tangent(
                model.tubes, lanes, mesh, record.scheme.dt + behind, par.copy(), record.inputs[-1], record.found[-1], after,
                rate, dpar, EPSILON, model.tangent_step, big, work, self.stored, stored, inverse, dx, dnodes,
            )  # fmt: skip
            if not ok:
                self._spare = stored
                return False
            self._spare = self._nothing if self._lent else self.stored
            self.stored, self.dx, self.dnodes, self._lent = stored, dx, dnodes, False
            behind = 0.0
        return True

    def fields_change(self, a: Floats) -> Floats:
        """(fields,) change of the model's fields by the coefficients ``a`` (r,)."""
        change = self.fields @ a
        return change if self.transfer is None else carried(self.transfer.prolong, change)

    def nodes_change(self, a: Floats) -> Floats:
        """(nodes, S) change of the model's node states by the coefficients ``a`` (r,)."""
        change = (self.dnodes @ a).reshape(-1, 16 + 3 * self.model.n)
        return change if self.transfer is None else carried(self.transfer.nodes, change)

    def position_deviation(self, pi: Floats) -> Floats:
        """(nodes,) deviation of the position per axis in m at the model's nodes, coefficients' covariance ``pi`` (r, r) or more. Kept while neither
        the columns nor ``pi`` are other arrays."""
        if self._deviation is None or self._deviation[0] is not self.dnodes or self._deviation[1] is not pi:
            deviation = position_deviations(self.dnodes, 16 + 3 * self.model.n, pi)
            if self.transfer is not None:
                deviation = carried(self.transfer.nodes, deviation)
            self._deviation = self.dnodes, pi, deviation
        return self._deviation[2]

    def change(self, change: Change) -> None:
        """Go over to other coefficients."""
        self.theta = change(self.theta)
        _, fields, columns = self.stored.shape
        self.stored = change(self.stored.reshape(-1, columns)).reshape(2, fields, -1)
        self.dnodes, self.dx = change(self.dnodes), change(self.dx)

    def energy(self) -> Floats:
        """(r, r) V^T W V, J."""
        assert self.mesh is not None
        known = self._weights.get(self.key)
        if known is None or np.abs(known[0] - self.beta).max() > MOVED:
            known = self._weights[self.key] = (self.beta, *energy_rows(self.model, self.mesh, self.beta))
        _, rows, roots = known
        weighted = self.fields.take(rows, axis=0)
        weighted *= roots
        return weighted.T @ weighted

    def snapshot(self) -> tuple:
        """What :meth:`restore` needs; references do, for the next step leaves the arrays alone and goes on with a copy."""
        self._lent = True
        return (
            self.key,
            self.mesh,
            self.transfer,
            self.beta,
            self.theta.copy(),
            self.stored,
            self.dnodes,
            self.dx,
        )

    def restore(self, snapshot: tuple) -> None:
        """Go back to an earlier snapshot."""
        self.key, self.mesh, self.transfer, self.beta, theta, self.stored, self.dnodes, self.dx = snapshot
        self._lent = True
        self.theta = theta.copy()
