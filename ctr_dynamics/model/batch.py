"""Many simulations at once: one case in every lane of the same sweeps, for ensembles and studies.

Cases share the robot's tubes, the mesh's sections and the time scheme; parameters, actuators, loads and histories are their own. Lanes iterate
together until the last one has converged. A case that meets a hard step, or whose sections change, leaves the batch and is simulated alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ctr_dynamics.errors import InputError
from ctr_dynamics.kernels.batched_steps import advance_batch
from ctr_dynamics.kernels.kinds import lanes_for
from ctr_dynamics.kernels.layout import RATES, input_rows
from ctr_dynamics.kernels.structures import Cases, RunArrays
from ctr_dynamics.kernels.time_step import EARLIER
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator, State
from ctr_dynamics.model.time_scheme import Scheme
from ctr_dynamics.model.trajectory import (
    CHUNK,
    TIP_ROWS,
    InputRows,
    Trajectory,
    run,
    to_inputs,
    while_fitting,
)

Floats = NDArray[np.float64]
LANES = 8  # cases in one batch: one pack, so that none waits for many
LIMIT = 40  # iterations of a stage


def run_many(
    model: Model,
    scheme: Scheme,
    parameters: Floats,
    inputs: Sequence[InputRows],
    duration: float,
    *,
    tolerance: float = 1e-7,
    lanes: int = LANES,
) -> list[Trajectory]:
    """Simulate many cases from rest, ``lanes`` at once.

    Args:
        parameters: (B, NP) blocks of the cases. inputs: of each case, rows at times (k,) s as for :func:`ctr_dynamics.model.trajectory.run`.
        tolerance: largest scaled residual at the tip.
    Returns:
        What :func:`~ctr_dynamics.model.trajectory.run` would return for each case, to within ``tolerance``; a case without an equilibrium to
        start from has a failure and no steps.
    """
    results: list[Trajectory | None] = [None] * len(inputs)
    for first in range(0, len(inputs), lanes):
        cases = list(range(first, min(first + lanes, len(inputs))))
        for case, found in zip(
            cases,
            _batch(model, scheme, parameters[cases], [inputs[c] for c in cases], duration, tolerance, lanes),
            strict=True,
        ):
            results[case] = found or _alone(
                model, scheme, parameters[case], inputs[case], duration, tolerance
            )
    return [r for r in results if r is not None]


def _alone(
    model: Model, scheme: Scheme, parameters: Floats, inputs: InputRows, duration: float, tolerance: float
) -> Trajectory:
    try:
        return run(model, scheme, parameters, inputs, duration, tolerance=tolerance)
    except InputError as error:
        return Trajectory(np.zeros(0), np.zeros((0, TIP_ROWS)), None, str(error))


def _batch(
    model: Model,
    scheme: Scheme,
    parameters: Floats,
    inputs: Sequence[InputRows],
    duration: float,
    tolerance: float,
    width: int,
) -> list[Trajectory | None]:
    """Trajectories of at most ``width`` cases; None for those that have to be simulated alone."""
    n, m, stages, dt = model.n, model.unknown_count, scheme.stages, scheme.dt
    lanes = lanes_for(width)
    L = lanes.count
    starts: list[State | None] = []
    for block, rows in zip(parameters, inputs, strict=True):
        first = to_inputs(n, rows(np.zeros(1))[0])
        rest = Inputs(first.alpha, np.zeros(n), first.beta, np.zeros(n), first.force, first.torque)
        try:
            starts.append(Simulator(model, scheme, tolerance, block).rest(rest))
        except InputError:
            starts.append(None)
    leader = next((s for s in starts if s is not None), None)
    if leader is None or len(inputs) == 1:
        return [None] * len(inputs)
    usable = np.array([s is not None and s.key == leader.key for s in starts] + [False] * (L - len(inputs)))
    # lanes without a case of their own repeat the leader
    own = [s if s is not None and ok else leader for s, ok in zip(starts, usable, strict=False)]
    own += [leader] * (L - len(own))
    number = starts.index(leader)
    source = [j if usable[j] else number for j in range(L)]
    mesh = leader.mesh
    batch, solver = model.sweep_buffers(mesh, L), model.shooting_solver(mesh, tolerance, limit=LIMIT)
    batch.parameters[:] = np.stack([parameters[j] for j in source], axis=1).ravel()
    bank = np.stack([s.bank for s in own], axis=2).reshape(RATES + stages, -1)
    unknowns = np.stack([s.unknowns for s in own], axis=2).reshape(stages, -1)
    nothing = np.zeros((0, 0))  # the parameters, Jacobians and nodes of the cases lie elsewhere
    run_arrays = RunArrays(
        nothing[0:0].ravel(), bank, unknowns, np.stack([unknowns] * EARLIER), nothing, nothing
    )
    cases = Cases(
        np.empty(m * L), np.zeros((L, m, m)), np.ones(L, bool), usable.copy(), np.zeros(L, np.int64)
    )
    alive = cases.alive
    unit = np.repeat(model.perturbation, L)
    steps = int(np.floor(duration / dt + 1e-9))
    tips = np.zeros((steps + 1, TIP_ROWS, L))
    tips[0] = np.stack([s.nodes[-1, :TIP_ROWS] for s in own], axis=1)
    sweeps = 0
    for k in range(0, steps, CHUNK):
        count = min(CHUNK, steps - k)
        times = (np.arange(k, k + count)[:, None] + scheme.times) * dt
        given = [rows(times.ravel()).reshape(count, stages, -1) for rows in inputs]
        for j in range(len(inputs)):
            beta = given[j][:, -1, input_rows(n)["beta"]]
            moves = not np.all(beta == own[j].inputs.beta)
            if moves and (model.moving_precurvature or while_fitting(model, leader.key, beta) < count):
                alive[j] = False
        rows_now = np.stack([given[j] for j in source], axis=3)
        sweeps += advance_batch(
            model.kind, lanes, mesh, scheme.coefficients, batch, solver, rows_now, run_arrays, unit, cases, tips[k + 1 : k + 1 + count]
        )  # fmt: skip
        if not alive.any():
            break
    t = dt * np.arange(steps + 1, dtype=np.float64)
    return [
        Trajectory(t, tips[:, :, j].copy(), None, sweeps=sweeps) if alive[j] else None
        for j in range(len(inputs))
    ]
