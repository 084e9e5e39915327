"""Whole simulations in compiled loops: the tip over many steps, and its sensitivities to parameters and inputs.

Steps run without Python in between as long as the sections stay and every step converges; what is harder goes through
:class:`ctr_dynamics.model.simulator.Simulator` with its retries, one step at a time. Sensitivities follow from the tangent of every step, so
that the derivatives by dozens of parameters cost a few simulations (docs/model.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.kinds import SIMD_WIDTH, lanes_for, unknown_lanes
from ctr_dynamics.kernels.layout import RATES, input_rows, parameters_of_inputs, state_rows
from ctr_dynamics.kernels.linearise import linearise
from ctr_dynamics.kernels.shooting import CONVERGED, aligned_zeros
from ctr_dynamics.kernels.step_sequence import NO_TANGENT, advance, advance_tangent
from ctr_dynamics.kernels.structures import (
    Derivatives,
    FiniteDifferences,
    RunTangent,
    Solution,
    SolvedStep,
    TangentBuffers,
)
from ctr_dynamics.kernels.tangent import step_tangent
from ctr_dynamics.model.mesh import Key, Mesh, fits
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.remeshing import remap_columns
from ctr_dynamics.model.simulator import Inputs, Record, Simulator, State
from ctr_dynamics.model.time_scheme import Scheme

Floats = NDArray[np.float64]
InputRows = Callable[[Floats], Floats]
TIP_ROWS = state_rows(1).force  # p, h, q, omega
CHUNK = 256  # steps between returns to Python
PATIENCE = 40  # steps that may need more than the compiled loop before a run is given up
SENSITIVE = 10.0  # m, of the tip by a quantity's unit: where a ten-thousandth of it moves the tip by a millimetre, no derivative tells of a change
EPSILON = 5e-9  # of a column's unit: small against the curvature of the step, large against rounding


@dataclass
class Trajectory:
    """The tip of one simulation.

    Attributes:
        t: (K,) s. tip: (K, 13) p m, quaternion h (not unit), q m/s and omega rad/s in the tip frame, at every step.
        columns: (K, 13, r) derivatives of ``tip``; None when not asked for. Zero from where they are too large to tell of any change (SENSITIVE),
            as after many impacts.
        failure: why the run ended before its time; empty when it did not.
        sweeps: plain sweeps of the arc length, counted over all steps.
    """

    t: Floats
    tip: Floats
    columns: Floats | None
    failure: str = ""
    sweeps: int = 0

    @classmethod
    def of_steps(
        cls, taken: int, t: Floats, tip: Floats, columns: Floats | None, failure: str, sweeps: int
    ) -> Trajectory:
        """The first ``taken`` steps between the times ``t`` (s); the arrays have room for more."""
        done = taken + 1
        return cls(t[:done], tip[:done], None if columns is None else columns[:done], failure, sweeps)


class ColumnEffects:
    """What r quantities do to parameters and inputs, as whole batches of columns; columns of zeros fill the last one.

    Args:
        model: the robot. effect: (NP, r) derivative of the parameter block by the quantities.
        input_effect: gives (k, inputs, r) derivatives of the inputs at times (k,); None where they do not depend on the quantities.
        batch: columns of a batch.

    Attributes:
        asked: r. count: columns of all batches. effect: (NP, count).
    """

    def __init__(
        self, model: Model, effect: Floats, input_effect: Callable[[Floats], Floats] | None, batch: int
    ) -> None:
        self.model, self.asked = model, effect.shape[1]
        self.count = -(-self.asked // batch) * batch
        self.effect = self._padded(effect)
        self._input_effect = input_effect

    def _padded(self, columns: Floats) -> Floats:
        spare = [(0, 0)] * (columns.ndim - 1) + [(0, self.count - self.asked)]
        return np.ascontiguousarray(np.pad(columns, spare))

    def input_effect(self, times: Floats) -> Floats:
        """(k, inputs, count) derivatives of the inputs at times (k,)."""
        if self._input_effect is None:
            return np.zeros((len(times), self.model.input_count, self.count))
        return self._padded(self._input_effect(times))


class _Columns(ColumnEffects):
    """Columns of the stored fields along a simulation, with their buffers.

    Batches of eight columns lie apart, each in one piece of memory.
    """

    def __init__(self, model: Model, effect: Floats, input_effect: Callable[[Floats], Floats] | None) -> None:
        super().__init__(model, effect, input_effect, SIMD_WIDTH)
        # a batch for columns beside the unknowns' lanes
        self.lanes = lanes_for(unknown_lanes(model.kind).count + SIMD_WIDTH)
        self.differences = FiniteDifferences(EPSILON, model.tangent_perturbation)
        m = model.unknown_count
        self.result = Derivatives(
            np.zeros((m, m)),
            np.zeros((m, self.count)),
            np.zeros((0, self.count)),
            np.zeros((state_rows(model.n).size, self.count)),
        )
        self._buffers: dict[Key, TangentBuffers] = {}

    def buffers(self, key: Key, mesh: Mesh, slots: int) -> TangentBuffers:
        """Buffers for the sections ``key``."""
        if key not in self._buffers:
            sweep = self.model.sweep_buffers(mesh, self.lanes.count)
            main, base = len(sweep.history) // self.lanes.count, len(sweep.base_history) // self.lanes.count
            self._buffers[key] = TangentBuffers(
                sweep,
                np.zeros(main),
                np.zeros(base),
                np.zeros((slots, main + base)),
                np.zeros_like(self.effect),
                np.zeros((main + base, self.count)),
            )
        return self._buffers[key]

    def start(self, state: State, par: Floats, row: Floats, drow: Floats, slots: int) -> Floats:
        """Columns at rest; returns those of the tip (13, r)."""
        n, layout = self.model.n, self.model.layout
        b = self.buffers(state.key, state.mesh, slots)
        b.history[:], b.base_history[:] = 0.0, 0.0
        fields = np.zeros((len(b.history) + len(b.base_history), self.count))
        rows = parameters_of_inputs(n)[: len(row)]
        par, dparameters = par.copy(), b.dparameters
        par[rows] = row
        par[layout["alpha_rate"]] = par[layout["beta_rate"]] = 0.0
        dparameters[:] = self.effect
        dparameters[rows] += drow[: len(rows)]
        dparameters[layout["alpha_rate"]] = dparameters[layout["beta_rate"]] = 0.0
        solution = Solution(par, state.unknowns[-1], b.history, b.base_history)
        result = self.result._replace(fields=fields)
        linearise(
            self.model.kind, self.lanes, 0.0, state.mesh, solution, dparameters, np.zeros_like(fields), self.differences, b.sweep, result
        )  # fmt: skip
        self.bank = aligned_zeros(len(fields) * slots * self.count).reshape(
            -1, slots, len(fields), SIMD_WIDTH
        )
        self.bank[:, :2] = np.moveaxis(fields.reshape(len(fields), -1, SIMD_WIDTH), 1, 0)[:, None]
        return self.tip

    @property
    def tip(self) -> Floats:
        """(13, r) columns of the tip."""
        return self.result.nodes[:TIP_ROWS, : self.asked].copy()

    def remap(self, old: Mesh, old_beta: Floats, new: Mesh, new_beta: Floats) -> None:
        """Carry the columns to another set of sections."""
        blocks, slots, fields, _ = self.bank.shape
        flat = np.moveaxis(self.bank, 0, 2).reshape(slots, fields, -1)
        flat = remap_columns(self.model.n, flat, old, old_beta, new, new_beta)
        self.bank = np.ascontiguousarray(np.moveaxis(flat.reshape(slots, -1, blocks, SIMD_WIDTH), 2, 0))

    def follow(self, record: Record, par: Floats) -> bool:
        """Move the columns over one recorded (sub)step."""
        buffers = self.buffers(record.key, record.mesh, self.bank.shape[1])
        done = SolvedStep(par.copy(), record.inputs, record.found, record.before, record.rates, record.after)
        return step_tangent(
            self.model.kind, self.lanes, record.mesh, record.scheme.coefficients, done, self.effect, self.input_effect(record.times),
            self.differences, buffers, self.bank, self.result,
        )  # fmt: skip


def to_inputs(n: int, row: Floats) -> Inputs:
    """One row of inputs as :class:`Inputs`; without rates of beta they are 0."""
    rows = input_rows(n)
    rate = row[rows["beta_rate"]] if len(row) > rows.beta_rate else np.zeros(n)
    return Inputs(
        row[rows["alpha"]],
        row[rows["alpha_rate"]],
        row[rows["beta"]],
        rate,
        row[rows["force"]],
        row[rows["torque"]],
    )


def run(
    model: Model,
    scheme: Scheme,
    parameters: Floats,
    inputs: InputRows,
    duration: float,
    *,
    effect: Floats | None = None,
    input_effect: Callable[[Floats], Floats] | None = None,
    tolerance: float = 1e-6,
    guess: Floats | None = None,
    events: Sequence[float] = (),
) -> Trajectory:
    """Simulate from rest in the static equilibrium of the first inputs.

    Args:
        parameters: (NP,) block; the actuators and the tip wrench in it are not read.
        inputs: gives (k, model.input_count) alpha, alpha rate, beta, force, torque and, for the extended model, beta rate (rad, rad/s, m, N,
            N m, m/s) at times (k,) s.
        duration: s; the number of steps is the largest that does not pass it.
        effect: (NP, r) derivative of the parameter block by r quantities, in units in which a millionth is a small change.
        input_effect: gives (k, inputs, r) derivatives of the inputs at times (k,).
        guess: (5 + N,) unknowns of the static equilibrium to start from.
        events: s, times at which the inputs jump or bend. One-step schemes divide the steps around them there, since a step across one is of
            first order only.
    Raises:
        InputError: no static equilibrium at the first inputs.
    """
    n = model.n
    simulator = Simulator(model, scheme, tolerance, parameters)
    dt, stages = scheme.dt, scheme.stages
    steps = int(np.floor(duration / dt + 1e-9))
    first = inputs(np.zeros(1))[0]
    at_rest = to_inputs(n, first)
    state = simulator.rest(
        Inputs(at_rest.alpha, np.zeros(n), at_rest.beta, np.zeros(n), at_rest.force, at_rest.torque), guess
    )
    tip = np.empty((steps + 1, TIP_ROWS))
    tip[0] = state.nodes[-1, :TIP_ROWS]
    columns: _Columns | None = None
    out: Floats | None = None
    if effect is not None:
        columns = _Columns(model, effect, input_effect)
        out = np.empty((steps + 1, TIP_ROWS, columns.asked))
        out[0] = columns.start(state, parameters, first, columns.input_effect(np.zeros(1))[0], RATES + stages)
    divided = _divided(events, dt) if scheme.one_step else {}
    k, sweeps, failure, hard = 0, 0, "", 0
    while k < steps:
        count = min(CHUNK, steps - k)
        times = (np.arange(k, k + count)[:, None] + scheme.times) * dt
        rows_now = inputs(times.ravel()).reshape(count, stages, -1)
        beta = rows_now[:, -1, input_rows(n)["beta"]]
        still = bool(np.all(beta == state.inputs.beta))
        usable = count
        if model.moving_precurvature and not still:
            usable = 0
        elif not still:
            usable = while_fitting(model, state.key, beta)
        plain = min((step - k for step in divided if step >= k), default=count)  # steps that are not divided
        usable = min(usable, plain)
        taken = 0
        if usable:
            taken, spent, outcome = _fast(model, simulator, state, rows_now[:usable], times[:usable], columns, tip[k + 1 :],
                                          None if out is None else out[k + 1 :])  # fmt: skip
            sweeps += spent
            if taken:
                state.inputs = to_inputs(n, rows_now[taken - 1, -1])
            if columns is not None and out is not None:
                lost = steps_with_meaning(out[k + 1 : k + 1 + taken]) if outcome != NO_TANGENT else taken - 1
                if lost < taken:
                    out[k + 1 + lost :] = 0.0
                    columns = None
        k += taken
        if taken < count:
            hard += taken < usable == min(count, plain)
            if hard > PATIENCE:
                failure = f"step at {k * dt:.4f} s: more than {PATIENCE} steps did not converge at once"
                break
            mesh, before = state.mesh, state.inputs.beta
            key = state.key
            result = simulator.step(
                state,
                k * dt,
                lambda t: to_inputs(n, inputs(np.array([t]))[0]),
                record=columns is not None,
                events=divided.get(k, ()),
            )
            sweeps += result.sweeps
            if not result.ok:
                failure = f"step at {k * dt:.4f} s failed: {result.reason}"
                break
            if columns is not None:
                for record in result.records:
                    if record.key != key:
                        columns.remap(mesh, before, record.mesh, record.inputs[-1, input_rows(n)["beta"]])
                        key = record.key
                    if not columns.follow(record, parameters):
                        columns = None
                        break
                assert out is not None
                if columns is None:
                    out[k + 1 :] = 0.0
                else:
                    out[k + 1] = columns.tip
            tip[k + 1] = state.nodes[-1, :TIP_ROWS]
            k += 1
    return Trajectory.of_steps(k, dt * np.arange(steps + 1.0), tip, out, failure, sweeps)


def steps_with_meaning(columns: Floats) -> int:
    """Number of steps until one of ``columns`` (K, 13, r) is beyond ``SENSITIVE``."""
    beyond = np.abs(columns[:, :3]).max(axis=(1, 2)) > SENSITIVE
    return int(np.argmax(beyond)) if beyond.any() else len(columns)


def _divided(events: Sequence[float], dt: float) -> dict[int, list[float]]:
    """Events within steps, by the step's number; those at its ends are met anyway."""
    within: dict[int, list[float]] = {}
    for event in sorted(events):
        step = int(np.floor(event / dt))
        if min(event - step * dt, (step + 1) * dt - event) > 1e-6 * dt:
            within.setdefault(step, []).append(float(event))
    return within


