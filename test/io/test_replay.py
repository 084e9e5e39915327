"""Replay: order and times in which the estimator is fed, the files it writes, and how it fails.

A stand-in with the estimator's interface shows what it was given; replays with the estimator itself are
tested with the estimator.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from ctr_dynamics import __version__
from ctr_dynamics.cli.main import main
from ctr_dynamics.cli.replay_command import settings_for_replay
from ctr_dynamics.errors import InputError
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.io.bag_reader import InputMessage, open_bag, sha256_of
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import cdr, topics
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.playback import load, shifted
from ctr_dynamics.runtime.replay import Player, arrivals, plain, replay
from ctr_dynamics.sensing.tracker import TrackerModel

JOINTS = ("tube1_rotation", "tube1_translation", "tube2_rotation", "tube2_translation")
T0 = 1_700_000_000_000_000_000


class StandIn:
    """Takes a step whenever the joints cover it, or 0.1 s late with what it has; notes every call."""

    made: list[StandIn]

    def __init__(self, make_step, robot, settings) -> None:
        self.make_step = make_step
        self.robot = robot or load_robot("till2020_tissue")
        self.settings = settings or Settings()
        self.tracker = TrackerModel.of_robot(self.robot)
        self.calls: list[tuple] = []
        self.t0_ns = None
        self.last_joint_ns = None
        self.k = self.lead_ns = 0
        self.innovations: list = []
        self.invalid = range(0)
        self.noted: list[tuple[str, str, str]] = []
        self.health = Health()
        self.runs = SimpleNamespace(expected_orientation=lambda: None)
        self.health.note = lambda *what: self.noted.append(what[:3])  # type: ignore[method-assign]

    def add_joint_state(self, stamp_ns, names, positions) -> None:
        self.calls.append(("joint", stamp_ns))
        if set(JOINTS) <= set(names):
            self.t0_ns = stamp_ns if self.t0_ns is None else self.t0_ns
            self.last_joint_ns = stamp_ns

    def add_tracker_pose(self, stamp_ns, position, quaternion_xyzw, frame_id="") -> None:
        self.calls.append(("tracker", stamp_ns))
        item = SimpleNamespace(
            stamp_ns=stamp_ns,
            residual=np.array((*position, 0.0, 0.0, 0.0)),
            variance=np.ones(6),
            nis=5.0,
            dof=6,
            accepted=True,
            delay_s=0.0,
            reason="",
        )
        self.innovations.append(item)

    def add_tip_load(self, stamp_ns, force, torque, frame_id="") -> None:
        self.calls.append(("load", stamp_ns))

    def _steps(self, until_ns) -> list:
        found = []
        while self.t0_ns is not None and self.t0_ns + self.k * topics.STEP_NS <= until_ns:
            valid = self.k not in self.invalid
            out = self.make_step(
                k=self.k,
                points=5,
                stamp_ns=self.t0_ns + self.k * topics.STEP_NS,
                innovations=self.innovations,
                valid=valid,
                reason="" if valid else "snap",
            )
            self.innovations = []
            found.append(out)
            self.k += 1
        return found

    def do_idle_work(self) -> None:
        pass

    def advance(self, now_ns=None) -> list:
        self.calls.append(("advance", now_ns))
        if self.t0_ns is None:
            return []
        covered = min(self.last_joint_ns, now_ns)
        return self._steps(max(covered, now_ns - 100_000_000))

    def finish(self) -> list:
        self.calls.append(("finish", None))
        return self._steps(self.last_joint_ns) if self.t0_ns is not None else []

    def summary(self) -> dict:
        return {
            "steps": self.k,
            "residual_rms_m": {"predicted": 0.001, "fused": float("nan")},
            "nis": {"mean": np.float64(1.0), "dof": 6, "lower95": 0.9, "upper95": 1.1, "within": True},
            "rejected": 0,
            "late": 0,
            "dropped": 0,
            "measurements": {
                "used": sum(call[0] == "tracker" for call in self.calls),
                "not_used": 0,
                "not_used_residual_rms_m": {"predicted": None, "fused": None},
            },
            "input_problems": {"joints": {}, "tracker": {}, "load": {}},
            "solver": {"failures": 0, "reasons": {}},
            "model_error": None,
            "refutation": "",
        }


@pytest.fixture
def stand_in(step):
    """A factory of stand-ins that keeps what it made."""
    made = []

    def make(robot, settings):
        made.append(StandIn(step, robot, settings))
        return made[-1]

    make.made = made
    return make


def run(bag, stand_in, tmp_path, **options):
    settings = Settings({"output.policy": "wait"})
    return replay(
        bag,
        "till2020_tissue",
        settings,
        tmp_path / "out.mcap",
        tmp_path / "out.json",
        make_estimator=stand_in,
        **options,
    )


def test_files_and_summary(bags, stand_in, tmp_path):
    bag = bags / "clean_release.mcap"
    result = run(bag, stand_in, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.json", "out.mcap"]
    summary = json.loads((tmp_path / "out.json").read_text())
    assert summary == result.summary
    # Last joint stamp at 5.99 s: steps 0 .. 1996.
    assert summary["steps"] == 1997
    assert summary["duration_s"] == pytest.approx(5.988)
    assert summary["realtime_ratio"] == pytest.approx(summary["duration_s"] / summary["wall_s"])
    assert 0 < summary["step_ms"]["p50"] <= summary["step_ms"]["p99"] <= summary["step_ms"]["max"]
    assert summary["residual_rms_m"] == {"predicted": 0.001, "fused": None}
    for key in ("nis", "rejected", "late", "dropped", "solver"):
        assert key in summary
    assert summary["version"] == __version__
    robot = load_robot("till2020_tissue")
    assert summary["robot"] == {"name": robot.name, "source": "till2020_tissue", "sha256": robot.sha256}
    assert summary["inputs"] == [{"name": "clean_release.mcap", "sha256": sha256_of(bag)}]
    assert summary["parameters"]["output.policy"] == "wait"
    assert summary["notes"] == []


def test_output_bag(bags, stand_in, tmp_path):
    run(bags / "clean_release.mcap", stand_in, tmp_path)
    out = open_bag(tmp_path / "out.mcap")
    counts = {t.name: t.messages for t in out.topics.values()}
    assert set(counts) == {t.name for t in topics.OUTPUTS}
    assert counts[topics.VALID] == counts[topics.TIP_POSE] == counts[topics.BACKBONE_STATE] == 1997
    assert counts[topics.BACKBONE] == len(range(0, 1997, 11))
    assert counts[topics.INNOVATION] == 240
    assert counts[topics.DIAGNOSTICS] == 6
    metadata = out.metadata("ctr_dynamics")
    assert metadata["version"] == __version__
    assert json.loads(metadata["robot"])["sha256"] == load_robot("till2020_tissue").sha256
    assert json.loads(metadata["inputs"])[0]["sha256"] == sha256_of(bags / "clean_release.mcap")
    assert json.loads(metadata["parameters"])["filter.rank"] == Settings()["filter.rank"]
    stamps = [m.log_ns for m in out.messages({topics.VALID})]
    assert stamps == [T0 + k * 3_000_000 for k in range(1997)]
    for message in out.messages():
        if topics.TOPIC[message.topic].has_header:
            assert cdr.decode_stamp(message.data) == message.log_ns


def test_identical_bytes(bags, stand_in, tmp_path):
    files = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        run(bags / "clean_release.mcap", stand_in, tmp_path / name)
        files.append((tmp_path / name / "out.mcap").read_bytes())
    assert files[0] == files[1]


def test_order_in_which_the_estimator_is_fed(bags, stand_in, tmp_path):
    run(bags / "clean_release.mcap", stand_in, tmp_path)
    estimator = stand_in.made[-1]
    inputs = [call for call in estimator.calls if call[0] in ("joint", "tracker", "load")]
    kinds = {topics.JOINT_STATES: "joint", topics.TRACKER_TIP: "tracker", topics.TIP_LOAD: "load"}
    expected = [(kinds[m.topic], m.message.stamp_ns) for m in open_bag(bags / "clean_release.mcap").inputs()]
    assert inputs == expected
    assert estimator.calls[-1] == ("finish", None)
    # Time never runs backwards, and all of one arrival time is in before the steps up to it are asked for.
    times = [call[1] for call in estimator.calls if call[0] == "advance"]
    assert times == sorted(times)
    newest = 0
    for kind, stamp in estimator.calls[:-1]:
        if kind == "advance":
            newest = stamp
        else:
            assert stamp > newest  # log time equals the stamp in this bag


def test_policy_default_and_overrides(tmp_path):
    assert settings_for_replay(None, [], True)["output.policy"] == "wait"
    assert settings_for_replay(None, ["output.policy=predict"], True)["output.policy"] == "predict"
    (tmp_path / "p.yaml").write_text("output.policy: predict\nmodel.nodes: 40\n")
    settings = settings_for_replay(tmp_path / "p.yaml", ["model.nodes=50"], False)
    assert (settings["output.policy"], settings["model.nodes"], settings["filter.enabled"]) == (
        "predict",
        50,
        False,
    )


def test_invalid_stretches_are_named(bags, step, tmp_path):
    def make(robot, settings):
        estimator = StandIn(step, robot, settings)
        estimator.invalid = range(100, 120)
        return estimator

    result = run(bags / "clean_release.mcap", make, tmp_path)
    invalid = result.summary["invalid"]
    assert invalid["steps"] == 20
    (stretch,) = invalid["stretches"]
    assert stretch["reason"] == "snap"
    assert stretch["from_s"] == pytest.approx(0.300)
    assert stretch["to_s"] == pytest.approx(0.357)
    counts = {t.name: t.messages for t in open_bag(tmp_path / "out.mcap").topics.values()}
    assert counts[topics.TIP_POSE] == 1977
    assert counts[topics.VALID] == 1997


def test_cut_bag_is_replayed_and_named(bags, stand_in, tmp_path):
    whole = (bags / "clean_release.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 6 // 10])
    result = run(tmp_path / "cut.mcap", stand_in, tmp_path)
    assert 500 < result.summary["steps"] < 1997
    assert "anything later is missing" in result.notes[0]
    assert result.summary["notes"] == result.notes


def test_progress_ends_near_one(bags, stand_in, tmp_path):
    seen = []
    run(
        bags / "clean_release.mcap",
        stand_in,
        tmp_path,
        progress=lambda done, steps: seen.append((done, steps)),
    )
    assert seen == sorted(seen)
    assert 0.9 < seen[-1][0] <= 1.0


# Failures.


def test_no_usable_joint_state(stand_in, tmp_path):
    with write_bag(tmp_path / "in.mcap", {}) as writer:
        for i in range(50):
            t = T0 + i * 10_000_000
            writer.write(topics.JOINT_STATES, t, encode_joint_state(t, ["shoulder", "elbow"], [0.1, 0.2]))
    with pytest.raises(InputError, match=r"joints found: elbow, shoulder; needed: tube1_rotation") as error:
        run(tmp_path / "in.mcap", stand_in, tmp_path)
    assert "\n" not in str(error.value)
    assert [p.name for p in tmp_path.iterdir()] == ["in.mcap"]


def test_what_a_replay_does_without_is_said(bags, stand_in, tmp_path):
    messages = list(open_bag(bags / "clean_release.mcap").messages())
    with write_bag(tmp_path / "in.mcap", {}) as writer:
        for m in messages:
            if m.topic != topics.TRACKER_TIP:
                writer.write(m.topic, m.log_ns, m.data)
    assert run(tmp_path / "in.mcap", stand_in, tmp_path).notes == [
        "no pose on /ctr/tracker/tip: the model runs in open loop"
    ]
    settings = Settings({"output.policy": "wait", "record.path": "a.mcap", "qos.publisher_depth": 3})
    result = replay(bags / "clean_release.mcap", "till2020_tissue", settings, make_estimator=stand_in)
    assert result.notes == [
        "parameters of the live node alone, without effect here: qos.publisher_depth, record.path"
    ]


def test_a_bag_that_is_cut_before_its_topics_says_that_it_is_cut(bags, stand_in, tmp_path):
    whole = (bags / "clean_release.mcap").read_bytes()
    (tmp_path / "in.mcap").write_bytes(whole[:100])
    with pytest.raises(InputError, match=r"no topics at all; .*in\.mcap") as error:
        run(tmp_path / "in.mcap", stand_in, tmp_path)
    assert "\n" not in str(error.value)


def test_names_that_are_not_utf8_are_escaped(bags, tmp_path, capsys):
    bag = tmp_path / os.fsdecode(b"caf\xe9.mcap")
    try:
        shutil.copyfile(bags / "clean_release.mcap", bag)
    except OSError:
        pytest.skip("this file system takes UTF-8 only")
    made = {f"--{name}": tmp_path / f"out.{name}" for name in ("summary", "report", "output")}
    assert main(["replay", str(bag), *(str(x) for pair in made.items() for x in pair)]) == 0
    summary = json.loads(made["--summary"].read_text(encoding="utf-8"))
    assert summary["inputs"][0]["name"] == bag.name
    assert "caf\\udce9.mcap" in made["--report"].read_text(encoding="utf-8")
    assert main(["info", str(bag)]) == 0
    assert main(["replay", str(bag), "--robot", "nobody"]) == 2
    assert "nobody" in capsys.readouterr().err


@pytest.mark.parametrize("error", [RuntimeError("solver"), KeyboardInterrupt()])
def test_nothing_is_left_behind(bags, step, tmp_path, error):
    class Failing(StandIn):
        def advance(self, now_ns=None):
            if self.k > 200:
                raise error
            return super().advance(now_ns)

    (tmp_path / "out.json").write_text("earlier")
    with pytest.raises(type(error)):
        run(bags / "clean_release.mcap", lambda r, s: Failing(step, r, s), tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["out.json"]
    assert (tmp_path / "out.json").read_text() == "earlier"


def test_outputs_that_are_inputs_or_each_other(bags, stand_in, tmp_path):
    bag = tmp_path / "in.mcap"
    bag.write_bytes((bags / "clean_release.mcap").read_bytes())
    with pytest.raises(InputError, match="output is the bag that is read"):
        replay(bag, "till2020_tissue", Settings(), bag, make_estimator=stand_in)
    same = tmp_path / "x"
    with pytest.raises(InputError, match="summary is the same file as the output"):
        replay(bag, "till2020_tissue", Settings(), same, same, make_estimator=stand_in)
    with pytest.raises(InputError, match="does not exist"):
        replay(bag, "till2020_tissue", Settings(), tmp_path / "no" / "x", make_estimator=stand_in)
    assert stand_in.made == [], "work was done before the check"


def joint_at(stamp_ns: int, log_ns: int) -> InputMessage:
    positions = (0.1, -0.2, 0.3, -0.1)
    return InputMessage(topics.JOINT_STATES, log_ns, cdr.JointStateIn(stamp_ns, "", JOINTS, positions))


def pose_at(stamp_ns: int, log_ns: int) -> InputMessage:
    """A pose that differs from every other, as measured ones do."""
    t = (stamp_ns - T0) * 1e-9
    position = (0.01 * math.sin(t), 0.01 * math.cos(t), 0.1)
    quaternion = (math.sin(0.3 + 0.1 * t), 0.0, 0.0, math.cos(0.3 + 0.1 * t))
    return InputMessage(topics.TRACKER_TIP, log_ns, cdr.PoseIn(stamp_ns, "ctr_base", position, quaternion))


def test_arrivals_are_grouped_by_log_time():
    items = [joint_at(1, 10), pose_at(2, 10), joint_at(3, 20), joint_at(4, 30), pose_at(5, 30)]
    assert [len(group) for group in arrivals(iter(items))] == [2, 1, 2]
    assert list(arrivals(iter([]))) == []


def bag_of(folder, items: list[InputMessage]):
    """A bag of joint states and poses with those stamps and log times."""
    with write_bag(folder / "in.mcap", {}) as writer:
        for topic, log_ns, message in items:
            if topic == topics.JOINT_STATES:
                data = encode_joint_state(message.stamp_ns, JOINTS, message.positions)
            else:
                data = encode_pose_stamped(
                    message.stamp_ns, "ctr_base", message.position, message.quaternion_xyzw
                )
            writer.write(topic, log_ns, data)
    return folder / "in.mcap"


def valid_stamps(folder) -> list[int]:
    return [m.log_ns - T0 for m in open_bag(folder / "out.mcap").messages({topics.VALID})]


MS = 1_000_000


def test_a_joint_state_far_ahead_is_left_out_as_a_node_leaves_it_out(stand_in, tmp_path):
    stamps = [T0 + i * 10 * MS for i in range(40)]
    items = [joint_at(t + (1500 * MS if i == 20 else 0), t) for i, t in enumerate(stamps)]
    result = run(bag_of(tmp_path, items), stand_in, tmp_path)
    estimator = stand_in.made[-1]
    assert T0 + 200 * MS + 1500 * MS not in [stamp for kind, stamp in estimator.calls if kind == "joint"]
    assert [(group, kind) for group, kind, _ in estimator.noted] == [("joints", "stamp ahead")]
    assert "1.500 s after its arrival, limit 0.020 s" in estimator.noted[0][2]
    assert valid_stamps(tmp_path) == list(range(0, 391 * MS, 3 * MS))
    assert result.summary["withheld"] == 0


def test_a_replay_ends_with_the_joints_and_says_what_came_after_them(stand_in, tmp_path):
    joints = [joint_at(T0 + i * 10 * MS, T0 + i * 10 * MS + 2 * MS) for i in range(40)]
    poses = [pose_at(T0 + i * 25 * MS, T0 + i * 25 * MS + 5 * MS) for i in range(200)]
    items = sorted(joints + poses, key=lambda item: item.log_ns)
    result = run(bag_of(tmp_path, items), stand_in, tmp_path)
    assert valid_stamps(tmp_path) == list(range(0, 391 * MS, 3 * MS))
    fed = [stamp for kind, stamp in stand_in.made[-1].calls if kind == "tracker"]
    assert T0 + 390 * MS + 900 * MS < max(fed) <= T0 + 392 * MS + 1000 * MS, "a late one may be of a step"
    assert result.summary["unused"] == 200 - len(fed)
    assert f"{200 - len(fed)} messages came more than 1 s after the last joint state" in result.notes[-1]


def test_no_stamp_is_replayed_twice_where_the_clock_is_set_back(bags, tmp_path):
    """With the estimator itself: after 1.5 s, while the robot moves, the clock that stamps goes back by 2 s."""
    messages = load(bags / "clean_sweep.mcap", duration_s=2.9)
    back_ns = messages[0].log_ns + 1500 * MS
    with write_bag(tmp_path / "in.mcap", {}) as writer:
        for raw in messages:
            data = shifted(raw.data, -2000 * MS) if raw.log_ns > back_ns else raw.data
            writer.write(raw.topic, raw.log_ns, data)
    result = replay(
        tmp_path / "in.mcap",
        "till2020_tissue",
        settings_for_replay(None, [], True),
        tmp_path / "out.mcap",
    )
    stamps = valid_stamps(tmp_path)
    assert stamps == sorted(set(stamps))
    assert result.summary["duration_s"] > 0.0
    assert result.summary["withheld"] > 300
    assert result.summary["steps"] == len(stamps)
    assert "clock was set back" in "; ".join(result.notes)
    compared = result.summary["residual_rms_m"]
    assert compared["fused"] is not None
    assert compared["fused"] < compared["predicted"]


def test_every_step_has_a_time(bags, step):
    player = Player(StandIn(step, None, None))
    outs = list(player.play(open_bag(bags / "clean_release.mcap")))
    assert [out.k for out in outs] == list(range(1997))
    assert len(player.times_s()) == 1997
    assert min(player.times_s()) > 0
    # An estimator that times its own steps is believed.
    player.estimator.step_times_s = [0.001] * 1997
    assert player.times_s() == [0.001] * 1997


def test_gap_in_the_joints_is_stepped_through_before_the_next_message(step, tmp_path):
    """A live node does not wait for the end of a gap of 2 s: neither does a replay."""
    with write_bag(tmp_path / "in.mcap", {}) as writer:
        for t in (0, 10, 20, 2020, 2030):
            stamp = T0 + t * 1_000_000
            writer.write(
                topics.JOINT_STATES, stamp, encode_joint_state(stamp, JOINTS, [0.1, -0.2, 0.3, -0.1])
            )
    estimator = StandIn(step, None, None)
    list(Player(estimator).play(open_bag(tmp_path)))
    after_gap = estimator.calls.index(("joint", T0 + 2_020_000_000))
    assert estimator.calls[after_gap - 1][0] == "advance"
    assert max(call[1] for call in estimator.calls[:after_gap]) == T0 + 2_020_000_000 - 1


def test_tracker_alone_before_the_joints(step, tmp_path):
    with write_bag(tmp_path / "in.mcap", {}) as writer:
        for t in range(0, 3000, 25):
            stamp = T0 + t * 1_000_000
            writer.write(
                topics.TRACKER_TIP, stamp, encode_pose_stamped(stamp, "ctr_base", (0, 0, 0.1), (0, 0, 0, 1))
            )
        for t in range(2000, 3000, 10):
            stamp = T0 + t * 1_000_000
            writer.write(
                topics.JOINT_STATES, stamp, encode_joint_state(stamp, JOINTS, [0.1, -0.2, 0.3, -0.1])
            )
    outs = list(Player(StandIn(step, None, None)).play(open_bag(tmp_path)))
    assert outs[0].stamp_ns == T0 + 2_000_000_000
    assert outs[-1].k == 330


def test_plain_json():
    value = {"a": np.float64("nan"), "b": [np.int64(3), float("inf")], 5: np.array([1.0, np.nan]), "c": True}
    assert plain(value) == {"a": None, "b": [3, None], "5": [1.0, None], "c": True}
