"""Tangent of a step: how fields, tip and nodes after it depend on fields and parameters before it, for many columns at once.

Every stage is linearised where it was solved. One sweep carries the base case and one lane for each unknown, which give the Jacobian of the
shooting problem; every column's boundary values follow through it (implicit function theorem). Columns are swept a pack at a time, so that
their fields stay in the cache.
"""

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.lanes import PACK, columns, fma, rows
from ctr_dynamics.kernels.layout import RATE_NOW, RATES, Y_BEFORE, Y_NOW
from ctr_dynamics.kernels.rod import sweep
from ctr_dynamics.kernels.shooting import broadcast, invert, lane_lengths
from ctr_dynamics.kernels.time_step import history
from ctr_dynamics.kernels.workspace import input_row, lane_count, unknown_lanes

THETA = 0.55  # of the one-stage tangent: nearly the trapezoidal rule, with a little damping of what the step does not resolve


@njit(cache=True, nogil=True)
def _halves(tubes, lanes, big):
    """Buffers of the lanes of the base case and the unknowns, and of one pack for columns, both in those of all lanes ``big``.

    Fields take the place of their own histories, which a sweep has read before it writes them: less to go through the cache.
    """
    W, par, seclen, x, _, histb, out, outb, nodes, res = big
    L, H = lane_count(lanes), lane_count(unknown_lanes(tubes))
    near = (
        W, par[: len(par) // L * H], seclen[: len(seclen) // L * H], x[: len(x) // L * H], out[: len(out) // L * H],
        histb[: len(histb) // L * H], out[: len(out) // L * H], outb[: len(outb) // L * H], nodes[: len(nodes) // L * H],
        res[: len(res) // L * H],
    )  # fmt: skip
    far = (
        W, _behind(par, L, H), _behind(seclen, L, H), _behind(x, L, H), _behind(out, L, H), _behind(histb, L, H), _behind(out, L, H),
        _behind(outb, L, H), _behind(nodes, L, H), _behind(res, L, H),
    )  # fmt: skip
    return near, far


@njit(cache=True, nogil=True)
def _behind(values, L, H):
    rows = len(values) // L
    return values[rows * H : rows * (H + PACK)]


@njit(cache=True, nogil=True)
def _without_nodes(buffers):
    """The buffers of a sweep that does not keep the states at the nodes."""
    W, par, seclen, x, hist, histb, out, outb, nodes, res = buffers
    return W, par, seclen, x, hist, histb, out, outb, nodes[:0], res


@njit(cache=True, nogil=True, error_model="numpy")
def _perturb(values, base, change, column, lane, count, epsilon):
    """Lanes of ``values`` (rows, L): ``base`` (rows,), and ``count`` of them from ``lane`` on with epsilon times the columns of ``change``
    from ``column`` on added."""
    L = len(values) // max(len(base), 1)
    if count == PACK and L == PACK and change.strides[1] == 8:
        target, source = rows((0,), values, 0, PACK), columns(change, column)
        for r in range(len(base)):
            target[r] = fma(source[r], epsilon, base[r])
    else:
        for r in range(len(base)):
            for j in range(L):
                values[r * L + j] = base[r]
            for k in range(count):
                values[r * L + lane + k] += epsilon * change[r, column + k]


@njit(cache=True, nogil=True, error_model="numpy")
def _lay(tubes, lanes, mesh, buffers, par, dpar, x, hist, histb, dhist, column, lane, count, epsilon):
    """The base case in all lanes of ``buffers``, with ``count`` columns of ``dpar`` and ``dhist`` from ``column`` on in those from ``lane`` on."""
    W, parL, seclenL, xL, histL, histbL, outL, outbL, nodesL, resL = buffers
    main = len(hist)
    broadcast(lanes, x, xL)
    _perturb(parL, par, dpar, column, lane, count, epsilon)
    if count:  # otherwise all lanes share that of the base case
        _perturb(histL, hist, dhist[:main], column, lane, count, epsilon)
    _perturb(histbL, histb, dhist[main:], column, lane, count, epsilon)
    lane_lengths(tubes, lanes, mesh, parL, seclenL)


@njit(cache=True, nogil=True, error_model="numpy")
def _base(tubes, mesh, c0, par, dpar, x, hist, histb, dhist, count, epsilon, perturb, near, inverse):
    """Sweep of the base case, one lane for each unknown, and the first ``count`` columns in lanes that are left. Leaves the inverse Jacobian in
    ``inverse`` and the slopes by the unknowns in the lanes of ``near``; False if that is singular or anything is not finite."""
    lanes = unknown_lanes(tubes)
    H, m = lane_count(lanes), len(x)
    _lay(tubes, lanes, mesh, near, par, dpar, x, hist, histb, dhist, 0, 1 + m, count, epsilon)
    W, parL, seclenL, xL, histL, histbL, outL, outbL, nodesL, resL = near
    for i in range(m):
        xL[i * H + 1 + i] += perturb[i]
    sweep(tubes, lanes, W, c0, mesh,
          parL, seclenL, xL, histL if count else hist, histbL, outL, outbL, nodesL, resL)  # fmt: skip
    jacobian = np.empty((m, m))
    for i in range(m):
        for k in range(m):
            jacobian[i, k] = (resL[i * H + 1 + k] - resL[i * H]) / perturb[k]
            if not np.isfinite(jacobian[i, k]):
                return False
    if not invert(jacobian, inverse):
        return False
    for values in (outL, outbL, nodesL):
        _slopes(values, H, perturb)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes(values, H, perturb):
    """Lanes of the unknowns in ``values`` (rows, H) become derivatives by them."""
    taken, scale = np.zeros(H), np.ones(H)
    for i in range(len(perturb)):
        taken[1 + i], scale[1 + i] = 1.0, 1.0 / perturb[i]
    base = rows((), values, 0, 1)
    for first in range(0, H, PACK):
        lanes, weight, factor = (
            rows((0,), values, first, H),
            rows((0,), taken, first, H),
            rows((0,), scale, first, H),
        )
        for r in range(len(values) // H):
            lanes[r] = (lanes[r] - weight[0] * base[r * H]) * factor[0]


@njit(cache=True, nogil=True, error_model="numpy")
def _boundary(base, res, lane, column, count, epsilon, inverse, dx):
    """Columns of the unknowns ``dx`` (m, r) from the imbalances ``res`` (m, L) of ``count`` lanes from ``lane`` on and ``base`` (m, H) of the base
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


@njit(cache=True, nogil=True, error_model="numpy")
def _columns_of(tubes, slopes, swept, follow, scale, target, size):
    """A pack of columns with the boundary values following, into ``size`` rows of the view ``target``: ``scale`` times what the perturbed lanes
    ``swept`` differ from the base case, and the ``slopes`` (rows, H) that :func:`_base` left times the unknowns' columns ``follow``.

    Four rows at a time: loading those columns for every row would be most of the work.
    """
    H, slope = lane_count(unknown_lanes(tubes)), rows((), slopes, 0, 1)
    whole = size - size % 4
    for r in range(0, whole, 4):
        a, b, c, d = r * H, (r + 1) * H, (r + 2) * H, (r + 3) * H
        first, second = (swept[r] - slope[a]) * scale, (swept[r + 1] - slope[b]) * scale
        third, fourth = (swept[r + 2] - slope[c]) * scale, (swept[r + 3] - slope[d]) * scale
        for k in range(5 + len(tubes)):
            unknown = follow[k]
            first, second = fma(unknown, slope[a + 1 + k], first), fma(unknown, slope[b + 1 + k], second)
            third, fourth = fma(unknown, slope[c + 1 + k], third), fma(unknown, slope[d + 1 + k], fourth)
        target[r], target[r + 1], target[r + 2], target[r + 3] = first, second, third, fourth
    for r in range(whole, size):
        total = (swept[r] - slope[r * H]) * scale
        for k in range(5 + len(tubes)):
            total = fma(follow[k], slope[r * H + 1 + k], total)
        target[r] = total


@njit(cache=True, nogil=True, error_model="numpy")
def _combine(tubes, slopes, values, lane, count, epsilon, dx, column, target):
    """d(values)/d(column) with the boundary values following: ``count`` columns of ``target`` (rows, r) from ``column`` on, from perturbed lanes of
    ``values`` (rows, L) and the ``slopes`` (rows, H) that :func:`_base` left. More rows than the target's: its are the last."""
    H, m = lane_count(unknown_lanes(tubes)), len(dx)
    size = len(target)
    L = len(values) // (len(slopes) // H)
    skipped = len(slopes) // H - size
    scale = 1.0 / epsilon
    if count == PACK and L == PACK and target.strides[1] == 8 and dx.strides[1] == 8:
        found = rows((0,), values[skipped * PACK :], 0, PACK)
        _columns_of(
            tubes, slopes[skipped * H :], found, columns(dx, column), scale, columns(target, column), size
        )
    else:
        for r in range(size):
            start = (skipped + r) * H
            for k in range(count):
                total = (values[(skipped + r) * L + lane + k] - slopes[start]) * scale
                for i in range(m):
                    total += slopes[start + 1 + i] * dx[i, column + k]
                target[r, column + k] = total


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(tubes, near, buffers, lane, column, count, epsilon, inverse, dx, dfields, dnodes):
    """Columns ``column`` and on of ``dx``, ``dfields`` and ``dnodes`` from ``count`` lanes of swept ``buffers`` from ``lane`` on; False if one is not
    finite."""
    outL, outbL, nodesL, resL = buffers[6:]
    if not _boundary(near[9], resL, lane, column, count, epsilon, inverse, dx):
        return False
    main = len(near[6]) // lane_count(unknown_lanes(tubes))
    _combine(tubes, near[6], outL, lane, count, epsilon, dx, column, dfields[:main])
    _combine(tubes, near[7], outbL, lane, count, epsilon, dx, column, dfields[main:])
    _combine(tubes, near[8], nodesL, lane, count, epsilon, dx, column, dnodes)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _sweep_pack(tubes, mesh, c0, buffers):
    W, par, seclen, x, hist, histb, out, outb, nodes, res = buffers
    sweep(tubes, (0,), W, c0, mesh, par, seclen, x, hist, histb, out, outb, nodes, res)


@njit(cache=True, nogil=True, error_model="numpy")
def linearise(
    tubes,
    lanes,
    mesh,
    c0,
    par,
    dpar,
    x,
    hist,
    histb,
    dhist,
    epsilon,
    perturb,
    big,
    inverse,
    dx,
    dfields,
    dnodes,
):
    """Linearise one solved two-point problem.

    ``par`` (NP,) and ``x`` (m,): where it was solved, with ``hist``, ``histb``. ``dpar`` (NP, r), ``dhist`` (fields, r): columns of perturbations
    in units in which a step of ``epsilon`` is small. Writes ``dx`` (m, r), ``dfields`` (fields, r), ``dnodes`` (rows, r; the last rows of the
    node states, nodes * S for all of them) and the inverse shooting Jacobian ``inverse`` (m, m). False if that is singular or anything is not finite.
    ``big``: buffers of the lanes ``lanes``, which have room for all lanes or for those of the unknowns and one pack more.
    """
    near, far = _halves(tubes, lanes, big)
    m = len(x)
    first = min(dpar.shape[1], lane_count(unknown_lanes(tubes)) - 1 - m)
    if not _base(tubes, mesh, c0, par, dpar, x, hist, histb, dhist, first, epsilon, perturb, near, inverse):
        return False
    if not _follow(tubes, near, near, 1 + m, 0, first, epsilon, inverse, dx, dfields, dnodes):
        return False
    for column in range(first, dpar.shape[1], PACK):
        count = min(PACK, dpar.shape[1] - column)
        _lay(tubes, (0,), mesh, far, par, dpar, x, hist, histb, dhist, column, 0, count, epsilon)
        _sweep_pack(tubes, mesh, c0, far)
        if not _follow(tubes, near, far, 0, column, count, epsilon, inverse, dx, dfields, dnodes):
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def theta_tangent(tubes, lanes, mesh, dt, par, inputs, x, after, rate, dpar, epsilon, perturb, big, work, before, result, inverse,
                  dx, dnodes):  # fmt: skip
    """Columns over one step by the one-stage theta method, linearised at the step's end: one sweep instead of one a stage.

    The covariance does not need the model's own time accuracy. ``after``, ``rate`` (fields,): fields and their rates at the end, ``x`` (m,) the
    unknowns there, ``inputs`` (3N + 6,). ``before`` (2, fields, r): columns of the fields and of their rates before the step; those after it
    go to ``result``, which may be the same array. Returns False where the step's end cannot be linearised.
    """
    hist, histb, dhist = work
    main = len(hist)
    c0 = 1.0 / (THETA * dt)
    ratio = (1.0 - THETA) / THETA
    for i in range(main):
        hist[i] = rate[i] - c0 * after[i]
    for i in range(len(histb)):
        histb[i] = rate[main + i] - c0 * after[main + i]
    dy, drate = before[0], before[1]
    fields, columns = dy.shape
    for i in range(fields):
        for k in range(columns):
            dhist[i, k] = -c0 * dy[i, k] - ratio * drate[i, k]
    for i in range(len(inputs)):
        par[input_row(tubes, i)] = inputs[i]
    dy, drate = result[0], result[1]
    if not linearise(tubes, lanes, mesh, c0, par, dpar, x, hist, histb, dhist, epsilon, perturb, big, inverse, dx, dy, dnodes):  # fmt: skip
        return False
    for i in range(fields):
        for k in range(columns):
            drate[i, k] = c0 * dy[i, k] + dhist[i, k]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _mix(weights, stored, first, base, values, epsilon):
    """History of one pack into ``values`` (rows, 8): ``base`` (rows,) plus epsilon times the sum of ``weights`` times the columns ``stored``
    (slots, fields, 8) from field ``first`` on."""
    fields = stored.shape[1]
    target, source, plain = (
        rows((0,), values, 0, PACK),
        rows((0,), stored.reshape(-1), 0, PACK),
        rows((), base, 0, 1),
    )
    used, factor = np.empty(len(weights), np.int64), np.empty(len(weights))
    count = 0
    for slot in range(len(weights)):
        if weights[slot] != 0.0:
            used[count], factor[count] = slot * fields + first, epsilon * weights[slot]
            count += 1
    share = rows((), factor, 0, 1)
    for i in range(len(plain)):
        total = fma(source[used[0] + i], share[0], plain[i])
        for k in range(1, count):
            total = fma(source[used[k] + i], share[k], total)
        target[i] = total


@njit(cache=True, nogil=True, error_model="numpy")
def _keep(tubes, stored, slot, first, c0, weights, slopes, found, epsilon, dx, column):
    """After a stage, from its swept fields ``found`` (rows, 8): their columns into the ``slot`` of ``stored`` (slots, fields, 8) from field
    ``first`` on. What a one-step scheme never reads is not written: the columns of many nodes exceed the cache."""
    size = len(slopes) // lane_count(unknown_lanes(tubes))
    now, before, rate = (
        columns(stored[Y_NOW, first:], 0),
        columns(stored[Y_BEFORE, first:], 0),
        columns(stored[RATE_NOW, first:], 0),
    )
    multistep = weights[Y_BEFORE] != 0.0 or weights[RATE_NOW] != 0.0
    if multistep:
        for i in range(size):
            past = now[i] * weights[Y_NOW] + before[i] * weights[Y_BEFORE]
            rate[i] = past + rate[i] * weights[RATE_NOW]
            before[i] = now[i]
    swept, target = rows((0,), found, 0, PACK), columns(stored[slot, first:], 0)
    _columns_of(tubes, slopes, swept, columns(dx, column), 1.0 / epsilon, target, size)
    if multistep:
        for i in range(size):
            rate[i] = rate[i] + now[i] * c0


@njit(cache=True, nogil=True, error_model="numpy")
def by_fields(c0, weights):
    """``weights`` (stages, 3 + stages) of the stored fields in the histories, for the fields at earlier stages instead of their rates, which are
    y_t = c0 y + h."""
    result = weights.copy()
    for stage in range(len(c0)):
        for earlier in range(stage):
            share = weights[stage, RATES + earlier]
            result[stage, RATES + earlier] = share * c0[earlier]
        for earlier in range(stage):
            result[stage] += weights[stage, RATES + earlier] * result[earlier]
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def step_tangent(tubes, lanes, mesh, c0, weights, par, inputs, found, before, rates, dpar, dinputs, epsilon, perturb, big, work,
                 dbank, inverse, dx, dnodes):  # fmt: skip
    """Tangent of a whole step.

    ``before`` (slots, fields): stored fields before the step; ``rates`` (stages, fields): the stages' rates; ``found`` (stages, m): their
    unknowns; ``inputs`` as in :func:`ctr_dynamics.kernels.time_step.step`, ``dinputs`` (stages, inputs, r) their columns, added to those of the
    parameters ``dpar`` (NP, r); r is a multiple of 8. ``dbank`` (r / 8, 3 + stages, fields, 8): columns of the stored fields, advanced in
    place like the fields themselves, but with the stages' fields in place of their rates. ``work`` = (hist, histb, bank
    (3 + stages, fields), dpar of a stage (NP, r)). ``lanes``, ``big``: as for :func:`linearise`. ``dnodes`` (rows, r): columns of the last
    ``rows`` numbers of the node states. Returns False where a stage cannot be linearised.
    """
    hist, histb, bank, dstage = work
    fields, stages, main = dbank.shape[2], len(c0), len(hist)
    whole = _halves(tubes, lanes, big)
    bare = _without_nodes(whole[0]), _without_nodes(whole[1])
    shares = by_fields(c0, weights)
    for i in range(fields):
        for slot in range(RATES):
            bank[slot, i] = before[slot, i]
        for stage in range(stages):
            bank[RATES + stage, i] = rates[stage, i]
    dstage[:] = dpar
    for stage in range(stages):
        history(weights[stage], bank, hist, histb)
        for i in range(inputs.shape[1]):
            row = input_row(tubes, i)
            par[row] = inputs[stage, i]
            for k in range(dpar.shape[1]):
                dstage[row, k] = dpar[row, k] + dinputs[stage, i, k]
        x, used, last = found[stage], shares[stage, : RATES + stage], stage == stages - 1
        near, far = whole if last else bare
        if not _base(
            tubes,
            mesh,
            c0[stage],
            par,
            dstage,
            x,
            hist,
            histb,
            dbank[0, 0],
            0,
            epsilon,
            perturb,
            near,
            inverse,
        ):
            return False
        broadcast((0,), x, far[3])
        for block in range(len(dbank)):
            column, stored = block * PACK, dbank[block]
            _perturb(far[1], par, dstage, column, 0, PACK, epsilon)
            lane_lengths(tubes, (0,), mesh, far[1], far[2])
            _mix(used, stored, 0, hist, far[4], epsilon)
            _mix(used, stored, main, histb, far[5], epsilon)
            _sweep_pack(tubes, mesh, c0[stage], far)
            if not _boundary(near[9], far[9], 0, column, PACK, epsilon, inverse, dx):
                return False
            slot = Y_NOW if last else RATES + stage
            _keep(tubes, stored, slot, 0, c0[stage], used, near[6], far[6], epsilon, dx, column)
            _keep(tubes, stored, slot, main, c0[stage], used, near[7], far[7], epsilon, dx, column)
            if last:
                _combine(tubes, near[8], far[8], 0, PACK, epsilon, dx, column, dnodes)
    return True
