"""docs/your_robot.md as it stands: its commands, one after the other, on logs of a robot that differs from its file."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from ctr_dynamics.cli.main import main
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn
from ctr_dynamics.io.truth_files import read_truth, write_truth
from ctr_dynamics.robot_files import load_robot, robot_to_yaml, robot_with

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "your_robot.md").read_text(encoding="utf-8")
MOTION = """
description: turns and slides
duration_s: 16.0
seed: 11
tubes:
  - rotation:
      - {kind: hold, duration_s: 1.0}
      - {kind: multisine, duration_s: 12.0, amplitudes: [0.8, 0.3], frequencies_hz: [0.15, 0.6], phases_rad: [0.0, 1.0], fade_s: 0.8}
    translation:
      - {kind: hold, duration_s: 3.0}
      - {kind: ramp, duration_s: 3.0, to: 0.02}
      - {kind: hold, duration_s: 4.0}
      - {kind: ramp, duration_s: 3.0, to: 0.0}
  - rotation:
      - {kind: hold, duration_s: 2.0}
      - {kind: multisine, duration_s: 11.0, amplitudes: [0.6, 0.2], frequencies_hz: [0.2, 0.7], phases_rad: [0.4, 0.0], fade_s: 0.8}
rates: {joints_hz: 100.0, tracker_hz: 40.0}
"""
START_S, APART_S = 812.5, 0.3  # of the motors' clock, and the tracker's minus the motors'
FUNCTION = f'ctr-dynamics() {{ "{sys.executable}" -m ctr_dynamics.cli.main "$@"; }}\n'


def blocks(language):
    """Code blocks of the page."""
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)


def shell(folder, text):
    """What the lines print; they must succeed."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-e", "-o", "pipefail", "-c", FUNCTION + text],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A folder with what the page takes for granted, the two logs, and the truth."""
    folder = tmp_path_factory.mktemp("lab")
    new = next(block for block in blocks("sh") if "robot new" in block)
    shell(folder, new.split("ctr-dynamics robot check")[0])
    assumed = load_robot(folder / "lab_robot.yaml")
    own = {
        "tubes[0].youngs_modulus": 0.93 * assumed.tubes[0].youngs_modulus.value,
        "tubes[0].precurvature[1].curvature": 1.02 * assumed.tubes[0].precurvature[1].curvature.array,
        "tubes[1].precurvature[1].curvature": 0.985 * assumed.tubes[1].precurvature[1].curvature.array,
        "tracker.delay": 0.0195,
    }
    hidden = folder / "hidden"
    hidden.mkdir()
    (hidden / "robot.yaml").write_text(robot_to_yaml(robot_with(assumed, own)))
    (hidden / "motion.yaml").write_text(MOTION)
    options = ["--robot", str(hidden / "robot.yaml"), "--output", str(hidden / "bag.mcap")]
    assert (
        main(["simulate", str(hidden / "motion.yaml"), *options, "--truth", str(hidden / "truth.npz")]) == 0
    )
    own_clock = replace(read_truth(hidden / "truth.npz"), start_ns=None)  # from the first joint state on
    write_truth(hidden / "truth.npz", own_clock)
    write_logs(folder, hidden / "bag.mcap")
    (folder / "layout.yaml").write_text(blocks("yaml")[0])
    (folder / "lab_robot.yaml").unlink()
    return folder


def write_logs(folder, bag):
    """The bag as a motor controller and a tracker of five degrees of freedom would log it."""
    layout = yaml.safe_load(blocks("yaml")[0])
    R = Rotation.from_rotvec(layout["tracker"]["registration_rotation_rad"])
    shift = np.array(layout["tracker"]["registration_translation_m"])
    home = [layout["joints"]["values"][f"tube{i}_translation"]["offset"] for i in (1, 2)]
    motors = ["# motor controller log v1.2", "host_time;rot1_deg;rot2_deg;adv1_mm;adv2_mm"]
    ndi = ["Time,Frame,State,Q0,Qx,Qy,Qz,Tx,Ty,Tz,Error"]
    rng, start_ns = np.random.default_rng(2), None
    for _, _, message in open_bag(bag).inputs():
        start_ns = message.stamp_ns if start_ns is None else start_ns
        t = START_S + (message.stamp_ns - start_ns) * 1e-9
        if isinstance(message, JointStateIn):
            at = dict(zip(message.names, message.positions, strict=True))
            turns = [np.degrees(at[f"tube{i}_rotation"]) for i in (1, 2)]
            slides = [1e3 * at[f"tube{i}_translation"] - home[i - 1] for i in (1, 2)]
            motors.append(";".join(f"{v:.6f}" for v in (t, *turns, *slides)))
        elif isinstance(message, PoseIn):
            p = 1e3 * (R.apply(message.position) + shift)
            roll = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
            x, y, z, w = (R * Rotation.from_quat(message.quaternion_xyzw) * roll).as_quat()
            numbers = ",".join(f"{v:.5f}" for v in (w, x, y, z))
            places = ",".join(f"{v:.3f}" for v in p)
            ndi.append(f"{t + APART_S:.4f},{len(ndi)},OK,{numbers},{places},0.21")
    (folder / "motors.csv").write_text("\n".join(motors) + "\n")
    (folder / "ndi.csv").write_text("\n".join(ndi) + "\n")


@pytest.mark.slow
def test_the_page_leads_from_two_logs_to_fused_poses_and_findings(lab, capsys):
    said = [shell(lab, block) for block in blocks("sh")]
    text = "\n".join(said)
    beyond = [tuple(map(float, pair)) for pair in re.findall(r"beyond it +(-?[\d.]+) \+- ([\d.]+) s", text)]
    assert len(beyond) == 2
    assert beyond[0][0] == pytest.approx(APART_S, abs=0.01)
    assert abs(beyond[1][0]) < 0.01
    assert "start_s: 999999999." in text  # the warning names the line that the page writes
    rms = {
        key: float(value)
        for key, value in re.findall(r"held out +\d+ +(before|after) +mean [\d.]+ mm, rms ([\d.]+) mm", text)
    }
    assert rms["after"] < rms["before"]
    capsys.readouterr()
    assert main(["evaluate", str(lab / "fused.mcap"), str(lab / "hidden" / "truth.npz"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["position_m"]["rms"] < 2.5e-4
    assert (lab / "report.html").exists()
    findings = json.loads((lab / "findings" / "findings.json").read_text())
    assert findings["inputs"][0]["name"] == "bag.mcap"
    assert findings["verdict"] == "clean"  # the robot differs within the tolerances of its file
