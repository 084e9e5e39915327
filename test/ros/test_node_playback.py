"""The driver's bag: order, part, stamps, pace; the figures of a live run."""

import numpy as np
import pytest

from ctr_dynamics.cli.main import main
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.cdr import CdrError, decode_joint_state, decode_stamp
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped
from ctr_dynamics.robot_files import load_robot, robot_with
from ctr_dynamics.runtime.live_report import (
    Received,
    Trace,
    compare,
    compare_truth,
    comparisons,
    nominal_tracker,
    trace_of,
    tracker_trace,
    truth_traces,
)
from ctr_dynamics.runtime.playback import load, pace, shifted


def test_shifting_moves_the_stamp_and_nothing_else():
    data = encode_joint_state(1_700_000_000_123_456_789, ["tube1_rotation"], [0.25])
    moved = shifted(data, 3_900_000_001)
    assert decode_stamp(moved) == 1_700_000_004_023_456_790
    assert decode_joint_state(moved).positions == (0.25,)
    assert moved[:4] + moved[12:] == data[:4] + data[12:]
    big = b"\x00\x00\x00\x00" + (5).to_bytes(4, "big") + (7).to_bytes(4, "big") + data[12:]
    assert decode_stamp(shifted(big, 1_000_000_000)) == 6_000_000_007


def test_a_stamp_that_cannot_be_moved_is_rejected():
    with pytest.raises(CdrError):
        shifted(encode_joint_state(0, ["tube1_rotation"], [0.25])[:8], 1)
    with pytest.raises(CdrError, match="beyond 32 bits"):
        shifted(encode_joint_state((2**31 - 1) * 10**9, ["tube1_rotation"], [0.25]), 10**9)


def test_a_part_of_a_bag_in_order_of_arrival(bags):
    whole = load(bags / "clean_release.mcap")
    assert {m.topic for m in whole} == {topic.name for topic in topics.INPUTS}
    assert [m.log_ns for m in whole] == sorted(m.log_ns for m in whole)
    part = load(bags / "clean_release.mcap", start_s=1.0, duration_s=0.5)
    assert 0 < len(part) < len(whole)
    assert part[0].log_ns - whole[0].log_ns >= 1_000_000_000
    assert part[-1].log_ns - whole[0].log_ns <= 1_500_000_000


def test_a_part_begins_with_the_load_that_acts_there(bags, tmp_path):
    whole = load(bags / "clean_release.mcap")
    begin = whole[0].log_ns
    loads = [m for m in whole if m.topic == topics.TIP_LOAD]
    first = loads[0]
    with write_bag(tmp_path / "in.mcap", {}) as writer:
        for m in whole:
            if m.topic != topics.TIP_LOAD or m is first:
                writer.write(m.topic, m.log_ns, m.data)
    part = load(tmp_path / "in.mcap", start_s=0.5, duration_s=0.2)
    assert (part[0].topic, part[0].data) == (first.topic, first.data), "it is held after its stamp"
    assert part[0].log_ns == begin + 500_000_000
    assert sum(m.topic == topics.TIP_LOAD for m in part) == 1


def test_a_bag_without_joints_in_that_part_is_rejected(bags, tmp_path):
    with pytest.raises(InputError, match="joint_states"):
        load(bags / "clean_release.mcap", start_s=1000.0)
    with pytest.raises(InputError):
        load(tmp_path / "none.mcap")


def test_pace_yields_each_moment_once_it_has_come_and_stops_when_told():
    clock = iter(range(0, 10_000, 7))
    moments = [1000, 1010, 1010, 1400]
    seen = []
    now = 0

    def tick():
        nonlocal now
        now = next(clock)
        return now

    for index, late in pace(moments, 50, lambda: len(seen) == 3, tick):
        due = 50 + moments[index] - moments[0]
        assert now >= due
        assert late == now - due
        seen.append(index)
    assert seen == [0, 1, 2]


