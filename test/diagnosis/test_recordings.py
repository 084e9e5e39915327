"""What is taken from a bag, and what is left out and said."""

from dataclasses import replace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import RecordingOptions
from ctr_dynamics.diagnosis.recording import measured_axes, read_recording
from ctr_dynamics.errors import InputError
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.io.bag_writer import write_bag
from ctr_dynamics.io.messages import topics
from ctr_dynamics.io.messages.encode import encode_joint_state, encode_pose_stamped, encode_wrench_stamped
from ctr_dynamics.parameters import Settings, axes_mask
from ctr_dynamics.runtime.joint_rate import with_joint_rate
from ctr_dynamics.sensing import TrackerModel
from ctr_dynamics.sensing.tracker_parameters import with_tracker_parameters

OPTIONS = RecordingOptions()
START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def bag(tmp_path, robot):
    """Makes a bag of a resting robot from the stamps (s) of joints and tracker."""
    names = [f"tube{n}_{kind}" for n in (1, 2) for kind in ("rotation", "translation")]
    rest = [x for pair in zip(robot.rest.alpha.value, robot.rest.beta.value, strict=True) for x in pair]

    def make(joints, poses, quaternions=lambda k: (0.0, 0.0, 0.0, 1.0), rate=0.0, loads=(), frame="ctr_base"):
        """The first tube turns at ``rate`` (rad/s); ``loads``: (s, N) in y."""
        path = tmp_path / "bag.mcap"
        with write_bag(path, {}) as writer:
            for t in joints:
                stamp = START_NS + round(1e9 * t)
                now = [rest[0] + rate * t, *rest[1:]]
                writer.write(topics.JOINT_STATES, stamp, encode_joint_state(stamp, names, now))
            for t, force in loads:
                stamp = START_NS + round(1e9 * t)
                load = encode_wrench_stamped(stamp, "ctr_base", (0.0, force, 0.0), (0.0, 0.0, 0.0))
                writer.write(topics.TIP_LOAD, stamp, load)
            for k, t in enumerate(poses):
                stamp = START_NS + round(1e9 * t)
                pose = encode_pose_stamped(stamp, frame, (0.01, 0.0, 0.2), quaternions(k))
                writer.write(topics.TRACKER_TIP, stamp, pose)
        return path

    return make


def test_poses_in_gaps_of_the_joints_and_soon_after_are_left_out(robot, bag):
    joints, poses = np.arange(0.0, 10.0, 0.01), np.arange(0.0, 9.9, 0.025)
    gap = (joints > 4.0) & (joints < 4.7)
    found = read_recording(bag(joints[~gap], poses), robot)
    kept = (poses <= 4.001) | (poses >= 4.7 + OPTIONS.settling_s - 1e-6)
    np.testing.assert_allclose(found.stamps, poses[kept], atol=1e-8)
    assert len(found.notes) == 1
    assert "joints are missing once, for up to 0.70 s" in found.notes[0]
    assert f"{int((~kept).sum())} of {len(poses)} tracker poses" in found.notes[0]


