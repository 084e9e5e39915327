"""Poses: placeholders, repeats, reach, orientation, clocks, two trackers; and the innocent streams that look like them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from stream_cases import BETA, POSE_PERIOD, T0, PoseStream, joint_rows, still

from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.sensing.checks import CheckOptions, InputChecks, Kind, PoseChecks, Verdict

Pose = tuple[int, tuple[float, ...], tuple[float, ...]]


def stream(count: int, source: PoseStream | None = None, start: int = 0) -> list[Pose]:
    source = source or PoseStream()
    return [(T0 + k * POSE_PERIOD, *source.pose(k * POSE_PERIOD * 1e-9)) for k in range(start, start + count)]


def feed(checks: PoseChecks, poses: list[Pose], **more: object) -> list[Verdict]:
    return [checks.check(stamp, stamp + 1_000_000, p, q, **more) for stamp, p, q in poses]


@pytest.fixture
def checks() -> PoseChecks:
    checks = PoseChecks(load_robot("till2020_tissue"))
    checks.follow_translations(BETA)
    return checks


def kinds(checks: PoseChecks) -> dict[Kind, int]:
    return {found.kind: found.count for found in checks.findings}


def test_a_swinging_tip_with_noise_is_accepted(checks):
    assert {v.use for v in feed(checks, stream(400))} == {"accept"}
    assert not kinds(checks)


@pytest.mark.parametrize("every", [2, 4])
def test_a_vibration_at_half_or_a_quarter_of_the_rate_is_no_second_tracker(checks, every):
    rng = np.random.default_rng(5)
    poses = []
    for k in range(400):
        swing = 0.01 * math.cos(2 * math.pi * k / every + 0.1)
        position = (swing + rng.normal(0, 3e-4), 0.03 + rng.normal(0, 3e-4), 0.12)
        poses.append(
            (T0 + k * POSE_PERIOD + int(rng.integers(-3_000_000, 3_000_000)), position, stream(1)[0][2])
        )
    quaternions = stream(400)
    verdicts = feed(checks, [(s, p, q[2]) for (s, p, _), q in zip(poses, quaternions, strict=True)])
    assert {v.use for v in verdicts} == {"accept"}


@pytest.mark.parametrize("left_out", [(3.0, 0.0, 0.0), (0.0, 0.0, 0.0), (math.nan, 0.0, 0.0)])
def test_poses_that_are_left_out_do_not_move_those_of_their_burst(checks, left_out):
    rng, errors = np.random.default_rng(4), []
    for k, (true, position, quaternion) in enumerate(stream(800)):
        stamp = T0 + (k // 4 * 4 + 3) * POSE_PERIOD + k % 4 * 100_000
        bad = k > 300 and rng.random() < 0.4
        verdict = checks.check(stamp, stamp, left_out if bad else position, quaternion)
        assert (verdict.use == "drop") == bad or k <= 300
        if k > 300 and not bad:
            errors.append(verdict.stamp_ns - true)
    assert max(map(abs, errors)) < 1_500_000


def test_another_frame_is_dropped(checks):
    verdicts = feed(checks, stream(3), frame_id="aurora")
    assert {v.kind for v in verdicts} == {Kind.OTHER_FRAME}
    assert "'aurora'" in verdicts[0].text


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)])
def test_poses_at_the_origin_are_placeholders(checks, quaternion):
    poses = stream(100)
    poses[40:60] = [(s, (0.0, 0.0, 0.0), quaternion) for s, _, _ in poses[40:60]]
    verdicts = feed(checks, poses)
    assert [i for i, v in enumerate(verdicts) if v.use == "drop"] == list(range(40, 60))
    assert kinds(checks) == {Kind.PLACEHOLDER: 20}


def test_a_pose_that_comes_back_among_others_is_a_placeholder(checks):
    poses = stream(200)
    parked = ((0.05, 0.02, 0.08), (0.1, 0.2, 0.3, math.sqrt(1 - 0.14)))
    poses[10::4] = [(s, *parked) for s, _, _ in poses[10::4]]
    verdicts = feed(checks, poses)
    used = [i for i in range(10, 200, 4) if verdicts[i].use != "drop"]
    assert used == [10]  # nothing tells the first from a pose
    assert Kind.PLACEHOLDER in kinds(checks)
    assert [i for i, v in enumerate(verdicts) if v.use == "drop" and i % 4 != 2] == []


def test_an_impossible_pose_is_out_of_reach_with_a_hint(checks):
    stamp, position, quaternion = stream(1)[0]
    huge = checks.check(stamp, None, (1e160, -1e160, 1e160), quaternion)
    assert (huge.use, huge.kind) == ("drop", Kind.OUT_OF_REACH)
    millimetres = checks.check(stamp, None, tuple(1e3 * p for p in position), quaternion)
    assert "millimetres" in millimetres.text
    assert "limit 0.156" in millimetres.text


def test_reach_follows_the_translations(checks):
    full = checks.reach
    checks.follow_translations((-0.35, -0.28))
    assert checks.reach == pytest.approx(full - 1.02 * (0.35 - 0.2521), abs=1e-6)
    assert feed(checks, stream(1))[0].kind is Kind.OUT_OF_REACH


def test_reach_is_measured_from_the_registered_base():
    checks = PoseChecks(load_robot("till2020_tissue"), CheckOptions(translation=(1.0, 0.0, 0.0)))
    stamp, position, quaternion = stream(1)[0]
    assert checks.check(stamp, None, (1.0 + position[0], *position[1:]), quaternion).use == "accept"


def test_repeats_under_new_stamps_count_once(checks):
    poses = []
    for stamp, p, q in stream(100):
        poses += [(stamp + k * POSE_PERIOD // 4, p, q) for k in range(4)]
    verdicts = feed(checks, poses)
    assert [i for i, v in enumerate(verdicts) if v.use == "accept"] == list(range(0, 400, 4))
    assert kinds(checks) == {Kind.POLLED: 300}
    assert checks.stamps.period_s == pytest.approx(0.025)


def test_interleaved_repeats_count_once(checks):
    poses = []
    for stamp, p, q in stream(100):
        poses += [(stamp + k * POSE_PERIOD * 3 // 5, p, q) for k in range(4)]
    poses.sort()
    verdicts = feed(checks, poses)
    assert sum(v.use == "accept" for v in verdicts) == 100
    assert Kind.PLACEHOLDER not in kinds(checks)


def test_a_frozen_tracker_is_named_after_a_tenth_of_a_second(checks):
    poses = stream(200)
    poses[80:160] = [(s, *poses[80][1:]) for s, _, _ in poses[80:160]]
    verdicts = feed(checks, poses)
    assert [i for i, v in enumerate(verdicts) if v.use == "drop"] == list(range(81, 160))
    assert verdicts[85].kind is Kind.FROZEN
    assert kinds(checks) == {Kind.FROZEN: 79}
    assert "1.98 s" in checks.findings[Kind.FROZEN].text


def test_a_tracker_without_noise_may_rest():
    robot = load_robot("till2020_tissue")
    noise = robot.tracker.noise
    exact = {
        name: getattr(noise, name).model_copy(update={"value": 0.0}) for name in ("position", "rotation")
    }
    robot = robot.model_copy(
        update={"tracker": robot.tracker.model_copy(update={"noise": noise.model_copy(update=exact)})}
    )
    checks = InputChecks(2, robot)
    for row in joint_rows(30, still):
        checks.joint_state(*row)
    pose = ((0.02, 0.03, 0.125), (0.0, 0.0, 0.0, 1.0))
    verdicts = [checks.pose(T0 + k * POSE_PERIOD, None, *pose) for k in range(50)]
    assert {v.use for v in verdicts} == {"accept"}
    assert not checks.findings()


def test_orientations_that_never_change_are_not_measured(checks):
    poses = [(s, p, (0.0, 0.0, 0.0, 1.0)) for s, p, _ in stream(50)]
    verdicts = feed(checks, poses)
    assert {v.use for v in verdicts} == {"correct"}
    assert not any(v.orientation for v in verdicts)
    assert kinds(checks) == {Kind.NO_ORIENTATION: 50}


def test_a_frozen_orientation_is_left_out_until_it_moves_again(checks):
    poses = stream(100)
    poses[30:60] = [(s, p, poses[30][2]) for s, p, _ in poses[30:60]]
    verdicts = feed(checks, poses)
    assert [i for i, v in enumerate(verdicts) if not v.orientation] == list(range(35, 60))


def test_quaternions_far_from_unit_length_are_dropped(checks):
    poses = [(s, p, tuple(0.5 * v for v in q)) for s, p, q in stream(3)]
    assert {v.kind for v in feed(checks, poses)} == {Kind.QUATERNION}


def test_quaternions_do_not_matter_where_only_positions_are_measured():
    checks = PoseChecks(load_robot("till2020_tissue"), CheckOptions(orientation=False))
    poses = [(s, p, (0.0, 0.0, 0.0, 0.0)) for s, p, _ in stream(20)]
    assert {v.use for v in feed(checks, poses)} == {"accept"}


def scalar_first(source: PoseStream, off: float, swap: bool) -> list[Verdict]:
    checks = PoseChecks(load_robot("till2020_tissue"))
    verdicts = []
    for stamp, p, (x, y, z, w) in stream(60, source):
        _, true = source.truth((stamp - T0) * 1e-9)
        c, s = math.cos(off / 2), math.sin(off / 2)
        tw, tx, ty, tz = true
        expected = (c * tw - s * ty, c * tx + s * tz, c * ty + s * tw, c * tz - s * tx)
        given = (w, x, y, z) if swap else (x, y, z, w)
        verdicts.append(checks.check(stamp, None, p, given, expected_wxyz=expected))
    return verdicts


def test_scalar_first_quaternions_are_put_in_order_after_ten_poses():
    verdicts = scalar_first(PoseStream(), 0.15, swap=True)
    assert not any(v.orientation for v in verdicts[:9])
    given = [quaternion for _, _, quaternion in stream(60, PoseStream())]
    assert [v.quaternion_xyzw for v in verdicts[9:]] == given[9:]
    assert verdicts[9].kind is Kind.SCALAR_FIRST
    assert "w last" in verdicts[9].text


def test_a_model_that_is_off_does_not_make_quaternions_scalar_first():
    assert {v.use for v in scalar_first(PoseStream(), 0.3, swap=False)} == {"accept"}


def follow(checks: PoseChecks, newest_ns: int = T0, offset_ns: int | None = 0) -> None:
    checks.follow_joints(newest_ns, offset_ns, moving=True)


def test_another_clock_than_the_joints_is_named_with_the_time_zone(checks):
    follow(checks)
    poses = [(s + 3600 * 10**9, p, q) for s, p, q in stream(3)]
    verdicts = [checks.check(s, s - 3600 * 10**9, p, q) for s, p, q in poses]
    assert {v.kind for v in verdicts} == {Kind.OTHER_CLOCK}
    assert "1 h" in verdicts[0].text


def test_a_latency_is_not_another_clock(checks):
    follow(checks)
    verdicts = [checks.check(s, s + 80_000_000, p, q) for s, p, q in stream(40)]
    assert {v.use for v in verdicts} == {"accept"}
    assert kinds(checks).keys() == {Kind.CLOCK_OFFSET}


def test_without_arrivals_only_unrelated_stamps_are_another_clock(checks):
    follow(checks, offset_ns=None)
    (stamp, p, q), (_, p2, q2) = stream(2)
    assert checks.check(stamp + 2 * 10**9, None, p, q).use == "accept"
    assert checks.check(stamp + 20 * 10**9, None, p2, q2).kind is Kind.OTHER_CLOCK


def test_a_stamp_of_zero_beside_joints_of_today_is_wrong_from_the_first(checks):
    follow(checks)
    _, p, q = stream(1)[0]
    assert checks.check(0, T0, p, q).kind is Kind.STAMP_ZERO


@pytest.mark.parametrize("phase", [0.3, 0.5])
def test_of_two_trackers_the_first_is_used(checks, phase):
    mixed, other = [], set()
    second = PoseStream(seed=9)
    for k, pose in enumerate(stream(300)):
        mixed.append(pose)
        if k >= 100:
            other.add(len(mixed))
            stamp = pose[0] + round(phase * POSE_PERIOD)
            p, q = second.pose((stamp - T0) * 1e-9)
            mixed.append((stamp, (p[0] + 0.012, *p[1:]), q))
    verdicts = feed(checks, mixed)
    assert [i for i, v in enumerate(verdicts) if v.use == "drop" and i not in other] == []
    assert sum(verdicts[i].use != "drop" for i in other) <= 6
    assert kinds(checks).keys() == {Kind.TWO_PUBLISHERS}


def test_two_trackers_that_nearly_agree_are_both_left_out(checks):
    mixed = []
    second = PoseStream(seed=9)
    for k, pose in enumerate(stream(300)):
        mixed.append(pose)
        if k >= 100:
            stamp = pose[0] + round(0.4 * POSE_PERIOD)
            p, q = second.pose((stamp - T0) * 1e-9)
            mixed.append((stamp, (p[0] + 0.005, *p[1:]), q))
    verdicts = feed(checks, mixed)
    assert sum(v.use != "drop" for v in verdicts[110:]) < 20
    assert "neither" in checks.findings[Kind.TWO_PUBLISHERS].text


def test_outliers_in_place_of_poses_are_no_second_tracker(checks):
    rng = np.random.default_rng(2)
    poses = [
        (s, tuple(v + rng.normal(0, 0.005) * (rng.random() < 0.5) for v in p), q) for s, p, q in stream(300)
    ]
    feed(checks, poses)
    assert Kind.TWO_PUBLISHERS not in kinds(checks)


def test_a_second_pose_of_the_same_stamp_is_dropped(checks):
    (first, p, q), (_, p2, q2) = stream(2)
    assert checks.check(first, None, p, q).use == "accept"
    assert checks.check(first, None, p, q).kind is Kind.REPEATED
    assert checks.check(first, None, p2, q2).kind is Kind.DUPLICATE
