"""One step of Radau IIA collocation: all stages are lanes of one sweep, and are solved together by multiple shooting.

Newton's method with Hairer's transformation (Hairer and Wanner 1996, section IV.8): the matrix C of the stages is diagonal in its eigenvectors, and
for each pair of eigenvalues one complex Jacobian about one stage's trajectory serves all stages. What that leaves out, and what the trajectory has
moved since, Broyden's updates learn within a solve (Kelley 1995, section 7.3).

One or two runs take a step in the same sweeps; each is a group of lanes with its own unknowns, Jacobian and convergence.
"""

import math

import numpy as np

from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.condensing import factorise, solve_system
from ctr_dynamics.kernels.coupling import STAGES, fill_coupling, stage_coupling
from ctr_dynamics.kernels.kinds import Lanes
from ctr_dynamics.kernels.layout import RATE_NOW, Y_NOW, input_row, parameter_rows, state_rows
from ctr_dynamics.kernels.sections import section_lengths
from ctr_dynamics.kernels.segmented_jacobian import complex_jacobian
from ctr_dynamics.kernels.shooting import CONVERGED, NOT_FINITE, STALLED
from ctr_dynamics.kernels.sweep import sweep

ONE_RUN, TWO_RUNS = Lanes(STAGES, STAGES), Lanes(2 * STAGES, 2 * STAGES)
UPDATES = 12  # Broyden steps of a solve: as many may be told apart in the residuals' digits
RISING = (
    4  # Broyden steps in a row without a gain before a new Jacobian: while they learn the residual may rise
)
RISE = 5.0  # by that much
JACOBIANS = 4  # of one solve
# what a run does with the next sweep
NEWTON, DAMPED, RETURN, DONE = 0, 1, 2, 3
# columns of a run's account of a solve: whether its Jacobian is not usable; then its outcome, its sweeps and its new Jacobians
FRESH, OUTCOME, SWEPT, RENEWED = 0, 1, 2, 3
ACCOUNT = 4


@njit(nogil=True)
def lagrange(known, x, at, result):
    """Values ``result`` (k, mt) at the times ``at`` (k,) of the polynomial through ``x`` (d + 1, mt) at the times ``known``."""
    result[:] = 0.0
    for q in range(len(at)):
        for i in range(len(known)):
            weight = 1.0
            for j in range(len(known)):
                if i != j:
                    weight *= (at[q] - known[j]) / (known[i] - known[j])
            for r in range(x.shape[1]):
                result[q, r] += weight * x[i, r]


@njit(nogil=True)
def predict(times, unknowns, known, units, at, guess):
    """Start of a step into ``guess`` (stages, mt) at the times ``at`` (stages,): the polynomial through the newest of the ``known`` last stages, of
    the degree that would have met the last step best. ``times`` (K,) and ``unknowns`` (K, mt) of earlier stages, the newest last."""
    stages, K = len(at), len(times)
    best, degree = math.inf, 0
    for d in range(min(stages + 2, known - stages - 1) + 1):
        first = K - stages - d - 1
        lagrange(times[first : K - stages], unknowns[first : K - stages], times[K - stages :], guess)
        missed = 0.0
        for q in range(stages):
            for i in range(len(units)):
                missed += abs(guess[q, i] - unknowns[K - stages + q, i]) / units[i]
        if missed < best:
            best, degree = missed, d
    lagrange(times[K - degree - 1 :], unknowns[K - degree - 1 :], at, guess)


@njit(nogil=True)
def remember_stages(times, unknowns, at, found):
    """The stages ``found`` (stages, mt) at the times ``at`` (stages,) s become the newest."""
    stages, K = len(at), len(times)
    for k in range(K - stages):
        times[k] = times[k + stages]
        unknowns[k] = unknowns[k + stages]
    times[K - stages :] = at
    unknowns[K - stages :] = found


@njit(nogil=True, error_model="numpy")
def newton_step(scheme, owner, factors, F, z, work):
    """z = - J^-1 F, both (stages, mt) in units, through the eigenvectors of C. ``work`` (2, 2, mt) is written to."""
    stages, mt = F.shape
    mode, moved = work[0], work[1]
    z[:] = 0.0
    for e in range(len(scheme.rates)):
        mode[:] = 0.0
        for q in range(stages):
            a, b = scheme.to_modes[e, q].real, scheme.to_modes[e, q].imag
            for i in range(mt):
                mode[0, i] += a * F[q, i]
                mode[1, i] += b * F[q, i]
        solve_system(owner, factors, e, mode, moved)
        for q in range(stages):
            a, b = scheme.from_modes[q, e].real, scheme.from_modes[q, e].imag
            for i in range(mt):
                z[q, i] += a * moved[0, i] - b * moved[1, i]


