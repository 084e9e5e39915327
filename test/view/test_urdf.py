"""The robot as a URDF: one tree, joints as in the joint states, frames as the estimator publishes them."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import pytest

from ctr_dynamics.cli.main import main
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.transform_encoder import tip_frame
from ctr_dynamics.view.urdf import robot_urdf


@pytest.mark.parametrize("name", ["till2020_tissue", "till2020_snap", "three_tube"])
def test_it_is_a_tree_of_links_with_the_joints_of_the_joint_states(name):
    robot = load_robot(name)
    root = ET.fromstring(robot_urdf(robot))
    links = [link.get("name") for link in root.iter("link")]
    assert len(set(links)) == len(links)
    children = [joint.find("child").get("link") for joint in root.iter("joint")]
    assert sorted([*children, "ctr_base"]) == sorted(links)  # every link but the base hangs on one joint
    assert all(joint.find("parent").get("link") in links for joint in root.iter("joint"))
    moved = {joint.get("name"): joint for joint in root.iter("joint") if joint.get("type") != "floating"}
    tubes = range(1, robot.n_tubes + 1)
    assert set(moved) == {f"tube{n}_{kind}" for n in tubes for kind in ("rotation", "translation")}
    for n, tube in zip(tubes, robot.tubes, strict=True):
        slide = moved[f"tube{n}_translation"]
        assert slide.find("axis").get("xyz") == "0 0 1"
        assert float(slide.find("limit").get("lower")) == pytest.approx(-tube.length)
        assert float(slide.find("limit").get("upper")) == 0.0
        assert moved[f"tube{n}_rotation"].get("type") == "continuous"
        assert tip_frame(Settings({})["output.frame_id"], n) in links
    assert all(float(shape.get("radius")) > 0.0 for shape in root.iter("cylinder"))


def test_the_command_writes_it(tmp_path, capsys):
    path = tmp_path / "robot.urdf"
    assert main(["robot", "urdf", "till2020_tissue", "--output", str(path), "--frame", "left_base"]) == 0
    root = ET.fromstring(path.read_text())
    assert "left_tube1_tip" in [link.get("name") for link in root.iter("link")]
    assert str(path) in capsys.readouterr().out
