"""Errors and NEES against a truth: of outputs whose errors are known, and of a replay from simulation to table."""

import json
import subprocess
import sys

import numpy as np
import pytest

from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.templates import Template, stamped_numbers
from ctr_dynamics.io.truth_files import Truth, read_truth, write_truth
from ctr_dynamics.reporting.evaluation import evaluate

START_NS, DT = 1_000_000_000, 0.003


def outputs(path, position, velocity, deviation=1e-3, invalid=0):
    """A bag of outputs at 3 ms steps with isotropic covariances; the first ``invalid`` steps hold no estimate."""
    pose = Template(stamped_numbers(topics.TIP_POSE, "ctr_base", 43))
    twist = Template(stamped_numbers(topics.TIP_TWIST, "ctr_base", 42))
    predicted = Template(stamped_numbers(topics.TIP_POSE_PREDICTED, "ctr_base", 7))
    covariance = (deviation**2 * np.eye(6)).ravel()
    still = [0.0, 0.0, 0.0, 1.0]
    with write_bag(path, {}) as writer:
        for k, (p, v) in enumerate(zip(position, velocity, strict=True)):
            stamp = START_NS + round(k * DT * 1e9)
            if k >= invalid:
                writer.write(topics.TIP_POSE, stamp, pose.fill(stamp, [*p, *still], covariance)[0])
                writer.write(topics.TIP_TWIST, stamp, twist.fill(stamp, [*v, 0.0, 0.0, 0.0], covariance)[0])
                writer.write(topics.TIP_POSE_PREDICTED, stamp, predicted.fill(stamp, [*p, *still])[0])
            writer.write(topics.VALID, stamp, b"\x00\x01\x00\x00\x01")
    return path


def motion(t):
    return np.stack([0.01 * np.sin(t), 0.02 * t, 0.1 + 0 * t], axis=1)


@pytest.mark.parametrize("invalid", [0, 40])
def test_errors_and_nees_of_known_errors(tmp_path, invalid):
    rng = np.random.default_rng(1)
    t = DT * np.arange(2000)
    error = 1e-3 * rng.standard_normal((len(t), 3))
    velocity = np.gradient(motion(t), DT, axis=0)
    bag = outputs(tmp_path / "out.mcap", motion(t) + error, velocity + 2.0 * error, invalid=invalid)
    fine = np.linspace(0.0, 7.0, 7001)
    quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (len(fine), 1))
    truth = Truth(fine, motion(fine), quaternion, np.gradient(motion(fine), fine, axis=0))
    write_truth(tmp_path / "truth.npz", truth)
    found = evaluate(bag, tmp_path / "truth.npz")
    used = error[invalid:]
    assert found["start_ns"] == START_NS
    assert found["steps"] == len(used)
    assert found["position_m"]["rms"] == pytest.approx(np.sqrt((used**2).sum(1).mean()), rel=1e-3)
    assert found["position_m"]["max"] == pytest.approx(np.linalg.norm(used, axis=1).max(), rel=1e-2)
    assert found["nees"]["position"]["mean"] == pytest.approx(np.mean((used / 1e-3) ** 2), rel=1e-3)
    assert found["nees"]["position"]["beyond_3_sigma"] == pytest.approx(0.029, abs=0.012)
    assert found["nees"]["velocity"]["mean"] == pytest.approx(4.0 * np.mean((used / 1e-3) ** 2), rel=0.05)
    assert found["orientation_rad"]["max"] == 0.0


def test_a_truth_of_another_time_and_bags_without_outputs_are_said(tmp_path):
    t = DT * np.arange(10)
    bag = outputs(tmp_path / "out.mcap", motion(t), motion(t))
    write_truth(tmp_path / "truth.npz", Truth(t, motion(t), start_ns=5 * START_NS))
    with pytest.raises(InputError, match="no output lies in the time of the truth"):
        evaluate(bag, tmp_path / "truth.npz")
    with write_bag(tmp_path / "empty.mcap", {}) as writer:
        writer.write(topics.VALID, 1, b"\x00\x01\x00\x00\x01")
    with pytest.raises(InputError, match="holds no message on /ctr/estimator/tip_pose"):
        evaluate(tmp_path / "empty.mcap", tmp_path / "truth.npz")


@pytest.mark.parametrize(
    ("arrays", "text"),
    [
        ({"p": np.zeros((3, 3))}, r"is no truth file \(t is not"),
        ({"t": [0.0, 1.0, 1.0], "p": np.zeros((3, 3))}, "no rising times"),
        ({"t": [0.0, 1.0], "q": np.zeros((2, 4))}, "p is missing"),
        ({"t": [0.0, 1.0], "p": np.zeros((3, 3))}, "expected \\(2, 3\\)"),
        ({"t": [0.0, 1.0], "p": np.full((2, 3), np.nan)}, "not finite"),
    ],
)
def test_files_that_are_no_truth(tmp_path, arrays, text):
    np.savez(tmp_path / "truth.npz", **arrays)
    with pytest.raises(InputError, match=text):
        read_truth(tmp_path / "truth.npz")


def test_from_simulation_to_table(tmp_path):
    """simulate --truth, replay, evaluate: three commands, and the model alone is right where nothing is hidden."""

    def command(*arguments):
        line = [sys.executable, "-m", "ctr_dynamics.cli.main", *map(str, arguments)]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    scenario = tmp_path / "short.yaml"
    scenario.write_text("duration_s: 1.0\nloads:\n  - hung_mass_kg: 0.01\n    end_s: 0.3\n    fall_s: 0.01\n")
    bag, truth, out = (tmp_path / name for name in ("in.mcap", "truth.npz", "out.mcap"))
    robot = ("--robot", "till2020_tissue")
    assert "truth" in command("simulate", scenario, *robot, "--output", bag, "--truth", truth)
    command("replay", bag, *robot, "--output", out)
    found = json.loads(command("evaluate", out, truth, "--json"))
    assert found["steps"] > 300
    assert found["predicted_m"]["rms"] < 0.2e-3
    assert found["velocity_m_s"]["rms"] < 0.1
    table = command("evaluate", out, truth)
    assert "tip position, fused" in table
    assert "NEES" in table
