"""The faults of studies/live_faults.py do to the messages what they say, and only then."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ctr_dynamics.io.messages import cdr, topics
from ctr_dynamics.runtime.playback import load
from studies import fault_messages as faults

ROOT = Path(__file__).parents[2]
BAG = ROOT / "test" / "data" / "bags" / "clean_release.mcap"


@pytest.fixture(scope="module")
def messages():
    return load(BAG, 0.0, 4.0)


def test_every_fault_keeps_order_and_what_lies_outside_its_time(messages):
    first = messages[0].log_ns
    for name, fault in faults.FAULTS.items():
        changed = fault(messages)
        assert np.all(np.diff([m.log_ns for m in changed]) >= 0), name
        if name in faults.WHOLE_RUN:
            continue
        early = [m for m in messages if m.log_ns - first < 2_000_000_000]
        assert [m for m in changed if m.log_ns - first < 2_000_000_000] == early, name
        assert changed != messages, name


def test_what_the_faults_do(messages):
    first = messages[0].log_ns

    def inside(name, topic):
        found = faults.FAULTS[name](messages)
        return [m for m in found if m.topic == topic and 2.0 <= (m.log_ns - first) * 1e-9 < 3.0]

    tracker, joints = topics.TRACKER_TIP, topics.JOINT_STATES
    assert inside("tracker silent for 1 s", tracker) == []
    assert len(inside("tracker silent for 1 s", joints)) == 100
    assert all(
        np.isnan(cdr.decode_pose_stamped(m.data).position[0]) for m in inside("tracker holds NaN", tracker)
    )
    assert all(
        cdr.decode_pose_stamped(m.data).frame_id == "camera"
        for m in inside("tracker in another frame", tracker)
    )
    assert (
        max(cdr.decode_pose_stamped(m.data).position[2] for m in inside("tracker in millimetres", tracker))
        > 50
    )
    assert all(len(cdr.decode_joint_state(m.data).names) == 3 for m in inside("a joint is missing", joints))
    ahead = [cdr.decode_stamp(m.data) - m.log_ns for m in inside("clock jumps 1 h ahead and back", joints)]
    assert set(ahead) == {3_600_000_000_000}
    for m in inside("messages cut in half", joints):
        with pytest.raises(cdr.CdrError):
            cdr.decode_joint_state(m.data)


def test_tenfold_is_linear_in_between(messages):
    more = [m for m in faults.tenfold(messages) if m.topic == topics.JOINT_STATES]
    few = [m for m in messages if m.topic == topics.JOINT_STATES]
    assert len(more) == 10 * (len(few) - 1) + 1
    stamps = np.array([cdr.decode_stamp(m.data) for m in more])
    assert np.all(np.diff(stamps) == 1_000_000)
    values = np.array([cdr.decode_joint_state(m.data).positions for m in more])
    whole = np.array([cdr.decode_joint_state(m.data).positions for m in few])
    np.testing.assert_allclose(values[::10], whole, atol=1e-12)
