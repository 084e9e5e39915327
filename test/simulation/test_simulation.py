"""Scenarios: motion primitives, refusals, and the bag that a run writes."""

import copy

import numpy as np
import pytest
import yaml

from ctr_dynamics.cli.main import main
from ctr_dynamics.errors import InputError
from ctr_dynamics.io import open_bag
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.simulation import Scenario, load_scenario, scenario_names, simulate
from ctr_dynamics.simulation.motion_primitives import Axis, Hold, Multisine, Ramp, Sine, Table
from ctr_dynamics.simulation.scenario_run import messages

SHORT = {
    "duration_s": 0.3,
    "seed": 3,
    "tubes": [{"rotation": [{"kind": "ramp", "duration_s": 0.2, "to": 0.1}]}],
    "loads": [{"force_N": [0.0, 0.05, 0.0], "end_s": 0.1, "fall_s": 0.01}],
    "solver": {"dt_s": 0.003, "nodes": 16},
}


def test_primitives_follow_one_another():
    axis = Axis(
        [
            Hold(kind="hold", duration_s=1.0),
            Ramp(kind="ramp", duration_s=2.0, to=0.5),
            Sine(kind="sine", duration_s=2.0, amplitude=0.1, frequency_hz=0.5),
            Ramp(kind="ramp", duration_s=1.0, to=-0.5, smooth=False),
        ]
    )
    assert axis.value(0.5) == 0.0
    assert axis.value(2.0) == pytest.approx(0.25)
    assert axis.value(3.5) == pytest.approx(0.6)
    assert axis.value(5.0) == pytest.approx(0.5)
    assert axis.value(100.0) == -0.5
    assert axis.rate(5.5) == pytest.approx(-1.0, abs=1e-8)
    assert axis.rate(3.0 - 1e-9) == pytest.approx(
        0.5 * 0.1 * 2 * np.pi * 0.5, abs=1e-3
    )  # mean of 0 and the sine's start
    times = np.linspace(0, 7, 70001)
    assert np.abs(np.diff([axis.value(t) for t in times])).max() < 1e-4 * 1.01  # no jump


def test_fading_motions_begin_and_end_without_a_jump_of_speed():
    part = Multisine(
        kind="multisine",
        duration_s=4.0,
        amplitudes=[0.3, 0.1],
        frequencies_hz=[0.7, 1.3],
        phases_rad=[1.0, 2.0],
        fade_s=1.0,
    )
    axis = Axis([part])
    for t in (0.0, 4.0):
        assert axis.value(t) == pytest.approx(0.0, abs=1e-12)
        assert abs(axis.rate(t)) < 1e-3
    assert max(abs(axis.value(t)) for t in np.linspace(0, 4, 400)) > 0.2


def test_tables_are_linear():
    axis = Axis([Table(kind="table", duration_s=2.0, times_s=[0.0, 1.0, 2.0], values=[0.0, 0.4, 0.2])])
    assert axis.value(0.5) == pytest.approx(0.2)
    assert axis.value(9.0) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda d: d.pop("duration_s"), "duration_s"),
        (lambda d: d.update(duration_s=-1.0), "duration_s"),
        (lambda d: d.update(durations=1.0), "durations"),
        (lambda d: d["tubes"][0]["rotation"][0].update(kind="jump"), "rotation"),
        (lambda d: d["tubes"][0]["rotation"][0].update(to="far"), "to"),
        (lambda d: d["tubes"][0]["rotation"][0].update(to=float("nan")), "to"),
        (lambda d: d["loads"][0].update(force_N=[1.0, 2.0]), "force_N"),
        (lambda d: d["loads"][0].update(start_s=5.0), "before start_s"),
        (lambda d: d.update(solver={"scheme": "euler"}), "scheme"),
    ],
)
def test_bad_scenarios_end_with_one_line(tmp_path, capsys, change, match):
    data = copy.deepcopy(SHORT)
    change(data)
    path = tmp_path / "s.yaml"
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(InputError, match=match) as caught:
        load_scenario(path)
    assert "\n" not in str(caught.value)
    assert (
        main(["simulate", str(path), "--robot", "till2020_tissue", "--output", str(tmp_path / "o.mcap")]) == 2
    )
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "o.mcap").exists()


