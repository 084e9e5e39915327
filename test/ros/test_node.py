"""The estimator node over real DDS: contract of topics, stamps, services and parameters."""

import json
import re
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from rclpy.qos import ReliabilityPolicy
from std_msgs.msg import Bool
from std_srvs.srv import SetBool

from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.robot_files import load_robot, robot_to_yaml
from ctr_dynamics.ros.node_processes import DRIVER, ESTIMATOR, NodeProcess
from ctr_dynamics.ros.qos import profile

VIEW = "ctr_dynamics.ros.view_node"
pytestmark = pytest.mark.ros


def test_topics_services_and_qos_are_the_contract(start):
    with start() as live:
        node = live.listener.node

        def known(ends):
            """Discovery tells endpoints before the name of their node."""
            return len(ends) == 1 and "UNKNOWN" not in ends[0].node_name

        for topic in topics.OUTPUTS:
            live.wait(
                lambda name=topic.name: known(node.get_publishers_info_by_topic(name)),
                f"the publisher of {topic.name}",
            )
            [end] = node.get_publishers_info_by_topic(topic.name)
            assert (end.node_namespace, end.node_name) == ("/ctr", "estimator")
            assert end.topic_type == topic.ros_type
            assert end.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        for topic in topics.INPUTS:
            live.wait(
                lambda name=topic.name: known(node.get_subscriptions_info_by_topic(name)),
                f"a subscription to {topic.name}",
            )
            [end] = node.get_subscriptions_info_by_topic(topic.name)
            assert (end.node_namespace, end.node_name) == ("/ctr", "estimator")
            assert end.topic_type == topic.ros_type
            assert end.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        live.wait(lambda: node.count_services("/ctr/estimator/enable_fusion"), "the services")
        services = dict(node.get_service_names_and_types_by_node("estimator", "/ctr"))
        assert services["/ctr/estimator/reset"] == ["std_srvs/srv/Trigger"]
        assert services["/ctr/estimator/save_snapshot"] == ["std_srvs/srv/Trigger"]
        assert services["/ctr/estimator/enable_fusion"] == ["std_srvs/srv/SetBool"]
        status = live.wait_for_status("output", 2)
        assert "joint state" in status.message


@pytest.mark.parametrize("policy", ["predict", "wait"])
def test_every_step_has_its_stamp_once(start, on_grid, policy):
    # a driver that a busy machine holds up is not a silent one
    with start({"output.policy": policy, "input_timeout_s": 4.0}) as live:
        robot = live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 400)
        live.wait_for_more(topics.BACKBONE, 3)
        live.wait_for_more(topics.INNOVATION, 3)
        t0 = live.stamps(topics.TIP_POSE)[0]
        assert t0 in robot.joint_stamps
        for topic in (topics.TIP_POSE, topics.TIP_TWIST, topics.TIP_POSE_PREDICTED, topics.BACKBONE_STATE):
            stamps = live.stamps(topic)
            on_grid(stamps, t0)
            assert np.all(np.diff(stamps) == topics.STEP_NS), topic
        display = live.stamps(topics.BACKBONE)
        assert not np.any((np.array(display) - t0) % (topics.BACKBONE_EVERY * topics.STEP_NS))
        assert all(pose.header.frame_id == "ctr_base" for pose in live.messages(topics.TIP_POSE))
        assert all(live.valid())
        cloud = live.messages(topics.BACKBONE_STATE)[-1]
        assert tuple(field.name for field in cloud.fields) == topics.BACKBONE_FIELDS
        assert np.all(np.isfinite(np.frombuffer(cloud.data, np.float32)))


def test_reset_reinitialises_and_repeats_no_stamp(start):
    with start() as live:
        live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 50)
        answer = live.trigger("reset")
        assert answer.success, answer.message
        live.wait_for_more(topics.TIP_POSE, 150)
        stamps = live.stamps(topics.TIP_POSE)
        assert np.all(np.diff(stamps) > 0)
        live.wait_for_status("timing", None, "('restarts', '1')")


def test_snapshot_is_a_file_that_says_where_the_estimator_stands(start):
    with start() as live:
        live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 20)
        answer = live.trigger("save_snapshot")
        assert answer.success, answer.message
        path = Path(answer.message.removeprefix("saved "))
        content = json.loads(path.read_text())
        path.unlink()
        assert content["robot"] == "till2020_tissue"
        assert content["parameters"]["output.policy"] == "predict"
        assert content["estimator"]["k"] >= 0


