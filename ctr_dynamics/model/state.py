"""What lives between the steps of a simulation, what drives them, and what a step leaves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from operator import is_not
from typing import NamedTuple

import numpy as np

from ctr_dynamics.kernels.layout import Y_NOW, input_rows, unknown_rows
from ctr_dynamics.kernels.shooting import CONVERGED, NOT_FINITE
from ctr_dynamics.kernels.structures import CollocationRun, RunArrays, SystemFactors
from ctr_dynamics.model.mesh import Mesh
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.time_scheme import Collocation, Scheme

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

    scheme: Scheme | Collocation
    key: tuple
    mesh: Mesh
    before: np.ndarray
    after: np.ndarray
    rates: np.ndarray
    inputs: np.ndarray
    found: np.ndarray
    times: np.ndarray


def at_inputs(model: Model, parameters: np.ndarray, now: Inputs) -> np.ndarray:
    """The parameter block (NP,) ``parameters`` with the actuators, standing, and the load of ``now``."""
    par, layout = parameters.copy(), model.layout
    par[layout["alpha"]], par[layout["beta"]], par[layout["alpha_rate"]] = now.alpha, now.beta, 0.0
    par[layout["force"]], par[layout["torque"]] = now.force, now.torque
    return par


OWN_ARRAYS = ("bank", "unknowns", "earlier", "inverse", "nodes", "times")  # of a state, which it writes to


@dataclass
class State:
    """Everything that lives between steps; :meth:`copy` makes an independent one.

    ``bank``: stored fields, those of now first. Of schemes that solve their stages one by one, ``unknowns`` (stages, 5 + N) are of the last step and
    ``earlier`` (EARLIER, stages, 5 + N) of those before. Of collocation ``unknowns`` (K, mt) are of the last stages, the newest last, at their
    ``times`` (K,) s, of which the last ``known`` tell what comes next; ``earlier`` is empty. Since there is its Jacobian, ``fewest`` sweeps have been
    wanted by a step, and ``beyond`` those by all steps.
    """

    key: tuple
    mesh: Mesh
    bank: np.ndarray
    unknowns: np.ndarray
    earlier: np.ndarray
    inverse: np.ndarray
    usable: bool
    nodes: np.ndarray
    inputs: Inputs
    times: np.ndarray = field(default_factory=lambda: np.zeros(0))
    known: int = 0
    fewest: int = 0
    beyond: int = 0
    _arrays: RunArrays | None = field(default=None, repr=False, compare=False)
    _run: tuple[tuple[np.ndarray, ...], CollocationRun] | None = field(
        default=None, repr=False, compare=False
    )

    def copy(self) -> State:
        """An independent copy; meshes are shared, they are never written."""
        return State(
            self.key, self.mesh, self.bank.copy(), self.unknowns.copy(), self.earlier.copy(), self.inverse.copy(), self.usable,
            self.nodes.copy(), self.inputs, self.times.copy(), self.known, self.fewest, self.beyond,
        )  # fmt: skip

    def copy_into(self, room: State | None) -> State:
        """An independent copy, in the arrays of ``room`` where those are as large; it is nobody else's then."""
        if room is None or any(getattr(room, name).shape != getattr(self, name).shape for name in OWN_ARRAYS):
            return self.copy()
        for name in OWN_ARRAYS:
            getattr(room, name)[:] = getattr(self, name)
        room.key, room.mesh, room.usable, room.inputs = self.key, self.mesh, self.usable, self.inputs
        room.known, room.fewest, room.beyond = self.known, self.fewest, self.beyond
        return room

    def become(self, other: State) -> None:
        """Take over all that ``other`` holds, to go on with a fresh Jacobian."""
        for name in (
            "key",
            "mesh",
            "bank",
            "unknowns",
            "earlier",
            "inverse",
            "nodes",
            "inputs",
            "times",
            "known",
        ):
            setattr(self, name, getattr(other, name))
        self.usable = False

    def forget_history(self) -> None:
        """Look for the next unknowns where the last step ended."""
        self.unknowns[:] = self.unknowns[-1]
        self.earlier[:] = self.unknowns[-1]
        self.known = min(self.known, 1)

    def arrays(self, parameters: np.ndarray) -> RunArrays:
        """The arrays for the kernels, with the ``parameters`` (NP,) of the run; the same object while they are the same."""
        arrays = parameters, self.bank, self.unknowns, self.earlier, self.inverse, self.nodes
        if self._arrays is None or any(a is not b for a, b in zip(self._arrays, arrays, strict=True)):
            self._arrays = RunArrays(*arrays)
        return self._arrays

    def run(self, parameters: np.ndarray, factors: Callable[[np.ndarray], SystemFactors]) -> CollocationRun:
        """The arrays for the kernels of collocation, with ``factors`` of the flat ``inverse``; the same object while they are the same."""
        arrays = parameters, self.bank, self.inverse, self.nodes, self.unknowns, self.times
        if self._run is None or any(map(is_not, self._run[0], arrays)):
            run = CollocationRun(
                parameters,
                self.bank,
                factors(self.inverse),
                self.nodes.reshape(-1),
                self.unknowns,
                self.times,
            )
            self._run = arrays, run
        return self._run[1]

    @property
    def unknowns_at_base(self) -> np.ndarray:
        """(5 + N,) unknowns at s = 0+ after the last step."""
        newest: np.ndarray = self.unknowns[-1, : unknown_rows(len(self.inputs.beta)).size]
        return newest

    @property
    def fields(self) -> np.ndarray:
        """(fields,) q, omega, u, gamma at every point: the state of the PDE. A view: writing changes the state."""
        return self.bank[Y_NOW]


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
    given = input_rows(model.n)
    alpha, alpha_rate, beta, force, torque, beta_rate = (given[name] for name in given.names)
    rows = np.empty((len(times), model.input_count))
    for row, time in zip(rows, times, strict=True):
        now = inputs_at(time)
        row[alpha], row[alpha_rate], row[beta] = now.alpha, now.alpha_rate, now.beta
        row[force], row[torque] = now.force, now.torque
        if model.extended:
            row[beta_rate] = now.beta_rate
    return rows, now
