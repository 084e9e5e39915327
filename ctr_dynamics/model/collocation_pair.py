"""Two runs of one robot a collocation step at a time, side by side in the same sweeps: eight lanes take little longer than four."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.collocation import ACCOUNT, FRESH, OUTCOME, TWO_RUNS, advance_two
from ctr_dynamics.kernels.coupling import DAMPED, STAGES, UNDAMPED
from ctr_dynamics.kernels.shooting import CONVERGED
from ctr_dynamics.kernels.structures import CollocationRun, RunPair
from ctr_dynamics.model.collocation_buffers import Workspaces
from ctr_dynamics.model.collocation_steps import CollocationSteps, accept, keeps_jacobian, recorded
from ctr_dynamics.model.simulator import Simulator
from ctr_dynamics.model.state import InputsAt, Record, State, StepResult, divided, stage_inputs
from ctr_dynamics.model.time_scheme import Collocation


class CollocationPair:
    """Steps two simulators of one model, scheme and tolerance together."""

    def __init__(self, first: Simulator, second: Simulator) -> None:
        assert first.model is second.model
        assert first.tolerance == second.tolerance
        assert isinstance(first.scheme, Collocation)
        assert first.scheme is second.scheme
        assert first.collocation is not None
        assert second.collocation is not None
        self.first, self.second = first, second
        self.scheme = first.scheme
        self._steps: tuple[CollocationSteps, CollocationSteps] = first.collocation, second.collocation
        self._runs: RunPair | None = None
        self._workspaces = Workspaces(first.model, first.scheme, first.tolerance, TWO_RUNS)

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
        each, divided at ``events`` (s). With ``record`` the first result carries what the tangent of the step needs, until the state is written to.

        None where they cannot go together: other sections or translations than each other's, sections that change, inputs that are not finite,
        a hard step. Nothing is done then, but that the next step of a run that has failed begins with a new Jacobian.
        """
        times = self.first.divisions(t, events)
        if len(times) == 2:
            return self._part(a, b, t, self.scheme, inputs_a, inputs_b, record)
        trials = a.copy(), b.copy()
        parts = []
        for begin, end in pairwise(times):
            for trial in trials:
                trial.usable = False  # the Jacobian is of another step length
            part = self._part(*trials, begin, self.scheme.parted(end - begin), inputs_a, inputs_b, record)
            if part is None:
                return None
            for trial in trials:
                trial.forget_history()
            parts.append(part)
        a.become(trials[0])
        b.become(trials[1])
        return divided([first for first, _ in parts]), divided([second for _, second in parts])

    def _together(self, first: CollocationRun, second: CollocationRun) -> RunPair:
        """Both runs; the same object while they are the same, of which the compiler knows the type."""
        if self._runs is None or self._runs.first is not first or self._runs.second is not second:
            self._runs = RunPair(first, second)
        return self._runs

    def _part(
        self,
        a: State,
        b: State,
        t: float,
        scheme: Collocation,
        inputs_a: InputsAt,
        inputs_b: InputsAt,
        record: bool,
    ) -> tuple[StepResult, StepResult] | None:
        """Both from t (s) on by the step of the ``scheme``."""
        model = self.first.model
        times = t + scheme.times * scheme.dt
        rows_a, last_a = stage_inputs(model, inputs_a, times)
        rows_b, last_b = stage_inputs(model, inputs_b, times)
        if a.key != b.key or not math.isfinite(np.vdot(rows_a, rows_a) + np.vdot(rows_b, rows_b)):
            return None
        key, mesh = a.key, a.mesh
        if model.moving_precurvature or last_a.beta.tobytes() != a.inputs.beta.tobytes():
            try:
                key, mesh = model.mesh(last_a.beta, a.key)
            except InputError:
                return None
            if key != a.key or last_a.beta.tobytes() != last_b.beta.tobytes():
                return None
        work = self._workspaces.of(key, mesh, last_a.beta, scheme)
        one, other = self._steps
        account = np.zeros((2, ACCOUNT), np.int64)
        account[0, FRESH], account[1, FRESH] = not a.usable, not b.usable
        damping = DAMPED if one.damping is DAMPED or other.damping is DAMPED else UNDAMPED
        runs = self._together(
            a.run(one.parameters, work.factors_in), b.run(other.parameters, work.factors_in)
        )
        sweeps, jacobians = advance_two(
            model.kind, damping, work.segments.mesh, scheme.coefficients, work.solver, runs, (a.known, b.known), (rows_a, rows_b), times, account
        )  # fmt: skip
        a_outcome, b_outcome = account[:, OUTCOME].tolist()
        if a_outcome != CONVERGED or b_outcome != CONVERGED:
            a.usable, b.usable = a_outcome == CONVERGED, b_outcome == CONVERGED
            return None
        for state, last, (_, _, swept, renewed) in zip(
            (a, b), (last_a, last_b), account.tolist(), strict=True
        ):
            state.mesh = mesh
            accept(state, last)
            state.usable = keeps_jacobian(state, swept, renewed > 0)
        records: tuple[Record, ...] = ()
        if record:
            own = np.asarray if scheme is self.scheme else np.copy  # parts of a step share one bank
            records = (recorded(model, a, scheme, rows_a, a.unknowns[-STAGES:], times, own),)
        return (
            StepResult(True, "ok", sweeps - 1, sweeps, jacobians, 1, records),
            StepResult(True, "ok", sweeps - 1, sweeps, jacobians),
        )
