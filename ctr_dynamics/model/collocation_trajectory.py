"""Whole simulations by collocation in compiled loops: the tip over many steps, and its sensitivities to parameters and inputs.

Steps run without Python in between as long as the sections stay and every step converges. What is harder is tried again from a fresh start, then in
halves and quarters, and in the end by the rescue of :class:`ctr_dynamics.model.collocation_steps.CollocationSteps`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.kernels.collocation import TWO_RUNS
from ctr_dynamics.kernels.collocation_sequence import (
    NO_TANGENT,
    PAIR,
    advance_columns_often,
    advance_stages_often,
    extrapolations,
    fill_tables,
)
from ctr_dynamics.kernels.coupling import DAMPED, UNDAMPED, table_size
from ctr_dynamics.kernels.kinds import SIMD_WIDTH, lanes_for, unknown_lanes
from ctr_dynamics.kernels.layout import input_rows, parameters_of_inputs, state_rows
from ctr_dynamics.kernels.linearise import linearise
from ctr_dynamics.kernels.structures import (
    CollocationTangent,
    Derivatives,
    FiniteDifferences,
    Solution,
    SweepBuffers,
)
from ctr_dynamics.model.collocation_buffers import Workspace
from ctr_dynamics.model.mesh import Key, Mesh
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.remeshing import remap_columns
from ctr_dynamics.model.simulator import Inputs, Simulator, State
from ctr_dynamics.model.state import StepResult
from ctr_dynamics.model.time_scheme import Collocation
from ctr_dynamics.model.trajectory import (
    CHUNK,
    PATIENCE,
    TIP_ROWS,
    ColumnEffects,
    InputRows,
    Trajectory,
    steps_with_meaning,
    to_inputs,
    while_fitting,
)

Floats = NDArray[np.float64]
EPSILON = 1e-6  # of a column's unit: above rounding, and strong friction is straight over it
HALVINGS = 2  # of a step, before the rescue


class _Columns(ColumnEffects):
    """Columns of the fields along a simulation, two and two, with their buffers."""

    def __init__(self, model: Model, effect: Floats, input_effect: Callable[[Floats], Floats] | None) -> None:
        super().__init__(model, effect, input_effect, PAIR)
        self._lanes: dict[Key, SweepBuffers] = {}
        self._tables: dict[float, Floats] = {}
        self._tangent: CollocationTangent | None = None
        self._made_for: tuple[object, ...] = ()
        self.fields = np.zeros((self.count // PAIR, 0, PAIR))
        self.tip_of_all = np.zeros((TIP_ROWS, self.count))

    @property
    def tip(self) -> Floats:
        """(13, r) columns of the tip."""
        return self.tip_of_all[:, : self.asked]

    def tangent(
        self, key: Key, mesh: Mesh, work: Workspace, scheme: Collocation, parameters: Floats
    ) -> CollocationTangent:
        """What the kernels move, for the sections of ``work`` and steps by ``scheme``; the same object while these are the same."""
        made_for = (key, scheme.dt, id(self.fields), id(self.tip_of_all))
        if self._tangent is None or self._made_for != made_for:
            if key not in self._lanes:
                self._lanes[key] = self.model.sweep_buffers(mesh, TWO_RUNS.count, len(work.segments.nodes))
            if scheme.dt not in self._tables:
                tables = np.zeros((self.count // PAIR, table_size(self.model.n, TWO_RUNS.width)))
                fill_tables(self.model.kind, scheme.coefficients.C, parameters, self.effect, EPSILON, tables)
                self._tables[scheme.dt] = tables
            shape = self.count, scheme.stages, len(work.solver.point.units)
            unknowns, guess = np.zeros(shape), np.zeros(shape)
            if self._tangent is not None and self._tangent.unknowns.shape == shape:
                unknowns, guess = self._tangent.unknowns, self._tangent.guess
            self._tangent = CollocationTangent(
                self.fields, unknowns, guess, extrapolations(scheme.times), self.tip_of_all, self._lanes[key], self._tables[scheme.dt],
                EPSILON, work.factors_in(work.new_factors()), np.zeros(1, np.bool_),
            )  # fmt: skip
            self._made_for = made_for
        return self._tangent

    def solve(
        self, c0: float, mesh: Mesh, solution: Solution, row: Floats, drow: Floats, par: Floats
    ) -> bool:
        """Columns of the problem y_t = c0 y + history at its ``solution``, with their own fields for the histories' columns."""
        model, n = self.model, self.model.n
        rows = parameters_of_inputs(n)[: len(row)]
        dparameters = self.effect.copy()
        dparameters[rows] += drow[: len(rows)]
        if c0 == 0.0:  # at rest
            layout = model.layout
            dparameters[layout["alpha_rate"]] = dparameters[layout["beta_rate"]] = 0.0
        lanes, m = lanes_for(unknown_lanes(model.kind).count + SIMD_WIDTH), model.unknown_count
        size = len(solution.history) + len(solution.base_history)
        dhistory = -c0 * self._flat() if c0 else np.zeros((size, self.count))
        result = Derivatives(
            np.zeros((m, m)),
            np.zeros((m, self.count)),
            np.zeros((size, self.count)),
            np.zeros((state_rows(n).size, self.count)),
        )
        differences = FiniteDifferences(EPSILON, model.tangent_perturbation)
        if not linearise(
            model.kind, lanes, c0, mesh, solution, dparameters, np.ascontiguousarray(dhistory), differences,
            model.sweep_buffers(mesh, lanes.count), result,
        ):  # fmt: skip
            return False
        self._keep(result.fields)
        self.tip_of_all = np.ascontiguousarray(result.nodes[:TIP_ROWS])
        return True

    def _flat(self) -> Floats:
        """(fields, r)"""
        return np.ascontiguousarray(np.moveaxis(self.fields, 0, 1)).reshape(self.fields.shape[1], -1)

    def _keep(self, columns: Floats) -> None:
        pairs = columns.reshape(len(columns), -1, PAIR)
        self.fields = np.ascontiguousarray(np.moveaxis(pairs, 1, 0))

    def remap(self, old: Mesh, old_beta: Floats, new: Mesh, new_beta: Floats) -> None:
        """Carry the columns to another set of sections."""
        self._keep(remap_columns(self.model.n, self._flat()[None], old, old_beta, new, new_beta)[0])


