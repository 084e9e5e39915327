"""Robots that differ from their files: what is found, what it is worth, and what is written."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from ctr_dynamics.calibration.calibration_report import lines, robot_text
from ctr_dynamics.calibration.model_error import model_error_of
from ctr_dynamics.calibration.robot_calibration import calibrate, calibrated_robot, split
from ctr_dynamics.calibration.tip_fit import Coordinate, TipFit, TipModel, fit_tips
from ctr_dynamics.cli.main import main
from ctr_dynamics.diagnosis.inference.recalibration import nuisances_of
from ctr_dynamics.errors import InputError
from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict, robot_to_yaml
from test.calibration.calibration_cases import tips_of

NOISE = 1e-4
SCALE = 1.06


@pytest.fixture(scope="module")
def robot():
    """A robot whose precurvatures are known to 5 percent."""
    data = robot_to_dict(load_robot("three_tube"))
    for tube in data["tubes"]:
        for segment in tube["precurvature"]:
            own = segment["curvature"]
            own["tolerance"] = [0.05 * abs(v) for v in own["value"]]
    return robot_from_dict(data)


@pytest.fixture(scope="module")
def true(robot):
    """The same, with the innermost tube more curved than its file says."""
    data = robot_to_dict(robot)
    for segment in data["tubes"][0]["precurvature"]:
        segment["curvature"]["value"] = [SCALE * v for v in segment["curvature"]["value"]]
    return robot_from_dict(data)


@pytest.fixture(scope="module")
def found(robot, true):
    return calibrate(robot, tips_of(true, lag=0.05, noise=NOISE))


def test_held_out_tips_are_met_to_the_noise(found):
    assert found.after.rms < 2.0 * NOISE * np.sqrt(3.0)
    assert found.after.rms < 0.2 * found.before.rms
    assert found.before.count == found.after.count == 80


def test_the_parameter_that_was_off_is_found(found):
    key = ("precurvature", "tube1.scale")
    assert abs(found.fit.point[key] - SCALE) < 4.0 * found.fit.deviations()[key]
    assert abs(found.fit.point[key] - SCALE) < 0.02


def test_deviations_are_no_larger_than_the_priors(found):
    priors = np.array([c.prior for c in found.fit.coordinates])
    assert np.all(found.fit.sigma <= priors * (1.0 + 1e-9))


def test_the_file_holds_what_was_fitted(found, tmp_path):
    path = tmp_path / "new.yaml"
    path.write_text(robot_text(found, False))
    new = load_robot(path)
    assert new == found.robot
    assert "Held-out tips after" in path.read_text()
    assert new.tracker.delay.value == pytest.approx(found.fit.point["tracker_latency", "delay_s"])


@pytest.mark.parametrize("tolerance", [0.0, 0.02])
def test_offsets_of_the_file_before_are_kept(robot, tolerance):
    """An offset that the file has already is part of the new one: a fit that changes nothing, or has no offset free, must keep it."""
    data = robot_to_dict(robot)
    data["extensions"]["encoder_offset"] = {"tube2.offset_rad": 0.02}
    data["encoders"]["offset"]["tolerance"] = tolerance
    with_offset = robot_from_dict(data)
    quantities = [q for q in nuisances_of(with_offset) if q.effect == "encoder_offset"]
    count = len(quantities)
    none = TipFit(
        tuple(Coordinate.of(q) for q in quantities), np.zeros(count), 1e-4 * np.eye(count), np.zeros((0, 6)), np.ones(2), 1.0, None
    )  # fmt: skip
    new = calibrated_robot(with_offset, none, "")
    assert new.extensions["encoder_offset"]["tube2.offset_rad"] == pytest.approx(0.02)
    assert new.extensions["encoder_offset"].get("tube1.offset_rad", 0.0) == 0.0


def test_errors_that_last_count_for_less(robot, true):
    """Slow errors beside the noise: the same tips say less, and the deviations are larger."""
    clean = tips_of(true, noise=NOISE)
    slow = 1e-3 * np.sin(2 * np.pi * clean.stamps[:, None] / 5.0 + np.array([0.0, 1.0, 2.0]))
    quantities = [Coordinate.of(q) for q in nuisances_of(robot) if q.effect == "precurvature"]
    sigma = []
    for position in (clean.position, clean.position + slow):
        tips = type(clean)(**{**clean.__dict__, "position": position})
        fit = fit_tips(TipModel(robot, tips), quantities)
        sigma.append(fit.sigma[0])
        assert abs(fit.point["precurvature", "tube1.scale"] - SCALE) < 4.0 * fit.sigma[0]
    assert fit.lasting > 3.0
    assert sigma[1] > 3.0 * sigma[0]


def test_what_the_model_gets_wrong_is_measured_and_written(robot, true, found):
    """A departure that no parameter explains: its size and its time are those of what is left on held-out tips."""
    assert found.robot.model_error is None  # noise explains all that is left
    clean = tips_of(true, noise=NOISE)
    slow = 1e-3 * np.sin(2 * np.pi * clean.stamps[:, None] / 2.0 + np.array([0.0, 1.0, 2.0]))
    departed = calibrate(robot, replace(clean, position=clean.position + slow))
    error = departed.robot.model_error
    assert error.position.value == pytest.approx(1e-3 / np.sqrt(2.0), rel=0.2)
    assert error.rotation.value < 1e-2
    # 1 + 2 sum rho up to the first zero of a sine of the period T is T / pi in time, and half of that is written
    assert error.time.value == pytest.approx(1.0 / np.pi, rel=0.3)
    assert robot_from_dict(robot_to_dict(departed.robot)) == departed.robot
    assert "model error" in "".join(lines(departed))


def test_the_drift_of_the_tracker_is_no_model_error(robot, true):
    """The estimator has a state for it beside the model's error."""
    clean = tips_of(true, noise=NOISE)
    residual = np.zeros((len(clean.stamps), 6))
    residual[:, :3] = 1e-3 * np.sin(2 * np.pi * clean.stamps[:, None] / 2.0 + np.array([0.0, 1.0, 2.0]))
    found = []
    for drift in (0.0, 4e-4, 8e-4):
        data = robot_to_dict(robot)
        data["tracker"]["noise"]["position"]["value"] = NOISE
        data["tracker"]["noise"]["drift"]["value"] = drift
        found.append(model_error_of(residual, clean, robot_from_dict(data)))
    without, some, all_of_it = found
    assert some.position.value**2 == pytest.approx(without.position.value**2 - 4e-4**2)
    assert all_of_it is None


