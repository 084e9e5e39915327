"""All streams together, over recordings; loads and findings."""

from __future__ import annotations

from pathlib import Path

import pytest
from stream_cases import BETA, T0, PoseStream, joint_rows

from ctr_dynamics.io.bag_reader import InputMessage, open_bag
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn
from ctr_dynamics.robot import cantilever
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.sensing.checks import Findings, InputChecks, Kind, LoadChecks
from ctr_dynamics.sensing.checks.input_checks import check_messages

BAGS = Path(__file__).parents[1] / "data" / "bags"
WEIGHT = 0.06 * 9.81  # N


@pytest.mark.parametrize("name", sorted(p.name for p in BAGS.glob("*.mcap")))
@pytest.mark.parametrize("robot", ["till2020_tissue", None])
def test_nothing_is_found_in_clean_recordings(name, robot):
    found = check_messages(open_bag(BAGS / name).inputs(), robot and load_robot(robot))
    assert [f.line() for f in found] == []


@pytest.mark.parametrize("robot", [True, False])
def test_findings_of_a_recording_name_stream_time_and_count(robot):
    names = ("tube1_rotation", "tube1_translation", "tube2_rotation", "tube2_translation")
    messages = []
    for k, (stamp, arrival, (a, b), _) in enumerate(joint_rows(200)):
        a += 1.0 if k == 100 else 0.0
        state = JointStateIn(stamp, "", names, (a, BETA[0], b, BETA[1]))
        messages.append(InputMessage("/ctr/joint_states", arrival, state))
    source = PoseStream()
    for k in range(80):
        pose = PoseIn(
            T0 + k * 25_000_000, "ctr_base", *(source.pose(k * 0.025) if k < 40 else ((0.0,) * 3, (0.0,) * 4))
        )
        messages.append(InputMessage("/ctr/tracker/tip", T0 + k * 25_000_000, pose))
    messages.sort(key=lambda m: m.log_ns)
    found = {
        (f.stream, f.kind): f
        for f in check_messages(messages, load_robot("till2020_tissue") if robot else None)
    }
    assert found.keys() == {("joints", Kind.GLITCH), ("tracker", Kind.PLACEHOLDER)}
    line = found["tracker", Kind.PLACEHOLDER].line(T0)
    assert line.startswith("placeholder (40 from 1.000 to 1.975 s): ")


def test_a_robot_may_be_unknown_and_its_joints_missing():
    pose = PoseIn(T0, "other", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0))
    found = check_messages([InputMessage("/ctr/tracker/tip", T0, pose)])
    assert [f.kind for f in found] == [Kind.OTHER_FRAME]
    assert check_messages([]) == []


def test_poses_are_judged_by_the_clock_of_the_joints():
    checks = InputChecks(2, load_robot("till2020_tissue"))
    rows = joint_rows(50)
    for row in rows:
        checks.joint_state(*row)
    position, quaternion = PoseStream().pose(0.0)
    late = checks.pose(rows[-1][0] - 7200 * 10**9, rows[-1][1], position, quaternion)
    assert late.kind is Kind.OTHER_CLOCK
    assert "2 h" in late.text


def test_joints_without_stamps_do_not_make_the_tracker_wrong():
    checks = InputChecks(2, load_robot("till2020_tissue"))
    for _, arrival, rotations, beta in joint_rows(50):
        checks.joint_state(0, arrival, rotations, beta)
    position, quaternion = PoseStream().pose(0.0)
    assert checks.pose(T0, T0, position, quaternion).use == "accept"
    assert [f.kind for f in checks.findings()] == [Kind.STAMP_ZERO]


def test_arrivals_of_zero_are_none():
    checks = InputChecks(2, load_robot("till2020_tissue"))
    assert {checks.joint_state(s, 0, r, b).use for s, _, r, b in joint_rows(100)} == {"accept"}


def test_a_reset_forgets_clocks_and_keeps_findings():
    checks = InputChecks(2, load_robot("till2020_tissue"))
    rows = joint_rows(50)
    for row in rows:
        checks.joint_state(*row)
    assert checks.joint_state(rows[0][0] - 10**12, rows[-1][1], *rows[0][2:]).use == "drop"
    checks.forget()
    assert checks.joint_state(rows[0][0] - 10**12, rows[-1][1], *rows[0][2:]).use == "accept"
    assert [f.kind for f in checks.findings()] == [Kind.LATE]


@pytest.fixture
def loads() -> LoadChecks:
    return LoadChecks(load_robot("till2020_tissue"))


def test_a_weight_on_the_tip_is_accepted(loads):
    assert loads.check(T0, T0, (0.0, -WEIGHT, 0.0), (0.0336 * WEIGHT, 0.0, 0.0), "ctr_base").use == "accept"
    assert loads.check(T0 + 1, T0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)).use == "accept"
    assert not list(loads.findings)


@pytest.mark.parametrize("robot", ["till2020_tissue", "till2020_snap_example", "three_tube"])
def test_fifty_newtons_are_beyond_reason_on_every_robot(robot):
    verdict = LoadChecks(load_robot(robot)).check(T0, None, (0.0, -50.0, 0.0), (0.0, 0.0, 0.0))
    assert (verdict.use, verdict.kind) == ("drop", Kind.BEYOND_REASON)
    assert "limit" in verdict.text


def test_moments_are_limited_too(loads):
    assert loads.check(T0, None, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)).kind is Kind.BEYOND_REASON


def test_loads_of_other_frames_and_without_numbers_are_dropped(loads):
    assert loads.check(T0, None, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), "tool").kind is Kind.OTHER_FRAME
    assert loads.check(T0, None, (0.0, float("inf"), 0.0), (0.0, 0.0, 0.0)).kind is Kind.NOT_FINITE


def test_the_compliance_is_that_of_a_cantilever():
    robot = load_robot("till2020_tissue")
    inner = robot.tubes[0]
    alone = cantilever(robot, (robot.rest.beta.value[0], -robot.tubes[1].length))
    length = inner.length + robot.rest.beta.value[0]
    stiffness = (
        inner.youngs_modulus.value
        * 0.7853981633974483
        * (inner.outer_radius.value**4 - inner.inner_radius.value**4)
    )
    assert alone.length == pytest.approx(length)
    assert alone.turn == pytest.approx(length**2 / (2 * stiffness))
    assert alone.turn_by_moment == pytest.approx(length / stiffness)


def test_findings_keep_the_worst_and_can_be_taken_back():
    found = Findings("joints")
    found.add(Kind.JUMP, 10, 1.0, "rad", "one")
    found.add(Kind.JUMP, 30, 3.0, "rad", "three", count=2)
    found.add(Kind.JUMP, 20, 2.0, "rad", "two")
    assert (found.count(Kind.JUMP), found[Kind.JUMP].text, found[Kind.JUMP].last_ns) == (4, "three", 30)
    found.uncount(Kind.JUMP, 4)
    assert Kind.JUMP not in found
