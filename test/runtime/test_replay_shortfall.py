"""Replays that estimated next to nothing say so, and summaries count what was used."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ctr_dynamics.errors import InputError
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.step_output import Innovation
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages.cdr import decode_joint_state, decode_pose_stamped
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped
from ctr_dynamics.io.messages.topics import JOINT_STATES, TRACKER_TIP
from ctr_dynamics.runtime.replay import replay

BAG = Path(__file__).parents[1] / "data" / "bags" / "clean_sweep.mcap"
SECONDS = 2.0


def edited(path, joints=lambda m: m, pose=lambda m: m, times=1):
    """The first seconds of a bag with its messages changed; played ``times`` times, the stamps the same."""
    bag = open_bag(BAG)
    messages = list(bag.messages({JOINT_STATES, TRACKER_TIP}))
    start_ns = messages[0].log_ns
    part = [m for m in messages if m.log_ns - start_ns < SECONDS * 1e9]
    with write_bag(path, {}) as writer:
        for turn in range(times):
            for topic, log_ns, data in part:
                if topic == JOINT_STATES:
                    m = joints(decode_joint_state(data))
                    out = encode_joint_state(m.stamp_ns, m.names, m.positions)
                else:
                    p = pose(decode_pose_stamped(data))
                    out = encode_pose_stamped(p.stamp_ns, p.frame_id, p.position, p.quaternion_xyzw)
                writer.write(topic, log_ns + turn * int((SECONDS + 0.1) * 1e9), out)
    return path


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return replay(edited(tmp_path_factory.mktemp("plain") / "a.mcap"), "till2020_tissue")


def test_a_good_replay_says_nothing(plain):
    assert plain.shortfall == ""
    assert plain.summary["measurements"]["used"] == 80 - plain.summary["dropped"]
    assert plain.summary["joints_cover_s"] == pytest.approx(SECONDS, abs=0.03)


def test_joints_without_stamps(tmp_path):
    bag = edited(tmp_path / "a.mcap", joints=lambda m: m._replace(stamp_ns=0))
    with pytest.raises(
        InputError,
        match=r"stamp zero \(\d+\), the last: .* fill in header\.stamp .*; mend what is said of the joints",
    ):
        replay(bag, "till2020_tissue")


def test_poses_in_another_frame(tmp_path):
    bag = edited(tmp_path / "a.mcap", pose=lambda m: m._replace(frame_id="aurora"))
    result = replay(bag, "till2020_tissue")
    assert result.shortfall.startswith(
        "the tracker was not used: 0 of 80 poses fused, limit 10 %: other frame (80)"
    )
    assert "aurora" in result.shortfall
    assert replay(bag, "till2020_tissue", {"filter.enabled": False}).shortfall == ""


def test_what_was_not_used_is_counted_apart():
    def innovation(distance_m, accepted):
        motion = SimpleNamespace(residual=np.array([distance_m, 0.0, 0.0]))
        fused = np.array([0.0, 0.5 * distance_m, 0.0])
        return Innovation(
            1, np.zeros(6), np.ones(6), 6.0, 6, accepted, 0.0, "" if accepted else "gate", None, motion, fused
        )

    health = Health()
    for distance_m, accepted in ((0.001, True), (0.1, False), (0.001, True)):
        health.measurements.add(innovation(distance_m, accepted), fusing=True)
    summary = health.summary()
    assert summary["residual_rms_m"] == {"predicted": pytest.approx(0.001), "fused": pytest.approx(0.0005)}
    assert summary["measurements"] == {
        "used": 2,
        "not_used": 1,
        "not_used_residual_rms_m": {"predicted": pytest.approx(0.1), "fused": pytest.approx(0.05)},
    }


def test_a_bag_that_was_played_twice_counts_once(tmp_path, plain):
    """The second time lies before what was out already: its steps are in no output, its measurements in no figure."""
    twice = replay(edited(tmp_path / "a.mcap", times=2), "till2020_tissue").summary
    assert twice["withheld"] > 500
    assert twice["measurements"]["used"] == plain.summary["measurements"]["used"]
    assert twice["residual_rms_m"]["fused"] == pytest.approx(
        plain.summary["residual_rms_m"]["fused"], rel=1e-3
    )
    assert twice["nis"]["dof"] == plain.summary["nis"]["dof"]
