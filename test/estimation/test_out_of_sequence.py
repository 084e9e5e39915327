"""State history, revert, and the schedule of corrections."""

from itertools import pairwise

import numpy as np
import pytest
from estimation_cases import START_NS, bag_messages, estimator

from ctr_dynamics.estimation.out_of_sequence import CorrectionOptions
from ctr_dynamics.io.messages.topics import STEP_NS

OPTIONS = CorrectionOptions()


def run(policy, until=0.6, poses=True):
    """An estimator in the middle of a bag."""
    made = estimator({"output.policy": policy})
    messages = [m for m in bag_messages("clean_sweep", until) if poses or m.kind != "pose"]
    for message in sorted(messages, key=lambda m: m.arrival):
        message.give(made)
        made.advance(START_NS + message.arrival)
    made.finish()
    return made


def standing(made):
    """All numbers that both runs stand at."""
    ekf, open_loop = made.runs.fused.ekf, made.runs.open_loop
    arrays = made.runs.fused.state.bank, open_loop.state.bank, ekf.pi, ekf.theta, ekf.bias, ekf.factor.fields
    tips = ekf.tips.last.mean, open_loop.tips.last.mean
    return [array.tobytes() for array in (*arrays, *tips)], made.inputs.measurements.fused()


@pytest.mark.parametrize("policy", ["wait", "predict"])
def test_checkpoints_cover_the_window(policy):
    made, every = run(policy), OPTIONS.checkpoint_every
    steps = [checkpoint.k for checkpoint in made.late.history.checkpoints]
    assert all(0 < b - a <= every for a, b in pairwise(steps))
    window = made.inputs.window_ns // STEP_NS
    assert made.k - window - 2 * every <= steps[0] <= made.k - window
    if policy == "wait":
        assert all(k % every == 0 for k in steps)
    else:
        assert steps[-1] == made.k


@pytest.mark.parametrize("poses", [False, True])
@pytest.mark.parametrize("policy", ["wait", "predict"])
@pytest.mark.parametrize("lag", [3, 20, 60])
def test_steps_that_are_taken_again_without_a_change_end_the_same(policy, lag, poses):
    """To the last bit without poses. A pose came after its step at first, and is fused right after it then."""
    made = run(policy, poses=poses)
    before, tip = standing(made), made.runs.fused.ekf.tips.last.mean.copy()
    counted, k, again = made.health.summary(), made.k, made.health.corrected_steps
    made.late.changed(START_NS + (k - lag) * STEP_NS)
    assert made.late.lag == lag
    assert not made.late.correct()
    assert not made.late.pending
    assert made.k == k
    after = made.health.summary()
    assert lag <= made.health.corrected_steps - again < lag + OPTIONS.checkpoint_every
    for summary in (counted, after):
        del summary["solver"]
    assert after == counted
    if poses:
        assert np.abs(made.runs.fused.ekf.tips.last.position - tip[:3]).max() < 1e-5
    else:
        assert standing(made) == before


def test_a_change_older_than_the_start_starts_again():
    made = run("predict", until=0.1)
    made.late.load_changed(made.t0_ns - 1, jumped=False)
    assert made.late.correct()
    assert made.k == made.runs.k
    assert made.late.history.checkpoints[0].k == 0


def test_a_step_goes_ahead_only_on_time_and_near_the_correction():
    waiting, made = run("wait"), run("predict")
    for one in (waiting, made):
        one.late.changed(START_NS + (one.k - 5) * STEP_NS)
    assert not waiting.late.may_go_ahead
    assert made.late.may_go_ahead
    made.late.load_changed(START_NS + (made.k - 5) * STEP_NS, jumped=True)
    assert not made.late.may_go_ahead
    far = run("predict")
    far.late.changed(START_NS + (far.k - OPTIONS.reuse_lag) * STEP_NS)
    assert not far.late.may_go_ahead
    load = run("predict")
    load.late.load_changed(START_NS + (load.k - OPTIONS.reuse_lag) * STEP_NS, jumped=False)
    assert load.late.may_go_ahead
    load.late.load_changed(START_NS + (load.k - OPTIONS.largest_lag) * STEP_NS, jumped=False)
    assert not load.late.may_go_ahead


def test_a_correction_that_is_far_behind_is_done_though_there_is_no_time():
    """Going ahead of it, a machine that is too slow for both would have even more to do with every step."""
    made = run("predict", poses=False)
    made.late.changed(START_NS + (made.k - OPTIONS.reuse_lag) * STEP_NS)
    again = made.health.corrected_steps
    made.late.correct(lambda: 0.0)
    assert not made.late.pending
    assert made.health.corrected_steps - again == OPTIONS.reuse_lag


def test_a_correction_without_time_goes_on_from_where_it_was():
    made = run("predict", poses=False)
    k, lag, calls, again = made.k, OPTIONS.reuse_lag - 1, [], made.health.corrected_steps

    def spare_s():
        calls.append(1)
        return 1.0 if len(calls) <= 3 else 0.0

    before = standing(made)
    made.late.changed(START_NS + (k - lag) * STEP_NS)
    made.late.correct(spare_s)
    corrected = lag - made.late.lag
    assert 0 < corrected < lag
    assert made.health.corrected_steps - again == corrected
    np.testing.assert_array_equal(standing(made)[0], before[0])  # back on the published trajectory
    assert made.runs.k == k
    made.late.correct()
    assert made.health.corrected_steps - again == lag
    assert not made.late.pending
    assert standing(made) == before
