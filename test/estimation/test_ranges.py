"""Parameters that the filter finds: far from the robot file's values where the data say so, and never where no robot can be."""

from dataclasses import replace

import numpy as np
import pytest
from estimation_cases import bag_messages, estimator, play, rms, truth_error

from ctr_dynamics.estimation.filter.parameter_priors import model_uncertainty


@pytest.fixture
def ekf():
    """The filter of a clean bag after half a second, which knows of parameters and tracker states together."""
    return play(bag_messages("clean_sweep", 0.5)).estimator.runs.fused.ekf


def parameter(ekf, name):
    return ekf.uncertainty.names.index(name)


def nearest(covariance, row, value):
    """The x nearest to 0 in the norm of the inverse ``covariance`` with row x = value, by the conditions of Karush, Kuhn and Tucker."""
    known = (
        covariance.diagonal() > 0.0
    )  # what has no variance stays: the model error of a robot whose file states none
    size = int(known.sum())
    system = np.zeros((size + 1, size + 1))
    system[:size, :size] = np.linalg.inv(covariance[np.ix_(known, known)])
    system[:size, size] = system[size, :size] = row[known]
    x = np.zeros(len(row))
    x[known] = np.linalg.solve(system, np.append(np.zeros(size), value))[:size]
    return x


def test_a_parameter_at_the_end_of_its_range_takes_the_rest_along(ekf):
    u, rows = ekf.uncertainty, ekf.factor.theta
    r = rows.shape[1]
    i = parameter(ekf, "base_viscous")
    gain = ekf.pi[:, :r] @ rows[i]
    x = gain * (-3.0 / (rows[i] @ gain[:r]))  # three times less than nothing
    assert (ekf.theta + rows @ x[:r])[i] < u.lowest[i] - 1.0
    moved = u.confined(x, ekf.theta, rows, ekf.pi)
    theta = ekf.theta + rows @ moved[:r]
    assert theta[i] == pytest.approx(u.lowest[i], abs=1e-9)
    row = np.append(rows[i], np.zeros(len(x) - r))
    wanted = x + nearest(ekf.pi, row, u.lowest[i] - ekf.theta[i] - rows[i] @ x[:r])
    np.testing.assert_allclose(moved, wanted, atol=1e-6 * np.abs(wanted).max())
    assert np.all(theta >= u.lowest - 1e-9)
    assert np.all(theta <= u.highest + 1e-9)


def test_corrections_inside_the_ranges_are_left_alone(ekf):
    x = 0.1 * np.ones(len(ekf.pi))
    confined = ekf.uncertainty.confined(x, ekf.theta, ekf.factor.theta, ekf.pi)
    np.testing.assert_array_equal(confined, x)


def test_ranges_are_those_of_a_robot(ekf):
    u = model_uncertainty(ekf.model)
    at = dict(zip(u.names, zip(u.lowest, u.highest, strict=True), strict=True))
    mass = ekf.model.robot.tubes[0].end_body.mass.value
    assert at["youngs_modulus.tube1"] == (-0.9, 9.0)
    assert at["payload_mass.tube1"] == pytest.approx((-0.9 * mass, 9.0 * mass))
    assert at["encoder_offset.tube2"] == (-0.5, 0.5)
    assert at["tip_force.x"] == (-np.inf, np.inf)
    for end in (u.lowest, u.highest):
        finite = np.where(np.isfinite(end), end, 0.0)
        for name in (
            "bending_stiffness",
            "torsional_stiffness",
            "body_mass",
            "base_viscous",
            "mass_per_length",
        ):
            rows = ekf.model.layout[name]
            assert np.all((ekf.nominal + u.effect @ finite)[rows] >= 0.0), name


def test_an_encoder_that_is_twenty_deviations_off_is_found():
    off = 0.035
    messages = []
    for m in bag_messages("clean_sweep", 6.0):
        if m.kind == "joints":
            names, values = m.content
            shown = [v - off * (name == "tube2_rotation") for name, v in zip(names, values, strict=True)]
            m = replace(m, content=(names, shown))
        messages.append(m)
    run = play(messages)
    ekf = run.estimator.runs.fused.ekf
    i = parameter(ekf, "encoder_offset.tube2")
    assert off > 19 * ekf.uncertainty.sigma[i]
    assert ekf.theta[i] == pytest.approx(off, abs=0.2 * off)
    error, _ = truth_error(run, "clean_sweep", "p_trk")
    late = rms(error[len(error) // 2 :])
    assert 1e3 * late < 0.4
    wrong, _ = truth_error(play(messages, {"filter.enabled": "false"}), "clean_sweep", "p_trk")
    assert rms(wrong[len(wrong) // 2 :]) > 5 * late
    assert estimator().runs.fused.ekf.theta[i] == 0.0
