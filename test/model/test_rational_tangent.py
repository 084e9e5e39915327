"""Columns by partial fractions against a NumPy twin."""

import numpy as np
import pytest
from model_cases import make_robot, make_tube

from ctr_dynamics.kernels.complex_linearise import complex_unknown_lanes
from ctr_dynamics.kernels.complex_rates import COMPLEX
from ctr_dynamics.kernels.kinds import SIMD_WIDTH, Lanes, lanes_for, unknown_lanes
from ctr_dynamics.kernels.linearise import linearise
from ctr_dynamics.kernels.structures import (
    Derivatives,
    FiniteDifferences,
    PartialFractions,
    RationalBuffers,
    Solution,
    SolvedStep,
)
from ctr_dynamics.kernels.tangent import rational_tangent
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.simulator import Inputs, Simulator

STEP = 0.006
FRACTION = PartialFractions(3.6, 4.0, 2.7 + 3.0j, -3.0 + 1.5j)
ZERO = np.zeros(2)


def robot(damping):
    inner = make_tube(
        segments=((0.10, (0.0, 0.0, 0.0)), (0.10, (6.0, 2.0, 0.0))), mass=0.002, inertia=(1e-8, 1e-8, 1e-8),
        bending_damping=damping * 4.5e-4, torsion_damping=damping * 4.5e-4,
    )  # fmt: skip
    outer = make_tube(
        0.7e-3, 0.9e-3, segments=((0.06, (0.0, 0.0, 0.0)), (0.06, (4.0, 0.0, 0.0))),
        bending_damping=damping * 2e-3, torsion_damping=damping * 2e-3,
    )  # fmt: skip
    return make_robot(
        [inner, outer],
        [-0.06, -0.05],
        gravity=(0.0, -9.81, 0.0),
        base=(0.2, 1e-5),
        between=(0.01, 1e-6),
    )


def moving(t):
    return Inputs(
        np.array([0.3 + 2.0 * t, -0.5 - 3.0 * t]),
        np.array([2.0, -3.0]),
        np.array([-0.06, -0.05]),
        ZERO,
        np.array([0.0, 0.02, 0.0]),
        np.zeros(3),
    )


@pytest.mark.parametrize(
    ("damping", "extended"), [(0.0, False), (2e-4, False), (2e-4, True)], ids=["plain", "damped", "extended"]
)
def test_partial_fractions_are_the_rational_function_of_the_linearised_dynamics(damping, extended):
    """The twin knows M = (mu - A)^-1 mu at one real mu, column by column, and finds R(h A) from it in complex numbers."""
    model = Model(robot(damping), nodes=5, base_cells=1, extended=extended)
    simulator = Simulator(model, tolerance=1e-11)
    state = simulator.rest(moving(0.0))
    for k in range(4):
        result = simulator.step(state, 0.003 * k, moving, record=True)
        assert result.ok
    record, n, m = result.records[-1], model.n, model.unknown_count
    fields, mu = len(record.after), FRACTION.real_pole / STEP
    parameters = model.parameters.copy()
    layout, last = model.layout, record.inputs[-1]
    for name, rows in (
        ("alpha", slice(0, n)),
        ("alpha_rate", slice(n, 2 * n)),
        ("beta", slice(2 * n, 3 * n)),
    ):
        parameters[layout[name]] = last[rows]
    parameters[layout["force"]] = last[3 * n : 3 * n + 3]
    kinds = FiniteDifferences(1e-5, 1e3 * model.tangent_perturbation)

    rng = np.random.default_rng(5)
    columns = 11  # a whole batch and a part of one
    stiffer = np.zeros((layout.size, columns))
    stiffer[layout["bending_stiffness"].start, :] = (
        0.05 * rng.normal(size=columns) * parameters[layout["bending_stiffness"].start]
    )
    dy = 0.1 * rng.normal(size=(fields, columns))

    def implicit(dparameters, dfields):
        """((mu - A)^-1 (mu dy + B dp), the tip's columns) by the real kernel."""
        count = dfields.shape[1]
        lanes = lanes_for(1 + m + count)
        buffers = model.sweep_buffers(record.mesh, lanes.count)
        history = record.rates[-1] - mu * record.after
        main = len(buffers.history) // lanes.count
        found = Derivatives(
            np.zeros((m, m)), np.zeros((m, count)), np.zeros((fields, count)), np.zeros((state.nodes.size, count))
        )  # fmt: skip
        solution = Solution(parameters, record.found[-1], history[:main], history[main:])
        assert linearise(
            model.kind, lanes, mu, record.mesh, solution, dparameters, -mu * dfields, kinds, buffers, found
        )  # fmt: skip
        return found.fields, found.nodes

    M = implicit(np.zeros((layout.size, fields)), np.eye(fields))[0]
    forced = implicit(stiffer, np.zeros((fields, columns)))[0]  # (mu - A)^-1 B dp
    expected = np.zeros((fields, columns))
    for pole, weight in (
        (FRACTION.real_pole, FRACTION.real_weight),
        (FRACTION.complex_pole, FRACTION.complex_weight),
    ):
        c = pole / STEP
        # c - A = (c - mu) + mu M^-1, so (c - A)^-1 (c dy + B dp) = ((c - mu) M + mu)^-1 (c M dy + mu (mu - A)^-1 B dp)
        v = np.linalg.solve((c - mu) * M + mu * np.eye(fields), c * M @ dy + mu * forced)
        expected += (weight * v).real

    counts = (
        1,
        unknown_lanes(model.kind).count + SIMD_WIDTH,
        complex_unknown_lanes(model.kind).count,
        COMPLEX.count,
    )
    buffers = RationalBuffers(
        *(model.sweep_buffers(record.mesh, count) for count in counts), np.zeros((fields, columns))
    )
    nodes = np.zeros((state.nodes.size, columns))
    found = Derivatives(np.zeros((m, m)), np.zeros((m, columns)), np.zeros((fields, columns)), nodes)
    done = SolvedStep(
        model.parameters.copy(), record.inputs, record.found, record.before, record.rates, record.after
    )
    assert rational_tangent(
        model.kind, Lanes(counts[1], SIMD_WIDTH), record.mesh, FRACTION, STEP, done, stiffer, dy, kinds, buffers, found
    )  # fmt: skip
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found.fields, expected, atol=5e-4 * scale)