@njit(nogil=True, error_model="numpy")
def take_residual(residual, L, first, scale, F):
    """Residuals of one run's lanes, in units, into ``F`` (stages, mt); returns the largest, infinity where one is not finite."""
    worst = 0.0
    for i in range(F.shape[1]):
        for q in range(F.shape[0]):
            value = residual[i * L + first + q] / scale[i]
            F[q, i] = value
            worst = max(worst, abs(value)) if math.isfinite(value) else math.inf
    return worst


@njit(nogil=True, error_model="numpy")
def slowest_stage(kind, nodes, L, first):
    """The stage at which the outermost tube turns slowest in the plate: friction is steepest there, and must not be taken too flat."""
    n, state = kind.tubes, state_rows(kind.tubes)
    slowest, best = math.inf, 0
    for q in range(STAGES):
        rate = nodes[(state.angular_velocity + 2) * L + first + q]
        if n > 1:
            rate += nodes[(state.gamma + n - 2) * L + first + q]
        if abs(rate) < slowest:
            slowest, best = abs(rate), q
    return best


@njit(nogil=True, error_model="numpy")
def renew(kind, mesh, scheme, b, L, first, solver, factors):
    """New factors of the Jacobians of the run whose lanes begin at ``first``, about the trajectory of the last sweep; False where there is none."""
    stage = slowest_stage(kind, b.nodes, L, first)
    lane = first + stage
    point = solver.point
    for values, target in (
        (b.parameters, point.parameters),
        (b.section_lengths, point.section_lengths),
        (b.unknowns, point.unknowns),
    ):
        for r in range(len(target)):
            target[r] = values[r * L + lane]
    main = len(b.history) // L
    for fields, history, start in ((b.fields, b.history, 0), (b.base_fields, b.base_history, main)):
        for r in range(len(history) // L):
            total = history[r * L + lane]
            for q in range(STAGES):
                total += scheme.C[stage, q] * fields[r * L + first + q]
            point.fields[start + r] = fields[r * L + lane]
            point.rates[start + r] = total
    for e in range(len(scheme.rates)):
        if not complex_jacobian(kind, scheme.rates[e], mesh, point, solver.wide, solver.matrix):
            return False
        if not factorise(solver.matrix, mesh.owner, factors, e):
            return False
    return True


@njit(nogil=True, error_model="numpy")
def learn(F_step, steps, lengths, count):
    """The next Broyden step from the Newton step ``F_step`` (stages, mt), in place, by the ``count`` steps before it."""
    for j in range(count):
        dot = 0.0
        for q in range(F_step.shape[0]):
            for i in range(F_step.shape[1]):
                dot += steps[j, q, i] * F_step[q, i]
        dot /= max(lengths[j], 1e-300)
        if j < count - 1:
            for q in range(F_step.shape[0]):
                for i in range(F_step.shape[1]):
                    F_step[q, i] += dot * steps[j + 1, q, i]
        elif abs(1.0 - dot) > 0.05:
            F_step /= 1.0 - dot


@njit(nogil=True, error_model="numpy")
def solve_stages(kind, damping, lanes, mesh, scheme, solver, x, factors, account):
    """Find the unknowns ``x`` (runs, stages, mt) of all stages, in place; the fields and nodes of the solution stay in the solver's buffers.

    ``factors``: of every run, in units. ``account`` (runs, 4): what is in :data:`FRESH` is read, the rest is written. Returns (sweeps, Jacobians).
    """
    fresh, outcome, renewed = account[:, FRESH] != 0, account[:, OUTCOME], account[:, RENEWED]
    b, units, scale = solver.stages, solver.point.units, solver.point.residual_units
    runs, stages, mt = x.shape
    L = lanes.count
    trial, best = x.copy(), x.copy()
    F, z = np.empty((runs, stages, mt)), np.empty((runs, stages, mt))
    steps, lengths = np.empty((runs, UPDATES, stages, mt)), np.empty((runs, UPDATES))
    work = np.empty((2, 2, mt))
    norm, least, factor = np.full(runs, math.inf), np.full(runs, math.inf), np.ones(runs)
    count, rising = np.zeros(runs, np.int64), np.zeros(runs, np.int64)
    renewed[:] = 0
    # the first sweep is at the start itself, as after a return
    phase, newest = np.full(runs, RETURN), np.zeros(runs, np.bool_)
    sweeps = 0
    coupling = stage_coupling(lanes, damping, solver.coupling)
    while sweeps < solver.limit:
        for g in range(runs):
            for i in range(mt):
                for q in range(stages):
                    b.unknowns[i * L + g * STAGES + q] = trial[g, q, i]
        sweep(kind, lanes, coupling, mesh, b)
        sweeps += 1
        waiting = False
        for g in range(runs):
            if phase[g] == DONE:
                continue
            account[g, SWEPT] = sweeps
            found = take_residual(b.residual, L, g * STAGES, scale, F[g])
            if phase[g] == RETURN:
                if math.isinf(found):
                    outcome[g], phase[g] = NOT_FINITE, DONE
                    continue
                x[g] = trial[g]
                norm[g] = least[g] = found
                fresh[g] |= sweeps > 1
            elif found > solver.tolerance:
                if (
                    phase[g] == NEWTON
                    and found < RISE * least[g]
                    and rising[g] < RISING
                    and count[g] < UPDATES
                ):
                    rising[g] = 0 if found < 0.6 * least[g] else rising[g] + 1
                    x[g] = trial[g]
                    norm[g] = found
                    steps[g, count[g]] = z[g]
                    lengths[g, count[g]] = (z[g] * z[g]).sum()
                    count[g] += 1
                    if found < least[g]:
                        least[g] = found
                        best[g] = x[g]
                    newest[g] = False
                elif phase[g] == DAMPED and found < (1.0 - 0.1 * factor[g]) * norm[g]:
                    x[g] = trial[g]
                    best[g] = x[g]
                    norm[g] = least[g] = found
                    fresh[g] = True
                elif newest[g]:
                    factor[g] = 0.5 * (factor[g] if phase[g] == DAMPED else 1.0)
                    if factor[g] < 1e-3:
                        outcome[g], phase[g] = STALLED, DONE
                        continue
                    phase[g] = DAMPED
                    waiting = True
                    for q in range(stages):
                        for i in range(mt):
                            trial[g, q, i] = x[g, q, i] + factor[g] * z[g, q, i] * units[i]
                    continue
                else:
                    trial[g] = best[g]
                    phase[g] = RETURN
                    waiting = True
                    continue
            if found <= solver.tolerance:
                x[g] = trial[g]
                outcome[g], phase[g] = CONVERGED, DONE
                continue
            if fresh[g]:
                if renewed[g] > JACOBIANS:
                    outcome[g], phase[g] = STALLED, DONE
                    continue
                renewed[g] += 1
                if not renew(kind, mesh, scheme, b, L, g * STAGES, solver, factors[g]):
                    outcome[g], phase[g] = NOT_FINITE, DONE
                    continue
                fresh[g], newest[g] = False, True
                count[g] = rising[g] = 0
            newton_step(scheme, mesh.owner, factors[g], F[g], z[g], work)
            learn(z[g], steps[g], lengths[g], count[g])
            phase[g] = NEWTON
            waiting = True
            for q in range(stages):
                for i in range(mt):
                    trial[g, q, i] = x[g, q, i] + z[g, q, i] * units[i]
        if not waiting:
            return sweeps, renewed.sum()
    for g in range(runs):
        if phase[g] != DONE:
            outcome[g] = STALLED
    return sweeps, renewed.sum()


@njit(nogil=True, error_model="numpy")
def prepare_stages(kind, lanes, mesh, scheme, solver, g, parameters, inputs, bank):
    """Parameters, section lengths and histories of run ``g`` into its lanes, with the ``inputs`` (stages, inputs) of the stages; the last stay in its
    ``parameters``."""
    n, L, b = kind.tubes, lanes.count, solver.stages
    beta, first, y = parameter_rows(n).beta, g * STAGES, bank[Y_NOW]
    fill_coupling(kind, scheme.C, parameters, solver.coupling, lanes.width, first)
    lengths = np.empty(len(mesh.sec_cells))
    for r in range(len(parameters)):
        for q in range(STAGES):
            b.parameters[r * L + first + q] = parameters[r]
    main = len(b.history) // L
    for q in range(STAGES):
        for i in range(inputs.shape[1]):
            row = input_row(n, i)
            parameters[row] = b.parameters[row * L + first + q] = inputs[q, i]
        section_lengths(mesh.bp_tube, mesh.bp_offset, parameters[beta : beta + n], lengths)
        for k in range(len(lengths)):
            b.section_lengths[k * L + first + q] = lengths[k]
    for q in range(STAGES):
        share = 0.0
        for j in range(STAGES):
            share += scheme.C[q, j]
        for r in range(main):
            b.history[r * L + first + q] = -share * y[r]
        for r in range(len(y) - main):
            b.base_history[r * L + first + q] = -share * y[main + r]


@njit(nogil=True, error_model="numpy")
def finish_stages(lanes, scheme, solver, g, bank, nodes):
    """Fields and their rates at the end of the step into the ``bank`` of run ``g``, and the states at the ``nodes`` (rows,)."""
    L, b, last = lanes.count, solver.stages, g * STAGES + STAGES - 1
    main = len(b.history) // L
    for fields, history, start in ((b.fields, b.history, 0), (b.base_fields, b.base_history, main)):
        for r in range(len(history) // L):
            total = history[r * L + last]
            for q in range(STAGES):
                total += scheme.C[STAGES - 1, q] * fields[r * L + g * STAGES + q]
            bank[RATE_NOW, start + r] = total
            bank[Y_NOW, start + r] = fields[r * L + last]
    for r in range(len(nodes)):
        nodes[r] = b.nodes[r * L + last]


@njit(nogil=True, error_model="numpy")
def advance_stages(kind, damping, mesh, scheme, solver, run, known, inputs, times, account):
    """A step of one run (:class:`~ctr_dynamics.kernels.structures.CollocationRun`) with ``inputs`` (stages, inputs) at the stages' ``times``
    (stages,) s.

    ``damping``: :data:`~ctr_dynamics.kernels.coupling.DAMPED` where a tube has damping; ``scheme``:
    :class:`~ctr_dynamics.kernels.structures.CollocationCoefficients`; ``solver``:
    :class:`~ctr_dynamics.kernels.structures.CollocationSolver`. ``known``: of the run's last stages, those that tell what comes next. ``account`` (1,
    4): as for :func:`solve_stages`. Returns (sweeps, Jacobians); on failure the run is as it was, but for its Jacobian.
    """
    x = np.empty((1, STAGES, run.unknowns.shape[1]))
    predict(run.times, run.unknowns, known, solver.point.units, times, x[0])
    prepare_stages(kind, ONE_RUN, mesh, scheme, solver, 0, run.parameters, inputs, run.bank)
    sweeps, jacobians = solve_stages(kind, damping, ONE_RUN, mesh, scheme, solver, x, (run.factors,), account)
    if account[0, OUTCOME] == CONVERGED:
        finish_stages(ONE_RUN, scheme, solver, 0, run.bank, run.nodes)
        remember_stages(run.times, run.unknowns, times, x[0])
    return sweeps, jacobians


@njit(nogil=True, error_model="numpy")
def advance_two(kind, damping, mesh, scheme, solver, runs, known, inputs, times, account):
    """A step of two ``runs`` in the same sweeps, as :func:`advance_stages` of one; ``known`` and ``inputs`` are pairs, ``account`` is (2, 4).

    Unless both converge, both runs are as they were but for their Jacobians. Returns (sweeps, Jacobians).
    """
    both = (runs.first, runs.second)
    x = np.empty((2, STAGES, runs.first.unknowns.shape[1]))
    for g in range(2):
        predict(both[g].times, both[g].unknowns, known[g], solver.point.units, times, x[g])
        prepare_stages(kind, TWO_RUNS, mesh, scheme, solver, g, both[g].parameters, inputs[g], both[g].bank)
    factors = (runs.first.factors, runs.second.factors)
    sweeps, jacobians = solve_stages(kind, damping, TWO_RUNS, mesh, scheme, solver, x, factors, account)
    if account[0, OUTCOME] == CONVERGED and account[1, OUTCOME] == CONVERGED:
        for g in range(2):
            finish_stages(TWO_RUNS, scheme, solver, g, both[g].bank, both[g].nodes)
            remember_stages(both[g].times, both[g].unknowns, times, x[g])
    return sweeps, jacobians
