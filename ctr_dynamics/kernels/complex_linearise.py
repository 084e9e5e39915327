"""Linearisation of a solved two-point problem about a complex c0 (:mod:`ctr_dynamics.kernels.complex_rates`), as
:mod:`ctr_dynamics.kernels.linearise` does it about a real one.

Lanes come in batches of eight real parts and the eight imaginary parts behind them. All of them begin at the base case, whose solution is real. A
perturbation of an unknown is real: the response to i times it is i times the response.
"""

import math

import numpy as np
from numba.extending import overload

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.complex_rates import COMPLEX, complex_rate
from ctr_dynamics.kernels.kinds import ONE_BATCH, ONE_LANE, SIMD_WIDTH, Lanes, RobotKind
from ctr_dynamics.kernels.layout import unknown_rows
from ctr_dynamics.kernels.shooting import invert, lane_lengths
from ctr_dynamics.kernels.simd import column_view, fma, view
from ctr_dynamics.kernels.structures import SweepBuffers
from ctr_dynamics.kernels.sweep import sweep

WIDE = COMPLEX.width


def complex_unknown_lanes(kind: RobotKind) -> Lanes:
    """Lanes with room for the real and the imaginary part of a base case and of one perturbation of each unknown."""
    return Lanes(WIDE * math.ceil((1 + unknown_rows(kind.tubes).size) / SIMD_WIDTH), WIDE)


@overload(complex_unknown_lanes, strict=False)
def _complex_unknown_lanes(kind):
    lanes = complex_unknown_lanes(RobotKind(kind.constants["tubes"]))
    return lambda kind: lanes


@njit(nogil=True)
def in_place(b):
    """The buffers ``b`` with the fields in the place of their own histories, which a sweep has read before it writes them."""
    return SweepBuffers(
        b.workspace, b.parameters, b.section_lengths, b.unknowns, b.fields, b.base_history, b.fields, b.base_fields, b.nodes, b.residual,
    )  # fmt: skip


@njit(nogil=True)
def place(lane):
    """Where the real part of a lane lies; its imaginary part lies ``SIMD_WIDTH`` behind it."""
    return lane // SIMD_WIDTH * WIDE + lane % SIMD_WIDTH


@njit(nogil=True, error_model="numpy")
def lay(values, real, imag):
    """The base case in all lanes of ``values`` (rows, L): ``real`` (rows,) and ``imag`` (rows,)."""
    rows = len(real)
    L = len(values) // max(rows, 1)
    for first in range(0, L, WIDE):
        one, other = (
            view(ONE_BATCH, values, first, L),
            view(ONE_BATCH, values, first + SIMD_WIDTH, L),
        )
        for r in range(rows):
            one[r] = real[r]
            other[r] = imag[r]


@njit(nogil=True, error_model="numpy")
def _perturb(values, change, column, lane, count, real, imag):
    """Add ``real`` + i ``imag`` times ``count`` columns of ``change`` (rows, r) from ``column`` on to the lanes from ``lane`` on."""
    rows = len(change)
    L = len(values) // max(rows, 1)
    first = place(lane)
    if count == SIMD_WIDTH and change.strides[1] == 8:
        one, other = (
            view(ONE_BATCH, values, first, L),
            view(ONE_BATCH, values, first + SIMD_WIDTH, L),
        )
        source = column_view(change, column)
        for r in range(rows):
            one[r] = fma(source[r], real, one[r])
            if imag != 0.0:
                other[r] = fma(source[r], imag, other[r])
    else:
        for r in range(rows):
            for k in range(count):
                values[r * L + first + k] += real * change[r, column + k]
                values[r * L + first + k + SIMD_WIDTH] += imag * change[r, column + k]


