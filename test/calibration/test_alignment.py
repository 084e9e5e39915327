"""Lag, registration and mount of trackers that are known."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from ctr_dynamics.calibration.alignment import align
from ctr_dynamics.calibration.alignment_report import file_text, lines, mismatch
from ctr_dynamics.errors import InputError
from ctr_dynamics.parameters import Settings, read_parameter_file
from ctr_dynamics.robot_files import load_robot, robot_with
from test.calibration.calibration_cases import tips_of

NOISE = 2e-4


@pytest.fixture(scope="module")
def robot():
    return load_robot("three_tube")


def turned(found, true):
    return (Rotation.from_rotvec(found) * true.inv()).magnitude()


@pytest.mark.parametrize("lag", [-0.23, 0.0, 0.117])
def test_the_lag_is_found_within_its_deviation(robot, lag):
    found = align(robot, tips_of(robot, lag=lag, noise=NOISE))
    assert abs(found.lag - lag) < 4.0 * found.lag_sigma
    assert found.lag_sigma < 0.02
    assert found.clock == pytest.approx(found.lag - robot.tracker.delay.value)


def test_an_unknown_registration_and_mount(robot):
    registration, mount = Rotation.from_rotvec([0.3, -2.0, 1.1]), Rotation.from_rotvec([0.2, 1.4, -0.6])
    shift = np.array([0.3, -0.8, 1.2])
    tips = tips_of(robot, lag=0.08, registration=registration, shift=shift, mount=mount, noise=NOISE)
    found = align(robot, tips, unknown_registration=True)
    assert abs(found.lag - 0.08) < 4.0 * found.lag_sigma
    assert turned(found.rotation, registration) < 4.0 * np.linalg.norm(found.rotation_sigma)
    assert turned(found.rotation, registration) < 0.05
    assert turned(found.mount, mount) < 4.0 * np.linalg.norm(found.mount_sigma)
    assert np.linalg.norm(found.translation - shift) < 4.0 * np.linalg.norm(found.translation_sigma)
    assert np.linalg.norm(found.translation - shift) < 0.01
    assert found.errors.rms < 2.0 * NOISE * np.sqrt(3.0)


def test_a_sensor_without_roll(robot):
    """The mount's turn about the tube stays unknown and is said to be; the rest is found."""
    tilt = Rotation.from_rotvec([0.15, -0.1, 0.0])
    found = align(robot, tips_of(robot, lag=0.1, mount=tilt, roll=False, noise=NOISE))
    axis = tilt.inv().apply([0.0, 0.0, 1.0])
    assert np.allclose(Rotation.from_rotvec(found.mount).inv().apply([0.0, 0.0, 1.0]), axis, atol=0.02)
    assert found.mount_sigma[2] > 1.0 > found.mount_sigma[0]
    assert "(not measured)" in "\n".join(lines(found))


def test_a_robot_off_its_file_does_not_pass_into_the_lag(robot):
    """Stiffness and curvature off by about a tolerance: the lag and its deviation still agree."""
    true = robot_with(
        robot,
        {
            "tubes[0].youngs_modulus": robot.tubes[0].youngs_modulus.value
            + robot.tubes[0].youngs_modulus.tolerance,
            "tubes[1].youngs_modulus": robot.tubes[1].youngs_modulus.value
            - robot.tubes[1].youngs_modulus.tolerance,
        },
    )
    found = align(robot, tips_of(true, lag=0.15, noise=NOISE))
    assert abs(found.lag - 0.15) < 4.0 * found.lag_sigma


def test_the_file_is_read_as_parameters(robot, tmp_path):
    mount = Rotation.from_rotvec([0.0, 1.2, 0.0])
    found = align(robot, tips_of(robot, lag=0.09, mount=mount, noise=NOISE))
    text, warning = file_text(found, Settings({"tracker.frame_id": "aurora"}), "ctr-dynamics align")
    assert not warning
    (tmp_path / "lab.yaml").write_text(text)
    values = read_parameter_file(tmp_path / "lab.yaml")
    assert values["tracker.frame_id"] == "aurora"
    assert values["tracker.delay_s"] == pytest.approx(found.clock, abs=1e-6)
    assert turned(values["tracker.mount_rotation_rad"], mount) < 0.05


def test_a_clock_that_is_too_far_off_is_no_delay(robot):
    found = align(robot, tips_of(robot, lag=0.6, noise=NOISE))
    text, warning = file_text(found, Settings(), "ctr-dynamics align")
    parameters = yaml.safe_load(text)["/ctr/estimator"]["ros__parameters"]["tracker"]
    assert "delay_s" not in parameters
    assert f"by {-found.clock:.4f} s" in warning
    assert "start_s" in warning


def test_another_robots_tips_are_no_alignment(robot):
    """Tips of a robot whose tubes are bent the other way lie on the other side of the base: no tolerance explains that."""
    last = [
        f"tubes[{i}].precurvature[{len(tube.precurvature) - 1}].curvature"
        for i, tube in enumerate(robot.tubes)
    ]
    bent = [tube.precurvature[-1].curvature.value for tube in robot.tubes]
    other = robot_with(
        robot, {path: tuple(-x for x in value) for path, value in zip(last, bent, strict=True)}
    )
    assert mismatch(align(robot, tips_of(robot, noise=NOISE))) == ""
    text = mismatch(align(robot, tips_of(other, noise=NOISE)))
    assert "another robot's file" in text
    assert "10 % of the robot's length" in text


def test_too_few_tips_are_refused(robot):
    tips = tips_of(robot).thinned(10)
    with pytest.raises(InputError, match="too few"):
        align(robot, tips)
