"""Where multiple shooting cuts the tubes: growth of perturbations along them, cuts at equal shares of it, units of the unknowns.

A stage's equations at the rate c0 let a perturbation at the base grow along the tubes as exp(G), with
G = sum over the sections of length (rho A c0^2 / E I)^(1/4) / sqrt 2: bending with inertia has the exponents (-rho A c0^2 / E I)^(1/4).
Newton's method loses its digits and its basin of convergence in exp(G), so each segment takes a limited share of G.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.kinds import cut_size, first_cut_row
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.structures import Mesh
from ctr_dynamics.model.mesh import Key
from ctr_dynamics.model.model import Model

Floats = NDArray[np.float64]
CONDENSED = (
    15.0  # growth from base to tip up to which systems are condensed: e^15 costs seven of sixteen digits
)
GROWTH = 4.0  # of one segment: e^4 costs the Jacobian's differences two of their digits


class Segments(NamedTuple):
    """A mesh with its cuts: ``mesh``, the ``nodes`` (cuts,) at which the segments behind them begin, and the growth G from base to tip."""

    mesh: Mesh
    nodes: NDArray[np.int64]
    growth: float


def growth(model: Model, mesh: Mesh, beta: Floats, rate: complex) -> Floats:
    """(sections,) shares of G at the ``rate`` c0 (1/s) and the translations ``beta`` (N,) m."""
    lengths = np.zeros(len(mesh.sec_cells))
    section_lengths(mesh.bp_tube, mesh.bp_offset, np.ascontiguousarray(beta, float), lengths)
    layout, par = model.layout, model.parameters
    stiffness = np.cumsum(par[layout["bending_stiffness"]])[mesh.sec_tubes - 1]
    mass = np.cumsum(par[layout["mass_per_length"]])[mesh.sec_tubes - 1]
    # cos(pi / 4 - |arg c0| / 2) = sqrt((1 + sin|arg c0|) / 2): of the fastest of the four exponents
    largest = math.sqrt(0.5 * (1.0 + math.sin(abs(np.angle(rate))))) * math.sqrt(abs(rate))
    return lengths * (mass / stiffness) ** 0.25 * largest


def segmented(model: Model, mesh: Mesh, beta: Floats, rate: complex) -> Segments:
    """Cuts for a step whose fastest stage has the ``rate`` (1/s): at least one, as many as keep each segment's growth below ``GROWTH``."""
    shares = growth(model, mesh, beta, rate)
    count = max(2, math.ceil(shares.sum() / GROWTH))
    steps = np.repeat(shares / mesh.sec_cells, mesh.sec_cells)
    before = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
    wanted = np.arange(1, count) / count * steps.sum()
    cells = sorted({int(np.argmin(np.abs(before - share))) for share in wanted} - {0})
    cut = -np.ones(len(steps))
    cut[cells] = np.arange(len(cells))
    first = np.concatenate([[0], np.cumsum(mesh.sec_cells)])
    owner = np.full(len(mesh.owner), len(cells), np.int64)
    present = np.append(mesh.sec_tubes, 0)
    for tube in range(1, model.n):
        # its balance stands where the first section without it begins, before any cut there
        section = int(np.argmax(present <= tube))
        owner[5 + tube] = sum(cell < first[section] for cell in cells)
    nodes = np.array([cell + int(np.searchsorted(first, cell, side="right")) - 1 for cell in cells], np.int64)
    return Segments(mesh._replace(cut=cut, owner=owner), nodes, float(shares.sum()))


def segments_of(model: Model, key: Key, mesh: Mesh, beta: Floats, rates: NDArray[np.complex128]) -> Segments:
    """The same cuts for all runs of the ``model`` on the sections ``key``, for steps whose stages have the ``rates`` (1/s)."""
    fastest = max(rates.tolist(), key=lambda rate: float(growth(model, mesh, beta, rate).sum()))
    known: Segments | None = model.cuts.get((key, fastest))
    if known is None:
        known = model.cuts[key, fastest] = segmented(model, mesh, beta, fastest)
    return known._replace(mesh=mesh._replace(cut=known.mesh.cut, owner=known.mesh.owner))


def unknown_units(model: Model, cuts: int, rate: float) -> tuple[Floats, Floats]:
    """Units (mt,) of the unknowns and of the residuals with so many cuts, for steps of the ``rate`` 1/s."""
    n, force, moment = model.n, model.scale[0], model.scale[3]
    length = moment / force
    state = np.concatenate(
        [
            np.full(3, length), np.ones(4), np.full(3, rate * length), np.full(3, rate), np.full(3, force),
            np.full(2 + n, moment), np.ones(n - 1), np.full(n - 1, rate),
        ]
    )[first_cut_row(model.kind) :]  # fmt: skip
    assert len(state) == cut_size(model.kind)
    unknowns = np.concatenate([np.full(n, moment), np.full(3, force), np.full(2, moment)])
    return (
        np.concatenate([unknowns, np.tile(state, cuts)]),
        np.concatenate([model.scale, np.tile(state, cuts)]),
    )