def test_a_clock_that_jumps_makes_two_recordings_of_which_the_longer_is_used(robot, bag):
    first, second = np.arange(0.0, 3.0, 0.01), 1e6 + np.arange(0.0, 5.0, 0.01)
    poses = np.concatenate([first[::4], second[::4]])
    loads = [(0.0, 0.001), (1.0, 0.002), (1e6 + 2.0, 0.003), (1e6 + 9.0, 0.004)]
    found = read_recording(bag(np.concatenate([first, second]), poses, loads=loads), robot)
    assert found.duration == pytest.approx(4.99)
    assert len(found.stamps) == len(second[::4])
    np.testing.assert_allclose(found.load[:, 0], [0.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(found.load[:, 2], [0.002, 0.003])
    assert "limit 10 s" in found.notes[0]
    assert "of 2 parts, only the longest was used, 5.0 s from 1000000 s on" in found.notes[0]


def test_a_recording_that_no_memory_holds_is_rejected(robot, bag):
    with pytest.raises(InputError, match=r"joints of 1005 s, limit 1000 s; cut the bag"):
        read_recording(bag(np.arange(0.0, 1006.0, 5.0), np.arange(0.0, 9.0, 0.025)), robot)


def test_a_recording_that_begins_in_motion_says_so_and_its_start_is_left_out(robot, bag):
    joints, poses = np.arange(0.0, 10.0, 0.01), np.arange(0.0, 9.9, 0.025)
    found = read_recording(bag(joints, poses, rate=0.5), robot)
    np.testing.assert_allclose(found.stamps, poses[poses >= OPTIONS.unsettled_s], atol=1e-8)
    assert len(found.notes) == 1
    assert "begins in motion (tube 1 turns at 0.5 rad/s)" in found.notes[0]
    assert not read_recording(bag(joints, poses, rate=1e-3), robot).notes


def test_joints_at_half_the_rate_are_no_gap(robot, bag):
    poses = np.arange(0.0, 4.9, 0.025)
    found = read_recording(bag(np.arange(0.0, 5.0, 0.02), poses), robot)
    assert len(found.stamps) == len(poses)
    assert not found.notes


def test_joints_that_come_and_go_leave_nothing_to_say(robot, bag):
    joints = np.arange(0.0, 10.0, 0.01)
    seen = joints % 0.5 < 0.5 - 2 * OPTIONS.gap_s
    with pytest.raises(
        InputError, match=rf"less than {OPTIONS.shortest_s:g} s \(joints are missing 19 times"
    ):
        read_recording(bag(joints[seen], np.arange(0.0, 9.9, 0.025)), robot)


@pytest.mark.parametrize("missing", [0.0, float("nan")])
def test_a_tracker_without_orientation_gives_positions(robot, bag, missing):
    joints, poses = np.arange(0.0, 5.0, 0.01), np.arange(0.0, 4.9, 0.025)
    found = read_recording(bag(joints, poses, lambda k: (missing,) * 4), robot)
    assert len(found.stamps) == len(poses)
    np.testing.assert_array_equal(found.quaternion, np.tile([1.0, 0.0, 0.0, 0.0], (len(poses), 1)))
    turning = replace(found, quaternion=np.eye(4)[np.arange(len(poses)) % 4])
    notes: list[str] = []
    assert measured_axes([turning], notes).all()
    assert not notes
    np.testing.assert_array_equal(measured_axes([turning, found], notes), [True] * 3 + [False] * 3)
    assert "three degrees of freedom" in notes[0]


def test_single_poses_without_orientation_are_left_out(robot, bag):
    joints, poses = np.arange(0.0, 5.0, 0.01), np.arange(0.0, 4.9, 0.025)
    found = read_recording(bag(joints, poses, lambda k: (0.0, 0.0, 0.0, float(k % 10 > 0))), robot)
    assert len(found.stamps) == len(poses) - len(poses[::10])
    assert found.notes == (f"{len(poses[::10])} messages hold values that cannot be used and were left out",)


# What a lab's bag is told to mean.


def test_poses_of_another_frame_need_its_name(robot, bag):
    path = bag(np.arange(0.0, 5.0, 0.01), np.arange(0.0, 4.9, 0.025), frame="aurora")
    with pytest.raises(InputError, match=r"expected 'ctr_base': .*set tracker\.frame_id=aurora"):
        read_recording(path, robot)
    found = read_recording(path, robot, settings=Settings({"tracker.frame_id": "aurora"}))
    assert len(found.stamps) == 196


def test_axes_are_those_of_the_parameter(robot, bag):
    path = bag(np.arange(0.0, 5.0, 0.01), np.arange(0.0, 4.9, 0.025), lambda k: tuple(np.eye(4)[k % 4]))
    for axes in ("xyzrpy", "xyzrp", "xyz"):
        found = read_recording(path, robot, settings=Settings({"tracker.axes": axes}))
        assert tuple(measured_axes([found], [])) == axes_mask(axes)


def test_slow_and_uneven_joints_are_no_gaps(robot, bag):
    rng = np.random.default_rng(1)
    times = np.arange(0.0, 8.0, 0.1)
    times[1:] += rng.uniform(-0.04, 0.04, len(times) - 1)  # some are 0.18 s apart
    assert not read_recording(bag(times, np.arange(0.0, 7.5, 0.025)), robot).notes
    gap = (times > 4.0) & (times < 4.9)
    found = read_recording(bag(times[~gap], np.arange(0.0, 7.5, 0.025)), robot)
    assert any("joints are missing once" in note for note in found.notes)


def test_replay_waits_for_slow_joints_unless_told_otherwise(bag):
    opened = open_bag(bag(np.arange(0.0, 5.0, 0.1), ()))
    settings, note = with_joint_rate(opened, Settings())
    assert settings["input_timeout_s"] == pytest.approx(0.3)
    assert "10 Hz" in note
    for told in (0.11, 0.1):
        assert with_joint_rate(opened, Settings({"input_timeout_s": told}))[0]["input_timeout_s"] == told
    quick = open_bag(bag(np.arange(0.0, 5.0, 0.01), ()))
    assert with_joint_rate(quick, Settings()) == (Settings(), "")


def test_parameters_of_the_tracker_change_the_robot_as_they_change_the_estimator(robot):
    lever, rotation, translation = (0.001, 0.0, 0.002), (0.1, -0.2, 0.3), (0.05, 0.0, -0.1)
    settings = Settings(
        {
            "tracker.delay_s": 0.01,
            "tracker.lever_arm_m": lever,
            "tracker.registration_rotation_rad": rotation,
            "tracker.registration_translation_m": translation,
        }
    )
    found = TrackerModel.of_robot(with_tracker_parameters(robot, settings))
    expected = TrackerModel.of_robot(robot).corrected(
        delay=0.01, lever=np.array(lever), rotation=np.array(rotation), translation=np.array(translation)
    )
    for name in ("delay", "lever", "rotation", "translation"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-12)
    assert with_tracker_parameters(robot, Settings()) is robot
