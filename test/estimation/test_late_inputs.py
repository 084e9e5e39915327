"""Inputs that come late, out of order or early: revert, the window of stored tips, and the two output policies."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from estimation_cases import START_NS, STEP_NS, bag_messages, check_outputs, estimator, play, truth_error

STEP = 0.003


def apart(a, b):
    """Distance of the last fused tips in m."""
    assert a.last.k == b.last.k
    return float(np.linalg.norm(a.last.tip_position - b.last.tip_position))


@pytest.fixture(scope="module")
def in_time(sweep):
    return play(sweep)


@pytest.mark.parametrize(("bag", "delay"), [("clean_sweep", 0.0), ("latency_sweep", 0.018)])
def test_late_and_shuffled_poses_give_nearly_the_same(bag, delay):
    settings = {"tracker.delay_s": delay}
    sweep = bag_messages(bag, 1.2)
    rng = np.random.default_rng(4)
    late = [m.late(rng.uniform(0.0, 0.195)) if m.kind == "pose" and m.stamp < 0.95e9 else m for m in sweep]
    order = [m.stamp for m in sorted(late, key=lambda m: m.arrival) if m.kind == "pose"]
    assert order != sorted(order)
    run, reference = play(late, settings), play(sweep, settings)
    check_outputs(run)
    health = run.estimator.health
    assert health.measurements.dropped == reference.estimator.health.measurements.dropped
    assert (
        health.measurements.accepted + health.measurements.rejected
        == reference.estimator.health.measurements.accepted + reference.estimator.health.measurements.rejected
    )
    assert health.late > 20
    assert apart(run, reference) < 0.05e-3
    without = play([m for m in sweep if m.kind != "pose"], settings)
    assert apart(without, reference) > 0.2e-3, (
        "the poses make no difference here: the comparison shows nothing"
    )
    delays = [i.delay_s for out in run.outputs for i in out.innovations]
    assert 0.15 < max(delays) < 0.2


def test_poses_later_than_the_window_are_dropped_and_counted(sweep, in_time):
    poses = [m for m in sweep if m.kind == "pose"]
    chosen = poses[10:14]
    run = play([m.late(0.21) if m in chosen else m for m in sweep])
    health = run.estimator.health
    assert health.measurements.dropped == in_time.estimator.health.measurements.dropped + 4
    assert health.measurements.accepted == in_time.estimator.health.measurements.accepted - 4
    assert health.tracker["too late"].count == 4
    assert "limit 0.2 s" in health.tracker["too late"].last
    left_out = play([m for m in sweep if m not in chosen])
    assert np.array_equal(run.column("tip_position"), left_out.column("tip_position"))


def test_late_joints_under_predict_end_as_in_time_under_wait(sweep, in_time):
    late = [m.late(0.030) if m.kind == "joints" and 0 < m.stamp < 1.1e9 else m for m in sweep]
    run = play(late, {"output.policy": "predict"}, tick=STEP)
    check_outputs(run)
    assert [out.k for out in run.outputs] == list(range(len(run.outputs)))
    assert run.estimator.health.corrected_steps > 100
    assert all(out.valid for out in run.outputs)
    # a step of its own time was published on extrapolated joints, and differs
    differences = [
        np.abs(a.tip_position - b.tip_position).max()
        for a, b in zip(run.outputs, in_time.outputs, strict=False)
    ]
    assert max(differences) > 1e-6
    last = in_time.last
    assert run.last.k == last.k
    # steps taken again reuse their stored covariance, and both runs end within the solver's tolerance
    assert np.abs(run.last.tip_position - last.tip_position).max() < 2e-6
    assert np.abs(run.last.tip_velocity - last.tip_velocity).max() < 3e-3
    variance = np.diag(last.tip_covariance)
    # the stored covariance was that of extrapolated joints: a few percent in variance
    assert np.abs(np.diag(run.last.tip_covariance) - variance).max() < 5e-2 * variance.max()
    assert np.abs(run.last.predicted_position - last.predicted_position).max() < 1e-6
    # measurements are counted once, however often they were fused again
    assert run.estimator.health.measurements.accepted == in_time.estimator.health.measurements.accepted


def corrected_apart(a, b):
    """Distances (m) of the tips, fused and open loop, after the last corrections: the last output may have been before them."""
    return tuple(
        float(np.linalg.norm(x.last.position - y.last.position))
        for x, y in (
            (a.estimator.runs.fused.ekf.tips, b.estimator.runs.fused.ekf.tips),
            (a.estimator.runs.open_loop.tips, b.estimator.runs.open_loop.tips),
        )
    )


def nis(run):
    """NIS per degree of freedom by the stamps of the poses. The last may be left for a next output."""
    reported = [i for out in run.outputs for i in out.innovations]
    return {i.stamp_ns: i.nis / i.dof for i in reported + run.estimator.innovations.take() if i.dof}


@pytest.mark.parametrize("chance", [0.3, 0.7])
def test_corrections_without_time_are_put_off_and_end_the_same(sweep, in_time, chance):
    """Joints and poses come late, and now and then there is no time to go on with the correction."""
    rng = np.random.default_rng(7)
    late = [
        m.late(0.030 if m.kind == "joints" else rng.uniform(0.0, 0.1)) if 0 < m.stamp < 1.0e9 else m
        for m in sweep
    ]
    run = play(
        late,
        {"output.policy": "predict"},
        tick=STEP,
        spare=lambda made: math.inf if made.k > 350 or rng.random() < chance else 0.0,
    )
    check_outputs(run)
    assert [out.k for out in run.outputs] == list(range(len(run.outputs)))
    assert all(out.valid for out in run.outputs)
    assert not run.estimator.correcting
    straight = play(late, {"output.policy": "predict"}, tick=STEP)
    # postponed corrections begin again after what came meanwhile, and are never left out
    assert run.estimator.health.corrected_steps != straight.estimator.health.corrected_steps
    for reference in (straight, in_time):
        fused, open_loop = corrected_apart(run, reference)
        assert fused < 1e-5  # the stored covariance is reused
        assert open_loop < 2e-6
    # measurements are counted once, however often they were fused again
    health = run.estimator.health
    assert (
        health.measurements.accepted + health.measurements.rejected
        == in_time.estimator.health.measurements.accepted
    )
    stamps = [i.stamp_ns for out in run.outputs for i in out.innovations]
    assert len(stamps) == len(set(stamps))
    found, expected = nis(run), nis(straight)
    assert found.keys() == expected.keys()
    # poses are compared with the corrected trajectory, and not with what was published before the correction
    apart = [abs(found[stamp] - expected[stamp]) for stamp in found]
    assert np.mean(apart) < 0.05


@pytest.mark.parametrize(("delay", "time_for", "limit"), [(0.002, 3, 0.05e-3), (0.012, 4, 0.2e-3)])
def test_steps_before_their_correction_do_not_take_it_for_a_jump_of_the_joints(sweep, delay, time_for, limit):
    """Between two steps there is time for a few of a correction; what is published meanwhile stays near the trajectory that is corrected at once."""
    late = [m.late(delay) if m.kind == "joints" and m.stamp > 0 else m for m in sweep if m.stamp < 1.5e9]
    asked = Counter()

    def spare(made):
        asked[made.k] += 1
        return math.inf if asked[made.k] <= time_for else 0.0

    run, at_once = (
        play(late, {"output.policy": "predict"}, tick=0.001, spare=spare_s) for spare_s in (spare, None)
    )
    apart = [
        np.linalg.norm(a.tip_position - b.tip_position)
        for a, b in zip(run.outputs, at_once.outputs, strict=True)
        if a.k > 100
    ]
    assert np.sqrt(np.mean(np.square(apart))) < limit


def test_a_late_load_has_jumped_where_it_is_not_what_was_taken_for_its_time(release):
    """Between two loads that are known the model has taken the line; a third one there is compared with that."""
    run = play([m for m in release if m.kind == "joints" and m.stamp <= 0.1e9])
    inputs = run.estimator.inputs

    def jumped(t, force):
        change = inputs.add_load(START_NS + round(t * 1e9), [force, 0.0, 0.0], [0.0] * 3, "")
        assert change is not None
        return change.jumped

    assert jumped(0.05, 1.0)
    assert jumped(0.15, 0.0)
    assert not jumped(0.10, 0.5)
    assert jumped(0.13, 1.0)


def test_a_trajectory_without_time_for_its_correction_is_corrected_in_the_end(sweep, in_time):
    """There is never any time: the correction then goes before the steps, and no further behind than it must."""
    run = play(
        sweep, {"output.policy": "predict"}, tick=STEP, spare=lambda made: math.inf if made.k > 380 else 0.0
    )
    check_outputs(run)
    assert all(out.valid for out in run.outputs)
    assert run.estimator.health.corrected_steps > 100
    assert corrected_apart(run, in_time)[1] < 1e-6


def test_predict_with_joints_in_time_extrapolates_for_less_than_their_period(sweep, in_time):
    run = play(sweep, {"output.policy": "predict"}, tick=STEP)
    differences = [
        float(np.linalg.norm(a.tip_position - b.tip_position))
        for a, b in zip(run.outputs, in_time.outputs, strict=False)
    ]
    assert float(np.median(differences)) < 5e-6
    first = 50  # poses wait for the joints of their time; the first of them move the tip most
    assert max(differences[first:]) < 0.1e-3


@pytest.mark.parametrize(
    ("policy", "period_ms", "awaited"),
    [("predict", 10, [1, 2, 3, 4, 5]), ("predict", 3, [1]), ("predict", 50, []), ("wait", 10, [])],
)
def test_poses_wait_for_joints_that_come_soon(policy, period_ms, awaited):
    """Within one and a half periods after the last joint state, where eight steps hold a period."""
    made = estimator({"output.policy": policy})
    names = [f"tube{i}_{kind}" for i in (1, 2) for kind in ("rotation", "translation")]
    last = 50  # step of the last joint state
    for ago in range(3, -1, -1):
        stamp_ns = START_NS + last * STEP_NS - ago * period_ms * 1_000_000
        made.add_joint_state(stamp_ns, names, [1.57, -0.2521, 1.57, -0.1977])
    now = (made.inputs.joints.stamps[-1] - made.t0_ns) // STEP_NS
    assert [i for i in range(-1, 20) if made.inputs.awaits_joints(now + i, 8)] == awaited


@pytest.mark.parametrize("policy", ["wait", "predict"])
def test_late_load_ends_as_in_time(release, policy):
    settings = {"output.policy": policy}
    late = [m.late(0.050) if m.kind == "load" and 0.9e9 < m.stamp < 1.3e9 else m for m in release]
    assert sum(a.arrival != b.arrival for a, b in zip(late, release, strict=True)) > 1
    reference = play(release, settings, tick=STEP)
    run = play(late, settings, tick=STEP)
    check_outputs(run)
    assert run.estimator.health.corrected_steps > 5
    # the cut was noticed late
    worst = max(
        np.abs(a.tip_position - b.tip_position).max()
        for a, b in zip(run.outputs, reference.outputs, strict=True)
    )
    assert worst > 1e-3
    assert np.abs(run.last.tip_position - reference.last.tip_position).max() < 2e-6
    assert np.abs(run.last.predicted_position - reference.last.predicted_position).max() < 1e-6


def test_a_jump_of_the_load_is_corrected_at_once_though_there_is_no_time(release):
    """Poses that were fused into a trajectory without the cut would throw the estimate off by more than what they measure."""
    late = [m.late(0.060) if m.kind == "load" and 0.9e9 < m.stamp < 1.3e9 else m for m in release]
    run = play(late, {"output.policy": "predict"}, tick=STEP, spare=lambda made: 0.0)
    reference = play(release, {"output.policy": "predict"}, tick=STEP)
    assert [out.k for out in run.outputs] == list(range(len(run.outputs)))
    known = [out for out in run.outputs if out.k * STEP > 1.15]
    assert all(out.valid for out in known), {out.reason for out in known}
    apart = [
        float(np.linalg.norm(a.tip_position - b.tip_position))
        for a, b in zip(run.outputs, reference.outputs, strict=True)
        if a.k * STEP > 1.15
    ]
    assert max(apart) < 0.5e-3  # a pose moves the tip by so much, and here it waits for joints a step longer


def test_first_loads_in_the_wrong_order_act_as_in_the_right_one(release):
    """Before the first of them by stamp there is no load, whichever came first."""
    joints = [m for m in release if m.kind == "joints" and m.stamp <= 0.6e9]
    loads = [m for m in release if m.kind == "load" and 0.3e9 <= m.stamp <= 0.6e9]
    in_order = play(joints + loads, tick=STEP)
    overtaken = (loads[1].arrival - loads[0].arrival) * 1e-9 + 0.02
    assert overtaken < 0.2
    run = play([*joints, loads[0].late(overtaken), *loads[1:]], tick=STEP)
    assert np.abs(run.last.predicted_position - in_order.last.predicted_position).max() < 1e-6
    before = round(0.299 / STEP)
    assert np.array_equal(
        run.column("predicted_position")[:before], in_order.column("predicted_position")[:before]
    )


def test_a_load_beyond_the_window_counts_only_where_it_is_the_newest(release):
    messages = [m for m in release if m.stamp <= 0.8e9]
    loads = [m for m in messages if m.kind == "load"]
    chosen = loads[3]
    run = play([m.late(0.3) if m is chosen else m for m in messages])
    left_out = play([m for m in messages if m is not chosen])
    problem = run.estimator.health.load["too late"]
    assert problem.count == 1
    assert "limit 0.2 s" in problem.last
    assert np.array_equal(run.column("tip_position"), left_out.column("tip_position"))

    # the only news of a load for long, late as it is, is what hangs there now
    joints_only = [m for m in messages if m.kind == "joints"] + loads[:1]
    gone = replace(loads[5], content=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), loads[5].content[2]))
    run, unaware = play([*joints_only, gone.late(0.3)]), play(joints_only)
    assert "too late" not in run.estimator.health.load
    assert np.abs(run.last.predicted_position - unaware.last.predicted_position).max() > 1e-3


def test_a_way_back_begins_with_what_a_pause_has_settled(sweep):
    """Each joint state leads back to a step that the columns are reduced behind: once is enough."""
    counts = []

    def with_pauses(made):
        advance, energy = made.advance, made.runs.fused.ekf.factor.energy  # asked for once a reduction

        def then_idle(*arguments):
            steps = advance(*arguments)
            if steps:
                made.do_idle_work()
            return steps

        def counted():
            counts[-1] += 1
            return energy()

        made.advance, made.runs.fused.ekf.factor.energy = then_idle, counted

    late = [m.late(0.001) if m.kind == "joints" else m for m in sweep]
    for policy in ("wait", "predict"):
        counts.append(0)
        run = play(late, {"output.policy": policy}, tick=STEP, prepare=with_pauses)
    assert run.estimator.health.corrected_steps > 300
    assert counts[0] > 15
    assert counts[1] <= counts[0] + 3


def test_figures_of_poses_that_are_first_fused_on_a_way_back_count_once(sweep, in_time):
    """Residuals and NIS are means over the same measurements, however late these came."""
    late = [m.late(0.012) if m.kind == "joints" else m for m in sweep]
    run = play(late, {"output.policy": "predict"}, tick=STEP, spare=lambda made: 0.0)
    assert run.estimator.health.corrected_steps > 100
    h, reference = run.estimator.health.measurements, in_time.estimator.health.measurements
    assert (h.residuals.compared, h.nis_count) == (reference.residuals.compared, reference.nis_count)
    found, expected = h.residuals.rms(True), reference.residuals.rms(True)
    assert found["predicted"] == pytest.approx(expected["predicted"], rel=1e-3)
    assert found["fused"] == pytest.approx(expected["fused"], rel=0.02)


@pytest.mark.parametrize("late", [0.004, 0.040, 0.090])
@pytest.mark.parametrize("policy", ["wait", "predict"])
def test_first_load_soon_after_the_joints_is_there_from_the_start(release, late, policy):
    """The robot starts in the equilibrium under that load, however late the message comes."""
    messages = [m for m in release if m.stamp <= 0.5e9]
    settings = {"output.policy": policy}
    run = play(
        [m.late(late) if m.kind == "load" and m.stamp < 0.3e9 else m for m in messages], settings, tick=STEP
    )
    reference = play(messages, settings, tick=STEP)
    assert np.abs(run.last.tip_position - reference.last.tip_position).max() < 1e-7
    assert np.abs(run.last.predicted_position - reference.last.predicted_position).max() < 1e-6


def test_load_that_came_before_the_joints_counts_from_their_start(release):
    messages = [m for m in release if m.stamp <= 0.3e9]
    first = next(m for m in messages if m.kind == "load")
    early = [m if m is not first else m.late(-0.1) for m in messages]
    a, b = play(early), play(messages)
    assert np.array_equal(a.column("tip_position"), b.column("tip_position"))


def test_first_load_much_later_acts_from_its_stamp_on(release):
    joints = [m for m in release if m.kind == "joints" and m.stamp <= 0.6e9]
    run = play(joints + [m for m in release if m.kind == "load" and 0.3e9 <= m.stamp <= 0.6e9])
    unloaded = play(joints)
    before = round(0.299 / STEP)
    assert np.array_equal(
        run.column("predicted_position")[:before], unloaded.column("predicted_position")[:before]
    )
    assert np.abs(run.last.predicted_position - unloaded.last.predicted_position).max() > 1e-3


def test_wait_takes_a_step_when_its_joints_are_in_or_the_timeout_is_over(sweep):
    made = estimator()
    states = [m for m in sweep if m.kind == "joints"]
    start = 1_700_000_000_000_000_000
    states[0].give(made)
    assert [out.k for out in made.advance(start)] == [0]
    assert made.advance(start + 50_000_000) == []
    states[1].give(made)
    assert [out.k for out in made.advance(start + 50_000_000)] == [1, 2, 3]
    assert [out.k for out in made.advance(start + 115_000_000)] == [4, 5]


def test_predict_takes_a_step_on_time(sweep):
    made = estimator({"output.policy": "predict"})
    sweep[0].give(made)
    start = 1_700_000_000_000_000_000
    assert [out.k for out in made.advance(start + 9_500_000)] == [0, 1, 2, 3]


def test_no_more_steps_are_taken_at_once_than_asked_for(sweep):
    made = estimator()
    for message in sweep[:40]:
        message.give(made)
    first = made.advance(None, None, 2)
    assert [out.k for out in first] == [0, 1]
    rest = made.advance(None)
    assert [out.k for out in rest] == list(range(2, 2 + len(rest)))
    assert len(rest) > 10


@pytest.mark.parametrize("chance", [0.0, 0.3])
def test_the_covariance_holds_what_late_joints_have_changed(sweep, chance):
    """Joints and poses up to 60 ms late in spells, and little or no time for corrections: errors stay within the published deviation."""
    rng, late, last = np.random.default_rng(3), [], 0
    delays = np.repeat(rng.choice([0.0, 0.02, 0.06], 40), 3)  # of 10 ms each
    for m in sorted(sweep, key=lambda m: m.stamp):
        held_up = m.late(delays[m.stamp // 10_000_000 % len(delays)])
        last = max(last, held_up.arrival)  # no message overtakes another
        late.append(replace(held_up, arrival=last))
    run = play(
        late,
        {"output.policy": "predict"},
        tick=STEP,
        spare=lambda made: math.inf if rng.random() < chance else 0.0,
    )
    error, steps = truth_error(run, "clean_sweep", "p_trk", since=0.3)
    valid, covariance = run.column("valid")[steps], run.column("tip_covariance")[steps, :3, :3]
    size = np.linalg.norm(error, axis=1)[valid]
    deviation = np.sqrt(np.trace(covariance, axis1=1, axis2=2))[valid]
    assert valid.mean() > 0.7
    assert size.max() > 2e-3, "the late joints make no difference here: nothing is shown"
    assert np.all(size < 3 * deviation + 0.3e-3)


def test_joints_that_stay_away_in_motion_are_what_the_reason_names(sweep):
    run = play(
        [m for m in sweep if m.kind != "joints" or m.stamp < 1.1e9], {"output.policy": "predict"}, tick=STEP
    )
    first = next(out for out in run.outputs if not out.valid)
    assert 1.1 < (first.stamp_ns - START_NS) * 1e-9 < 1.2
    assert first.reason.startswith("joint states come too late")
