"""Faults on the way to the estimator: what is left out or mended is named, and the estimate is as good as without the fault."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from ctr_dynamics.io.bag_reader import InputMessage, open_bag
from ctr_dynamics.io.messages.cdr import JointStateIn, PoseIn, WrenchIn
from ctr_dynamics.parameters import Settings
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.runtime.input_gate import InputGate
from ctr_dynamics.runtime.replay import Player

BAG = Path(__file__).parents[1] / "data" / "bags" / "clean_sweep.mcap"
MS = 1_000_000
END_NS = 3_000 * MS  # of the inputs that are used


class Source:
    """Inputs with the interface of a bag."""

    def __init__(self, items: list[InputMessage]) -> None:
        self.items = sorted(items, key=lambda item: item.log_ns)

    def inputs(self):
        return iter(self.items)


@pytest.fixture(scope="module")
def clean() -> list[InputMessage]:
    items = list(open_bag(BAG).inputs())
    return [item for item in items if item.log_ns - items[0].log_ns < END_NS]


@pytest.fixture(scope="module")
def play():
    """Replays messages; returns the estimator and its outputs."""
    from ctr_dynamics.estimation.estimator import Estimator

    robot = load_robot("till2020_tissue")

    def run(items: list[InputMessage], monkeypatch):
        estimator = Estimator(robot, Settings({"output.policy": "wait"}))
        joints = [item for item in items if isinstance(item.message, JointStateIn)]
        last = max(item.message.stamp_ns for item in joints), max(item.log_ns for item in joints)
        monkeypatch.setattr("ctr_dynamics.runtime.replay.last_joints", lambda bag: last)
        return estimator, list(Player(estimator).play(Source(items)))

    return run


@pytest.fixture(scope="module")
def reference(clean, play):
    with pytest.MonkeyPatch.context() as monkeypatch:
        return play(clean, monkeypatch)


def is_pose(item: InputMessage) -> bool:
    return isinstance(item.message, PoseIn)


def changed(items, kind, change):
    """The messages with those of ``kind`` given to ``change(item, seconds since the first)``; lists are spliced in."""
    begin = items[0].log_ns
    out = []
    for item in items:
        if isinstance(item.message, kind):
            out += change(item, (item.log_ns - begin) * 1e-9)
        else:
            out.append(item)
    return out


def problems(estimator, group) -> dict[str, int]:
    return {kind: found["count"] for kind, found in estimator.health.input_problems()[group].items()}


def assert_as_good_as(estimator, outputs, reference, worse=1.15):
    """No failed step, all valid, and residual and NIS close to those without fault."""
    other = reference[0].health
    health = estimator.health
    assert health.failures == 0
    assert all(out.valid for out in outputs)
    assert len(outputs) == len(reference[1])
    assert (
        health.measurements.residuals.rms(True)["fused"]
        < worse * other.measurements.residuals.rms(True)["fused"]
    )
    assert health.measurements.nis_summary()["mean"] < worse * other.measurements.nis_summary()["mean"]


def test_clean_inputs_pass_as_they_are(clean, reference, monkeypatch):
    estimator, _ = reference
    assert estimator.health.input_problems() == {"joints": {}, "tracker": {}, "load": {}}
    gate, taken = InputGate(estimator), []
    monkeypatch.setattr(estimator, "add_tracker_pose", lambda *pose: taken.append(pose))
    for item in clean[:200]:
        if is_pose(item):
            gate.give_pose(item.message, item.log_ns)
            pose = item.message
            assert taken.pop() == (pose.stamp_ns, pose.position, pose.quaternion_xyzw, pose.frame_id)
        elif isinstance(item.message, JointStateIn):
            assert gate.joint_state(item.message, item.log_ns) is item.message


def test_a_tracker_polled_faster_than_it_measures(clean, reference, play, monkeypatch):
    def repeat(item, _):
        later = [
            item._replace(
                log_ns=item.log_ns + i * 6 * MS,
                message=item.message._replace(stamp_ns=item.message.stamp_ns + i * 6 * MS),
            )
            for i in range(4)
        ]
        return later

    items = changed(clean, PoseIn, repeat)
    estimator, outputs = play([i for i in items if i.log_ns <= clean[-1].log_ns], monkeypatch)
    assert_as_good_as(estimator, outputs, reference, worse=1.01)
    found = problems(estimator, "tracker")
    assert list(found) == ["polled too fast"]
    assert found["polled too fast"] == estimator.health.measurements.dropped
    assert "publish only new measurements" in estimator.health.tracker["polled too fast"].last


def test_a_frozen_tracker(clean, reference, play, monkeypatch):
    frozen = []

    def freeze(item, t):
        if not 1.0 <= t < 2.0:
            return [item]
        frozen.append(item)
        return [item._replace(message=frozen[0].message._replace(stamp_ns=item.message.stamp_ns))]

    estimator, outputs = play(changed(clean, PoseIn, freeze), monkeypatch)
    assert_as_good_as(estimator, outputs, reference)
    assert problems(estimator, "tracker") == {"frozen": len(frozen) - 1}


def test_placeholders_of_a_hidden_tracker(clean, reference, play, monkeypatch):
    def hide(item, t):
        hidden = item.message._replace(position=(0.0, 0.0, 0.0), quaternion_xyzw=(0.0, 0.0, 0.0, 1.0))
        return [item._replace(message=hidden)] if 1.0 <= t < 2.0 else [item]

    estimator, outputs = play(changed(clean, PoseIn, hide), monkeypatch)
    assert_as_good_as(estimator, outputs, reference)
    assert problems(estimator, "tracker") == {"placeholder": 40}


def test_orientations_with_the_scalar_first(clean, reference, play, monkeypatch):
    def reorder(item, _):
        x, y, z, w = item.message.quaternion_xyzw
        return [item._replace(message=item.message._replace(quaternion_xyzw=(w, x, y, z)))]

    estimator, outputs = play(changed(clean, PoseIn, reorder), monkeypatch)
    found = problems(estimator, "tracker")
    assert list(found) == ["scalar first"]
    assert estimator.health.measurements.dropped == 9, "poses that came before it was known were left out"
    assert_as_good_as(estimator, outputs, reference)
    assert "w last" in estimator.health.tracker["scalar first"].last


def test_wrapped_angles_are_unwrapped_bit_for_bit(clean):
    """Two gates: one is given angles that grow beyond pi, the other the same wrapped."""
    from ctr_dynamics.estimation.estimator import Estimator

    estimator = Estimator(load_robot("till2020_tissue"), Settings({"output.policy": "wait"}))
    straight, wrapping = InputGate(estimator), InputGate(estimator)
    names = ("tube1_rotation", "tube1_translation", "tube2_rotation", "tube2_translation")
    begin = clean[0].log_ns
    differed = 0
    for k in range(300):
        # wrapped first, as a driver would; what the sum gives is then the same to the last bit
        wrapped = math.remainder(2.0 + 2.0 * k * 0.01, 2 * math.pi)
        turns = round((2.0 + 2.0 * k * 0.01 - wrapped) / (2 * math.pi))
        stamp = begin + k * 10 * MS
        message = JointStateIn(stamp, "", names, (wrapped, -0.25, 1.5, -0.19))
        whole = message._replace(positions=(wrapped + turns * 2 * math.pi, *message.positions[1:]))
        differed += whole != message
        assert wrapping.joint_state(message, stamp).positions == straight.joint_state(whole, stamp).positions
    assert differed > 100
    assert 0 < problems(estimator, "joints")["angle wrapped"] < 5


def test_a_load_beyond_reason_is_refused(reference):
    from ctr_dynamics.estimation.estimator import Estimator

    estimator = Estimator(load_robot("till2020_tissue"), Settings({"output.policy": "wait"}))
    gate = InputGate(estimator)
    light = WrenchIn(MS, "ctr_base", (0.0, -0.05, 0.0), (0.0, 0.0, 0.0))
    assert gate.load(light, MS) is light
    assert gate.load(light._replace(stamp_ns=2 * MS, force=(0.0, -50.0, 0.0)), 2 * MS) is None
    assert problems(estimator, "load") == {"beyond reason": 1}
    assert "50 N, limit" in estimator.health.load["beyond reason"].last


def test_a_reset_of_the_estimator_is_one_of_the_checks(clean):
    from ctr_dynamics.estimation.estimator import Estimator

    estimator = Estimator(load_robot("till2020_tissue"), Settings({"output.policy": "wait"}))
    gate = InputGate(estimator)
    joints = [item.message for item in clean if isinstance(item.message, JointStateIn)][:50]
    for message in joints:
        given = gate.joint_state(message, message.stamp_ns)
        estimator.add_joint_state(given.stamp_ns, given.names, given.positions)
    estimator.reset()
    # elsewhere, on a clock an hour before: neither a jump nor set back
    earlier = joints[0].stamp_ns - 3_600_000 * MS
    moved = joints[0]._replace(stamp_ns=earlier, positions=(-1.0, -0.25, -1.0, -0.19))
    assert gate.joint_state(moved, earlier) is moved
    assert problems(estimator, "joints") == {}


def test_a_glitch_that_shows_one_joint_state_later_is_taken_back(clean, reference, play, monkeypatch):
    """0.12 rad are within what an actuator does in 10 ms, and beyond what it does there and back."""
    joints = [item for item in clean if isinstance(item.message, JointStateIn)]
    off = joints[len(joints) // 2]

    def glitch(item, _):
        first, *rest = item.message.positions
        wrong = item._replace(message=item.message._replace(positions=(first + 0.12, *rest)))
        return [wrong if item is off else item]

    estimator, outputs = play(changed(clean, JointStateIn, glitch), monkeypatch)
    assert problems(estimator, "joints") == {"glitch": 1}
    assert estimator.health.corrected_steps > 0
    assert_as_good_as(estimator, outputs, reference, worse=1.01)
    apart = [math.dist(a.tip_position, b.tip_position) for a, b in zip(outputs, reference[1], strict=True)]
    used = [out.stamp_ns for out, m in zip(outputs, apart, strict=True) if m > 1e-4]
    assert max(used) <= off.message.stamp_ns
    assert apart[-1] < 1e-5
