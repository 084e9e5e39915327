"""Faults of drivers, tracker and machine over DDS: each is named, and the valid tip stays where the robot is."""

import signal
import time

import numpy as np
import pytest

from ctr_dynamics.io.messages import topics

pytestmark = pytest.mark.ros


def assert_kept(live, tip) -> None:
    """Every valid pose lies within 3 mm or three of its deviations of `tip` (3,) m, and none was stamped after it came."""
    for message, heard in zip(
        live.messages(topics.TIP_POSE), live.listener.received[topics.TIP_POSE], strict=False
    ):
        p, covariance = message.pose.pose.position, np.array(message.pose.covariance).reshape(6, 6)
        error = np.linalg.norm(np.array([p.x, p.y, p.z]) - tip)
        assert error < max(3e-3, 3.0 * np.sqrt(np.trace(covariance[:3, :3])))
        stamp = message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec < heard.arrival_ns + topics.STEP_NS


def test_faults_of_drivers_and_tracker_are_named_and_leave_the_tip_where_it_is(start):
    with start() as live:
        robot = live.resting_robot()
        live.wait_for_more(topics.INNOVATION, 2)
        tip = np.array(robot.agreeing_pose().position)  # at rest: the equilibrium
        robot.joints(time.time_ns() + 900_000_000)
        live.wait_for_status("joints", 1, "stamp ahead")
        for _ in range(30):  # a second driver, 0.5 rad away
            robot.joints(time.time_ns(), positions=[x + 0.5 * (x > 0) for x in robot.positions])
            time.sleep(0.01)
        live.wait_for_status("joints", 1, "two publishers")
        for _ in range(20):
            robot.tracker(time.time_ns(), (1e160, -1e160, 1e160), robot.agreeing_pose().quaternion_xyzw)
            time.sleep(0.01)
        live.wait_for_status("tracker", 1, "out of reach")
        robot.load(time.time_ns(), (0.0, -50.0, 0.0))
        live.wait_for_status("load", 1, "beyond reason")
        live.wait_for_more(topics.TIP_POSE, 200)
        assert_kept(live, tip)
        live.wait_for_status("output", 0)


def test_outputs_of_a_stopped_process_are_invalid_and_come_back(start):
    with start({"output.max_age_s": 0.5}) as live:
        robot = live.resting_robot()
        live.wait_for_more(topics.INNOVATION, 2)
        tip = np.array(robot.agreeing_pose().position)
        live.process.send(signal.SIGSTOP)
        time.sleep(2.0)
        live.process.send(signal.SIGCONT)
        # what is said at once: the first statuses after the stop
        live.wait_for_status("output", 2, "old when it goes out")
        live.wait_for_status("output", 0)
        live.wait_for_more(topics.TIP_POSE, 100)
        heard = live.listener.received
        came = [message.arrival_ns for message in heard[topics.TIP_POSE]]
        # of half a second when they go out, and under way for a while
        old = [
            ns for ns, stamp in zip(came, live.stamps(topics.TIP_POSE), strict=False) if ns - stamp > 1.5e9
        ]
        # one may have been half sent when the process was stopped: then the next thing that is said is that it is invalid
        assert len(old) <= 1
        said = zip([message.arrival_ns for message in heard[topics.VALID]], live.valid(), strict=False)
        for came_ns in old:
            assert not next(valid for ns, valid in said if ns > came_ns - 0.5e9)
        assert_kept(live, tip)


@pytest.mark.parametrize("how", ["start", "reset"])
def test_a_start_in_motion_is_said_and_waits_until_the_motion_is_known(start, how):
    with start() as live:
        robot = live.resting_robot(turning=1.0 if how == "start" else 0.0)
        if how == "reset":
            live.wait_for_more(topics.TIP_POSE, 20)
            robot.turning = 1.0
            assert live.trigger("reset").success
        live.wait_for_status("output", 2, "started while the robot moved")
        live.wait_for_more(topics.TIP_POSE, 20)
        robot.turning = 0.0  # a slow machine cannot go on with this for as long as it takes
        live.wait_for_status("output", 0)
