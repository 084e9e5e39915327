"""Two simulations of one robot a step at a time, side by side in the same sweeps: four lanes, two of them probes, take no longer than one.

Sections, mesh and time scheme are common; parameters, actuators, loads and histories are each one's own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.batched_shooting import solve_lanes
from ctr_dynamics.kernels.compiler import njit
from ctr_dynamics.kernels.time_step import extrapolate, history, remember
from ctr_dynamics.kernels.workspace import input_row
from ctr_dynamics.model.mesh import Key, Mesh, section_lengths
from ctr_dynamics.model.simulator import InputsAt, Record, Simulator, State, StepResult, divided, stage_inputs
from ctr_dynamics.model.time_scheme import RATE_NOW, RATES, Y_BEFORE, Y_NOW, Scheme, make_scheme

LANES = (False,) * 4  # lane tuple of a pair: both cases, and a probe of each


@njit(cache=True, nogil=True, error_model="numpy")
def _spread(first, second, target):
    """The numbers (rows,) of both cases to their lanes of ``target`` (rows, 4), flat."""
    for i in range(len(first)):
        target[4 * i] = target[4 * i + 2] = first[i]
        target[4 * i + 1] = target[4 * i + 3] = second[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(values, first, second):
    """The opposite of :func:`_spread`."""
    for i in range(len(first)):
        first[i], second[i] = values[4 * i], values[4 * i + 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _rates(c0, out, j, hist, rate):
    """``rate`` (rows,) of the fields of case ``j`` after a stage, c0 out + hist, from its lane of ``out`` (rows, 4), flat."""
    for i in range(len(rate)):
        rate[i] = c0 * out[4 * i + j] + hist[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _together(first, second, n):
    """Whether all inputs (stages, inputs) of both cases are finite, and their translations the same."""
    total = 0.0
    for stage in range(len(first)):
        for i in range(first.shape[1]):
            total += abs(first[stage, i]) + abs(second[stage, i])
        for i in range(2 * n, 3 * n):
            if first[stage, i] != second[stage, i]:
                return False
    return math.isfinite(total)


@njit(cache=True, nogil=True, error_model="numpy")
def _step(tubes, few, mesh, c0, weights, pars, inputs, banks, unknowns, earlier, founds, inverses, usable, work, scale, perturb, tolerance, limit,
          column, nodes, alive):  # fmt: skip
    """A step of both cases, as :func:`ctr_dynamics.kernels.time_step.step` for one; returns sweeps, 0 where they cannot go together, and new
    Jacobians.

    ``work``: buffers of the four lanes, of one for a Jacobian, of the Jacobian's lanes, and (2, fields) for histories. ``column``: the unknown to
    probe first. ``nodes``: states at the nodes (nodes, S) of both. ``alive`` (2,): set; False where a case does not converge, and then
    nothing else has changed."""
    alive[:] = True
    first, second = inputs
    if not _together(first, second, len(tubes)):
        return 0, 0
    big, one, eight, h = work
    par, seclen, hist, histb, out, outb = big[1], big[2], big[4], big[5], big[6], big[7]
    n, stages, m, main = len(tubes), len(c0), len(scale), len(big[4]) // 4
    x, sweeps, jacobians, spent = np.empty(2 * m), 0, 0, np.zeros(2, np.int64)
    guess, inverse = np.empty((2, stages, m)), np.empty((2, m, m))
    lengths = np.empty(len(mesh.sec_cells))
    fresh = np.empty(2, np.bool_)
    _spread(pars[0], pars[1], par)
    for j in range(2):
        inverse[j], fresh[j] = inverses[j], not usable[j]
        extrapolate(unknowns[j], earlier[j], perturb, guess[j])
    for stage in range(stages):
        for j in range(2):
            history(weights[stage], banks[j], h[j, :main], h[j, main:])
        _spread(h[0, :main], h[1, :main], hist)
        _spread(h[0, main:], h[1, main:], histb)
        for i in range(first.shape[1]):
            row = 4 * input_row(tubes, i)
            par[row] = par[row + 2] = first[stage, i]
            par[row + 1] = par[row + 3] = second[stage, i]
        section_lengths(mesh.bp_tube, mesh.bp_offset, first[stage, 2 * n : 3 * n], lengths)
        _spread(lengths, lengths, seclen)
        for j in range(2):
            for i in range(m):
                # what the guess missed at the stage before, it misses here too
                x[2 * i + j] = guess[j, stage, i] + (
                    founds[j, stage - 1, i] - guess[j, stage - 1, i] if stage else 0.0
                )
        plain, renewed, column = solve_lanes(tubes, LANES, few, mesh, c0[stage], big, one, eight, x, inverse, fresh, alive, scale, perturb,
                                             tolerance, limit, spent, column)  # fmt: skip
        sweeps += plain
        jacobians += renewed
        if not (alive[0] and alive[1]):
            return sweeps, jacobians
        for j in range(2):
            _rates(c0[stage], out, j, h[j, :main], banks[j][RATES + stage, :main])
            _rates(c0[stage], outb, j, h[j, main:], banks[j][RATES + stage, main:])
            for i in range(m):
                founds[j, stage, i] = x[2 * i + j]
    for j in range(2):
        inverses[j][:] = inverse[j]
        for i in range(inputs[j].shape[1]):
            pars[j][input_row(tubes, i)] = inputs[j][stages - 1, i]
        banks[j][Y_BEFORE] = banks[j][Y_NOW]
        remember(unknowns[j], earlier[j], founds[j])
    _gather(out, banks[0][Y_NOW, :main], banks[1][Y_NOW, :main])
    _gather(outb, banks[0][Y_NOW, main:], banks[1][Y_NOW, main:])
    for j in range(2):
        banks[j][RATE_NOW] = banks[j][RATES + stages - 1]
    _gather(big[8], nodes[0].reshape(-1), nodes[1].reshape(-1))
    return sweeps, jacobians


class Pair:
    """Steps two simulators of one model, scheme and tolerance together."""

    def __init__(self, first: Simulator, second: Simulator) -> None:
        assert first.model is second.model
        assert first.scheme is second.scheme
        assert first.tolerance == second.tolerance
        self.first, self.second = first, second
        self._times = first.scheme.times * first.scheme.dt
        self._key: Key = ((), ())  # sections that the buffers are for
        self._buffers: tuple = ()

    def step(
        self,
        a: State,
        b: State,
        t: float,
        inputs_a: InputsAt,
        inputs_b: InputsAt,
        *,
        record: bool = False,
        events: Sequence[float] = (),
    ) -> tuple[StepResult, StepResult] | None:
        """Advance the states ``a`` of the first simulator and ``b`` of the second from t to t + dt (s) in place, as :meth:`Simulator.step` does
        each, divided at ``events`` (s). With ``record`` the first result carries what the tangent of its last stages needs, until the state is
        written to.

        None where they cannot go together: other sections or translations than each other's, sections that change, inputs that are not finite,
        a hard step. Nothing is done then, but that the next step of a run that has failed begins with a new Jacobian.
        """
        times = self.first.divisions(t, events)
        if len(times) == 2:
            return self._part(a, b, t, self.first.scheme, inputs_a, inputs_b, record)
        trials = a.copy(), b.copy()
        for trial in trials:
            trial.forget_course()
        parts = []
        for begin, end in pairwise(times):
            for trial in trials:
                trial.usable = False  # the Jacobian is of another step length
            scheme = make_scheme(self.first.scheme.name, end - begin)
            part = self._part(*trials, begin, scheme, inputs_a, inputs_b, record)
            if part is None:
                return None
            parts.append(part)
        a.become(trials[0])
        b.become(trials[1])
        return divided([first for first, _ in parts]), divided([second for _, second in parts])

    def _part(
        self,
        a: State,
        b: State,
        t: float,
        scheme: Scheme,
        inputs_a: InputsAt,
        inputs_b: InputsAt,
        record: bool,
    ) -> tuple[StepResult, StepResult] | None:
        """Both from t (s) on by the step of the ``scheme``."""
        model = self.first.model
        whole = scheme is self.first.scheme
        times = t + (self._times if whole else scheme.times * scheme.dt)
        rows_a, last_a = stage_inputs(model, inputs_a, times)
        rows_b, last_b = stage_inputs(model, inputs_b, times)
        if a.key != b.key:
            return None
        key, mesh = a.key, a.mesh
        if model.moving_precurvature or last_a.beta.tobytes() != a.inputs.beta.tobytes():
            if not math.isfinite(last_a.beta.sum()):
                return None
            try:
                key, mesh = model.mesh(last_a.beta, a.key)
            except InputError:
                return None
            if key != a.key:
                return None
        if key != self._key:
            self._key, self._buffers = key, self._make(mesh)
        work, found, alive = self._buffers
        # a step may be too short to probe all columns: the next one begins at another
        column = scheme.stages * round(t / self.first.scheme.dt) % len(model.step)
        sweeps, jacobians = _step(
            model.tubes, model.jacobian_lanes, mesh, scheme.c0, scheme.weights, (self.first.parameters, self.second.parameters), (rows_a, rows_b),
            (a.bank, b.bank), (a.unknowns, b.unknowns), (a.earlier, b.earlier), found, (a.inverse, b.inverse), (a.usable, b.usable),
            work, model.scale, model.step, self.first.tolerance, self.first.limit, column, (a.nodes, b.nodes), alive,
        )  # fmt: skip
        if not (sweeps and alive[0] and alive[1]):
            a.usable, b.usable = a.usable and bool(alive[0]), b.usable and bool(alive[1])
            return None
        a.usable = b.usable = True  # the probes keep the Jacobians so
        a.mesh = b.mesh = mesh
        a.inputs, b.inputs = last_a, last_b
        records: tuple[Record, ...] = ()
        if record:
            # parts of a step share one bank, so each record of one needs its own copy
            own = np.asarray if whole else np.copy
            rates = own(a.bank[RATES + scheme.stages - 1 : RATES + scheme.stages])
            records = (
                Record(
                    scheme, key, mesh, a.bank[:0], own(a.bank[Y_NOW]), rates, rows_a, own(found[0]), times
                ),
            )
        iterations = sweeps - scheme.stages
        return (
            StepResult(True, "ok", iterations, sweeps, jacobians, 1, records),
            StepResult(True, "ok", iterations, sweeps, jacobians),
        )

    def _make(self, mesh: Mesh) -> tuple:
        """Buffers of the kernel, the unknowns found at the stages of both (2, stages, 5 + N), and whether they converged."""
        model, stages = self.first.model, self.first.scheme.stages
        big, alone = model.buffers(mesh, len(LANES)), model.buffers(mesh, 1)
        work = (
            big,
            tuple(alone[i] for i in (1, 2, 3, 4, 5)),
            model.buffers(mesh, 8 * len(model.jacobian_lanes)),
            np.empty((2, len(alone[4]) + len(alone[5]))),
        )
        return work, np.empty((2, stages, 5 + model.n)), np.ones(2, np.bool_)
