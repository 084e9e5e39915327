"""The dynamic model in time: start at rest, step, follow moving actuators, recover from hard steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.layout import RATES, Y_BEFORE, Y_NOW
from ctr_dynamics.kernels.shooting import CONVERGED, NOT_FINITE
from ctr_dynamics.kernels.time_step import EARLIER, RENEW, extrapolate, remember, step
from ctr_dynamics.model.mesh import Mesh, point_positions
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import Scheme, make_scheme

OUTCOMES = {
    CONVERGED: "ok",
    1: "the shooting did not converge",
    NOT_FINITE: "the shooting left the range of finite numbers",
}


@dataclass(slots=True)  # not frozen: those take three times as long to make
class Inputs:
    """Actuators and tip wrench at one time. Never written to once made: states and their copies share it.

    Args:
        alpha, alpha_rate: (N,) rad and rad/s, angles of the tubes at their bases, innermost first.
        beta, beta_rate: (N,) m and m/s, translations of the bases, <= 0.
        force, torque: (3,) N and N m on tube 1's tip, in the axes of ``ctr_base``.

    Example:
        >>> import numpy as np
        >>> from ctr_dynamics import Inputs
        >>> still = Inputs(np.array([1.57, 1.57]), np.zeros(2), np.array([-0.2521, -0.1977]), np.zeros(2))
        >>> still.force
        array([0., 0., 0.])
    """

    alpha: np.ndarray
    alpha_rate: np.ndarray
    beta: np.ndarray
    beta_rate: np.ndarray
    force: np.ndarray = field(default_factory=lambda: np.zeros(3))
    torque: np.ndarray = field(default_factory=lambda: np.zeros(3))


# of a step: events closer than that to its ends, or to one another, do not divide it. They matter little there, and the shorter the part, the
# worse is the shooting's condition
SHORTEST_PART = 0.2

InputsAt = Callable[[float], Inputs]
"""Inputs at a time in s. One that also has ``stages(times)``, which returns what :func:`stage_inputs` does, is asked for all stages at once."""


class StepResult(NamedTuple):
    """What a step did. ``ok`` False leaves the state as it was; ``reason`` says why."""

    ok: bool
    reason: str
    iterations: int
    sweeps: int
    jacobians: int
    substeps: int = 1
    records: tuple[Record, ...] = ()


class Record(NamedTuple):
    """What the tangent of a solved step needs.

    ``after`` (fields,): fields at its end; ``inputs`` (stages, 3N + 6) and ``found`` (stages, 5 + N) at its stages. :func:`step_tangent
    <ctr_dynamics.kernels.tangent.step_tangent>` also reads ``before`` (3, fields), the stored fields before the step, and all of
    ``rates`` (stages, fields); without them ``before`` is empty and ``rates`` holds the last stage's alone.
    """

    scheme: Scheme
    key: tuple
    mesh: Mesh
    before: np.ndarray
    after: np.ndarray
    rates: np.ndarray
    inputs: np.ndarray
    found: np.ndarray
    times: np.ndarray


@dataclass
class State:
    """Everything that lives between steps; :meth:`copy` makes an independent one."""

    key: tuple
    mesh: Mesh
    bank: np.ndarray
    unknowns: np.ndarray
    earlier: np.ndarray
    inverse: np.ndarray
    usable: bool
    nodes: np.ndarray
    inputs: Inputs

    def copy(self) -> State:
        """An independent copy; meshes are shared, they are never written."""
        return State(
            self.key, self.mesh, self.bank.copy(), self.unknowns.copy(), self.earlier.copy(), self.inverse.copy(), self.usable,
            self.nodes.copy(), self.inputs,
        )  # fmt: skip

    def become(self, other: State) -> None:
        """Take over all that ``other`` holds, to go on with a fresh Jacobian."""
        for name in ("key", "mesh", "bank", "unknowns", "earlier", "inverse", "nodes", "inputs"):
            setattr(self, name, getattr(other, name))
        self.usable = False

    def forget_course(self) -> None:
        """Look for the next unknowns where the last step ended."""
        self.unknowns[:] = self.unknowns[-1]
        self.earlier[:] = self.unknowns[-1]

    @property
    def fields(self) -> np.ndarray:
        """(fields,) q, omega, u, gamma at every point: the state of the PDE. A view: writing changes the state."""
        return self.bank[Y_NOW]


class Simulator:
    """Forward simulation of one model.

    Args:
        model: the robot.
        scheme: time scheme with its step.
        tolerance: largest scaled imbalance at the tip.
        parameters: (NP,) block instead of the robot file's; written to freely by its owner between steps.

    Example:
        Both tubes turn at 2 rad/s from rest, for ten steps of 3 ms:

        >>> import numpy as np
        >>> from ctr_dynamics import Inputs, Model, Simulator, load_robot
        >>> simulator = Simulator(Model(load_robot("till2020_tissue")))
        >>> alpha, beta = np.array([1.57, 1.57]), np.array([-0.2521, -0.1977])
        >>> state = simulator.rest(Inputs(alpha, np.zeros(2), beta, np.zeros(2)))
        >>> turning = lambda t: Inputs(alpha + 2.0 * t, np.full(2, 2.0), beta, np.zeros(2))
        >>> results = [simulator.step(state, 0.003 * k, turning) for k in range(10)]
        >>> all(result.ok for result in results)
        True
        >>> state.nodes[-1, :3].shape  # tip, m in ctr_base
        (3,)
    """

    def __init__(
        self,
        model: Model,
        scheme: Scheme | None = None,
        tolerance: float = 1e-7,
        parameters: np.ndarray | None = None,
    ) -> None:
        self.model = model
        self.scheme = scheme or make_scheme("sdirk3", 0.003)
        self.tolerance = tolerance
        self.parameters = (model.parameters if parameters is None else parameters).copy()
        self.limit = 40
        self._buffers: dict[tuple, tuple] = {}

    def rest(self, inputs: Inputs, guess: np.ndarray | None = None) -> State:
        """State at rest in the static equilibrium at ``inputs``.

        Raises:
            InputError: there is no equilibrium that the continuation reaches, or the actuators are out of range.
        """
        equilibrium = Statics(self.model).solve(
            inputs.beta, inputs.alpha, inputs.force, inputs.torque, guess=guess, parameters=self.parameters
        )
        if not equilibrium.converged:
            raise InputError(
                f"no static equilibrium found at beta {np.round(inputs.beta, 4)} m, alpha {np.round(inputs.alpha, 3)} rad",
                do="check the robot file, the joints and the load",
            )
        stages = self.scheme.stages
        bank = np.zeros((RATES + stages, len(equilibrium.fields)))
        bank[Y_NOW] = bank[Y_BEFORE] = equilibrium.fields
        m = 5 + self.model.n
        unknowns = np.tile(equilibrium.x, (stages, 1))
        return State(
            equilibrium.key,
            equilibrium.mesh,
            bank,
            unknowns,
            np.stack([unknowns] * EARLIER),
            np.zeros((m, m)),
            False,
            equilibrium.nodes,
            inputs,
        )

    def step(
        self,
        state: State,
        t: float,
        inputs_at: InputsAt,
        *,
        record: bool | Literal["end"] = False,
        events: Sequence[float] = (),
    ) -> StepResult:
        """Advance ``state`` from t to t + dt (s) in place; ``inputs_at`` gives actuators and load at any time in between.

        A step that fails is tried again with a fresh Jacobian and, for one-step schemes, in up to 32 substeps. With ``record`` the result
        carries what the tangent of the step needs; with "end", of its last stage alone, and the record holds until the state is written
        to. ``events``: s, times at which the inputs jump or bend; one-step schemes divide the step there, since a step across one is of first
        order only.
        """
        times = self.divisions(t, events)
        if len(times) > 2:
            in_parts = self._divided(state, times, inputs_at, record)
            if in_parts is not None:
                return in_parts
        result = self._attempt(state, self.scheme, t, inputs_at, not state.usable, record)
        if result.ok:
            return result
        totals = [result.iterations, result.sweeps, result.jacobians]
        line = 2.0 * state.unknowns - state.earlier[0]
        retries = [
            (1, line),
            (1, line + state.unknowns - 2.0 * state.earlier[0] + state.earlier[1]),
            (1, None),
        ] + [(2**halving, None) for halving in range(1, 6) if self.scheme.one_step]
        for count, start in retries:
            trial = state.copy()
            if start is None:
                trial.forget_course()
            scheme = make_scheme(self.scheme.name, self.scheme.dt / count) if count > 1 else self.scheme
            records: list[Record] = []
            for part in range(count):
                result = self._attempt(trial, scheme, t + part * scheme.dt, inputs_at, True, record, start)
                records.extend(result.records)
                for i, value in enumerate((result.iterations, result.sweeps, result.jacobians)):
                    totals[i] += value
                if not result.ok:
                    break
            if result.ok:
                state.become(trial)
                how = f"{count} substeps" if count > 1 else "fresh start"
                return StepResult(True, how, totals[0], totals[1], totals[2], count, tuple(records))
        return StepResult(False, result.reason, totals[0], totals[1], totals[2])

    def divisions(self, t: float, events: Sequence[float]) -> list[float]:
        """Where the step from t (s) begins, those of the ``events`` (s) at which it is divided, and where it ends."""
        dt = self.scheme.dt
        least = SHORTEST_PART * dt
        times = [t]
        for event in sorted(events) if self.scheme.one_step else ():
            if event - times[-1] > least and t + dt - event > least:
                times.append(event)
        return [*times, t + dt]

    def _divided(
        self, state: State, times: list[float], inputs_at: InputsAt, record: bool | Literal["end"]
    ) -> StepResult | None:
        """The step in parts between ``times``; None where a part fails."""
        trial = state.copy()
        trial.forget_course()
        parts = []
        for begin, end in pairwise(times):
            scheme = make_scheme(self.scheme.name, end - begin)
            part = self._attempt(trial, scheme, begin, inputs_at, True, record)
            if not part.ok:
                return None
            parts.append(part)
        state.become(trial)
        return divided(parts)

    def _attempt(
        self,
        state: State,
        scheme: Scheme,
        t: float,
        inputs_at: InputsAt,
        fresh: bool,
        record: bool | Literal["end"],
        start: np.ndarray | None = None,
    ) -> StepResult:
        n, stages = self.model.n, scheme.stages
        inputs, last = stage_inputs(self.model, inputs_at, t + scheme.times * scheme.dt)
        if not math.isfinite(np.vdot(inputs, inputs)):
            return StepResult(False, "actuators or load hold a number that is not finite", 0, 0, 0)
        bank, mesh = state.bank, state.mesh
        try:
            still = not self.model.moving_precurvature and last.beta.tobytes() == state.inputs.beta.tobytes()
            key, now_mesh = (state.key, mesh) if still else self.model.mesh(last.beta, state.key)
        except InputError as error:
            return StepResult(False, str(error), 0, 0, 0)
        if key != state.key:
            bank = remap_fields(n, bank, mesh, state.inputs.beta, now_mesh, last.beta)
            fresh = True
        mesh = now_mesh
        small, big = self._work(key, mesh)
        if start is None:
            guess = np.empty_like(state.unknowns)
            extrapolate(state.unknowns, state.earlier, self.model.step, guess)
        else:
            guess = start
        before = bank[:RATES].copy() if record is True else bank[:0]
        found = np.empty_like(guess)
        outcome, iterations, sweeps, jacobians = step(
            self.model.tubes, self.model.lane, self.model.jacobian_lanes, mesh, scheme.c0, scheme.weights, self.parameters,
            inputs, bank, guess, found, state.inverse, fresh, small, big, self.model.scale, self.model.step,
            self.tolerance, self.limit,
        )  # fmt: skip
        state.usable = outcome == CONVERGED and sweeps <= RENEW * stages
        if outcome != CONVERGED:
            return StepResult(False, OUTCOMES[outcome], iterations, sweeps, jacobians)
        state.key, state.mesh, state.bank = key, mesh, bank
        remember(state.unknowns, state.earlier, found)
        state.nodes = small[6].reshape(-1, 16 + 3 * n).copy()
        state.inputs = last
        records: tuple[Record, ...] = ()
        if record:
            # substeps share one bank, so each record needs its own copy
            own = np.copy if record is True or scheme is not self.scheme else np.asarray
            rates = own(bank[RATES + (0 if record is True else stages - 1) : RATES + stages])
            times = t + scheme.times * scheme.dt
            records = (Record(scheme, key, mesh, before, own(bank[Y_NOW]), rates, inputs, found, times),)
        return StepResult(True, "ok", iterations, sweeps, jacobians, records=records)

    def _work(self, key: tuple, mesh: Mesh) -> tuple:
        if key not in self._buffers:
            W, _, seclen, _, hist, histb, out, outb, nodes, res = self.model.buffers(mesh, 1)
            lanes = 8 * len(self.model.jacobian_lanes)
            self._buffers[key] = (
                (W, seclen, hist, histb, out, outb, nodes, res),
                self.model.buffers(mesh, lanes),
            )
        return self._buffers[key]


def divided(parts: Sequence[StepResult]) -> StepResult:
    """What a step in ``parts`` that have all succeeded comes to."""
    return StepResult(
        True,
        "divided at an event",
        sum(p.iterations for p in parts),
        sum(p.sweeps for p in parts),
        sum(p.jacobians for p in parts),
        records=tuple(r for p in parts for r in p.records),
    )


def stage_inputs(model: Model, inputs_at: InputsAt, times: np.ndarray) -> tuple[np.ndarray, Inputs]:
    """Rows (stages, inputs) of alpha, its rate, beta, tip force, torque, and beta's rate where the model reads it, at ``times`` (stages,) s;
    and the inputs at the last of them."""
    at_once = getattr(inputs_at, "stages", None)
    if at_once is not None:
        return at_once(times)
    n = model.n
    rows = np.empty((len(times), model.input_count))
    for row, time in zip(rows, times, strict=True):
        now = inputs_at(time)
        row[:n], row[n : 2 * n], row[2 * n : 3 * n] = now.alpha, now.alpha_rate, now.beta
        row[3 * n : 3 * n + 3], row[3 * n + 3 : 3 * n + 6] = now.force, now.torque
        row[3 * n + 6 :] = now.beta_rate[: model.input_count - 3 * n - 6]
    return rows, now


def remap_fields(
    n: int, bank: np.ndarray, old: Mesh, old_beta: np.ndarray, new: Mesh, new_beta: np.ndarray
) -> np.ndarray:
    """Fields (rows, fields) of the sections ``old`` at ``old_beta`` as fields of the sections ``new`` at ``new_beta``.

    By interpolation inside each old section, never across one. Sections that are the same but for their cells keep their reference coordinate.
    The Runge-Kutta stages of a cell are not the field at their abscissa: at the middle they miss it by -e and +e with e of second order in the
    cell's length, at the end by an error of third order. These offsets belong to the history as well, or the change of cells would be a kick.
    """
    old_s, old_section = point_positions(old, old_beta)
    new_s, new_section = point_positions(new, new_beta)
    F = 7 + 2 * n
    main = len(old_s) * F
    ends = [old_s[old_section == k][-1] for k in range(len(old.sec_cells))]
    result = np.zeros((len(bank), len(new_s) * F + bank.shape[1] - main))
    result[:, len(new_s) * F :] = bank[:, main:]
    fields = bank[:, :main].reshape(len(bank), -1, F).swapaxes(0, 1)
    target = result[:, : len(new_s) * F].reshape(len(bank), -1, F).swapaxes(0, 1)
    same = np.array_equal(old.bp_tube, new.bp_tube) and np.array_equal(old.bp_offset, new.bp_offset)
    for k in range(len(new.sec_cells)):
        where = np.flatnonzero(new_section == k)
        s = new_s[where] * old_s[-1] / new_s[-1]
        middle = 0.5 * (s[0] + s[-1])
        source = (
            k if same else next((j for j, end in enumerate(ends) if middle <= end + 1e-12), len(ends) - 1)
        )
        points = np.flatnonzero(old_section == source)
        x = old_s[points]
        if same:
            s = x[0] + (new_s[where] - new_s[where][0]) / max(np.ptp(new_s[where]), 1e-15) * (x[-1] - x[0])
        target[where] = _resample(x, fields[points], s)
    return result


def _resample(x: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Stage values (points, ...) of one section's cells at ``x`` as those of other cells at ``at``; both hold four stages a cell and the end."""
    if x[-1] - x[0] < 1e-12:
        return np.repeat(values[-1:], len(at), axis=0)
    at = np.clip(at, x[0], x[-1])
    first, second, last = values[1:-1:4], values[2:-1:4], values[3:-1:4]
    nodes = np.concatenate([values[0:-1:4], values[-1:]])
    knots = np.concatenate([x[0:-1:4], x[-1:]])
    centres = 0.5 * (knots[:-1] + knots[1:])
    grid = np.empty(2 * len(centres) + 1)
    grid[0::2], grid[1::2] = knots, centres
    known = np.empty((len(grid), *values.shape[1:]))
    known[0::2], known[1::2] = nodes, 0.5 * (first + second)
    result = CubicSpline(grid, known)(at) if len(grid) > 3 else _quadratic(grid, known, at)
    ratio = (at[-1] - at[0]) / ((len(at) - 1) // 4) / (x[-1] - x[0]) * len(centres)
    half, end = 0.5 * (second - first) * ratio**2, (last - nodes[1:]) * ratio**3
    for stage, offset in ((1, -half), (2, half), (3, end)):
        result[stage:-1:4] += _linear(centres, offset, 0.5 * (at[0:-1:4] + at[3:-1:4]))
    return result


def _linear(x: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Linear interpolation of values (points, ...), held outside the range of ``x``."""
    if len(x) == 1:
        return np.repeat(values, len(at), axis=0)
    left = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    w = np.clip((at - x[left]) / (x[left + 1] - x[left]), 0.0, 1.0).reshape(-1, *[1] * (values.ndim - 1))
    return (1.0 - w) * values[left] + w * values[left + 1]


def _quadratic(x: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Parabola through three values (3, ...)."""
    w0 = (at - x[1]) * (at - x[2]) / ((x[0] - x[1]) * (x[0] - x[2]))
    w1 = (at - x[0]) * (at - x[2]) / ((x[1] - x[0]) * (x[1] - x[2]))
    w2 = (at - x[0]) * (at - x[1]) / ((x[2] - x[0]) * (x[2] - x[1]))
    return np.tensordot(np.stack([w0, w1, w2], axis=1), values, axes=1)


def remap_columns(
    n: int, columns: np.ndarray, old: Mesh, old_beta: np.ndarray, new: Mesh, new_beta: np.ndarray
) -> np.ndarray:
    """Columns (slots, fields, r) of stored fields carried over like the fields themselves."""
    slots, _, r = columns.shape
    rows = np.ascontiguousarray(columns.transpose(0, 2, 1)).reshape(slots * r, -1)
    moved = remap_fields(n, rows, old, old_beta, new, new_beta)
    return np.ascontiguousarray(moved.reshape(slots, r, -1).transpose(0, 2, 1))
