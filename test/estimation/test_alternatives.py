"""What else may be right is weighed after the output, in idle time or before the next step, which makes no difference."""

import pytest

from .estimation_cases import START_NS, bag_messages, play


@pytest.fixture(scope="module")
def late():
    """Joints and poses of three seconds, with poses that are 60 ms late."""
    return [m.shifted(0.06) if m.kind == "pose" else m for m in bag_messages("clean_sweep", 3.0)]


def test_measurements_count_in_idle_time_as_before_the_next_step(late):
    concluded = []

    def idling(made):
        advance, alternatives = made.advance, made.runs.fused.alternatives

        def then_idle(*arguments):
            steps = advance(*arguments)
            made.do_idle_work()
            return steps

        conclude = alternatives.conclude

        def noted(*arguments):
            again = conclude(*arguments)
            concluded.append(again)
            return again

        made.advance, alternatives.conclude = then_idle, noted

    def without_idle(made):
        made.options = type(made.options)(longest_without_idle=10**9)

    idle = play(late, prepare=idling)
    assert any(concluded)  # the latency is found
    busy = play(late, prepare=without_idle)
    for run in (idle, busy):
        assert "older than their stamps" in run.estimator.health.tracker["latency"].last
    for name in ("tip_position", "tip_quaternion_wxyz"):
        assert idle.column(name).tobytes() == busy.column(name).tobytes()
    nis = [[i.nis for out in run.outputs for i in out.innovations] for run in (idle, busy)]
    assert nis[0] == nis[1]


def test_an_output_does_not_wait_for_what_its_measurement_says_of_the_tracker(late):
    waiting = []

    def watched(made):
        alternatives, step = made.runs.fused.alternatives, made.runs.step
        add, count, known = alternatives.add, alternatives.count, [0]

        def added(compared):
            known[0] += 1
            add(compared)

        def counted():
            known[0] = 0
            count()

        def stepped(*arguments, **named):
            result = step(*arguments, **named)
            waiting.append(known[0])
            return result

        alternatives.add, alternatives.count, made.runs.step = added, counted, stepped

    play([m for m in late if m.stamp < 0.5e9], prepare=watched)
    assert max(waiting) == 1
    assert sum(waiting) > 10


def test_nothing_is_concluded_without_a_new_measurement_nor_where_none_is_fused(late):
    run = play([m for m in late if m.stamp < 0.3e9], {"filter.enabled": False})
    alternatives, open_loop = run.estimator.runs.fused.alternatives, run.estimator.runs.open_loop
    alternatives.moving = True
    assert not alternatives.conclude(open_loop, run.estimator.k)
    assert not alternatives.not_fused


def test_while_the_latency_is_doubted_the_open_loop_run_is_published_with_room_for_the_filter(late):
    """Poses of a tracker that is late by a time that is not known are not fused meanwhile."""
    on_time = bag_messages("clean_sweep", 3.0)
    made = play([m for m in on_time if m.stamp < 2.0e9]).estimator
    alternatives = made.runs.fused.alternatives
    alternatives._doubted_since = made.k
    joints = [m for m in on_time if m.kind == "joints"]  # the tracker is silent from here on
    for message in joints:
        if 2.0e9 <= message.stamp < 2.02e9:
            message.give(made)
    (*_, out) = made.advance()
    assert out.tip_position.tolist() == out.predicted_position.tolist()
    apart = ((made.runs.fused.ekf.tip_estimate().position - out.tip_position) ** 2).sum() ** 0.5
    assert apart > 1e-4  # m
    assert out.tip_covariance[:3, :3].trace() ** 0.5 > 0.9 * apart
    assert out.backbone[-1, 1:4] == pytest.approx(out.tip_position, abs=1e-3)
    for message in joints:
        if 2.02e9 <= message.stamp < 2.5e9:
            message.give(made)
    outputs = made.advance()
    until = 2.0 + alternatives.usual_timing.late.options.longest_s
    for out in outputs[:: len(outputs) // 8]:
        same = out.tip_position.tolist() == out.predicted_position.tolist()
        assert same == ((out.stamp_ns - START_NS) * 1e-9 < until)
