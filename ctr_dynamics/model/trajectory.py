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
from ctr_dynamics.kernels.lanes import PACK
from ctr_dynamics.kernels.layout import RATES
from ctr_dynamics.kernels.shooting import CONVERGED, aligned_zeros, lanes_for
from ctr_dynamics.kernels.step_sequence import advance, advance_tangent
from ctr_dynamics.kernels.tangent import linearise, step_tangent
from ctr_dynamics.kernels.workspace import input_row
from ctr_dynamics.model.mesh import Key, Mesh, fits
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Record, Simulator, State, remap_columns
from ctr_dynamics.model.time_scheme import Scheme

Floats = NDArray[np.float64]
InputRows = Callable[[Floats], Floats]
TIP_ROWS = 13  # p, h, q, omega
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


class _Columns:
    """Columns of the stored fields along a simulation, with their buffers.

    Packs of eight columns lie apart, each in one piece of memory; columns of zeros fill the last one.
    """

    def __init__(self, model: Model, effect: Floats, input_effect: Callable[[Floats], Floats]) -> None:
        self.asked = effect.shape[1]
        self.count = -(-self.asked // PACK) * PACK
        self.model, self.effect = model, self._padded(effect)
        self._input_effect = input_effect
        self.wide = (*lanes_for(6 + model.n), 0)  # a pack for columns beside the unknowns' lanes
        m = 5 + model.n
        self.dx, self.matrix = np.zeros((m, self.count)), np.zeros((m, m))
        self.dnodes = np.zeros((16 + 3 * model.n, self.count))
        self._buffers: dict[Key, tuple] = {}

    def _padded(self, columns: Floats) -> Floats:
        spare = [(0, 0)] * (columns.ndim - 1) + [(0, self.count - self.asked)]
        return np.ascontiguousarray(np.pad(columns, spare))

    def input_effect(self, times: Floats) -> Floats:
        """(k, inputs, columns) derivatives of the inputs at times (k,)."""
        return self._padded(self._input_effect(times))

    def buffers(self, key: Key, mesh: Mesh, slots: int) -> tuple:
        """(many, work, before) for the sections ``key``."""
        if key not in self._buffers:
            L = 8 * len(self.wide)
            many = self.model.buffers(mesh, L)
            main, base = len(many[4]) // L, len(many[5]) // L
            fields = main + base
            work = (
                np.zeros(main), np.zeros(base), np.zeros((slots, fields)), np.zeros_like(self.effect),
            )  # fmt: skip
            self._buffers[key] = many, work, np.zeros((RATES, fields))
        return self._buffers[key]

    def start(self, state: State, par: Floats, row: Floats, drow: Floats, slots: int) -> Floats:
        """Columns at rest; returns those of the tip (13, r)."""
        n, layout = self.model.n, self.model.layout
        many, work, _ = self.buffers(state.key, state.mesh, slots)
        hist, histb, _, dstage = work
        hist[:], histb[:] = 0.0, 0.0
        fields = np.zeros((len(hist) + len(histb), self.count))
        rows = input_rows(n)[: len(row)]
        par = par.copy()
        par[rows] = row
        par[layout["alpha_rate"]] = par[layout["beta_rate"]] = 0.0
        dstage[:] = self.effect
        dstage[rows] += drow[: len(rows)]
        dstage[layout["alpha_rate"]] = dstage[layout["beta_rate"]] = 0.0
        linearise(
            self.model.tubes, self.wide, state.mesh, 0.0, par, dstage, state.unknowns[-1], hist, histb, np.zeros_like(fields), EPSILON,
            self.model.tangent_step, many, self.matrix, self.dx, fields, self.dnodes,
        )  # fmt: skip
        self.bank = aligned_zeros(len(fields) * slots * self.count).reshape(-1, slots, len(fields), PACK)
        self.bank[:, :2] = np.moveaxis(fields.reshape(len(fields), -1, PACK), 1, 0)[:, None]
        return self.tip

    @property
    def tip(self) -> Floats:
        """(13, r) columns of the tip."""
        return self.dnodes[:TIP_ROWS, : self.asked].copy()

    def remap(self, old: Mesh, old_beta: Floats, new: Mesh, new_beta: Floats) -> None:
        """Carry the columns to another set of sections."""
        blocks, slots, fields, _ = self.bank.shape
        flat = np.moveaxis(self.bank, 0, 2).reshape(slots, fields, -1)
        flat = remap_columns(self.model.n, flat, old, old_beta, new, new_beta)
        self.bank = np.ascontiguousarray(np.moveaxis(flat.reshape(slots, -1, blocks, PACK), 2, 0))

    def follow(self, record: Record, par: Floats) -> bool:
        """Move the columns over one recorded (sub)step."""
        slots = self.bank.shape[1]
        many, work, _ = self.buffers(record.key, record.mesh, slots)
        dinputs = self.input_effect(record.times)
        return step_tangent(
            self.model.tubes, self.wide, record.mesh, record.scheme.c0, record.scheme.weights, par.copy(), record.inputs, record.found,
            record.before, record.rates, self.effect, dinputs, EPSILON, self.model.tangent_step, many, work, self.bank, self.matrix,
            self.dx, self.dnodes,
        )  # fmt: skip


def input_rows(n: int) -> NDArray[np.int64]:
    """Rows of the parameter block that hold the inputs of ``n`` tubes, in their order."""
    return np.array([input_row.py_func((0,) * n, i) for i in range(4 * n + 6)])


def to_inputs(n: int, row: Floats) -> Inputs:
    """One row of inputs as :class:`Inputs`; without rates of beta they are 0."""
    rate = row[3 * n + 6 :] if len(row) > 3 * n + 6 else np.zeros(n)
    return Inputs(
        row[:n], row[n : 2 * n], row[2 * n : 3 * n], rate, row[3 * n : 3 * n + 3], row[3 * n + 3 : 3 * n + 6]
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
        r = effect.shape[1]
        give = input_effect or (lambda times: np.zeros((len(times), model.input_count, r)))
        columns = _Columns(model, effect, give)
        out = np.empty((steps + 1, TIP_ROWS, r))
        out[0] = columns.start(state, parameters, first, columns.input_effect(np.zeros(1))[0], RATES + stages)
    divided = _divided(events, dt) if scheme.one_step else {}
    k, sweeps, failure, hard = 0, 0, "", 0
    while k < steps:
        count = min(CHUNK, steps - k)
        times = (np.arange(k, k + count)[:, None] + scheme.times) * dt
        rows_now = inputs(times.ravel()).reshape(count, stages, -1)
        beta = rows_now[:, -1, 2 * n : 3 * n]
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
                lost = _lost(out[k + 1 : k + 1 + taken]) if outcome != -1 else taken - 1
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
                        columns.remap(mesh, before, record.mesh, record.inputs[-1, 2 * n : 3 * n])
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
    done = k + 1
    return Trajectory(
        dt * np.arange(done, dtype=np.float64),
        tip[:done],
        None if out is None else out[:done],
        failure,
        sweeps,
    )


def _lost(columns: Floats) -> int:
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
    small, big = simulator._work(state.key, state.mesh)
    scheme = simulator.scheme
    nodes = small[6]
    # the compiled loop reads the tip from the last rows of the node states
    S = 16 + 3 * model.n
    last = np.empty((len(rows), S))
    common = (
        model.tubes, model.lane, model.jacobian_lanes,
    )  # fmt: skip
    solver = (
        state.mesh, scheme.c0, scheme.weights, simulator.parameters, rows, state.bank, state.unknowns, state.earlier, state.inverse,
        not state.usable, small, big, model.scale, model.step,
    )  # fmt: skip
    if columns is None:
        taken, sweeps, outcome = advance(*common, *solver, simulator.tolerance, simulator.limit, last)
    else:
        assert dtips is not None
        many, work, before = columns.buffers(state.key, state.mesh, len(state.bank))
        shape = (*rows.shape, columns.count)
        dinputs = np.ascontiguousarray(columns.input_effect(times.ravel()).reshape(shape))
        taken, sweeps, outcome = advance_tangent(
            *common, columns.wide, *solver, model.tangent_step, simulator.tolerance, simulator.limit, last, columns.effect, dinputs,
            EPSILON, many, work, columns.bank, before, columns.matrix, columns.dx, columns.dnodes, dtips,
        )  # fmt: skip
    if outcome == -1:  # the step has been taken, and has no tangent
        taken += 1
    tips[:taken] = last[:taken, :TIP_ROWS]
    state.usable = outcome in (CONVERGED, -1)
    if taken:
        state.nodes = nodes.reshape(-1, S).copy() if state.usable else state.nodes
    return taken, sweeps, outcome