def test_fusion_can_be_switched_off_and_on(start):
    with start() as live:
        live.resting_robot()
        live.wait_for_more(topics.INNOVATION, 2)
        answer = live.call("enable_fusion", SetBool.Request(data=False))
        assert answer.success, answer.message
        assert "off" in answer.message
        live.wait_for_status("tracker", None, "('fusion', 'off')")
        assert live.get_parameters(["filter.enabled"])[0].bool_value is False
        live.wait_for_more(topics.TIP_POSE, 20)
        assert live.call("enable_fusion", SetBool.Request(data=True)).success
        live.wait_for_status("tracker", None, "('fusion', 'on')")


def test_parameters_are_checked_when_set(start):
    with start({"input_timeout_s": 1, "tracker.lever_arm_m": [0.0, 0.0, 0.001]}) as live:
        timeout, lever = live.get_parameters(["input_timeout_s", "tracker.lever_arm_m"])
        assert timeout.double_value == 1.0
        assert list(lever.double_array_value) == [0.0, 0.0, 0.001]
        refused = live.set_parameter("filter.gate_probability", 2.0)
        assert not refused.successful
        assert "filter.gate_probability" in refused.reason
        fixed = live.set_parameter("robot", "three_tube")
        assert not fixed.successful
        mask = live.set_parameter("tracker.axes", "zyx")
        assert not mask.successful
        assert "xyzrpy" in mask.reason
        assert live.set_parameter("tracker.axes", "xyz").successful
        live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 10)


def test_the_clock_is_that_of_the_start(start):
    with start() as live:
        answer = live.set_parameter("use_sim_time", True)
        assert not answer.successful
        assert "start it again" in answer.reason
        assert live.set_parameter("use_sim_time", False).successful
        live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 20)


@pytest.mark.parametrize(
    ("yaml", "wanted"),
    [
        ("filter.rnk: 3", r"filter\.rnk.*did you mean filter\.rank"),
        ("input_timeout_s: 99.0", r"input_timeout_s.*99 s.*0\.003 to 10 s"),
        ("output.policy: maybe", r"output\.policy.*'maybe'.*wait or predict"),
        ("filter.rank: two", r"filter\.rank.*'two'.*whole number"),
        ("tracker.lever_arm_m: [1.0, 2.5]", r"tracker\.lever_arm_m"),
        ("tracker.lever_arm_m: [0, 2.5, 0]", r"same type"),
        ("robot: nobody", r"'nobody'.*till2020_tissue"),
        (
            "timing_report: /no/such/folder/t.json",
            r"timing_report '/no/such.*does not exist; create it first",
        ),
        ("record.path: /no/such/folder/t.mcap", r"record\.path '/no/such.*does not exist; create it first"),
    ],
)
def test_parameters_of_a_file_are_rejected_with_a_clear_line(tmp_path, yaml, wanted):
    file = tmp_path / "parameters.yaml"
    file.write_text(f"/ctr/estimator:\n  ros__parameters:\n    {yaml}\n")
    process = NodeProcess(ESTIMATOR, {}, 1, tmp_path / "log", ["--params-file", str(file)])
    assert process.wait(120) == 2, process.output()
    line = process.output().splitlines()[-1]
    assert re.match(f"estimator: .*{wanted}", line), line


@pytest.mark.parametrize(
    ("module", "wrong", "wanted"),
    [
        (DRIVER, {"start_s": -1.0}, r"driver: .*start_s.*-1 s.*0 to 1e\+06 s"),
        (DRIVER, {"depth": 0}, r"driver: .*depth.*1 to 10000"),
        (DRIVER, {"reliability": "total"}, r"driver: .*'total'.*best_effort or reliable"),
        (DRIVER, {"star_s": 1.0}, r"driver: .*star_s is unknown; did you mean start_s"),
        (DRIVER, {"report": "BAG"}, r"driver: BAG: report is the bag in\.mcap that is read"),
        (VIEW, {"rate_hz": 0.0}, r"view: .*rate_hz.*0\.01 to 1000 Hz"),
        (ESTIMATOR, {"robot": "ROBOT", "timing_report": "ROBOT"}, r"estimator: ROBOT: timing_report is the robot file"),
    ],
)  # fmt: skip
def test_what_no_node_can_use_ends_it_with_one_line(tmp_path, bags, module, wrong, wanted):
    files = {"BAG": tmp_path / "in.mcap", "ROBOT": tmp_path / "robot.yaml"}
    shutil.copyfile(bags / "clean_release.mcap", files["BAG"])
    files["ROBOT"].write_text(robot_to_yaml(load_robot("till2020_tissue")))
    before = [file.read_bytes() for file in files.values()]
    given = {name: str(files[value]) if value in files else value for name, value in wrong.items()}
    bag = {"bag": str(files["BAG"])} if module == DRIVER else {}
    process = NodeProcess(module, {**bag, **given}, 1, tmp_path / "log")
    assert process.wait(120) == 2, process.output()
    for name, file in files.items():
        wanted = wanted.replace(name, re.escape(str(file)))
    assert re.match(wanted, process.output().splitlines()[-1]), process.output()
    assert [file.read_bytes() for file in files.values()] == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_node_with_code_0(start, tmp_path, number):
    report, recording = tmp_path / "timing.json", tmp_path / "live.mcap"
    with start({"timing_report": str(report), "record.path": str(recording)}) as live:
        live.resting_robot()
        live.wait_for_more(topics.TIP_POSE, 100)
        live.process.send(number)
        assert live.process.wait(120) == 0, live.process.output()
        heard = live.count(topics.TIP_POSE)
    timing = json.loads(report.read_text())
    assert timing["steps"] + timing["start"]["steps"] >= heard
    assert timing["skipped"] == 0
    bag = open_bag(recording)
    assert bag.notes == []
    assert bag.topics[topics.TIP_POSE].messages >= heard
    assert bag.topics[topics.JOINT_STATES].messages > 0


