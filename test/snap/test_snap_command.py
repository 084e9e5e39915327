"""`ctr-dynamics snap`: files, options, exit codes, one-line errors."""

import csv
import json

import numpy as np
import pytest
import yaml
from snap_cases import EXAMPLE

from ctr_dynamics.cli.main import main
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_info import inspect
from ctr_dynamics.robot_files import load_robot, robot_to_dict
from ctr_dynamics.snap.experiment import Plan, Trajectory, robot_for_snap, run

SHORT = ("--duration", "1e-4", "--points", "120", "--cells", "4,4,3,6,4,2")


def columns(file):
    with file.open() as stream:
        header, *rows = csv.reader(stream)
    return header, rows


def test_files_of_a_short_run(tmp_path, capsys):
    out = tmp_path / "new" / "folder"
    assert main(["snap", "--robot", EXAMPLE, "--output", str(out), *SHORT]) == 0
    names = {
        "trajectory.csv",
        "scurve.csv",
        "peaks.csv",
        "summary.json",
        "theta_f.png",
        "scurve.png",
        "backbone.mcap",
    }
    assert {p.name for p in out.iterdir()} == names
    header, rows = columns(out / "trajectory.csv")
    tips = [f"{which}_tip_{axis}" for which in ("inner", "outer") for axis in "xyz"]
    assert header[:9] == ["t_s", "theta_b", "theta_f", *tips]
    assert len(rows) == 10
    assert float(rows[0][0]) == 1e-5
    assert float(rows[0][1]) == pytest.approx(3.5601, abs=1e-12)
    header, rows = columns(out / "scurve.csv")
    assert header[:2] == ["theta_b", "theta_f"]
    assert len(rows) == 120
    assert columns(out / "peaks.csv") == (["kind", "t_s", "theta_f"], [])
    summary = json.loads((out / "summary.json").read_text())
    assert summary["robot"] == EXAMPLE
    assert len(summary["robot_sha256"]) == 64
    assert summary["snap_predicted"]["theta_b"] == pytest.approx(3.573, abs=1e-3)
    assert summary["crossing"]["t_s"] is None
    shown = capsys.readouterr().out
    assert "snap predicted at" in shown
    report = inspect(out / "backbone.mcap")
    assert {t.name: t.ros_type for t in report.topics}["/ctr/snap/backbone"] == "nav_msgs/msg/Path"
    assert report.duration_s == pytest.approx(0.1, abs=0.01)  # a thousand times slower


