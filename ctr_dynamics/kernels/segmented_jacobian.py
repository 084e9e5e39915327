"""Jacobian of multiple shooting from one sweep, at a real or a complex rate.

The segments between the cuts of a mesh do not know of each other while they are swept. So one lane perturbs the same row of every segment's start,
and a sweep of as many lanes as a start has rows gives all of the Jacobian. Unknowns and residuals are in their units here: 5 + N of the two-point
problem, then the states at the cuts (:func:`ctr_dynamics.kernels.sweep.sweep`).

The complex Jacobian belongs to y_t = lambda y + h; every lane then has an imaginary part (:mod:`ctr_dynamics.kernels.complex_rates`).
"""

import math

import numpy as np
from numba.extending import overload

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.complex_linearise import WIDE, lay, place
from ctr_dynamics.kernels.complex_rates import complex_rate
from ctr_dynamics.kernels.kinds import SIMD_WIDTH, Lanes, RobotKind, cut_size, segment_lanes
from ctr_dynamics.kernels.layout import unknown_rows
from ctr_dynamics.kernels.shooting import broadcast
from ctr_dynamics.kernels.structures import SweepBuffers
from ctr_dynamics.kernels.sweep import sweep


def complex_segment_lanes(kind: RobotKind) -> Lanes:
    """As :func:`~ctr_dynamics.kernels.kinds.segment_lanes`, with the imaginary parts."""
    return Lanes(WIDE * math.ceil((1 + cut_size(kind)) / SIMD_WIDTH), WIDE)


@overload(complex_segment_lanes, strict=False)
def _complex_segment_lanes(kind):
    lanes = complex_segment_lanes(RobotKind(kind.constants["tubes"], kind.physics))
    return lambda kind: lanes


@njit(nogil=True)
def lane_of(number, imaginary_too):
    """Lane of the base case, number 0, and of the perturbations behind it."""
    return place(number) if imaginary_too else number


@njit(nogil=True)
def perturb_starts(kind, values, L, imaginary_too, units, step):
    """Move row r of every segment's start by ``step`` units in lane number 1 + r of ``values`` (mt, L)."""
    m, size = unknown_rows(kind.tubes).size, cut_size(kind)
    for row in range(len(units)):
        r = row if row < m else (row - m) % size
        values[row * L + lane_of(1 + r, imaginary_too)] += step * units[row]


@njit(nogil=True, error_model="numpy")
def assemble(kind, residual, L, imaginary_too, part, owner, residual_units, step, matrix):
    """The Jacobian ``matrix`` (mt, mt), in units, from the ``residual`` (mt, L) of perturbed lanes; of the imaginary ``part`` 1 or the real one 0.
    False where anything is not finite."""
    offset = part * SIMD_WIDTH
    m, size, mt = unknown_rows(kind.tubes).size, cut_size(kind), len(residual_units)
    matrix[:] = 0.0
    for row in range(mt):
        segment = owner[row] if row < m else (row - m) // size  # whose start moves this row
        first, count = (0, m) if segment == 0 else (m + (segment - 1) * size, size)
        scale = 1.0 / (step * residual_units[row])
        for r in range(count):
            lane = lane_of(1 + r, imaginary_too) + offset
            value = (residual[row * L + lane] - residual[row * L + offset]) * scale
            if not math.isfinite(value):
                return False
            matrix[row, first + r] = value
        if row >= m and part == 0:
            matrix[row, row] -= 1.0
            r = (row - m) % size
            if r < count:  # the same lane has moved the start behind the cut
                matrix[row, first + r] += 1.0
    return True


@njit(nogil=True)
def real_jacobian(kind, c0, mesh, single, x, b, units, residual_units, step, matrix):
    """Jacobian at the unknowns ``x`` (mt,) into ``matrix`` (mt, mt), in units; False where anything is not finite.

    ``single``: buffers of one lane with parameters, lengths and histories. ``b``: those of
    :func:`~ctr_dynamics.kernels.kinds.segment_lanes`.
    """
    lanes = segment_lanes(kind)
    L = lanes.count
    broadcast(lanes, single.parameters, b.parameters)
    broadcast(lanes, single.section_lengths, b.section_lengths)
    broadcast(lanes, x, b.unknowns)
    broadcast(lanes, single.base_history, b.base_history)
    perturb_starts(kind, b.unknowns, L, False, units, step)
    shared = SweepBuffers(
        b.workspace, b.parameters, b.section_lengths, b.unknowns, single.history, b.base_history, b.fields[:0],
        b.base_fields, b.nodes[:0], b.residual,
    )  # fmt: skip
    sweep(kind, lanes, c0, mesh, shared)
    return assemble(kind, b.residual, L, False, 0, mesh.owner, residual_units, step, matrix)


@njit(nogil=True)
def complex_jacobian(kind, rate, mesh, point, b, matrix):
    """Jacobian, in units, at the complex ``rate`` about one solved or nearly solved stage, into ``matrix`` (2, mt, mt), real and imaginary.

    ``point``: :class:`~ctr_dynamics.kernels.structures.StagePoint`. ``b``: buffers of :func:`complex_segment_lanes`, its histories those of one
    batch. False where anything is not finite.
    """
    lanes = complex_segment_lanes(kind)
    L, re, im, main = lanes.count, rate.real, rate.imag, len(b.history) // WIDE
    lay(b.parameters, point.parameters, point.parameters)
    lay(b.section_lengths, point.section_lengths, point.section_lengths)
    lay(b.unknowns, point.unknowns, point.unknowns)
    # both parts begin at the real trajectory
    real, imaginary = np.empty(len(point.fields)), np.empty(len(point.fields))
    for r in range(len(point.fields)):
        real[r] = point.rates[r] - (re - im) * point.fields[r]
        imaginary[r] = point.rates[r] - (re + im) * point.fields[r]
    lay(b.history, real[:main], imaginary[:main])
    lay(b.base_history, real[main:], imaginary[main:])
    perturb_starts(kind, b.unknowns, L, True, point.units, point.step)
    swept = SweepBuffers(
        b.workspace, b.parameters, b.section_lengths, b.unknowns, b.history, b.base_history, b.fields[:0],
        b.base_fields, b.nodes[:0], b.residual,
    )  # fmt: skip
    sweep(kind, lanes, complex_rate(re, im), mesh, swept)
    owner, units, step = mesh.owner, point.residual_units, point.step
    done = assemble(kind, b.residual, L, True, 0, owner, units, step, matrix[0])
    return done and assemble(kind, b.residual, L, True, 1, owner, units, step, matrix[1])
