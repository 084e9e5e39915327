"""The demo: two processes over real DDS, figures, picture and exit code."""

import json

import pytest

from ctr_dynamics.cli import demo_command as demo_file
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.encode import encode_joint_state
from ctr_dynamics.ros import node_processes as processes

pytestmark = pytest.mark.ros


def run(capfd, **options):
    defaults = {"bag": None, "truth": None, "robot": "till2020_tissue", "policy": "predict", "duration": 0.0}
    code = demo_file.demo(**{**defaults, **options})
    return code, capfd.readouterr().out


@pytest.mark.parametrize("most", [demo_file.MOST_TOO_OLD, -1.0], ids=["this machine", "too slow a machine"])
def test_the_demo_ends_with_tables_picture_and_recorded_outputs(tmp_path, capfd, monkeypatch, most):
    monkeypatch.setattr(demo_file, "MOST_TOO_OLD", most)
    code, shown = run(capfd, output=tmp_path / "out", duration=2.0)
    assert code == 0, shown
    assert "open loop" in shown
    assert "fused" in shown
    assert most > 0.0 or "a replay of the same bag" in " ".join(shown.split())
    figures = json.loads((tmp_path / "out" / "demo.json").read_text())
    assert {c["reference"] for c in figures["comparisons"]} == {"tracker", "truth"}
    # on a machine that is too slow for the live node, the figures are those of a replay
    assert all(c["fused_rms"] < 1e-3 for c in figures["comparisons"])
    assert figures["timing"]["skipped"] == 0
    assert (tmp_path / "out" / "demo.png").read_bytes().startswith(b"\x89PNG")
    bag = open_bag(tmp_path / "out" / "outputs.mcap")
    assert bag.topics[topics.VALID].messages > 300
    assert bag.topics[topics.TIP_POSE].messages > 0


def test_an_unknown_robot_or_policy_is_rejected_before_anything_starts(tmp_path, capfd):
    with pytest.raises(InputError, match="nobody"):
        run(capfd, output=tmp_path, robot="nobody")
    with pytest.raises(InputError, match="maybe"):
        run(capfd, output=tmp_path, policy="maybe")


def test_an_estimator_that_does_not_start_fails_the_demo(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(processes, "ESTIMATOR", "ctr_dynamics.ros.no_such_module")
    code, shown = run(capfd, output=tmp_path)
    assert code == 1
    assert "demo failed: the estimator did not start" in shown
    assert "no_such_module" in shown


def test_outputs_that_do_not_come_fail_the_demo(tmp_path, capfd):
    bag = tmp_path / "one_tube.mcap"
    with write_bag(bag, {}) as writer:
        for stamp_ns in range(10**18, 10**18 + 2 * 10**9, 10**7):
            joints = encode_joint_state(stamp_ns, ["tube1_rotation", "tube1_translation"], [0.0, -0.25])
            writer.write(topics.JOINT_STATES, stamp_ns, joints)
    code, shown = run(capfd, output=tmp_path / "out", bag=bag)
    assert code == 1
    assert "no tip pose came" in shown


def test_a_process_that_ignores_the_signal_is_killed(tmp_path, monkeypatch):
    script = tmp_path / "stubborn.py"
    script.write_text(
        "import signal, time\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "print('up', flush=True)\n"
        "time.sleep(600)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    process = processes.NodeProcess("stubborn", {}, 1, tmp_path / "log")
    while "up" not in process.output():
        assert process.code is None
    assert process.stop(timeout_s=0.5) == -9
