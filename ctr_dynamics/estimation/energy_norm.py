"""The energy norm, in which covariance factors are reduced and vibration modes are found.

Half the sum of weight times field squared is the kinetic plus the elastic energy of the fields, in J.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.layout import base_end_rows, field_rows
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.model.mesh import Key, Mesh
from ctr_dynamics.model.model import Model

Floats = NDArray[np.float64]
# m: the weights are renewed where a translation has changed by more. They only choose what a reduction drops, and a percent of a section's
# length changes little in that.
MOVED = 1e-3


def field_weights(model: Model, mesh: Mesh, beta: Floats) -> Floats:
    """(fields,) weights of the energy norm on ``mesh`` with translations ``beta`` (N,) m."""
    n, layout, par = model.n, model.layout, model.parameters
    F = field_rows(n).size
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
    rows.append(
        np.zeros(base_end_rows(n).size)
    )  # what only the extended physics moves at the tubes' bases and ends
    weights = np.concatenate(rows)
    body = par[layout["body_mass"]][0]
    main = sum((4 * c + 1) * F for c in mesh.sec_cells)
    weights[main - F : main - F + 3] += body  # the payload's kinetic energy, at the last point
    return weights


def energy_rows(model: Model, mesh: Mesh, beta: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Fields (k,) that the norm of a covariance factor is taken from, and the roots (k, 1) of their weights.

    The two middle stages of a cell stand for one place, and so do the last of a cell and the first of the next. One of each two is taken,
    with the weights of both.
    """
    alike: list[NDArray[np.int64]] = []
    begin = 0
    for cells, size in [(c, field_rows(model.n).size) for c in mesh.sec_cells] + [
        (mesh.base_cells, 2)
    ] * model.n:
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


class EnergyNorm:
    """The norm of factors on the sections that a robot has come through; their weights are stored by section."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._weights: dict[Key, tuple[Floats, NDArray[np.int64], Floats]] = {}

    def gram(self, fields: Floats, key: Key, mesh: Mesh, beta: Floats) -> Floats:
        """(r, r) V^T W V in J of columns ``fields`` (fields, r) on the sections ``key``, ``mesh`` at ``beta`` (N,) m."""
        known = self._weights.get(key)
        if known is None or np.abs(known[0] - beta).max() > MOVED:
            known = self._weights[key] = (beta, *energy_rows(self.model, mesh, beta))
        _, rows, roots = known
        weighted = fields.take(rows, axis=0)
        weighted *= roots
        return weighted.T @ weighted
