"""What is counted of measurements and restarts: once each, however often steps are taken again; and what a reset forgets."""

import math
from dataclasses import replace

import numpy as np
import pytest
from estimation_cases import START_NS, bag_messages, estimator

from ctr_dynamics.estimation.inputs.measurement_queue import MeasurementQueue
from ctr_dynamics.estimation.monitoring.health import Health
from ctr_dynamics.estimation.monitoring.innovation_log import REMEMBERED_NS, InnovationLog
from ctr_dynamics.estimation.monitoring.measurement_record import FEWEST_APART
from ctr_dynamics.estimation.step_output import Innovation
from ctr_dynamics.estimation.timeline import Timeline
from ctr_dynamics.model.stability import Stability

MS = 1_000_000


def innovation(stamp_ns, apart=1e-3):
    return Innovation(
        stamp_ns,
        np.zeros(6),
        np.ones(6),
        6.0,
        6,
        True,
        0.0,
        "",
        np.ones(6),
        None,
        np.array([apart, 0.0, 0.0]),
    )


def test_a_fast_tracker_is_counted_once_over_the_longest_correction():
    """400 poses a second, of which those of two seconds are fused again."""
    health = Health()
    log, period = InnovationLog(health), 1_000_000_000 // 400
    for i in range(1, 2001):
        log.add(innovation(i * period))
        log.take()
    assert health.measurements.nis_count == 2000
    mark = log.mark()
    for i in range(1200, 2002):
        log.add(innovation(i * period))
    log.keep_new(mark)
    assert health.measurements.nis_count == 2001
    assert [i.stamp_ns for i in log.take()] == [2001 * period]
    log.add(innovation(2 * REMEMBERED_NS))
    log.take()
    assert len(log._reported) == 1, "the memory is bounded"


def test_what_could_not_be_compared_is_noted_once_however_often_it_comes_due():
    health = Health()
    log = InnovationLog(health)
    for _ in range(3):
        mark = log.mark()
        log.add(innovation(MS)._replace(dof=0, reason="no joint states at its time"))
        log.discard(mark)
    assert not health.tracker
    log.add(innovation(MS)._replace(dof=0, reason="no joint states at its time"))
    log.take()
    assert health.tracker["not compared"].count == 1
    assert "no joint states" in health.tracker["not compared"].last


def test_the_limit_of_the_recent_nis_goes_by_its_degrees_of_freedom():
    record = Health().measurements
    for _ in range(10):
        record.add(innovation(MS)._replace(nis=3.0, dof=3), fusing=True)
    assert record.recent_nis == pytest.approx((1.0, 1.0 + 4.0 * (2.0 / 30.0) ** 0.5))


def test_distances_that_are_taken_back_do_not_count():
    health = Health()
    log = InnovationLog(health)
    for i in range(FEWEST_APART):
        assert health.measurements.apart_m == 0.0
        log.add(innovation(i * MS))
    assert health.measurements.apart_m == pytest.approx(1e-3)
    mark = log.mark()
    for i in range(10):
        log.add(innovation((10 + i) * MS, apart=5e-3))
    assert health.measurements.apart_m == pytest.approx(5e-3)
    log.discard(mark)
    assert health.measurements.apart_m == pytest.approx(1e-3)
    health.measurements.distances.clear()
    assert health.measurements.apart_m == 0.0


@pytest.mark.parametrize("skew", [0.0, 1e-3])
def test_a_pose_is_fused_at_the_step_that_is_foretold(skew):
    """With a tracker's clock that runs fast, long after the start."""
    made = estimator()
    timeline = Timeline()
    timeline.t0_ns = 0
    queue = MeasurementQueue(made.tracker.corrected(), "ctr_base", 10**9, timeline, Health())
    object.__setattr__(queue.tracker, "skew", skew)
    stamp_ns = 100_000 * MS
    timeline.k = math.floor((stamp_ns / (1.0 + skew)) / (3 * MS)) - 2
    queue.add(stamp_ns, (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0), "", stamp_ns)
    first = queue.first_fusion(timeline.k)
    assert not queue.due((first - 1) * 3e-3)
    assert len(queue.due(first * 3e-3)) == 1


def test_a_start_in_motion_counts_one_restart_though_its_step_is_taken_again():
    made = estimator({"output.policy": "predict"})
    messages = sorted(bag_messages("clean_sweep", 3.4), key=lambda m: m.arrival)
    moving = [m for m in messages if m.stamp > 3000 * MS]
    late = next(m for m in moving[4:] if m.kind == "joints")
    moving.remove(late)
    for message in moving[:20]:
        message.give(made)
        made.advance(START_NS + message.arrival)
    before, again = made.health.restarts, made.health.corrected_steps
    assert before >= 1
    late.give(made)
    made.finish()
    assert made.health.corrected_steps > again
    assert made.health.restarts == before


def test_a_start_forgets_what_the_actuators_have_done_unknown_before_it():
    made = estimator({"output.policy": "predict"})
    messages = sorted(
        (m for m in bag_messages("clean_sweep", 0.4) if m.kind == "joints"), key=lambda m: m.arrival
    )
    late = messages.pop(20)
    for message in messages:
        message.give(made)
        made.advance(START_NS + message.arrival)
    made.runs.stop()
    names, positions = late.content
    replace(late, content=(names, [value + 0.05 for value in positions])).give(made)
    assert made.inputs.actuator_error.at(made.timeline.taken_ns).any()
    made.advance(START_NS + messages[-1].arrival + 10 * MS)
    assert made.runs.running
    assert not made.inputs.actuator_error._uncorrected.any()


def test_a_reset_leaves_no_figure_of_what_was_before():
    health = Health()
    health.stability = Stability.__new__(Stability)
    health.refutation, health.shift_m, health.noise_ratio = "the file is refuted", 3e-3, 4.0
    health.force_sigma, health.tracker_age_s = 0.1, 5.0
    health.measurements.rejected = 3
    health.reinitialise()
    fresh = Health()
    for name in ("stability", "refutation", "shift_m", "noise_ratio", "force_sigma", "tracker_age_s"):
        assert getattr(health, name) == getattr(fresh, name), name
    assert health.measurements.rejected == 3, "counters stay"


def test_measurements_agree_anew_after_a_start():
    made = estimator()
    for message in sorted(bag_messages("clean_release", 0.6), key=lambda m: m.arrival):
        message.give(made)
        made.advance()
    assert made.runs.fused.agreed
    made.runs.stop()
    assert not made.runs.start(made.k)
    assert not made.runs.fused.agreed


def test_poses_from_within_a_gap_are_left_out_by_the_time_that_they_show():
    """Of a tracker that has been found to be 0.15 s late, beside joints that are missing for 0.3 s."""
    made, late_s, gap = estimator({"output.policy": "wait"}), 0.15, (600 * MS, 900 * MS)
    out = []
    for message in sorted(bag_messages("clean_sweep", 1.6), key=lambda m: m.arrival):
        if message.kind == "joints" and gap[0] < message.stamp < gap[1]:
            continue
        moved = message.shifted(late_s) if message.kind == "pose" else message
        moved.give(made)
        if made.k < 0:
            made.runs.fused.ekf.expected.late_by(late_s, 1e-3)
        out += made.advance()
    left_out = [i for step in out for i in step.innovations if "no joint states" in i.reason]
    shown = [(i.stamp_ns - START_NS) / MS - 1e3 * late_s for i in left_out]
    assert len(shown) > 5
    assert all(590 < t < 910 for t in shown), shown