def test_a_table_without_times_tells_no_model_error(robot, true):
    tips = replace(tips_of(true, noise=NOISE), timed=False)
    shifted = replace(tips, position=tips.position + 1e-3 * np.sin(np.arange(len(tips.stamps)))[:, None])
    assert calibrate(robot, shifted).robot.model_error is None


def test_split_by_time_and_of_tables(robot):
    tips = tips_of(robot)
    seen, unseen = split(tips, 8.0)
    assert seen.stamps.max() <= 8.0 < unseen.stamps.min()
    with pytest.raises(InputError, match="held out"):
        split(tips, 1e6)
    table = type(tips)(**{**tips.__dict__, "timed": False})
    assert len(split(table, None)[1].stamps) == len(tips.stamps) // 3
    with pytest.raises(InputError, match="no times"):
        split(table, 8.0)


def write_table(path, tips, oriented=True):
    names = [f"beta{i}" for i in (1, 2, 3)] + [f"alpha{i}" for i in (1, 2, 3)] + ["tip_x", "tip_y", "tip_z"]
    names += ["qw", "qx", "qy", "qz"] if oriented else []
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(names)
        for joints, p, q in zip(tips.joints, tips.position, tips.quaternion, strict=True):
            writer.writerow([*joints[4:], *joints[1:4], *p, *(q if oriented else ())])


def test_statics_measured_on_a_table(robot, true, tmp_path, capsys):
    """The figures on the screen are those of the tips in the table."""
    (tmp_path / "r.yaml").write_text(robot_to_yaml(robot))
    tips = tips_of(true).thinned(40)
    tips = type(tips)(
        **{**tips.__dict__, "joints": tips.joints[np.searchsorted(tips.joints[:, 0], tips.stamps)]}
    )
    write_table(tmp_path / "poses.csv", tips)
    arguments = ["--robot", str(tmp_path / "r.yaml"), "--measured", "--output", str(tmp_path / "out.csv")]
    assert main(["statics", "--poses", str(tmp_path / "poses.csv"), *arguments]) == 0
    out = capsys.readouterr().out
    with (tmp_path / "out.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(tips.stamps)
    measured = np.array([[float(row[f"measured_{a}"]) for a in "xyz"] for row in rows])
    expected = np.array([[float(row[f"expected_{a}"]) for a in "xyz"] for row in rows])
    assert np.allclose(measured, tips.position, atol=1e-8)
    size = np.linalg.norm(measured - expected, axis=1)
    assert np.allclose(size, [float(row["error"]) for row in rows], atol=1e-8)
    assert f"mean {1e3 * size.mean():.3f} mm" in out
    assert np.allclose(
        expected, tips_of(robot).position[np.isin(tips_of(robot).stamps, tips.stamps)], atol=1e-6
    )


def test_calibrate_a_table_by_the_command(robot, true, tmp_path, capsys):
    (tmp_path / "r.yaml").write_text(robot_to_yaml(robot))
    write_table(tmp_path / "poses.csv", tips_of(true, noise=NOISE), oriented=False)
    arguments = ["--robot", str(tmp_path / "r.yaml"), "--output", str(tmp_path / "n.yaml")]
    assert main(["calibrate", str(tmp_path / "poses.csv"), *arguments]) == 0
    curve = load_robot(tmp_path / "n.yaml").tubes[0].precurvature[-1].curvature.array
    assert np.allclose(curve, SCALE * robot.tubes[0].precurvature[-1].curvature.array, rtol=0.02)
    shown = capsys.readouterr()
    assert "held out       80" in shown.out
    assert not shown.err
    moved = "tracker.registration_translation_m=0,0,1e-5"
    assert main(["calibrate", str(tmp_path / "poses.csv"), *arguments, "--set", moved]) == 0
    assert "do not give them with it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda text: text.replace("tip_z", "height", 1), "tip_z"),
        (lambda text: text.replace("qw", "scalar", 1), "qw"),
    ],
)
def test_columns_that_are_missing_are_named(robot, tmp_path, capsys, change, says):
    (tmp_path / "r.yaml").write_text(robot_to_yaml(robot))
    path = tmp_path / "poses.csv"
    write_table(path, tips_of(robot))
    path.write_text(change(path.read_text()))
    code = main(
        ["calibrate", str(path), "--robot", str(tmp_path / "r.yaml"), "--output", str(tmp_path / "n.yaml")]
    )
    assert code == 2
    assert f"'{says}' is missing" in capsys.readouterr().err
