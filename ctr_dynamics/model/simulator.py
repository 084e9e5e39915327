"""The dynamic model in time: start at rest, step, follow moving actuators, recover from hard steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.layout import RATES, Y_BEFORE, Y_NOW, state_rows
from ctr_dynamics.kernels.shooting import CONVERGED
from ctr_dynamics.kernels.structures import ShootingSolver
from ctr_dynamics.kernels.time_step import EARLIER, RENEW, advance_step, extrapolate, remember
from ctr_dynamics.model.collocation_steps import CollocationSteps
from ctr_dynamics.model.mesh import Mesh
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.remeshing import remap_fields
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
from ctr_dynamics.model.statics import Statics
from ctr_dynamics.model.time_scheme import Collocation, Scheme, collocation, make_scheme

# of a step: events closer than that to its ends, or to one another, do not divide it. They matter little there, and the shorter the part, the
# worse is the shooting's condition
SHORTEST_PART = 0.2


class Simulator:
    """Forward simulation of one model.

    Args:
        model: the robot.
        scheme: time scheme with its step.
        tolerance: largest scaled residual at the tip.
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
        scheme: Scheme | Collocation | None = None,
        tolerance: float = 1e-7,
        parameters: np.ndarray | None = None,
    ) -> None:
        self.model = model
        self.scheme = scheme or collocation(0.003)
        self.tolerance = tolerance
        self.parameters = (model.parameters if parameters is None else parameters).copy()
        self._solvers: dict[tuple, ShootingSolver] = {}
        self.collocation = (
            CollocationSteps(model, self.scheme, tolerance, self.parameters)
            if isinstance(self.scheme, Collocation)
            else None
        )

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
        if self.collocation is not None:
            return self.collocation.rest(equilibrium, inputs)
        stages = self.scheme.stages
        bank = np.zeros((RATES + stages, len(equilibrium.fields)))
        bank[Y_NOW] = bank[Y_BEFORE] = equilibrium.fields
        m = self.model.unknown_count
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
        if self.collocation is not None:
            return self.collocation.step(state, times, inputs_at, record)
        if len(times) > 2:
            in_parts = self._divided(state, times, inputs_at, record)
            if in_parts is not None:
                return in_parts
        assert isinstance(self.scheme, Scheme)
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
                trial.forget_history()
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

    def divisions(self, t: float, events: Sequence[float], dt: float | None = None) -> list[float]:
        """Where the step of ``dt`` (s; None for that of the scheme) from t (s) begins, those of the ``events`` (s) at which it is divided, and where
        it ends."""
        dt = self.scheme.dt if dt is None else dt
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
        trial.forget_history()
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
        model, stages = self.model, scheme.stages
        inputs, last = stage_inputs(model, inputs_at, t + scheme.times * scheme.dt)
        if not math.isfinite(np.vdot(inputs, inputs)):
            return StepResult(False, "actuators or load hold a number that is not finite", 0, 0, 0)
        bank, mesh = state.bank, state.mesh
        try:
            still = not model.moving_precurvature and last.beta.tobytes() == state.inputs.beta.tobytes()
            key, now_mesh = (state.key, mesh) if still else model.mesh(last.beta, state.key)
        except InputError as error:
            return StepResult(False, str(error), 0, 0, 0)
        if key != state.key:
            bank = remap_fields(model.n, bank, mesh, state.inputs.beta, now_mesh, last.beta)
            fresh = True
        mesh = now_mesh
        solver = self.solver(key, mesh)
        if start is None:
            guess = np.empty_like(state.unknowns)
            extrapolate(state.unknowns, state.earlier, model.perturbation, guess)
        else:
            guess = start
        before = bank[:RATES].copy() if record is True else bank[:0]
        found = np.empty_like(guess)
        outcome, iterations, sweeps, jacobians = advance_step(
            model.kind, mesh, scheme.coefficients, solver, inputs, guess, found, bank, state.inverse, fresh
        )
        state.usable = outcome == CONVERGED and sweeps <= RENEW * stages
        if outcome != CONVERGED:
            return StepResult(False, OUTCOMES[outcome], iterations, sweeps, jacobians)
        state.key, state.mesh, state.bank = key, mesh, bank
        remember(state.unknowns, state.earlier, found)
        state.nodes = solver.single.nodes.reshape(-1, state_rows(model.n).size).copy()
        state.inputs = last
        records: tuple[Record, ...] = ()
        if record:
            # substeps share one bank, so each record needs its own copy
            own = np.copy if record is True or scheme is not self.scheme else np.asarray
            rates = own(bank[RATES + (0 if record is True else stages - 1) : RATES + stages])
            times = t + scheme.times * scheme.dt
            records = (Record(scheme, key, mesh, before, own(bank[Y_NOW]), rates, inputs, found, times),)
        return StepResult(True, "ok", iterations, sweeps, jacobians, records=records)

    def solver(self, key: tuple, mesh: Mesh) -> ShootingSolver:
        """Buffers and options for the sections ``key``; the kernels read and write the simulator's own parameters."""
        if key not in self._solvers:
            self._solvers[key] = self.model.shooting_solver(mesh, self.tolerance, self.parameters)
        return self._solvers[key]
