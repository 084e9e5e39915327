"""`inspect` finds each problem that a bag can have, and nothing in the clean ones."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable

import pytest

from ctr_dynamics.cli.main import main
from ctr_dynamics.io.bag_info import BagReport, inspect
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped, encode_wrench_stamped

NAMES = ("tube1_rotation", "tube1_translation", "tube2_rotation", "tube2_translation")
T0 = 1_700_000_000_000_000_000


class Scenario:
    """Two seconds of joints at 100 Hz and tracker at 40 Hz, to be spoiled by a test."""

    def __init__(self) -> None:
        self.names = NAMES
        self.joints = lambda t: (0.3, -0.2, 0.1, -0.1)
        self.position = lambda t: (0.0, 0.05, 0.1)
        self.quaternion = lambda t: (0.0, 0.0, 0.0, 1.0)
        self.frame = "ctr_base"
        self.joint_stamp: Callable[[int], int] = lambda t: t
        self.tracker_stamp: Callable[[int], int] = lambda t: t
        self.skip: Callable[[str, float], bool] = lambda topic, t: False

    def inspect(self, path) -> BagReport:
        messages = []
        for i in range(200):
            messages.append((topics.JOINT_STATES, i * 10_000_000))
        for i in range(80):
            messages.append((topics.TRACKER_TIP, i * 25_000_000))
        with write_bag(path, {}) as writer:
            for topic, t in sorted(messages, key=lambda m: (m[1], m[0])):
                if self.skip(topic, t * 1e-9):
                    continue
                if topic == topics.JOINT_STATES:
                    data = encode_joint_state(self.joint_stamp(T0 + t), self.names, self.joints(t * 1e-9))
                else:
                    data = encode_pose_stamped(
                        self.tracker_stamp(T0 + t),
                        self.frame,
                        self.position(t * 1e-9),
                        self.quaternion(t * 1e-9),
                    )
                writer.write(topic, T0 + t, data)
            writer.write(topics.TIP_LOAD, T0, encode_wrench_stamped(T0, "ctr_base", (0, -0.5, 0), (0, 0, 0)))
        return inspect(path)


@pytest.fixture
def scenario() -> Scenario:
    return Scenario()


def texts(report: BagReport, topic: str | None = None) -> str:
    return "\n".join(f"{f.level} {f.text}" for f in report.problems if topic in (None, f.topic))


@pytest.mark.parametrize("name", ["clean_release", "clean_protocol", "exact_release", "payload_protocol"])
def test_no_problem_in_clean_bags(bags, name):
    report = inspect(bags / f"{name}.mcap")
    assert report.problems == []
    assert report.worst == "ok"
    rates = {t.name: t.rate_hz for t in report.topics}
    assert rates[topics.JOINT_STATES] == pytest.approx(100.0)
    assert rates[topics.TRACKER_TIP] == pytest.approx(40.0)


def test_scenario_is_clean(scenario, tmp_path):
    report = scenario.inspect(tmp_path / "a.mcap")
    assert report.problems == []
    joints = next(t for t in report.topics if t.name == topics.JOINT_STATES)
    assert joints.messages == 200
    assert joints.longest_gap_s == pytest.approx(0.01)
    assert joints.values["tubes"] == 2


def test_load_missing_is_a_note(bags):
    report = inspect(bags / "clean_sweep.mcap")
    assert report.worst == "note"
    assert "taken as zero" in texts(report)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((0.3, -200.0, 0.1, -100.0), r"error tube1_translation reaches 200 m, limit 1 m: millimetres"),
        ((0.3, 0.2, 0.1, 0.3), r"error tube1_translation reaches \+0.2 m, it must be zero or negative"),
        ((170.0, -0.2, 0.1, -0.1), r"error tube1_rotation reaches 170 rad, limit 12.6 rad: degrees"),
        ((0.3, -0.1, 0.1, -0.2), r"error 200 messages break tube1_translation <= tube2_translation"),
        ((math.nan, -0.2, 0.1, -0.1), r"warning 200 numbers are NaN"),
    ],
)
def test_joint_values(scenario, tmp_path, values, expected):
    import re

    scenario.joints = lambda t: values
    assert re.search(expected, texts(scenario.inspect(tmp_path / "a.mcap"), topics.JOINT_STATES))


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("a", "b", "c", "d"), "names found: a, b, c, d"),
        (("tube1_rotation", "tube1_translation", "tube2_rotation", "x"), "missing joints: tube2_translation"),
        (
            ("tube2_rotation", "tube2_translation", "y", "x"),
            "missing joints: tube1_rotation, tube1_translation",
        ),
        ((*NAMES, "more"), "not as many positions as names"),
    ],
)
def test_joint_names(scenario, tmp_path, names, expected):
    scenario.names = names
    report = scenario.inspect(tmp_path / "a.mcap")
    assert expected in texts(report, topics.JOINT_STATES)
    assert report.worst == "error"


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"position": lambda t: (0.0, 50.0, 100.0)}, "error positions reach 100 m, limit 1 m: millimetres"),
        ({"position": lambda t: (0.0, math.nan, 0.1)}, "warning 80 numbers are NaN"),
        (
            {"quaternion": lambda t: (0.0, 0.0, 0.0, 1.1)},
            "warning 80 quaternions are not of unit length (norm 1.1",
        ),
        ({"quaternion": lambda t: (0.0, 0.0, 0.0, 0.0)}, "warning 80 quaternions are zero"),
        ({"frame": "tracker"}, "error 80 messages are in frame 'tracker', 'ctr_base' is expected"),
        (
            {"skip": lambda topic, t: topic == topics.TRACKER_TIP and t < 1.2},
            "starts 1.200 s after the joints",
        ),
        (
            {"skip": lambda topic, t: topic == topics.JOINT_STATES and t < 1.2},
            "starts 1.200 s before the joints",
        ),
        (
            {"skip": lambda topic, t: topic == topics.TRACKER_TIP and t > 0.8},
            "ends 1.190 s before the joints",
        ),
        (
            {"skip": lambda topic, t: topic == topics.TRACKER_TIP and 0.5 < t < 1.5},
            "1 gaps longer than 0.5 s, the longest 1.000 s at 0.500 s",
        ),
        ({"skip": lambda topic, t: topic == topics.TRACKER_TIP}, "only the open loop can run"),
        ({"tracker_stamp": lambda t: t - 3_000_000_000}, "log times are 3.000 s after the stamps"),
        ({"tracker_stamp": lambda t: t + 80_000_000}, "stamps are 0.080 s ahead of the joints'"),
        ({"tracker_stamp": lambda t: t // 50_000_000 * 50_000_000}, "40 stamps occur more than once"),
        (
            {"tracker_stamp": lambda t: t - 700_000_000 if (t // 25_000_000) % 10 == 3 else t},
            "came 0.700 s later than the quickest",
        ),
        (
            {"tracker_stamp": lambda t: t - 60_000_000 if (t // 25_000_000) % 10 == 3 else t},
            "note stamps run backwards 8 times, by 0.035 s at most (up to 0.2 s is fused",
        ),
    ],
)
def test_tracker(scenario, tmp_path, change, expected):
    vars(scenario).update(change)
    assert expected in texts(scenario.inspect(tmp_path / "a.mcap"), topics.TRACKER_TIP)


@pytest.mark.parametrize("frame", ["", "/ctr_base"])
def test_frames_that_the_node_takes_are_no_fault(scenario, tmp_path, frame):
    scenario.frame = frame
    assert "is expected" not in texts(scenario.inspect(tmp_path / "a.mcap"), topics.TRACKER_TIP)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            {"skip": lambda topic, t: topic == topics.JOINT_STATES and 0.5 < t < 1.5},
            "1 gaps longer than 0.1 s, the longest 1.000 s at 0.500 s",
        ),
        (
            {"joint_stamp": lambda t: t - 500_000_000 if t > T0 + 10**9 else t},
            "warning stamps run backwards 1 times",
        ),
        ({"skip": lambda topic, t: topic == topics.JOINT_STATES}, "nothing can be estimated without it"),
    ],
)
def test_joint_stamps(scenario, tmp_path, change, expected):
    vars(scenario).update(change)
    assert expected in texts(scenario.inspect(tmp_path / "a.mcap"), topics.JOINT_STATES)


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "ctr_dynamics.cli.main", "info", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


def test_command_text_and_json(bags, tmp_path):
    done = run(bags / "clean_release.mcap")
    assert done.returncode == 0
    assert done.stderr == ""
    assert "/ctr/joint_states" in done.stdout
    assert "no problems found" in done.stdout
    content = json.loads(run(bags / "clean_release.mcap", "--json").stdout)
    assert content["verdict"] == "ok"
    assert {t["name"]: t["messages"] for t in content["topics"]} == {
        "/ctr/joint_states": 600,
        "/ctr/tip_load": 65,
        "/ctr/tracker/tip": 240,
    }


def test_command_on_a_cut_and_on_a_bad_file(bags, tmp_path):
    whole = (bags / "clean_release.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 6 // 10])
    done = run(tmp_path / "cut.mcap", "--json")
    assert done.returncode == 0
    assert "anything later is missing" in json.loads(done.stdout)["problems"][0]["text"]
    (tmp_path / "bad.mcap").write_bytes(b"nonsense")
    for path in (tmp_path / "bad.mcap", tmp_path / "none.mcap"):
        done = run(path)
        assert done.returncode == 2
        assert done.stdout == ""
        assert len(done.stderr.splitlines()) == 1
        assert "Traceback" not in done.stderr


def test_faults_that_a_replay_leaves_out_are_listed(tmp_path, capsys):
    """A tracker that sends one pose for two seconds: one line, with times from the start of the bag."""
    Scenario().inspect(tmp_path / "in.mcap")
    assert main(["info", str(tmp_path / "in.mcap")]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "frozen" in line]
    assert len(lines) == 1
    assert lines[0].startswith("error: /ctr/tracker/tip: frozen (79 from 0.")
