"""Outputs wait after a start in motion, and the estimate goes on along the gap where joints come back."""

import numpy as np
import pytest
from estimation_cases import START_NS, bag_messages, play, rms, truth_error

from ctr_dynamics.estimation.monitoring.settling import Settling, SettlingOptions
from ctr_dynamics.estimation.step_output import Innovation, MotionPoint

NOISE, MS = 2.5e-4, 1_000_000


def innovation(at_ms, residual=(0.0, 0.0, 0.0), reason=""):
    motion = MotionPoint(np.array(residual), *np.zeros((7, 3)))
    return Innovation(
        at_ms * MS, np.zeros(6), np.ones(6), 6.0, 6, not reason, 0.0, reason, np.ones(6), motion
    )


def test_outputs_count_again_after_measurements_in_a_row():
    settling, options = Settling(NOISE, 2e-4), SettlingOptions()
    assert not settling.problem(0)
    settling.begin(1000 * MS, "joints were missing")
    assert "joints were missing" in settling.problem(1001 * MS)
    for i in range(options.agreeing - 1):
        settling.take([innovation(1010 + i)])
    settling.take([innovation(1100, reason="outside the gate")])
    for i in range(options.agreeing - 1):
        settling.take([innovation(1101 + i)])
    assert settling.problem(1200 * MS)
    settling.take([innovation(1201)])
    assert settling.problem(1202 * MS, on_time=lambda: False), "a late tracker agrees as well"
    assert not settling.problem(1202 * MS)
    settling.begin(2000 * MS, "again")
    assert settling.problem(1999 * MS + round(options.longest_s * 1e9))
    assert not settling.problem(2001 * MS + round(options.longest_s * 1e9))


@pytest.mark.parametrize(("change", "waits"), [(0.0003, False), (0.003, True)])
def test_a_residual_that_changes_after_a_start_shows_motion(change, waits):
    settling = Settling(NOISE, 2e-4)
    settling.start(0, np.zeros(4))
    settling.take([innovation(10, (0.005, 0.0, 0.0)), innovation(35, (0.005 + change, 0.0, 0.0))])
    assert bool(settling.problem(36 * MS)) == waits


def test_joints_that_move_after_a_start_make_outputs_wait():
    messages = [m for m in bag_messages("clean_sweep", 4.8) if m.stamp >= 2e9]
    run = play(messages)
    invalid = [out for out in run.outputs if not out.valid]
    assert invalid
    assert all("while the robot moved" in out.reason for out in invalid)
    assert run.outputs[-1].valid
    consistency = run.estimator.health.consistency
    assert consistency.nis < 1.3  # 3.6 with the measurements of a motion that was not known yet


@pytest.mark.parametrize("policy", ["predict", "wait"])
def test_after_a_gap_in_motion_the_estimate_is_where_it_would_have_been(policy):
    messages = bag_messages("clean_sweep", 3.0)
    whole = play(messages, {"output.policy": policy})
    gap = [m for m in messages if m.kind != "joints" or not 1.5e9 < m.stamp < 1.9e9]
    run = play(gap, {"output.policy": policy})
    by_k = {out.k: out for out in whole.outputs}
    after = [(out, by_k[out.k]) for out in run.outputs if out.stamp_ns > START_NS + 1_920_000_000]
    assert any("missing for 0.4" in out.reason for out, _ in after)
    difference = [out.tip_position - other.tip_position for out, other in after if out.valid]
    assert len(difference) > 200
    assert rms(np.array(difference)) < 1e-3
    assert np.abs(difference).max() < 5e-3


