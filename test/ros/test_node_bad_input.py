"""The node stays up, says what is wrong, marks its output invalid where it is, and recovers."""

import math
import time

import numpy as np
import pytest

from ctr_dynamics.io.messages import topics

pytestmark = pytest.mark.ros

NAN = math.nan


def assert_goes_on(live) -> None:
    """Steps keep coming, valid, each stamp later than the one before, and every number finite."""
    live.wait_for_more(topics.TIP_POSE, 60)
    stamps = live.stamps(topics.TIP_POSE)
    assert np.all(np.diff(stamps) > 0)
    for message in live.messages(topics.TIP_POSE)[-60:]:
        p, q = message.pose.pose.position, message.pose.pose.orientation
        assert np.all(np.isfinite([p.x, p.y, p.z, q.x, q.y, q.z, q.w, *message.pose.covariance]))
    live.wait_for_status(
        "output", 0, "valid"
    )  # diagnostics come once a second: the last one may be older than these steps


def test_poses_that_cannot_be_used(start):
    with start() as live:
        robot = live.resting_robot()
        live.wait_for_more(topics.INNOVATION, 2)
        robot.tracker_on = False
        p, q = robot.agreeing_pose().position, robot.agreeing_pose().quaternion_xyzw
        robot.tracker(time.time_ns(), (NAN, 0.0, 0.1), q)
        live.wait_for_status("tracker", 1, "not finite")
        robot.tracker(time.time_ns(), p, (NAN, 0.0, 0.0, 1.0))
        live.wait_for_status("tracker", 1, "not finite', '2")
        robot.tracker(time.time_ns(), p, (0.0, 0.0, 0.0, 0.0))
        live.wait_for_status("tracker", 1, "norm 0")
        robot.tracker(time.time_ns(), p, q, frame="polaris")
        live.wait_for_status("tracker", 1, "'polaris'")
        stamp = time.time_ns()
        robot.tracker(stamp, p, q)
        robot.tracker(stamp, (p[0] + 1e-3, *p[1:]), q)
        live.wait_for_status("tracker", 1, "duplicate stamp")
        robot.tracker(stamp - 60_000_000_000, p, q)
        live.wait_for_status("tracker", 1, "limit")
        robot.tracker_on = True
        assert_goes_on(live)


def test_a_frozen_tracker_is_left_out_and_named(start):
    with start() as live:
        robot = live.resting_robot()
        live.wait_for_more(topics.INNOVATION, 2)
        robot.tracker_frozen = True
        status = live.wait_for_status("tracker", 1, "the tracker is frozen")
        assert "frozen" in {value.key for value in status.values}
        robot.tracker_frozen = False
        live.wait_for_more(topics.INNOVATION, 5)
        assert_goes_on(live)


def test_joint_states_that_cannot_be_used(start):
    with start() as live:
        robot = live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 20)
        robot.joints(time.time_ns(), ["a", "b", "c", "d"])
        live.wait_for_status("joints", 1, "tube1_rotation")
        robot.joints(time.time_ns(), positions=[NAN, *robot.positions[1:]])
        live.wait_for_status("joints", 1, "not finite")
        robot.joints(time.time_ns(), positions=[robot.positions[0], -300.0, *robot.positions[2:]])
        live.wait_for_status("joints", 1, "299.7 m")
        stamp = robot.joint_stamps[-1]
        robot.joints(stamp)
        robot.joints(stamp)
        live.wait_for_status("joints", 1, "duplicate stamp")
        robot.joints(time.time_ns() - 60_000_000_000)
        live.wait_for_status("joints", 1, "time ran backwards")
        robot.joints(time.time_ns() + 3_600_000_000_000)
        live.wait_for_status("joints", 1, "stamp ahead")
        assert_goes_on(live)
        assert abs(live.stamps(topics.TIP_POSE)[-1] - time.time_ns()) < 60_000_000_000


def test_joint_states_without_stamps_start_no_time_line(start):
    with start() as live:
        robot = live.resting_robot(joints_on=False)
        for _ in range(20):
            robot.joints(0)
            time.sleep(0.01)
        live.wait_for_status("joints", 1, "stamp zero")
        assert live.count(topics.VALID) == 0
        robot.joints_on = True
        live.wait_for_more(topics.TIP_POSE, 50)
        assert live.stamps(topics.TIP_POSE)[0] >= robot.joint_stamps[0]
        log = live.process.output()
        assert " s behind" not in log, log
        assert "stamp ahead" not in str(live.status("joints").values)


def test_undecodable_messages_are_counted(start):
    with start() as live:
        robot = live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 20)
        # A message that the middleware takes and that ends inside a field.
        robot.publishers[topics.TRACKER_TIP].publish(b"\x00\x01\x00\x00" + bytes(12))
        live.wait_for_status("topics", 1, topics.TRACKER_TIP)
        assert_goes_on(live)


def test_a_gap_of_the_joints_makes_the_output_invalid_until_they_return(start):
    with start() as live:
        robot = live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 50)
        robot.joints_on = False
        live.wait(lambda: False in live.valid()[-1:], "an invalid step")
        poses = live.count(topics.TIP_POSE)
        status = live.wait_for_status("output", 2, "limit 0.1 s")
        assert "joint" in status.message
        live.wait_for_more(topics.VALID, 700)  # steps go on for two seconds
        assert live.count(topics.TIP_POSE) == poses
        robot.joints_on = True
        live.wait_for_more(topics.TIP_POSE, 60)
        live.wait_for_status("output", 0)
        assert_goes_on(live)
        stamps = live.stamps(topics.TIP_POSE)
        assert not np.any((np.array(stamps) - stamps[0]) % topics.STEP_NS)


def test_stamps_of_another_clock_are_followed_and_said(start):
    with start() as live:
        robot = live.resting_robot(shift_ns=-50_000_000 * 1_000_000_000)
        live.wait_for_status("clock", 1, "behind the node's clock")
        live.wait_for_more(topics.TIP_POSE, 100)
        assert abs(live.stamps(topics.TIP_POSE)[-1] - robot.joint_stamps[-1]) < 10_000_000_000


def test_stamps_that_go_back_are_withheld_until_they_are_new_again(start):
    with start() as live:
        robot = live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 50)
        robot.shift_ns = -3_000_000_000
        live.wait_for_status("joints", 1, "time ran backwards")
        status = live.wait_for_status("timing", 2, "before the last published stamp")
        assert "~/reset" in status.message
        assert_goes_on(live)  # three seconds later the stamps are new


def test_stamps_that_go_back_for_good_are_taken_after_a_reset(start):
    with start() as live:
        robot = live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 50)
        robot.shift_ns = -3_600_000_000_000
        live.wait_for_status("timing", 2, "before the last published stamp")
        last = live.stamps(topics.TIP_POSE)[-1]
        assert live.trigger("reset").success
        live.wait_for_more(topics.TIP_POSE, 60)
        assert live.stamps(topics.TIP_POSE)[-1] < last