class _Run:
    """A simulation under way, with its columns as long as they tell anything."""

    def __init__(
        self,
        model: Model,
        scheme: Collocation,
        parameters: Floats,
        inputs: InputRows,
        columns: _Columns | None,
        tolerance: float,
        guess: Floats | None,
    ) -> None:
        self.model, self.scheme, self.inputs, self.columns = model, scheme, inputs, columns
        self.simulator = Simulator(model, scheme, tolerance, parameters)
        assert self.simulator.collocation is not None
        self.steps, self.parameters = self.simulator.collocation, parameters
        rows = model.layout.rows
        damping = np.concatenate([rows("bending_damping"), rows("torsion_damping")])
        damped = parameters[damping].any() or (columns is not None and columns.effect[damping].any())
        self.damping = DAMPED if damped else UNDAMPED
        self.sweeps, self.reason = 0, ""
        n, first = model.n, inputs(np.zeros(1))[0]
        at_rest = to_inputs(n, first)
        still = Inputs(at_rest.alpha, np.zeros(n), at_rest.beta, np.zeros(n), at_rest.force, at_rest.torque)
        self.state = self.simulator.rest(still, guess)
        if columns is not None and not self._start(columns, first):
            self.columns = None

    def _start(self, columns: _Columns, first: Floats) -> bool:
        par, layout, state = self.parameters.copy(), self.model.layout, self.state
        par[parameters_of_inputs(self.model.n)[: len(first)]] = first
        par[layout["alpha_rate"]] = par[layout["beta_rate"]] = 0.0
        buffers = self.model.sweep_buffers(state.mesh, 1)
        nothing = np.zeros_like(buffers.history), np.zeros_like(buffers.base_history)
        solution = Solution(par, state.unknowns_at_base.copy(), *nothing)
        drow = columns.input_effect(np.zeros(1))[0]
        return columns.solve(0.0, state.mesh, solution, first, drow, par)

    @property
    def tip(self) -> Floats:
        """(13,) of now."""
        return self.state.nodes[-1, :TIP_ROWS]

    def serving(self, rows: Floats) -> int:
        """Number of steps with ``rows`` (K, stages, inputs) for which the sections of now serve."""
        beta = rows[:, -1, input_rows(self.model.n)["beta"]]
        if np.all(beta == self.state.inputs.beta):
            return len(rows)
        return 0 if self.model.moving_precurvature else while_fitting(self.model, self.state.key, beta)

    def fast(self, scheme: Collocation, at: Floats, rows: Floats, tips: Floats, dtips: Floats | None) -> int:
        """Steps on the sections of now at the stages' times ``at`` (K, stages) s in the compiled loop; returns how many were taken."""
        state, model = self.state, self.model
        beta = rows[-1, -1, input_rows(model.n)["beta"]]
        work = self.steps.workspaces.of(state.key, state.mesh, beta, scheme)
        run = state.run(self.steps.parameters, work.factors_in)
        common = (
            model.kind, self.damping, work.segments.mesh, scheme.coefficients, work.solver, run, state.known, at, rows, not state.usable, tips,
        )  # fmt: skip
        columns = self.columns
        if columns is None:
            taken, sweeps, outcome, known = advance_stages_often(*common)
        else:
            assert dtips is not None
            dinputs = columns.input_effect(at.ravel()).reshape(*rows.shape, columns.count)
            tangent = columns.tangent(state.key, state.mesh, work, scheme, self.parameters)
            taken, sweeps, outcome, known = advance_columns_often(
                *common, columns.effect, dinputs, tangent, dtips
            )
            if outcome == NO_TANGENT:
                self.columns, taken = None, taken + 1
        self.sweeps += sweeps
        state.known, state.usable = known, taken == len(rows)
        if taken:
            state.inputs = to_inputs(model.n, rows[taken - 1, -1])
        return taken

    def piece(self, t: float, scheme: Collocation, halvings: int) -> bool:
        """From t (s) on by one step of ``scheme``, however hard; False where it cannot be taken."""
        for fresh in (False, True):
            if fresh:
                self.state.forget_history()
                self.state.usable = False
            at = t + scheme.times * scheme.dt
            rows = self.inputs(at)
            moved = self.steps.at_sections(self.state, rows, to_inputs(self.model.n, rows[-1]))
            if isinstance(moved, StepResult):
                self.reason = moved.reason
                return False
            self._move(moved, rows[-1])
            tips, dtips = np.empty((1, TIP_ROWS)), None
            if self.columns is not None:
                dtips = np.empty((1, TIP_ROWS, self.columns.asked))
            if self.fast(scheme, at[None], rows[None], tips, dtips):
                return True
        if halvings:
            half = scheme.parted(0.5 * scheme.dt)
            done = self.piece(t, half, halvings - 1) and self.piece(t + half.dt, half, halvings - 1)
            self.state.usable = False
            return done
        return self._rescued(t, scheme)

    def _move(self, moved: State, row: Floats) -> None:
        state, beta = self.state, row[input_rows(self.model.n)["beta"]]
        if moved is state:
            return
        if self.columns is not None and moved.key != state.key:
            self.columns.remap(state.mesh, state.inputs.beta, moved.mesh, beta)
        self.state = moved

    def _rescued(self, t: float, scheme: Collocation) -> bool:
        """By the rescue; columns follow each of its substeps by an implicit Euler step."""
        model, n = self.model, self.model.n
        mesh, beta, key = self.state.mesh, self.state.inputs.beta, self.state.key

        def inputs_at(time: float) -> Inputs:
            return to_inputs(n, self.inputs(np.array([time]))[0])

        result = self.steps.rescue(self.state, scheme, t, inputs_at, self.columns is not None)
        self.sweeps += result.sweeps
        self.reason = result.reason
        if not result.ok:
            return False
        for record in result.records:
            columns = self.columns
            if columns is None:
                break
            if record.key != key:
                now = record.inputs[-1, input_rows(n)["beta"]]
                columns.remap(mesh, beta, record.mesh, now)
                key, mesh, beta = record.key, record.mesh, now
            c0, row = 1.0 / record.scheme.dt, record.inputs[-1]
            par = self.parameters.copy()
            par[parameters_of_inputs(n)[: len(row)]] = row
            history = record.rates[-1] - c0 * record.after
            main = len(model.sweep_buffers(mesh, 1).history)
            solution = Solution(par, record.found[-1].copy(), history[:main], history[main:])
            drow = columns.input_effect(record.times[-1:])[0]
            if not columns.solve(c0, mesh, solution, row, drow, par):
                self.columns = None
        return True