def test_extrapolated_actuators_are_as_uncertain_as_they_accelerate():
    """A sine of 1 Hz and 0.5 rad that falls silent: the tip's deviation covers what the hold of the last rate errs by."""
    messages = [m for m in bag_messages("clean_sweep", 2.1) if m.kind != "joints" or m.stamp < 2.0e9]
    whole, run = (
        play(bag_messages("clean_sweep", 2.1)),
        play(messages, {"output.policy": "predict"}, tick=0.003),
    )
    right = {out.k: out.tip_position for out in whole.outputs}
    silent = [out for out in run.outputs if 2.01e9 < out.stamp_ns - START_NS < 2.09e9 and out.k in right]
    assert len(silent) > 20
    for out in silent:
        deviation = np.sqrt(np.trace(out.tip_covariance[:3, :3]))
        assert np.linalg.norm(out.tip_position - right[out.k]) < 3.0 * deviation
    assert np.trace(silent[-1].tip_covariance[:3, :3]) > 4.0 * np.trace(silent[0].tip_covariance[:3, :3])


def test_outputs_are_invalid_where_the_tip_is_not_known_well_enough():
    messages = bag_messages("clean_sweep", 0.3)
    usual, strict = play(messages), play(messages, {"output.largest_deviation_m": 1e-4})
    assert all(out.valid for out in usual.outputs)
    invalid = [out for out in strict.outputs if not out.valid]
    assert invalid
    assert all("is known to" in out.reason and "limit of 0.1 mm" in out.reason for out in invalid)


@pytest.mark.parametrize(
    ("seen", "waits"),
    [
        ([(10, 0.011)], True),
        ([(10, 0.001), (20, 0.002), (60, 0.5)], False),
        ([(300, 0.3)], True),
        ([(300, 0.001), (310, 0.3)], False),
    ],
    ids=["at once", "later", "at the first look after a long start", "at the second"],
)
def test_joints_that_move_at_the_start_have_outputs_wait(seen, waits):
    settling = Settling(NOISE, 2e-4)
    settling.start(0, np.zeros(4))
    for ms, angle in seen:
        settling.watch(ms * MS, np.array([angle, 0.0, 0.0, 0.0]))
    assert bool(settling.problem(1 * MS)) == waits


@pytest.mark.parametrize(("ms", "rad", "waits"), [(10, 0.0025, True), (10, 0.0015, False), (3, 9e-4, False)])
def test_a_rate_tells_before_the_watched_time_is_over_if_it_is_more_than_noise(ms, rad, waits):
    """0.2 rad/s and more; within 3 ms that is 0.6 mrad, less than four deviations of a difference of two readings."""
    settling = Settling(NOISE, 2e-4)
    settling.start(0, np.zeros(4))
    settling.watch(ms * MS, np.array([rad, 0.0, 0.0, 0.0]))
    assert bool(settling.problem((ms + 1) * MS)) == waits


def test_measurements_of_a_tracker_that_is_not_trusted_do_not_agree():
    """They are within any gate. Where none agree, the filter begins again, and outputs wait once more."""
    settling, longest = Settling(NOISE, 2e-4), round(SettlingOptions().longest_s * 1e9)
    settling.begin(0, "it moved")
    assert settling.begun
    settling.begun = False
    for ms in range(0, 1200, 25):
        settling.take([innovation(ms)], shifted=True)
    assert "it moved" in settling.problem(longest - 1)
    settling.problem(longest + 1)
    assert settling.begun
    settling.begun = False
    assert not settling.problem(longest + 2), "the model alone counts, while nothing is measured"
    settling.take([innovation(1300)], shifted=True)
    assert "have not agreed" in settling.problem(longest + 3)
    assert not settling.problem(2 * longest + 2)
    assert not settling.begun, "it is not done a third time"


@pytest.mark.parametrize(("noises", "agree"), [(5.0, True), (8.0, False)])
def test_measurements_agree_by_the_noise_that_is_stated(noises, agree):
    """Whatever the filter takes the noise for, and however little it knows of the tip: within the gate is any that lies so near."""
    settling, options = Settling(NOISE, 2e-4), SettlingOptions()
    settling.begin(0, "it moved")
    beside = innovation(10)
    beside.residual[0] = noises * NOISE
    settling.take([beside._replace(stamp_ns=10 * MS + i) for i in range(options.agreeing)])
    assert (not settling.problem(20 * MS)) == agree