def while_fitting(model: Model, key: Key, beta: Floats) -> int:
    """Number of rows of ``beta`` (k, N) for which the sections ``key`` serve."""
    for i, row in enumerate(beta):
        try:
            if not fits(key, model.segments, row, model.nodes):
                return i
        except InputError:
            return i
    return len(beta)


def _fast(
    model: Model,
    simulator: Simulator,
    state: State,
    rows: Floats,
    times: Floats,
    columns: _Columns | None,
    tips: Floats,
    dtips: Floats | None,
) -> tuple[int, int, int]:
    """Steps in the compiled loop; returns (steps taken, sweeps, outcome)."""
    solver = simulator.solver(state.key, state.mesh)
    kind, scheme, mesh = model.kind, simulator.scheme, state.mesh
    coefficients, arrays, fresh = scheme.coefficients, state.arrays(simulator.parameters), not state.usable
    # the compiled loop reads the tip from the last rows of the node states
    S = state_rows(model.n).size
    last = np.empty((len(rows), S))
    if columns is None:
        taken, sweeps, outcome = advance(kind, mesh, coefficients, solver, rows, arrays, fresh, last)
    else:
        assert dtips is not None
        buffers = columns.buffers(state.key, mesh, len(state.bank))
        shape = (*rows.shape, columns.count)
        dinputs = np.ascontiguousarray(columns.input_effect(times.ravel()).reshape(shape))
        before = np.zeros((RATES, state.bank.shape[1]))
        tangent = RunTangent(
            before, columns.effect, dinputs, columns.differences, buffers, columns.bank, columns.result, dtips
        )
        taken, sweeps, outcome = advance_tangent(
            kind, columns.lanes, mesh, coefficients, solver, rows, arrays, fresh, last, tangent
        )
    if outcome == NO_TANGENT:  # the step has been taken
        taken += 1
    tips[:taken] = last[:taken, :TIP_ROWS]
    state.usable = outcome in (CONVERGED, NO_TANGENT)
    if taken:
        state.nodes = solver.single.nodes.reshape(-1, S).copy() if state.usable else state.nodes
    return taken, sweeps, outcome
