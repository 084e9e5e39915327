"""The gate, and the inflation of the covariance after several rejections in a row."""

import numpy as np
import pytest

from ctr_dynamics.estimation.filter.adapted_variances import FORCE_PART, AdaptedVariances, ForceRange
from ctr_dynamics.estimation.filter.gating import Gate, GateOptions

R = 1e-6 * np.eye(2)
H = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 1.0]])  # two coefficients, one tracker state


@pytest.fixture
def gate():
    return Gate(GateOptions())


def force_of(part, most=1.0):
    force = AdaptedVariances(ForceRange(1e-3, most, 20.0), 2e-4, 0.1)
    force.start(np.diag([part, 0.0, 0.0]), slice(0, 1))
    return force


def nis(nu, pi):
    return float(nu @ np.linalg.solve(H @ pi @ H.T + R, nu))


def test_the_gate_holds_the_probability_that_it_is_given():
    gate = Gate(GateOptions(probability=0.95))
    rng = np.random.default_rng(0)
    for dof in (1, 3, 6):
        drawn = rng.chisquare(dof, 20_000)
        inside = np.mean([not gate.outside(value, dof) for value in drawn])
        assert inside == pytest.approx(0.95, abs=0.01)


def test_the_covariance_is_inflated_ever_more_seldom(gate):
    inflated = []
    for number in range(1, 200):
        gate.count(True)
        if gate.recovers:
            inflated.append(number)
    assert inflated == [2, 4, 8, 16, 32, 64, 96, 128, 160, 192]
    gate.count(False)
    gate.count(True)
    assert not gate.recovers


def test_an_inflation_makes_the_measurement_plausible_and_leaves_the_tracker_states(gate):
    pi = np.diag([1e-6, 1e-6, 1e-6])
    force = force_of(1e-6, most=1e-3)  # no headroom: all of it is done by the coefficients
    nu = np.array([0.05, -0.03])
    inflated = gate.inflate(nu, H, R, pi, 2, force)
    assert inflated is not None
    assert nis(nu, inflated) <= gate.limits[2]
    assert inflated[2, 2] == pi[2, 2]
    ratio = inflated[0, 0] / pi[0, 0]
    assert inflated[1, 1] / pi[1, 1] == pytest.approx(ratio)
    assert force.parts[FORCE_PART, 0, 0] == pytest.approx(1e-6 * ratio)


def test_the_force_is_raised_first(gate):
    pi, force = np.diag([1e-6, 1e-6, 1e-6]), force_of(1e-6)
    nu = np.array([0.012, 0.0])
    inflated = gate.inflate(nu, H, R, pi, 2, force)
    assert nis(nu, inflated) <= gate.limits[2]
    assert inflated[1, 1] == pi[1, 1]
    assert force.sigma > 1e-3
    np.testing.assert_allclose(inflated - pi, force.parts[FORCE_PART] - np.diag([1e-6, 0.0, 0.0]), atol=1e-12)


def test_a_measurement_beyond_the_size_of_a_robot_changes_nothing(gate):
    pi, force = np.diag([1e-6, 1e-6, 1e-6]), force_of(1e-6)
    before = force.checkpoint()
    assert gate.inflate(np.array([300.0, 0.0]), H, R, pi, 2, force) is None
    np.testing.assert_array_equal(pi, np.diag([1e-6, 1e-6, 1e-6]))
    assert force.sigma == before.sigma
    np.testing.assert_array_equal(force.parts, before.parts)