def run_collocation(
    model: Model,
    scheme: Collocation,
    parameters: Floats,
    inputs: InputRows,
    duration: float | Floats,
    *,
    effect: Floats | None = None,
    input_effect: Callable[[Floats], Floats] | None = None,
    tolerance: float = 1e-6,
    guess: Floats | None = None,
    events: Sequence[float] = (),
) -> Trajectory:
    """Simulate from rest, as :func:`ctr_dynamics.model.trajectory.run` does with other schemes; arguments and errors are those.

    Args:
        duration: s, or the lengths (K,) s of all steps where these are not that of the scheme.
    """
    if isinstance(duration, np.ndarray):
        steps, lengths, t = len(duration), duration, np.concatenate([[0.0], np.cumsum(duration)])
    else:
        steps = int(np.floor(duration / scheme.dt + 1e-9))
        lengths, t = np.full(steps, scheme.dt), scheme.dt * np.arange(steps + 1.0)
    schemes = {float(h): scheme if h == scheme.dt else scheme.parted(float(h)) for h in np.unique(lengths)}
    other = np.append(np.flatnonzero(np.diff(lengths)) + 1, steps)  # first step of another length
    stages = scheme.stages
    columns: _Columns | None = None
    out: Floats | None = None
    if effect is not None:
        columns = _Columns(model, effect, input_effect)
        out = np.zeros((steps + 1, TIP_ROWS, columns.asked))
    this = _Run(model, scheme, parameters, inputs, columns, tolerance, guess)
    tip = np.empty((steps + 1, TIP_ROWS))
    tip[0] = this.tip
    if out is not None and this.columns is not None:
        out[0] = this.columns.tip
    divided = sorted({int(np.searchsorted(t, event, side="right")) - 1 for event in events})
    k, failure, hard = 0, "", 0
    while k < steps:
        dt = float(lengths[k])
        used = schemes[dt]
        this.state.usable &= not k or lengths[k - 1] == dt  # a Jacobian is of one step length
        plain = min((step - k for step in divided if step >= k), default=CHUNK)  # steps that are not divided
        count = min(CHUNK, int(other[np.searchsorted(other, k, side="right")]) - k)
        at = t[k : k + count, None] + scheme.times * dt
        rows = inputs(at.ravel()).reshape(count, stages, -1)
        usable = min(plain, this.serving(rows))
        taken = 0
        if usable:
            dtips = None if out is None else out[k + 1 : k + 1 + usable]
            taken = this.fast(used, at[:usable], rows[:usable], tip[k + 1 : k + 1 + usable], dtips)
            if out is not None and this.columns is not None:
                lost = steps_with_meaning(out[k + 1 : k + 1 + taken])
                if lost < taken:
                    out[k + 1 + lost :] = 0.0
                    this.columns = None
        k += taken
        if taken == count:
            continue
        hard += taken < usable
        begin_of_step = float(t[k])
        if hard > PATIENCE:
            failure = f"step at {begin_of_step:.4f} s: more than {PATIENCE} steps did not converge at once"
            break
        times = this.simulator.divisions(begin_of_step, events, dt)
        whole = len(times) == 2
        for begin, end in pairwise(times):
            this.state.usable &= whole
            if not this.piece(begin, used if whole else scheme.parted(end - begin), HALVINGS):
                failure = f"step at {begin_of_step:.4f} s failed: {this.reason}"
                break
            if not whole:
                this.state.forget_history()  # the inputs jump or bend here
        this.state.usable &= whole
        if failure:
            break
        tip[k + 1] = this.tip
        if out is not None and this.columns is not None:
            out[k + 1] = this.columns.tip
        k += 1
    return Trajectory.of_steps(k, t, tip, out, failure, this.sweeps)