def test_motions_out_of_range_are_rejected_before_anything_runs():
    robot = load_robot("till2020_tissue")
    motion = {"kind": "ramp", "duration_s": 0.2, "to": 0.3}
    with pytest.raises(InputError, match="beyond tube 1"):
        simulate(Scenario(duration_s=0.3, tubes=[{}, {"translation": [motion]}]), robot)
    with pytest.raises(InputError, match="the robot has 2"):
        simulate(Scenario(duration_s=0.3, tubes=[{}, {}, {}]), robot)


def test_shipped_scenarios_are_valid():
    assert scenario_names() == ("light_release", "release", "reversals", "sweep", "turns")
    for name in scenario_names():
        assert load_scenario(name).duration_s > 1
    release = load_scenario("release")
    assert release.loads[0].factor(1.0) == 1.0
    assert release.loads[0].factor(1.005) == pytest.approx(0.5)
    assert release.loads[0].factor(1.02) == 0.0


def test_steps_are_divided_where_loads_begin_and_end():
    """A load that vanishes at once within a step: divided there, steps of 3 ms come as near to fine ones as to nothing else."""

    def tips(dt, end):
        content = copy.deepcopy(SHORT)
        content["loads"] = [{"force_N": [0.0, 0.05, 0.0], "end_s": end, "fall_s": 0.0}]
        content["solver"]["dt_s"] = dt
        return simulate(Scenario(**content), load_robot("till2020_tissue")).position

    fine = tips(0.0005, 0.1)[::6]
    shifts = [
        np.abs(tips(0.003, end) - fine).max() for end in (0.1, 0.099, 0.102)
    ]  # the latter two at the step's ends
    assert shifts[0] < 0.2 * min(shifts[1:])


def test_command_writes_a_bag_with_the_input_topics(tmp_path, capsys):
    path, first, second = tmp_path / "s.yaml", tmp_path / "a.mcap", tmp_path / "b.mcap"
    path.write_text(yaml.safe_dump(SHORT))
    for out in (first, second):
        assert main(["simulate", str(path), "--robot", "till2020_tissue", "--output", str(out)]) == 0
    assert "0.300 s" in capsys.readouterr().out
    assert first.read_bytes() == second.read_bytes()
    bag = open_bag(first)
    read = list(bag.inputs()) if hasattr(bag, "inputs") else list(bag.messages())
    by_type = [type(item.message) for item in read]
    assert by_type.count(JointStateIn) == 31
    assert by_type.count(PoseIn) == 13
    joints = next(item.message for item in read if isinstance(item.message, JointStateIn))
    assert set(joints.names) == {f"tube{i}_{kind}" for i in (1, 2) for kind in ("rotation", "translation")}


def test_noise_is_seeded_and_can_be_off():
    robot = load_robot("till2020_tissue")
    base = Scenario(**SHORT)
    recording = simulate(base, robot)
    assert not recording.failure
    exact = base.model_copy(update={"noise": False})
    assert messages(base, robot, recording) == messages(base, robot, recording)
    assert messages(base, robot, recording) != messages(exact, robot, recording)
    other = base.model_copy(update={"seed": 4})
    assert messages(base, robot, recording) != messages(other, robot, recording)
    assert np.linalg.norm(recording.position[-1] - recording.position[0]) > 3e-4
    assert recording.wrench(0.05)[1] == pytest.approx(0.05)
    assert recording.wrench(0.2)[1] == 0.0


def test_a_scenario_that_cannot_be_followed_ends_there(tmp_path, capsys):
    data = copy.deepcopy(SHORT)
    data["loads"] = [{"force_N": [0.0, 4e4, 3e4], "start_s": 0.1}]
    path, out = tmp_path / "s.yaml", tmp_path / "o.mcap"
    path.write_text(yaml.safe_dump(data))
    assert main(["simulate", str(path), "--robot", "till2020_tissue", "--output", str(out)]) == 1
    assert "failed" in capsys.readouterr().err
    assert out.exists()