@pytest.mark.parametrize("into_compiling_s", [0.0, 0.7, 1.7])
def test_a_signal_while_starting_ends_with_code_0(tmp_path, monkeypatch, into_compiling_s):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "empty"))  # compiled anew, not loaded
    process = NodeProcess(ESTIMATOR, {}, 1, tmp_path / "log")
    while "compiling" not in process.output() and process.code is None:
        time.sleep(0.01)
    time.sleep(into_compiling_s)
    process.send(signal.SIGTERM)
    assert process.wait(120) == 0, process.output()
    assert "kernels ready" not in process.output()


@pytest.mark.parametrize("reliability", ["best_effort", "reliable"])
def test_a_driver_of_either_reliability_is_heard(start, bags, tmp_path, reliability):
    with start() as live:
        played = {
            "bag": str(bags / "clean_release.mcap"),
            "duration_s": 0.5,
            "reliability": reliability,
            "report": str(tmp_path / "driver.json"),
        }
        with NodeProcess(DRIVER, played, live.domain, tmp_path / "driver.log") as driver:
            assert driver.wait(120) == 0, driver.output()
        live.wait(lambda: live.count(topics.TIP_POSE) >= 160, "the steps of half a second")
        report = json.loads((tmp_path / "driver.json").read_text())
        assert report["messages"] == report["of"] > 0
        if reliability == "reliable":
            assert live.stamps(topics.TIP_POSE)[0] == report["first_log_time_ns"] + report["shift_ns"]


def test_an_incompatible_driver_is_an_error_in_the_diagnostics(start):
    with start({"qos.subscription_reliability": "reliable"}) as live:
        live.resting_robot(matched=False)
        status = live.wait_for_status("topics", 2, topics.JOINT_STATES)
        assert "RELIABILITY" in status.message
        assert "qos.subscription_reliability" in status.message


def test_an_incompatible_subscriber_is_an_error_in_the_diagnostics(start):
    heard = [topics.DIAGNOSTICS]
    with start({"qos.publisher_reliability": "best_effort"}, heard=heard, reliability="best_effort") as live:
        live.listener.node.create_subscription(
            Bool, topics.VALID, lambda message: None, profile("reliable", 10)
        )
        status = live.wait_for_status("topics", 2, topics.VALID)
        assert "qos.publisher_reliability" in status.message


def test_sim_time_follows_the_clock_topic(start, bags, tmp_path):
    bag = bags / "clean_release.mcap"
    with start({"use_sim_time": True, "output.policy": "wait"}) as live:
        live.wait_for_status("clock", 1, "no /clock")
        played = {"bag": str(bag), "duration_s": 0.5, "clock_hz": 200.0, "reliability": "reliable"}
        with NodeProcess(DRIVER, played, live.domain, tmp_path / "driver.log") as driver:
            assert driver.wait(120) == 0, driver.output()
        live.wait(lambda: live.count(topics.TIP_POSE) >= 160, "the steps of half a second")
        first = next(iter(open_bag(bag).inputs())).message.stamp_ns
        stamps = live.stamps(topics.TIP_POSE)
        assert (stamps[0] - first) % topics.STEP_NS == 0
        assert abs(stamps[0] - first) < 1_000_000_000