def test_comparison_is_over_the_samples_within_the_run():
    t = np.r_[0.0:0.3:0.003, 0.5:1.0:0.003]  # in between, outputs were invalid
    straight = np.column_stack([t, 0 * t, 0 * t])
    fused, alone = Trace(t, straight), Trace(t, straight + np.array([0.0, 3e-3, 4e-3]))
    samples = Trace(
        np.array([-1.0, 0.25, 0.4, 0.55, 2.0]),
        np.array([[9, 9, 9], [0.25, 0, 0], [9, 9, 9], [0.55, 1e-3, 0], [9, 9, 9]]),
    )
    found = compare("tracker", samples, alone, fused)
    assert found.samples == 2
    assert found.fused_max == pytest.approx(1e-3)
    assert found.fused_rms == pytest.approx(1e-3 / np.sqrt(2))
    assert found.open_loop_max == pytest.approx(5e-3)
    with pytest.raises(ValueError, match="tracker"):
        compare("tracker", Trace(np.array([5.0]), np.zeros((1, 3))), alone, fused)
    far = Trace(t, straight + 1.0)
    assert compare_truth([far, fused], alone, fused).fused_rms == 0.0


def test_traces_of_messages_bag_and_truth(bags):
    heard = [
        Received(0, encode_pose_stamped(stamp, "ctr_base", (stamp, 0, 0), (0, 0, 0, 1))) for stamp in (30, 10)
    ]
    trace = trace_of(heard, 10)
    np.testing.assert_allclose(trace.t, [0.0, 20e-9])
    np.testing.assert_allclose(trace.p[:, 0], [10, 30])
    bag = bags / "clean_release.mcap"
    start = next(iter(open_bag(bag).inputs())).message.stamp_ns
    tracker = tracker_trace(bag, start, nominal_tracker(load_robot("till2020_tissue")))
    truth = truth_traces(bags / "truth" / "clean_release.npz")
    assert len(tracker.t) > 200
    near = min(float(np.sqrt(np.mean(np.sum((c.at(tracker.t) - tracker.p) ** 2, axis=1)))) for c in truth)
    assert near < 1.5e-3


def test_the_tip_that_poses_show_is_that_of_the_robots_registration_lever_arm_and_delay(bags):
    turned = robot_with(
        load_robot("till2020_tissue"),
        {
            "tracker.registration_rotation": [0.0, 0.0, np.pi / 2],
            "tracker.registration_translation": [0.1, 0.2, 0.3],
            "tracker.delay": 0.025,
        },
    )
    bag = bags / "clean_release.mcap"
    plain = tracker_trace(bag, 0, nominal_tracker(load_robot("till2020_tissue")))
    moved = tracker_trace(bag, 0, nominal_tracker(turned))
    delay = nominal_tracker(load_robot("till2020_tissue")).delay
    np.testing.assert_allclose(moved.t - plain.t, delay - 0.025, atol=1e-6)
    x, y, z = plain.p.T
    np.testing.assert_allclose(moved.p, np.c_[y - 0.2, 0.1 - x, z - 0.3], atol=1e-12)


def test_what_does_not_fall_into_the_run_is_not_compared():
    t = np.arange(0.0, 1.0, 0.003)
    run = Trace(t, np.zeros((len(t), 3)))
    late = Trace(t + 5.0, np.zeros((len(t), 3)))
    nothing = Trace(np.zeros(0), np.zeros((0, 3)))
    assert comparisons(nothing, [], run, run) == []
    assert comparisons(late, [late], run, run) == []
    assert [c.reference for c in comparisons(run, [run], run, run)] == ["tracker", "truth"]


def test_a_truth_that_is_none_is_one_clear_error(tmp_path):
    empty, other, wrong = (tmp_path / name for name in ("a.npz", "b.npz", "c.npz"))
    empty.write_bytes(b"")
    np.savez(other, t=np.zeros(3))
    np.savez(wrong, t=np.zeros(3), p=np.zeros((2, 3)))
    for file in (tmp_path / "none.npz", empty, other, wrong):
        with pytest.raises(InputError, match=file.name):
            truth_traces(file)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--duration", "0.2"], "--duration is 0.2 s; write 2 s or more"),
        (["--duration", "nan"], "--duration is nan s"),
        (["--duration=-1"], "--duration is -1 s"),
        (["--truth", "none.npz"], "none.npz"),
        (["--robot", "nobody"], "nobody"),
        (["--policy", "maybe"], "maybe"),
    ],
)
def test_a_demo_that_cannot_be_shown_is_rejected_before_it_starts(capsys, tmp_path, arguments, words):
    pytest.importorskip("rclpy")
    assert main(["demo", *arguments, "--output", str(tmp_path / "out")]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
