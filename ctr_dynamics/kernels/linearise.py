"""Linearisation of a solved two-point problem: how its unknowns, fields and node states follow from parameters and histories.

One sweep carries the base case and one perturbed lane for each unknown, which give the Jacobian of the shooting problem. Every other perturbation
is a *column*: its lane is swept with the unknowns held, and the unknowns follow through the Jacobian (implicit function theorem).
"""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.kinds import ONE_BATCH, ONE_LANE, SIMD_WIDTH, unknown_lanes
from ctr_dynamics.kernels.layout import unknown_rows
from ctr_dynamics.kernels.shooting import broadcast, invert, lane_lengths
from ctr_dynamics.kernels.simd import column_view, fma, view
from ctr_dynamics.kernels.structures import SweepBuffers
from ctr_dynamics.kernels.sweep import sweep


@njit(nogil=True)
def split_buffers(kind, lanes, b):
    """Buffers of the lanes of the base case and the unknowns, and of one batch for columns, both in those of all ``lanes``.

    Fields take the place of their own histories, which a sweep has read before it writes them: less to go through the cache.
    """
    L, H = lanes.count, unknown_lanes(kind).count
    near = SweepBuffers(
        b.workspace,
        b.parameters[: len(b.parameters) // L * H],
        b.section_lengths[: len(b.section_lengths) // L * H],
        b.unknowns[: len(b.unknowns) // L * H],
        b.fields[: len(b.fields) // L * H],
        b.base_history[: len(b.base_history) // L * H],
        b.fields[: len(b.fields) // L * H],
        b.base_fields[: len(b.base_fields) // L * H],
        b.nodes[: len(b.nodes) // L * H],
        b.residual[: len(b.residual) // L * H],
    )
    far = SweepBuffers(
        b.workspace,
        _behind(b.parameters, L, H),
        _behind(b.section_lengths, L, H),
        _behind(b.unknowns, L, H),
        _behind(b.fields, L, H),
        _behind(b.base_history, L, H),
        _behind(b.fields, L, H),
        _behind(b.base_fields, L, H),
        _behind(b.nodes, L, H),
        _behind(b.residual, L, H),
    )
    return near, far


@njit(nogil=True)
def _behind(values, L, H):
    rows = len(values) // L
    return values[rows * H : rows * (H + SIMD_WIDTH)]


@njit(nogil=True, error_model="numpy")
def perturb(values, base, change, column, lane, count, epsilon):
    """Lanes of ``values`` (rows, L): ``base`` (rows,), and ``count`` of them from ``lane`` on with epsilon times the columns of ``change``
    from ``column`` on added."""
    L = len(values) // max(len(base), 1)
    if count == SIMD_WIDTH and L == SIMD_WIDTH and change.strides[1] == 8:
        target, source = view(ONE_BATCH, values, 0, SIMD_WIDTH), column_view(change, column)
        for r in range(len(base)):
            target[r] = fma(source[r], epsilon, base[r])
    else:
        for r in range(len(base)):
            for j in range(L):
                values[r * L + j] = base[r]
            for k in range(count):
                values[r * L + lane + k] += epsilon * change[r, column + k]


@njit(nogil=True, error_model="numpy")
def _lay(kind, lanes, mesh, b, solution, dparameters, dhistory, column, lane, count, epsilon):
    """The base case in all lanes of the buffers ``b``, with ``count`` columns from ``column`` on in those from ``lane`` on."""
    main = len(solution.history)
    broadcast(lanes, solution.unknowns, b.unknowns)
    perturb(b.parameters, solution.parameters, dparameters, column, lane, count, epsilon)
    if count:  # otherwise all lanes share that of the base case
        perturb(b.history, solution.history, dhistory[:main], column, lane, count, epsilon)
    perturb(b.base_history, solution.base_history, dhistory[main:], column, lane, count, epsilon)
    lane_lengths(kind, lanes, mesh, b.parameters, b.section_lengths)


@njit(nogil=True, error_model="numpy")
def sweep_base(kind, c0, mesh, solution, dparameters, dhistory, count, differences, near, inverse):
    """Sweep of the base case, one lane for each unknown, and the first ``count`` columns in lanes that are left. Leaves the inverse Jacobian in
    ``inverse`` and the slopes by the unknowns in the lanes of ``near``; False if that is singular or anything is not finite."""
    lanes = unknown_lanes(kind)
    H, m = lanes.count, len(solution.unknowns)
    step = differences.unknowns
    _lay(kind, lanes, mesh, near, solution, dparameters, dhistory, 0, 1 + m, count, differences.column)
    for i in range(m):
        near.unknowns[i * H + 1 + i] += step[i]
    swept = SweepBuffers(
        near.workspace, near.parameters, near.section_lengths, near.unknowns, near.history if count else solution.history,
        near.base_history, near.fields, near.base_fields, near.nodes, near.residual,
    )  # fmt: skip
    sweep(kind, lanes, c0, mesh, swept)
    res = near.residual
    jacobian = np.empty((m, m))
    for i in range(m):
        for k in range(m):
            jacobian[i, k] = (res[i * H + 1 + k] - res[i * H]) / step[k]
            if not np.isfinite(jacobian[i, k]):
                return False
    if not invert(jacobian, inverse):
        return False
    for values in (near.fields, near.base_fields, near.nodes):
        _slopes(values, H, step)
    return True


@njit(nogil=True, error_model="numpy")
def _slopes(values, H, step):
    """Lanes of the unknowns in ``values`` (rows, H) become derivatives by them."""
    taken, scale = np.zeros(H), np.ones(H)
    for i in range(len(step)):
        taken[1 + i], scale[1 + i] = 1.0, 1.0 / step[i]
    base = view(ONE_LANE, values, 0, 1)
    for first in range(0, H, SIMD_WIDTH):
        lanes, weight, factor = (
            view(ONE_BATCH, values, first, H),
            view(ONE_BATCH, taken, first, H),
            view(ONE_BATCH, scale, first, H),
        )
        for r in range(len(values) // H):
            lanes[r] = (lanes[r] - weight[0] * base[r * H]) * factor[0]


@njit(nogil=True, error_model="numpy")
def boundary_columns(base, res, lane, column, count, epsilon, inverse, dx):
    """Columns of the unknowns ``dx`` (m, r) from the residuals ``res`` (m, L) of ``count`` lanes from ``lane`` on and ``base`` (m, H) of the base
    case; False if one is not finite."""
    m = len(inverse)
    L, H = len(res) // m, len(base) // m
    for k in range(count):
        for i in range(m):
            dx[i, column + k] = 0.0
        for q in range(m):
            slope = (res[q * L + lane + k] - base[q * H]) / epsilon
            if not np.isfinite(slope):
                return False
            for i in range(m):
                dx[i, column + k] -= inverse[i, q] * slope
    return True


@njit(nogil=True, error_model="numpy")
def columns_of(kind, slopes, swept, follow, scale, target, size):
    """A batch of columns with the boundary values following, into ``size`` rows of the view ``target``: ``scale`` times what the perturbed lanes
    ``swept`` differ from the base case, and the ``slopes`` (rows, H) that :func:`sweep_base` left times the unknowns' columns ``follow``.

    Four rows at a time: loading those columns for every row would be most of the work.
    """
    H, m, slope = unknown_lanes(kind).count, unknown_rows(kind.tubes).size, view(ONE_LANE, slopes, 0, 1)
    whole = size - size % 4
    for r in range(0, whole, 4):
        a, b, c, d = r * H, (r + 1) * H, (r + 2) * H, (r + 3) * H
        first, second = (swept[r] - slope[a]) * scale, (swept[r + 1] - slope[b]) * scale
        third, fourth = (swept[r + 2] - slope[c]) * scale, (swept[r + 3] - slope[d]) * scale
        for k in range(m):
            unknown = follow[k]
            first, second = fma(unknown, slope[a + 1 + k], first), fma(unknown, slope[b + 1 + k], second)
            third, fourth = fma(unknown, slope[c + 1 + k], third), fma(unknown, slope[d + 1 + k], fourth)
        target[r], target[r + 1], target[r + 2], target[r + 3] = first, second, third, fourth
    for r in range(whole, size):
        total = (swept[r] - slope[r * H]) * scale
        for k in range(m):
            total = fma(follow[k], slope[r * H + 1 + k], total)
        target[r] = total


@njit(nogil=True, error_model="numpy")
def combine(kind, slopes, values, lane, count, epsilon, dx, column, target):
    """d(values)/d(column) with the boundary values following: ``count`` columns of ``target`` (rows, r) from ``column`` on, from perturbed lanes of
    ``values`` (rows, L) and the ``slopes`` (rows, H) that :func:`sweep_base` left. More rows than the target's: its are the last."""
    H, m = unknown_lanes(kind).count, len(dx)
    size = len(target)
    L = len(values) // (len(slopes) // H)
    skipped = len(slopes) // H - size
    scale = 1.0 / epsilon
    if count == SIMD_WIDTH and L == SIMD_WIDTH and target.strides[1] == 8 and dx.strides[1] == 8:
        found = view(ONE_BATCH, values[skipped * SIMD_WIDTH :], 0, SIMD_WIDTH)
        follow = column_view(dx, column)
        columns_of(kind, slopes[skipped * H :], found, follow, scale, column_view(target, column), size)
    else:
        for r in range(size):
            start = (skipped + r) * H
            for k in range(count):
                total = (values[(skipped + r) * L + lane + k] - slopes[start]) * scale
                for i in range(m):
                    total += slopes[start + 1 + i] * dx[i, column + k]
                target[r, column + k] = total


@njit(nogil=True, error_model="numpy")
def _follow(kind, near, b, lane, column, count, epsilon, result):
    """Columns ``column`` and on of the ``result`` from ``count`` lanes of swept buffers ``b`` from ``lane`` on; False if one is not finite."""
    dx, dfields = result.unknowns, result.fields
    if not boundary_columns(near.residual, b.residual, lane, column, count, epsilon, result.inverse, dx):
        return False
    main = len(near.fields) // unknown_lanes(kind).count
    combine(kind, near.fields, b.fields, lane, count, epsilon, dx, column, dfields[:main])
    combine(kind, near.base_fields, b.base_fields, lane, count, epsilon, dx, column, dfields[main:])
    combine(kind, near.nodes, b.nodes, lane, count, epsilon, dx, column, result.nodes)
    return True


@njit(nogil=True, error_model="numpy")
def linearise(kind, lanes, c0, mesh, solution, dparameters, dhistory, differences, b, result):
    """Linearise one solved two-point problem.

    ``solution``: :class:`~ctr_dynamics.kernels.structures.Solution`. ``dparameters`` (NP, r), ``dhistory`` (fields, r): columns of perturbations
    in units in which a step of ``differences.column`` is small (:class:`~ctr_dynamics.kernels.structures.FiniteDifferences`). ``b``: buffers of the
    ``lanes``, which have room for all lanes or for those of the unknowns and one batch more. Writes the ``result``
    (:class:`~ctr_dynamics.kernels.structures.Derivatives`); False if the Jacobian is singular or anything is not finite.
    """
    near, far = split_buffers(kind, lanes, b)
    m, epsilon = len(solution.unknowns), differences.column
    first = min(dparameters.shape[1], unknown_lanes(kind).count - 1 - m)
    if not sweep_base(
        kind, c0, mesh, solution, dparameters, dhistory, first, differences, near, result.inverse
    ):
        return False
    if not _follow(kind, near, near, 1 + m, 0, first, epsilon, result):
        return False
    for column in range(first, dparameters.shape[1], SIMD_WIDTH):
        count = min(SIMD_WIDTH, dparameters.shape[1] - column)
        _lay(kind, ONE_BATCH, mesh, far, solution, dparameters, dhistory, column, 0, count, epsilon)
        sweep(kind, ONE_BATCH, c0, mesh, far)
        if not _follow(kind, near, far, 0, column, count, epsilon, result):
            return False
    return True
