"""What the buffer of inputs says of joints and loads that it takes in."""

import numpy as np
import pytest
from estimation_cases import JOINTS, START_NS, estimator, joints

from ctr_dynamics.robot_files import load_robot, robot_from_dict, robot_to_dict

MS = 1_000_000
REST = (1.5708, 1.5708, -0.2521, -0.1977)


def taken_at_rest(until_s):
    """An estimator that has taken its steps, with joints of a robot at rest."""
    made = estimator({"output.policy": "predict"})
    for k in range(round(100 * until_s) + 1):
        joints(0.01 * k, REST).give(made)
    made.advance(START_NS + round(until_s * 1e9))
    return made


def add(made, after_ms, change=0.0):
    """Returns from when on (ms) a joint state ``after_ms`` (ms) after the start changes what is known; None where it does not."""
    positions = list(REST)
    positions[0] += change
    from_ns = made.inputs.add_joints(START_NS + after_ms * MS, JOINTS, positions)
    return None if from_ns is None else round((from_ns - START_NS) / MS)


def test_a_joint_state_between_two_gaps_changes_what_was_held_over_the_first():
    made = taken_at_rest(0.02)
    assert add(made, 170, 0.1) is None, "the next one tells the rate there"
    assert add(made, 320, 0.2) == 20
    assert add(made, 330, 0.2) == 170


def test_a_joint_state_after_a_gap_that_comes_twice_ends_it():
    made = taken_at_rest(0.02)
    assert add(made, 170, 0.1) is None
    assert add(made, 170, 0.1) == 20
    assert made.inputs.joints.stamps[-1] == START_NS + 170 * MS


def test_the_first_load_of_a_running_robot_sets_in_at_once():
    made = taken_at_rest(2.0)
    change = made.inputs.add_load(START_NS + 1900 * MS, [0.0, -0.5, 0.0], [0.0, 0.0, 0.0], "")
    assert change.jumped
    assert change.end_ns - change.begin_ns == 1
    assert change.difference == pytest.approx([0.0, -0.5, 0.0, 0.0, 0.0, 0.0])


def test_a_load_with_the_start_has_always_been_there():
    made = taken_at_rest(0.02)
    change = made.inputs.add_load(START_NS + MS, [0.0, -0.5, 0.0], [0.0, 0.0, 0.0], "")
    assert not change.difference.any()


def test_a_load_ahead_of_the_steps_changes_none_that_were_taken():
    made = taken_at_rest(0.5)
    made.late.load_changed(START_NS + 600 * MS, jumped=True)
    assert not made.late.pending
    made.late.changed(START_NS + 490 * MS)
    assert made.late.pending
    assert made.late.may_go_ahead, "a correction for joints alone, that is not urgent"


def test_a_tracker_without_noise_has_that_of_the_best():
    data = robot_to_dict(load_robot("till2020_tissue"))
    data["tracker"]["noise"]["position"]["value"] = 0.0
    made = estimator({"output.policy": "wait"}, robot=robot_from_dict(data))
    for k in range(20):
        joints(0.01 * k, REST).give(made)
    assert np.isfinite(made.advance()[-1].tip_covariance).all()


def test_a_joint_state_that_is_taken_back_leaves_the_line_between_its_neighbours():
    made = taken_at_rest(0.1)
    assert add(made, 110, 0.12) == 100
    made.advance(START_NS + 110 * MS)
    made.retract_joint_state(START_NS + 110 * MS)
    add(made, 120)
    assert made.late.lag > 0, "steps that used it are corrected"
    assert made.inputs.joints.at(START_NS + 110 * MS)[0] == pytest.approx(np.array(REST), abs=1e-12)
    uncorrected = made.inputs.actuator_error.at(START_NS + 109 * MS)
    assert uncorrected[0] > 0.09, "until then the covariance knows"


def test_a_joint_state_is_not_taken_back_where_that_makes_a_gap_or_leaves_none():
    made = estimator({"output.policy": "predict"})
    for after_ms in (0, 60, 120):
        add(made, after_ms)
    assert made.inputs.retract_joints(START_NS) is None
    assert made.inputs.retract_joints(START_NS + 60 * MS) is None
    assert made.inputs.retract_joints(START_NS + 70 * MS) is None, "it never came"
    assert len(made.inputs.joints.stamps) == 3


def test_a_joint_state_ahead_that_is_taken_back_ends_no_gap():
    made = taken_at_rest(0.02)
    assert add(made, 920, 0.1) is None
    assert made.inputs.retract_joints(START_NS + 920 * MS) is None
    assert add(made, 30) == 20
    assert made.inputs.joints.stamps[-1] == START_NS + 30 * MS


def test_a_pose_that_is_taken_back_is_not_fused():
    made = taken_at_rest(0.02)
    made.add_tracker_pose(START_NS + 900 * MS, [0.0, 0.0, 0.2], [0.0, 0.0, 0.0, 1.0])
    made.retract_tracker_pose(START_NS + 900 * MS)
    assert made.inputs.measurements.measurements == []
    assert made.health.measurements.dropped == 1
