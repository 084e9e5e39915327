"""`ctr-dynamics replay`: bad input in one line, figures of the estimator itself, and what it says of odd inputs."""

import json
import subprocess
import sys

import pytest

from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import cdr
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped

T0 = 1_700_000_000_000_000_000


def command(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "ctr_dynamics.cli.main", "replay", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["{tmp}/none.mcap"], "no such bag"),
        (["{tmp}/bad.mcap"], "not an MCAP file"),
        (["{tmp}/empty.mcap"], "empty"),
        (["{bag}", "--robot", "till2020_tisue"], "did you mean 'till2020_tissue'"),
        (["{bag}", "--set", "tracker.delay=1"], "tracker.delay_s"),
        (["{bag}", "--set", "model.nodes"], "NAME=VALUE"),
        (["{bag}", "--params", "{tmp}/none.yaml"], "none.yaml"),
        (["{bag}", "--output", "{tmp}/no/out.mcap"], "does not exist"),
    ],
)
def test_command_rejects_bad_input_in_one_line(bags, tmp_path, arguments, text):
    (tmp_path / "bad.mcap").write_bytes(b"nonsense")
    (tmp_path / "empty.mcap").write_bytes(b"")
    before = sorted(tmp_path.iterdir())
    done = command(*(a.format(tmp=tmp_path, bag=bags / "clean_release.mcap") for a in arguments))
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert text in done.stderr
    assert done.stdout == ""
    assert sorted(tmp_path.iterdir()) == before


def test_command_with_the_estimator(bags, tmp_path):
    """Half a second of a bag, twice, through the estimator itself: same bytes, complete summary."""
    with write_bag(tmp_path / "in.mcap", {}) as writer:
        for message in open_bag(bags / "clean_release.mcap").messages():
            if message.log_ns <= T0 + 500_000_000:
                writer.write(*message)
    outputs = []
    for name in ("a", "b"):
        target, summary = tmp_path / f"{name}.mcap", tmp_path / f"{name}.json"
        done = command(
            tmp_path / "in.mcap", "--robot", "till2020_tissue", "--output", target, "--summary", summary
        )
        assert done.returncode == 0, done.stderr
        assert "residual rms, fused" in done.stdout
        outputs.append(target.read_bytes())
        content = json.loads(summary.read_text())
        assert content["steps"] == 167
        assert set(content["step_ms"]) == {"p50", "p99", "max"}
        assert set(content["residual_rms_m"]) >= {"predicted", "fused"}
        assert set(content["nis"]) >= {"mean", "dof", "lower95", "upper95", "within"}
        assert set(content["solver"]) >= {"failures", "reasons"}
        assert {"duration_s", "wall_s", "realtime_ratio", "rejected", "late", "dropped"} <= set(content)
    assert outputs[0] == outputs[1]


def start_of(bag, target, change):
    """The first 0.3 s of ``bag``, every input but the load as ``change(message)`` encodes it."""
    with write_bag(target, {}) as writer:
        for item in open_bag(bag).inputs():
            data = change(item.message) if item.log_ns <= T0 + 300_000_000 else None
            if data is not None:
                writer.write(item.topic, item.log_ns, data)


def test_what_was_odd_about_the_inputs_is_said(bags, tmp_path):
    def elsewhere(m):
        if isinstance(m, cdr.JointStateIn):
            return encode_joint_state(m.stamp_ns, m.names, m.positions)
        if isinstance(m, cdr.PoseIn):
            return encode_pose_stamped(m.stamp_ns, "polaris", m.position, m.quaternion_xyzw)
        return None

    start_of(bags / "clean_release.mcap", tmp_path / "in.mcap", elsewhere)
    done = command(tmp_path / "in.mcap", "--summary", tmp_path / "out.json")
    assert done.returncode == 1, done.stderr
    assert "the tracker was not used: 0 of 12 poses fused" in done.stderr
    assert (
        "note: tracker: other frame (12), the last: pose in frame 'polaris', expected 'ctr_base'"
        in done.stderr
    )
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["dropped"] == content["input_problems"]["tracker"]["other frame"]["count"] == 12
    assert len(content["notes"]) == 1


def test_joints_in_millimetres_are_rejected_with_value_and_limit(bags, tmp_path):
    def in_millimetres(m):
        if not isinstance(m, cdr.JointStateIn):
            return None
        values = [
            1e3 * x if "translation" in name else x for name, x in zip(m.names, m.positions, strict=True)
        ]
        return encode_joint_state(m.stamp_ns, m.names, values)

    start_of(bags / "clean_release.mcap", tmp_path / "in.mcap", in_millimetres)
    done = command(tmp_path / "in.mcap")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "joints: out of range" in done.stderr
    assert "give metres" in done.stderr


# Arrivals and clocks.
