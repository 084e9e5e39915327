"""Steps by collocation: all stages of a step in the same sweeps, and a rescue for the few steps that want one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.collocation import ACCOUNT, FRESH, OUTCOME, SWEPT, advance_stages, remember_stages
from ctr_dynamics.kernels.coupling import DAMPED, STAGES, UNDAMPED, Damping
from ctr_dynamics.kernels.layout import RATE_NOW, RATES, Y_BEFORE, Y_NOW, state_rows
from ctr_dynamics.kernels.segmented_shooting import advance_segmented
from ctr_dynamics.kernels.shooting import CONVERGED
from ctr_dynamics.kernels.structures import SegmentedSolver
from ctr_dynamics.model.collocation_buffers import Workspace, Workspaces, resampled, starts_at
from ctr_dynamics.model.mesh import Key, Mesh
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.remeshing import remap_fields
from ctr_dynamics.model.segments import unknown_units
from ctr_dynamics.model.state import (
    OUTCOMES,
    Inputs,
    InputsAt,
    Record,
    State,
    StepResult,
    divided,
    stage_inputs,
)
from ctr_dynamics.model.statics import Equilibrium
from ctr_dynamics.model.time_scheme import Collocation, Scheme, make_scheme

Floats = NDArray[np.float64]
Recorded = bool | Literal["end"]
PAST = 12  # stages whose unknowns are kept: a step's, and those before it through which a polynomial of degree 6 goes
RESCUE = "sdirk3"  # stage by stage, each with its own Jacobian: it stands stages that differ too much for a common one
HALVINGS = 5
JACOBIAN_COST = 20  # sweeps: twice what a new Jacobian with its factors costs, as a part of what goes beyond the fewest is chance


class CollocationSteps:
    """Steps one run by collocation.

    Args:
        model: the robot.
        scheme: of the whole steps.
        tolerance: largest scaled residual.
        parameters: (NP,) block of the run, which its owner may write between steps.
    """

    def __init__(self, model: Model, scheme: Collocation, tolerance: float, parameters: Floats) -> None:
        self.model, self.scheme, self.parameters = model, scheme, parameters
        self.workspaces = Workspaces(model, scheme, tolerance)
        rows = model.layout.rows
        self._damping_rows = [*rows("bending_damping").tolist(), *rows("torsion_damping").tolist()]

    def shift(self, state: State, change: Floats, nodes: Floats) -> None:
        """Move the unknowns of ``state`` with a correction: the first of them by ``change`` (5 + N,), those at the cuts as the ``nodes`` (P, S)."""
        work = self.workspaces.of(state.key, state.mesh, state.inputs.beta, self.scheme)
        state.unknowns += starts_at(self.model, change, nodes, work.segments)

    @property
    def damping(self) -> Damping:
        """Whether a tube of the run has damping."""
        return DAMPED if any(map(self.parameters.item, self._damping_rows)) else UNDAMPED

    def rest(self, equilibrium: Equilibrium, inputs: Inputs) -> State:
        """State at rest in the ``equilibrium`` at ``inputs``."""
        key, mesh = equilibrium.key, equilibrium.mesh
        work = self.workspaces.of(key, mesh, inputs.beta, self.scheme)
        bank = np.zeros((RATES, len(equilibrium.fields)))
        bank[Y_NOW] = bank[Y_BEFORE] = equilibrium.fields
        x = starts_at(self.model, equilibrium.x, equilibrium.nodes, work.segments)
        past = np.tile(x, (PAST, 1))
        return State(
            key, mesh, bank, past, np.zeros((0, PAST, len(x))), work.new_factors(), False, equilibrium.nodes, inputs,
            np.zeros(PAST), 1,
        )  # fmt: skip

    def step(self, state: State, times: Sequence[float], inputs_at: InputsAt, record: Recorded) -> StepResult:
        """Advance ``state`` in place through the ``times`` (s): beginning and end of a step, and where it is divided between."""
        if len(times) == 2:
            return self.part(state, self.scheme, times[0], inputs_at, record)
        trial = state.copy()
        parts = []
        for begin, end in pairwise(times):
            trial.usable = False  # the Jacobian is of another step length
            part = self.part(trial, self.scheme.parted(end - begin), begin, inputs_at, record)
            if not part.ok:
                return part
            trial.forget_history()  # the inputs jump or bend here
            parts.append(part)
        state.become(trial)
        return divided(parts)

    def part(
        self, state: State, scheme: Collocation, t: float, inputs_at: InputsAt, record: Recorded
    ) -> StepResult:
        """From t (s) on by the step of the ``scheme``: as it is, with a new Jacobian, in halves, and by the rescue."""
        result = self.attempt(state, scheme, t, inputs_at, not state.usable, record)
        if result.ok:
            return result
        sweeps, jacobians = result.sweeps, result.jacobians
        for count in (1, 2):
            trial = state.copy()
            trial.forget_history()
            parts = []
            for k in range(count):
                used = scheme if count == 1 else scheme.parted(scheme.dt / count)
                result = self.attempt(trial, used, t + k * used.dt, inputs_at, True, record)
                sweeps, jacobians = sweeps + result.sweeps, jacobians + result.jacobians
                parts.append(result)
                if not result.ok:
                    break
            if result.ok:
                state.become(trial)
                how = "fresh start" if count == 1 else f"{count} substeps"
                records = tuple(r for p in parts for r in p.records)
                return StepResult(True, how, sweeps - 1, sweeps, jacobians, count, records)
        result = self.rescue(state, scheme, t, inputs_at, record)
        return result._replace(sweeps=result.sweeps + sweeps, jacobians=result.jacobians + jacobians)

    def attempt(
        self,
        state: State,
        scheme: Collocation,
        t: float,
        inputs_at: InputsAt,
        fresh: bool,
        record: Recorded,
    ) -> StepResult:
        """One collocation step from t (s) on; where it fails the state stays, but for its Jacobian."""
        model = self.model
        times = t + scheme.times * scheme.dt
        inputs, last = stage_inputs(model, inputs_at, times)
        moved = self.at_sections(state, inputs, last)
        if isinstance(moved, StepResult):
            return moved
        work = self.workspaces.of(moved.key, moved.mesh, last.beta, scheme)
        account = np.zeros((1, ACCOUNT), np.int64)
        account[0, FRESH] = fresh or not moved.usable
        sweeps, jacobians = advance_stages(
            model.kind, self.damping, work.segments.mesh, scheme.coefficients, work.solver,
            moved.run(self.parameters, work.factors_in), moved.known, inputs, times, account,
        )  # fmt: skip
        state.usable = False
        outcome = int(account[0, OUTCOME])
        if outcome != CONVERGED:
            return StepResult(False, OUTCOMES[outcome], sweeps - 1, sweeps, jacobians)
        accept(moved, last)
        if moved is not state:
            state.become(moved)
        state.usable = keeps_jacobian(state, int(account[0, SWEPT]), jacobians > 0)
        records: tuple[Record, ...] = ()
        if record:
            # parts of a step share one bank
            own = np.asarray if record == "end" and scheme is self.scheme else np.copy
            found = state.unknowns[-STAGES:]
            records = (recorded(model, state, scheme, inputs, found, times, own),)
        return StepResult(True, "ok", sweeps - 1, sweeps, jacobians, records=records)

    def at_sections(self, state: State, inputs: Floats, last: Inputs) -> State | StepResult:
        """``state`` itself while its sections serve at the ``last`` of a step's inputs, else a copy on others; why neither can be."""
        model = self.model
        if not math.isfinite(np.vdot(inputs, inputs)):
            return StepResult(False, "actuators or load hold a number that is not finite", 0, 0, 0)
        if not model.moving_precurvature and last.beta.tobytes() == state.inputs.beta.tobytes():
            return state
        try:
            key, mesh = model.mesh(last.beta, state.key)
        except InputError as error:
            return StepResult(False, str(error), 0, 0, 0)
        if key == state.key and mesh is state.mesh:
            return state
        moved = state.copy()
        moved.mesh, moved.usable = mesh, state.usable
        if key != state.key:
            self._remap(moved, state.mesh, key, last)
        return moved

    def _remap(self, state: State, old: Mesh, key: Key, last: Inputs) -> None:
        """Carry all of ``state`` from the mesh ``old`` to other sections; the unknowns at their cuts are looked for from the states at the nodes."""
        model, beta, mesh = self.model, state.inputs.beta, state.mesh
        state.bank = remap_fields(model.n, state.bank, old, beta, mesh, last.beta)
        state.nodes = resampled(state.nodes, old, beta, mesh, last.beta)
        work = self.workspaces.of(key, mesh, last.beta, self.scheme)
        x = starts_at(model, state.unknowns[-1], state.nodes, work.segments)
        state.unknowns, state.earlier = np.tile(x, (PAST, 1)), np.zeros((0, PAST, len(x)))
        state.inverse = work.new_factors()
        state.key, state.usable, state.known = key, False, 1

    def rescue(
        self, state: State, scheme: Collocation, t: float, inputs_at: InputsAt, record: Recorded
    ) -> StepResult:
        """The step in 2, 4 .. 32 substeps whose stages are solved one after the other."""
        model = self.model
        sweeps, jacobians = 0, 0
        reason = OUTCOMES[1]
        for halving in range(1, HALVINGS + 1):
            trial = state.copy()
            used = make_scheme(RESCUE, scheme.dt / 2**halving)
            records: list[Record] = []
            ok = True
            for k in range(2**halving):
                begin = t + k * used.dt
                times = begin + used.times * used.dt
                inputs, last = stage_inputs(model, inputs_at, times)
                moved = self.at_sections(trial, inputs, last)
                if isinstance(moved, StepResult):
                    return moved
                trial = moved
                work = self.workspaces.of(trial.key, trial.mesh, last.beta, scheme)
                mt = trial.unknowns.shape[1]
                solver = self._rescue_solver(work, used.c0[0])
                bank = np.zeros((RATES + used.stages, trial.bank.shape[1]))
                bank[Y_NOW] = trial.bank[Y_NOW]
                found = np.empty((used.stages, mt))
                outcome, _, plain, new = advance_segmented(
                    model.kind, work.segments.mesh, used.coefficients, solver, inputs, trial.unknowns[-1].copy(), found, bank,
                    np.zeros((mt, mt)),
                )  # fmt: skip
                sweeps, jacobians = sweeps + plain, jacobians + new
                ok = outcome == CONVERGED
                if not ok:
                    reason = OUTCOMES[outcome]
                    break
                trial.bank[Y_NOW], trial.bank[RATE_NOW] = bank[Y_NOW], bank[RATES + used.stages - 1]
                trial.nodes = solver.single.nodes.reshape(-1, state_rows(model.n).size).copy()
                remember_stages(trial.times, trial.unknowns, times, found)
                accept(trial, last, len(times))
                if record:
                    records.append(recorded(model, trial, used, inputs, found, times, np.copy))
            if ok:
                trial.forget_history()  # nothing is told by what was hard
                state.become(trial)
                return StepResult(
                    True, f"{2**halving} substeps", sweeps, sweeps, jacobians, 2**halving, tuple(records)
                )
        return StepResult(False, reason, sweeps, sweeps, jacobians)

    def _rescue_solver(self, work: Workspace, rate: float) -> SegmentedSolver:
        units, scale = unknown_units(self.model, len(work.segments.nodes), rate)
        solver = work.rescue
        solver.units[:], solver.scale[:] = units, scale
        solver.single.parameters[:] = self.parameters
        return solver