def test_after_a_start_in_motion_the_open_loop_run_tells_nothing_of_the_tracker_for_a_while():
    settling, longest = Settling(NOISE, 2e-4), round(SettlingOptions().longest_s * 1e9)
    settling.start(0, np.zeros(4))
    assert not settling.lacks_vibration(5 * MS)
    settling.watch(10 * MS, np.array([0.1, 0.0, 0.0, 0.0]))
    settling.take([innovation(20 + i) for i in range(SettlingOptions().agreeing)])
    assert not settling.problem(30 * MS), "measurements agree with the filter"
    assert settling.lacks_vibration(30 * MS), "but the open-loop run is as it was"
    assert not settling.lacks_vibration(longest + 1)
    settling.begin(0, "a gap of the joints", vibrating=False)
    assert not settling.lacks_vibration(5 * MS)


def test_nothing_is_seen_of_the_motion_until_joints_and_measurements_have_told():
    settling = Settling(NOISE, 2e-4)
    assert settling.unseen(0) is None
    settling.start(0, np.zeros(4))
    settling.watch(0, np.zeros(4))
    assert settling.unseen(1 * MS) == 0.0, "the joint state of the start tells nothing"
    settling.watch(10 * MS, np.zeros(4))
    settling.take([innovation(10, (3e-4, 0.0, 4e-4))])
    assert settling.unseen(30 * MS) == pytest.approx(5e-4), "nor does one measurement"
    settling.take([innovation(35, (3e-4, 0.0, 4e-4))])
    assert settling.unseen(36 * MS) is None
    settling.start(0, np.zeros(4))
    settling.watch(10 * MS, np.zeros(4))
    assert settling.unseen(200 * MS) == 0.0
    assert settling.unseen(201 * MS) is None, "without measurements it is not waited for"


@pytest.mark.parametrize("since_s", [1.02, 1.1, 1.33])
def test_a_start_in_a_vibration_follows_it_soon(since_s):
    """The weight has just been cut, the joints rest: measurements alone tell how the robot vibrates. The model alone is centimetres off.

    A late tracker would show the same with another phase, so outputs wait as long as they do at most.
    """
    run = play([m for m in bag_messages("clean_release", since_s + 2.0) if m.stamp >= since_s * 1e9])
    first = next(out for out in run.outputs if not out.valid)
    assert first.stamp_ns - START_NS < (since_s + 0.08) * 1e9
    error, steps = truth_error(run, "clean_release", "p_trk", since_s + 1.4)
    assert all(run.outputs[k].valid for k in steps)
    alone = run.column("predicted_position")[steps] - (run.column("tip_position")[steps] - error)
    assert rms(alone) > 4e-3
    assert rms(error) < 0.15 * rms(alone)
    # before the first pose nothing tells
    error, steps = truth_error(run, "clean_release", "p_trk", since_s + 0.03)
    deviation = np.sqrt(run.column("tip_covariance")[steps][:, range(3), range(3)].sum(axis=1))
    broken = np.linalg.norm(error, axis=1) > np.maximum(3.0 * deviation, 3e-3)
    assert not broken[[run.outputs[k].valid for k in steps]].any()


def test_outputs_wait_where_the_known_load_has_changed_in_a_gap_of_everything():
    """A weight is cut while nothing is recorded, as where a file of a split bag is lost: nobody knows when, so the vibration is not known."""
    messages = [m for m in bag_messages("clean_release", 4.0) if not 0.99e9 < m.stamp < 1.9e9]
    run = play(messages)
    error, steps = truth_error(run, "clean_release", "p_trk")
    distance = np.linalg.norm(error, axis=1)
    valid, covariance = run.column("valid")[steps], run.column("tip_covariance")[steps, :3, :3]
    deviation = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    back = valid & (run.t[steps] > 1.9)
    assert back.any()
    assert np.all((distance < 3e-3)[back] | (distance < 3.0 * deviation)[back])
    assert any("known load on the robot changed" in out.reason for out in run.outputs)