@njit(nogil=True, error_model="numpy")
def _slopes(values, H, step):
    """Lanes of the unknowns in ``values`` (rows, H) become derivatives by them."""
    taken, scale = np.zeros(H), np.ones(H)
    for i in range(len(step)):
        at = place(1 + i)
        for part in (at, at + SIMD_WIDTH):
            taken[part], scale[part] = 1.0, 1.0 / step[i]
    base = view(ONE_LANE, values, 0, 1)
    for first in range(0, H, SIMD_WIDTH):
        lanes, weight, factor = (
            view(ONE_BATCH, values, first, H),
            view(ONE_BATCH, taken, first, H),
            view(ONE_BATCH, scale, first, H),
        )
        start = first % WIDE  # of the base case, the part that these lanes are
        for r in range(len(values) // H):
            lanes[r] = (lanes[r] - weight[0] * base[r * H + start]) * factor[0]


@njit(nogil=True, error_model="numpy")
def _jacobian(res, step, inverse):
    """Inverse Jacobian from the residuals ``res`` (m, H) of the base case and the unknowns; False if singular or not finite."""
    m = len(step)
    H = len(res) // m
    matrix = np.empty((m, m), np.complex128)
    for i in range(m):
        base = i * H
        for k in range(m):
            at = base + place(1 + k)
            slope = complex(res[at] - res[base], res[at + SIMD_WIDTH] - res[base + SIMD_WIDTH]) / step[k]
            if not np.isfinite(slope):
                return False
            matrix[i, k] = slope
    return invert(matrix, inverse)


@njit(nogil=True, error_model="numpy")
def _boundary(base, res, lane, column, count, epsilon, inverse, weight, share, follow, dx):
    """Weighted columns of the unknowns from ``count`` lanes of residuals ``res`` (m, L) and of ``base`` (m, H), the base case.

    Into ``follow`` (2, m, 8), real and imaginary parts of ``weight`` times them at the place of their lanes; their real parts onto ``share`` times
    ``dx`` (m, r). False if one is not finite.
    """
    m = len(inverse)
    L, H = len(res) // m, len(base) // m
    first = place(lane)
    slope = np.empty(m, np.complex128)
    follow[:] = 0.0
    for k in range(count):
        for q in range(m):
            at = q * L + first + k
            slope[q] = (
                complex(res[at] - base[q * H], res[at + SIMD_WIDTH] - base[q * H + SIMD_WIDTH]) / epsilon
            )
            if not np.isfinite(slope[q]):
                return False
        for i in range(m):
            total = 0j
            for q in range(m):
                total -= inverse[i, q] * slope[q]
            total *= weight
            there = (lane + k) % SIMD_WIDTH
            follow[0, i, there], follow[1, i, there] = total.real, total.imag
            dx[i, column + k] = (share * dx[i, column + k] if share != 0.0 else 0.0) + total.real
    return True


@njit(nogil=True, error_model="numpy")
def _add(kind, slopes, swept, lane, count, epsilon, weight, share, follow, column, target):
    """Real parts of ``weight`` times the columns of ``swept`` (rows, L), with the unknowns following, onto ``share`` times ``target`` (rows, r).

    ``slopes`` (rows, H): as :func:`_slopes` leaves them. ``follow``: of :func:`_boundary`.
    """
    H, m = complex_unknown_lanes(kind).count, unknown_rows(kind.tubes).size
    rows = len(target)
    L = len(swept) // rows
    first = place(lane) // SIMD_WIDTH * SIMD_WIDTH
    one, other = (
        view(ONE_BATCH, swept, first, L),
        view(ONE_BATCH, swept, first + SIMD_WIDTH, L),
    )
    slope = view(ONE_LANE, slopes, 0, 1)
    real, imag = (
        view(ONE_BATCH, follow[0].reshape(-1), 0, SIMD_WIDTH),
        view(ONE_BATCH, follow[1].reshape(-1), 0, SIMD_WIDTH),
    )
    a, b = weight.real / epsilon, -weight.imag / epsilon
    aligned = count == SIMD_WIDTH and target.strides[1] == 8
    whole = column_view(target, column if aligned else 0)
    scratch = np.empty(SIMD_WIDTH)
    part = view(ONE_BATCH, scratch, 0, SIMD_WIDTH)
    for r in range(rows):
        at = r * H
        total = (one[r] - slope[at]) * a
        rest = (other[r] - slope[at + SIMD_WIDTH]) * b
        for i in range(m):
            there = at + (1 + i) // SIMD_WIDTH * WIDE + (1 + i) % SIMD_WIDTH
            total = fma(real[i], slope[there], total)
            rest = fma(imag[i], -slope[there + SIMD_WIDTH], rest)
        if aligned:
            whole[r] = fma(whole[r], share, total + rest) if share != 0.0 else total + rest
        else:
            part[0] = total + rest
            for k in range(count):
                was = share * target[r, column + k] if share != 0.0 else 0.0
                target[r, column + k] = was + scratch[(lane + k) % SIMD_WIDTH]


@njit(nogil=True, error_model="numpy")
def _follow(kind, near, b, lane, column, count, epsilon, inverse, weight, share, follow, result):
    """``count`` columns of the ``result`` from ``column`` on, from the lanes of swept buffers ``b`` from ``lane`` on; False if one is not finite."""
    if not _boundary(
        near.residual, b.residual, lane, column, count, epsilon, inverse, weight, share, follow, result.unknowns
    ):  # fmt: skip
        return False
    dfields = result.fields
    main = len(near.fields) // complex_unknown_lanes(kind).count
    _add(kind, near.fields, b.fields, lane, count, epsilon, weight, share, follow, column, dfields[:main])
    _add(
        kind, near.base_fields, b.base_fields, lane, count, epsilon, weight, share, follow, column, dfields[main:]
    )  # fmt: skip
    _add(kind, near.nodes, b.nodes, lane, count, epsilon, weight, share, follow, column, result.nodes)
    return True


@njit(nogil=True, error_model="numpy")
def _lay(kind, lanes, mesh, c0, base, dparameters, dfields, column, lane, count, epsilon, b):
    """The ``base`` case (parameters, unknowns, both parts of the history) in all lanes of ``b``, and ``count`` columns from ``column`` on in those
    from ``lane`` on."""
    parameters, unknowns, real, imag = base
    main = len(b.history) // lanes.count
    lay(b.parameters, parameters, parameters)
    lay(b.unknowns, unknowns, unknowns)
    lay(b.history, real[:main], imag[:main])
    lay(b.base_history, real[main:], imag[main:])
    _perturb(b.parameters, dparameters, column, lane, count, epsilon, 0.0)
    _perturb(b.history, dfields[:main], column, lane, count, -epsilon * c0.real, -epsilon * c0.imag)
    _perturb(b.base_history, dfields[main:], column, lane, count, -epsilon * c0.real, -epsilon * c0.imag)
    lane_lengths(kind, lanes, mesh, b.parameters, b.section_lengths)


@njit(nogil=True, error_model="numpy")
def add_complex(kind, mesh, c0, weight, share, solved, dparameters, dfields, differences, buffers, result):
    """Into ``result``: ``share`` times what it holds plus Re(``weight`` v), with v the solution of (c0 - A) v = c0 ``dfields`` + B ``dparameters``.

    ``c0``, ``weight``: complex. ``solved``: parameters (NP,), unknowns (m,), fields and their rates (fields,) of a solved stage, about which A and B
    are taken. ``dparameters`` (NP, r), ``dfields`` (fields, r): columns in units in which a step of ``differences.column`` is small. ``buffers``: of
    :func:`complex_unknown_lanes` lanes and of ``COMPLEX``. ``result``: :class:`~ctr_dynamics.kernels.structures.Derivatives`, of which the inverse is
    not written, and whose fields are not ``dfields``. Returns False if the Jacobian is singular or anything is not finite.
    """
    lanes = complex_unknown_lanes(kind)
    parameters, unknowns, fields, rates = solved
    near, far = in_place(buffers[0]), in_place(buffers[1])
    H, m, epsilon, step = lanes.count, len(unknowns), differences.column, differences.unknowns
    columns, rate = dfields.shape[1], complex_rate(c0.real, c0.imag)
    # both parts of the base case hold the fields y; c0 mixes them, and their histories bring the rate of each back to that of the solved stage
    base = (
        parameters,
        unknowns,
        rates - (c0.real - c0.imag) * fields,
        rates - (c0.real + c0.imag) * fields,
    )
    inverse, follow = np.empty((m, m), np.complex128), np.empty((2, m, SIMD_WIDTH))
    # 1. The base case, the unknowns, and columns in the lanes that are left.
    first = min(columns, H // 2 - 1 - m)
    _lay(kind, lanes, mesh, c0, base, dparameters, dfields, 0, 1 + m, first, epsilon, near)
    for i in range(m):
        near.unknowns[i * H + place(1 + i)] += step[i]
    sweep(kind, lanes, rate, mesh, near)
    if not _jacobian(near.residual, step, inverse):
        return False
    for values in (near.fields, near.base_fields, near.nodes):
        _slopes(values, H, step)
    if not _follow(kind, near, near, 1 + m, 0, first, epsilon, inverse, weight, share, follow, result):
        return False
    # 2. The other columns.
    for column in range(first, columns, SIMD_WIDTH):
        count = min(SIMD_WIDTH, columns - column)
        _lay(kind, COMPLEX, mesh, c0, base, dparameters, dfields, column, 0, count, epsilon, far)
        sweep(kind, COMPLEX, rate, mesh, far)
        if not _follow(kind, near, far, 0, column, count, epsilon, inverse, weight, share, follow, result):
            return False
    return True
