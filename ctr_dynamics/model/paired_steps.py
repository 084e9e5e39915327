"""Two simulations of one robot a step at a time, side by side in the same sweeps.

Four lanes take no longer than one: two of them are the runs, the other two renew the Jacobians.

Sections, mesh and time scheme are common; parameters, actuators, loads and histories are each one's own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.layout import RATES, Y_NOW
from ctr_dynamics.kernels.paired_time_step import PAIR_LANES, advance_both
from ctr_dynamics.kernels.structures import PairBuffers
from ctr_dynamics.model.mesh import Key, Mesh
from ctr_dynamics.model.simulator import InputsAt, Record, Simulator, State, StepResult, divided, stage_inputs
from ctr_dynamics.model.time_scheme import Scheme, make_scheme


class PairedSteps:
    """Steps two simulators of one model, scheme and tolerance together."""

    def __init__(self, first: Simulator, second: Simulator) -> None:
        assert first.model is second.model
        assert first.scheme is second.scheme
        assert first.tolerance == second.tolerance
        assert isinstance(first.scheme, Scheme)
        self.first, self.second, self._scheme = first, second, first.scheme
        self._times = first.scheme.times * first.scheme.dt
        self._key: Key = ((), ())  # sections that the buffers are for
        self._buffers: PairBuffers | None = None
        stages, m = first.scheme.stages, first.model.unknown_count
        self._found, self._alive = np.empty((2, stages, m)), np.ones(2, np.bool_)

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
            return self._part(a, b, t, self._scheme, inputs_a, inputs_b, record)
        trials = a.copy(), b.copy()
        for trial in trials:
            trial.forget_history()
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
        found, alive = self._found, self._alive
        # a step may be too short to renew all columns: the next one begins at another
        column = scheme.stages * round(t / self.first.scheme.dt) % model.unknown_count
        runs = a.arrays(self.first.parameters), b.arrays(self.second.parameters)
        sweeps, jacobians = advance_both(
            model.kind, mesh, scheme.coefficients, self._buffers, runs, (rows_a, rows_b), found, (a.usable, b.usable), column, alive
        )  # fmt: skip
        if not (sweeps and alive[0] and alive[1]):
            a.usable, b.usable = a.usable and bool(alive[0]), b.usable and bool(alive[1])
            return None
        a.usable = b.usable = True  # the spare lanes keep the Jacobians so
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

    def _make(self, mesh: Mesh) -> PairBuffers:
        """Buffers for the sections of ``mesh``."""
        model = self.first.model
        batch, solver = (
            model.sweep_buffers(mesh, PAIR_LANES.count),
            model.shooting_solver(mesh, self.first.tolerance),
        )
        fields = len(solver.single.history) + len(solver.single.base_history)
        return PairBuffers(batch, solver, np.empty((2, fields)))
