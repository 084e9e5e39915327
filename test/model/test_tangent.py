"""Tangent of a step against central differences of whole runs.

Initial fields, a parameter and an actuator angle.
"""

import numpy as np
import pytest

from ctr_dynamics.kernels.kinds import lanes_for
from ctr_dynamics.kernels.layout import RATES, input_rows
from ctr_dynamics.kernels.structures import Derivatives, FiniteDifferences, SolvedStep, TangentBuffers
from ctr_dynamics.kernels.tangent import step_tangent
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.robot_files import load_robot

DT, STEPS, COLUMNS = 0.003, 12, 8
BETA, STILL = np.array([-0.2521, -0.1977]), np.zeros(2)


def moving(t, turn=0.0, push=0.0):
    """Turning tubes, a load that falls off, `turn` rad added to tube 1 and `push` N to the load."""
    force = np.array([push, -0.3 * (t < 0.02), 0.0])
    return Inputs(
        np.array([1.57 + 0.5 * t + turn, 1.57 - 0.7 * t]),
        np.array([0.5, -0.7]),
        BETA,
        STILL,
        force,
        np.zeros(3),
    )


@pytest.mark.parametrize("scheme", ["sdirk3", "bdf_alpha"])
def test_tangent_of_steps_equals_finite_differences(scheme):
    model = Model(load_robot("till2020_tissue"), nodes=16)
    layout = model.layout
    stiffness, angle, force = (layout[k].start for k in ("bending_stiffness", "alpha", "force"))

    def simulator(stiffer=0.0):
        parameters = model.parameters.copy()
        parameters[stiffness] *= 1 + stiffer
        return Simulator(model, make_scheme(scheme, DT), parameters=parameters, tolerance=1e-12)

    start = simulator().rest(moving(0.0))
    for k in range(8):
        assert simulator().step(start, k * DT, moving).ok
    # a smooth direction in the fields: where they went
    direction = start.bank[0] - simulator().rest(moving(0.0)).bank[0]

    def run(along=0.0, stiffer=0.0, turn=0.0, push=0.0):
        sim, state, records = simulator(stiffer), start.copy(), []
        state.bank[:RATES] += along * direction
        for k in range(STEPS):
            result = sim.step(state, (8 + k) * DT, lambda t: moving(t, turn, push), record=True)
            assert result.ok
            records += result.records
        return state, records

    state, records = run()
    m, stages = model.unknown_count, make_scheme(scheme, DT).stages
    fields = state.bank.shape[1]
    columns = np.zeros((1, RATES + stages, fields, COLUMNS))
    columns[0, :RATES, :, 0] = direction
    parameters = np.zeros((layout.size, COLUMNS))
    parameters[stiffness, 1] = model.parameters[stiffness] * 0.01
    parameters[angle, 2] = 0.01
    parameters[force, 3] = 0.01
    lanes = lanes_for(1 + m + COLUMNS)
    sweep = model.sweep_buffers(state.mesh, lanes.count)
    buffers = TangentBuffers(
        sweep,
        np.zeros(sweep.history.size // lanes.count),
        np.zeros(sweep.base_history.size // lanes.count),
        np.zeros((RATES + stages, fields)),
        np.zeros((layout.size, COLUMNS)),
        np.zeros((0, COLUMNS)),
    )
    nodes = np.zeros((state.nodes.size, COLUMNS))
    result = Derivatives(np.zeros((m, m)), np.zeros((m, COLUMNS)), np.zeros((0, COLUMNS)), nodes)
    differences = FiniteDifferences(1e-6, 0.1 * model.perturbation)
    still = np.zeros((stages, input_rows(model.n).beta_rate, COLUMNS))
    for record in records:
        done = SolvedStep(
            model.parameters.copy(), record.inputs, record.found, record.before, record.rates, record.after
        )
        assert step_tangent(
            model.kind, lanes, record.mesh, record.scheme.coefficients, done, parameters, still, differences, buffers, columns, result
        )  # fmt: skip

    h = 1e-4
    for column, name, scale in (
        (0, "along", 1.0),
        (1, "stiffer", 0.01),
        (2, "turn", 0.01),
        (3, "push", 0.01),
    ):
        plus, minus = run(**{name: h * scale})[0], run(**{name: -h * scale})[0]
        expected = (plus.bank[0] - minus.bank[0]) / (2 * h)
        assert np.abs(columns[0, 0, :, column] - expected).max() < 2e-4 * np.abs(expected).max(), name
        shape = (plus.nodes - minus.nodes).ravel() / (2 * h)
        assert np.abs(nodes[:, column] - shape).max() < 2e-4 * np.abs(shape).max(), name