def test_a_run_is_the_same_twice(tmp_path):
    for name in "ab":
        assert main(["snap", "--robot", EXAMPLE, "--output", str(tmp_path / name), *SHORT]) == 0
    for file in ("trajectory.csv", "scurve.csv", "peaks.csv", "backbone.mcap"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_options_reach_the_solver(tmp_path):
    arguments = [
        "--set",
        "tube_coulomb=0",
        "--set",
        "epsilon=100",
        "--dt",
        "2e-5",
        "--refine",
        "2",
        "--start",
        "3.0",
    ]
    assert main(["snap", "--robot", EXAMPLE, "--output", str(tmp_path), *arguments, *SHORT]) == 0
    _, rows = columns(tmp_path / "trajectory.csv")
    assert [float(row[0]) for row in rows] == pytest.approx([2e-5, 4e-5, 6e-5, 8e-5, 1e-4])
    assert float(rows[0][1]) == pytest.approx(3.0002)
    assert json.loads((tmp_path / "summary.json").read_text())["cells"] == [8, 8, 6, 12, 8, 4]


def test_extensions_of_the_robot_file_are_in_use(tmp_path):
    """A drive that gives way lets the base turn further before the snap."""
    data = robot_to_dict(load_robot(EXAMPLE))
    data["extensions"] = {
        "drivetrain_compliance": {"tube1.stiffness_Nm_per_rad": 0.3, "tube1.inertia_kgm2": 1.4e-9}
    }
    file = tmp_path / "soft.yaml"
    file.write_text(yaml.safe_dump(data))
    assert (
        main(["snap", "--robot", str(file), "--output", str(tmp_path / "out"), "--start", "3.6", *SHORT]) == 0
    )
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["snap_predicted"]["theta_b"] > 3.573 + 0.1
    assert summary["theta_f_start"] < 2.0


def test_transmission_length_changes_the_straight_length_only():
    robot, longer = load_robot(EXAMPLE), robot_for_snap(load_robot(EXAMPLE), {"beta1": -0.2136})
    assert longer.rest.beta.value == (-0.2136, 0.0)
    a, b = robot.tubes[0].breakpoints - 0.112, longer.tubes[0].breakpoints - 0.2136
    np.testing.assert_allclose(a[1:], b[1:], atol=1e-12)
    assert longer.sha256 == robot.sha256


def test_settings_of_a_robot():
    changed = robot_for_snap(
        load_robot(EXAMPLE),
        {"tube_coulomb": 0.001, "tube_viscous": 1e-7, "epsilon": 20.0, "tubes[0].youngs_modulus": 80e9},
    )
    friction = changed.friction
    assert (friction.tubes.coulomb.value, friction.tubes.viscous.value) == (0.001, 1e-7)
    assert friction.epsilon.value == 20.0
    assert changed.tubes[0].youngs_modulus.value == 80e9


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["--set", "tube_coulomb"], "NAME=VALUE"),
        (["--set", "tube_coulomb=much"], "not a number"),
        (["--set", "tube_coulomb=nan"], "finite"),
        (["--set", "tube_coulomb=-1"], "outside"),
        (["--set", "nonsense=1"], "not known"),
        (["--set", "beta1=112"], "outside"),
        (["--set", "epsilon=1", "--set", "epsilon=2"], "twice"),
        (["--dt", "0"], "dt 0 s"),
        (["--dt", "nan"], "dt nan s"),
        (["--duration", "-1"], "duration"),
        (["--refine", "0"], "--refine 0"),
        (["--points", "2"], "--points"),
        (["--cells", "1,2"], "counts of cells"),
        (["--cells", "a"], "not a list"),
        (["--scheme", "magic"], "not known"),
        (["--scheme", "sdirk3"], "stages"),
        (["--equations", "wrong"], "equations 'wrong' are not known"),
        (["--adaptive", "1e-6"], "longest step"),
        (["--start", "3.6"], "fold"),
        (["--robot", "nobody"], "neither"),
        (["--slower", "0"], "slower"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_code_2(arguments, match, tmp_path, capsys):
    short = [] if "--cells" in arguments else ["--cells", "4,4,3,6,4,2"]
    command = ["snap", "--robot", EXAMPLE, "--output", str(tmp_path), "--points", "100", *short, *arguments]
    if "--duration" not in arguments:
        command += ["--duration", "5e-5"]
    assert main(command) == 2
    captured = capsys.readouterr().err
    assert captured.count("\n") == 1
    assert match in captured


def test_failed_step_is_named_and_exit_code_1(tmp_path, capsys, monkeypatch):
    import ctr_dynamics.snap.experiment as experiment

    real = experiment.run

    def broken(robot, plan, progress=None):
        found = real(robot, plan, progress)
        assert isinstance(found, Trajectory)
        found.failure = "step to 0.000050 s failed: Newton's method did not converge"
        return found

    monkeypatch.setattr(experiment, "run", broken)
    assert main(["snap", "--robot", EXAMPLE, "--output", str(tmp_path), *SHORT]) == 1
    assert "step to 0.000050 s failed" in capsys.readouterr().err


def test_a_first_step_that_fails_leaves_the_start(tmp_path, capsys, monkeypatch):
    from ctr_dynamics.snap.solver import SnapSolver, Solved

    monkeypatch.setattr(SnapSolver, "step", lambda *_: Solved(False, "Newton's method gave up", 1, 1, 1.0))
    assert main(["snap", "--robot", EXAMPLE, "--output", str(tmp_path), "--start", "3.0", *SHORT]) == 1
    assert "Newton's method gave up" in capsys.readouterr().err
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["steps"], summary["theta_b_start"]) == (0, 3.0)
    assert columns(tmp_path / "trajectory.csv")[1] == []


def test_a_step_that_cannot_be_solved_ends_the_run():
    robot = load_robot(EXAMPLE)
    found = run(robot, Plan(3.0, rate=1e4, dt=1e-3, duration=0.1, cells=(2, 2, 2, 2, 2, 2)))
    assert np.isfinite(found.theta_f).all()
    assert np.isfinite(found.positions).all()
    assert bool(found.failure) == (len(found.t) < 100)


def test_robot_with_one_tube_is_refused():
    from model_cases import make_robot, make_tube

    with pytest.raises(InputError, match="one tube"):
        run(make_robot([make_tube()], [-0.02]), Plan(1.0))
