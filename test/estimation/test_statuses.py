"""Statuses of inputs: the newest problem while it is recent, totals for ever."""

import pytest

from ctr_dynamics.estimation.estimator import Estimator
from ctr_dynamics.estimation.monitoring.health import RECENT_S, Health
from ctr_dynamics.estimation.monitoring.statuses import all_statuses
from ctr_dynamics.io.messages.topics import STEP_NS
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot

RECENT_STEPS = round(RECENT_S * 1e9 / STEP_NS)


def status(health, name):
    return next(s for s in all_statuses(health) if s.name == name)


def noted(group="joints"):
    health = Health()
    health.note(group, "not finite", "tube1_rotation is nan", 30)
    return health


@pytest.mark.parametrize("group", ["joints", "tracker", "load"])
def test_the_newest_kind_is_told_and_not_the_most_frequent(group):
    health = noted(group)
    health.steps += 10
    health.note(group, "jump", "by 3 rad")
    found = status(health, group)
    assert (found.level, found.message) == (1, "jump (1): by 3 rad")
    assert found.values["not finite"] == "30, last: tube1_rotation is nan"
    health.note(group, "not finite", "tube2_rotation is nan")
    assert status(health, group).message == "not finite (31): tube2_rotation is nan"


def test_what_is_over_for_long_is_no_warning_and_stays_counted():
    health = noted()
    health.note("joints", "jump", "by 3 rad")
    health.steps += RECENT_STEPS - 1
    assert status(health, "joints").level == 1
    health.steps += 2
    found = status(health, "joints")
    assert (found.level, found.message) == (0, "ok; earlier: jump (1), not finite (30)")
    assert found.values["not finite"].startswith("30, last")
    assert health.summary()["input_problems"]["joints"]["not finite"]["count"] == 30
    health.note("joints", "not finite", "tube1_rotation is inf")
    assert status(health, "joints").message == "not finite (31): tube1_rotation is inf"


def test_what_is_put_down_to_another_kind_is_not_news():
    health = noted()
    health.steps += RECENT_STEPS + 1
    health.note("joints", "not finite", "", -10)
    assert status(health, "joints").message == "ok; earlier: not finite (20)"
    health.note("joints", "not finite", "", -20)
    assert status(health, "joints").message == "ok"


def test_a_tracker_without_usable_poses_tells_what_is_wrong_with_them():
    health = Health(tracker_age_s=3.5)
    silent = "no usable measurement for 3.5 s, limit 1 s: the pose is the model's prediction since then"
    assert status(health, "tracker").message == silent
    health.note("tracker", "other frame", "pose in frame 'aurora', expected 'ctr_base'")
    assert (
        status(health, "tracker").message
        == f"{silent}; the last: pose in frame 'aurora', expected 'ctr_base'"
    )
    health.steps += RECENT_STEPS + 1
    assert status(health, "tracker").message == silent


@pytest.mark.parametrize(
    ("period_ms", "slow"), [(10, False), (20, False), (45, False), (60, True), (200, True)]
)
def test_slow_joint_states_are_named(period_ms, slow):
    health = Health()
    health.joint_stamps.extend(k * period_ms * 1_000_000 for k in range(8))
    found = status(health, "joints")
    assert found.level == slow
    assert (f"every {period_ms * 1e-3:g} s" in found.message) == slow
    assert ("limit 0.05 s" in found.message) == slow
    health.reinitialise()
    assert status(health, "joints").message == "ok"


def test_the_estimator_tells_the_period_of_its_joint_states():
    robot = load_robot("till2020_tissue")
    made = Estimator(robot, Settings({"input_timeout_s": 0.5}))
    names = [f"tube{i}_{kind}" for kind in ("rotation", "translation") for i in (1, 2)]
    rest = [*robot.rest.alpha.value, *robot.rest.beta.value]
    for k in range(8):
        made.add_joint_state(1_000_000_000 + k * 200_000_000, names, rest)
    assert "joint states come every 0.2 s" in status(made.health, "joints").message
    made.reset()
    assert status(made.health, "joints").message == "ok"


def test_one_gap_does_not_make_joint_states_slow():
    health = Health()
    health.joint_stamps.extend(k * 10_000_000 + (k > 4) * 2_000_000_000 for k in range(8))
    assert status(health, "joints").message == "ok"


def test_slow_joint_states_are_named_beside_a_problem():
    health = noted()
    health.joint_stamps.extend(k * 200_000_000 for k in range(8))
    found = status(health, "joints")
    assert found.message.startswith("not finite (30): tube1_rotation is nan; joint states come every 0.2 s")
    assert found.level == 1