def accept(state: State, last: Inputs, stages: int = STAGES) -> None:
    """The newest unknowns of ``state`` are those of ``stages`` more stages; ``last`` are its inputs."""
    state.known = min(state.known + stages, PAST)
    state.inputs = last


def keeps_jacobian(state: State, sweeps: int, renewed: bool) -> bool:
    """Whether the Jacobian of ``state`` serves the next step too, after one that has taken ``sweeps`` sweeps; ``renewed``: with a new one.

    The trajectory moves away from where it was taken, and steps take more and more sweeps. It is renewed when these have cost as much as new ones:
    where they grow evenly, that is the least cost in the mean.
    """
    state.fewest = sweeps if renewed else min(state.fewest, sweeps)
    state.beyond = 0 if renewed else state.beyond + sweeps - state.fewest
    return state.beyond < JACOBIAN_COST


def recorded(
    model: Model,
    state: State,
    scheme: Scheme | Collocation,
    inputs: Floats,
    found: Floats,
    times: Floats,
    own: Callable[[Floats], Floats],
) -> Record:
    """What the tangent of the step needs, of its last stage; ``own`` copies what the state may go on to write before that is read."""
    rates = own(state.bank[RATE_NOW : RATE_NOW + 1])
    first = found[:, : model.unknown_count].copy()
    return Record(
        scheme, state.key, state.mesh, state.bank[:0], own(state.bank[Y_NOW]), rates, inputs, first, times
    )
