"""A tracker and a model that lie far apart: nobody knows which of them is wrong, so that outputs are invalid until they agree again."""

from dataclasses import replace

import numpy as np
import pytest
from estimation_cases import bag_messages, play

FROM_S, TO_S = 1.0, 1.8


def displaced(move, since=FROM_S, until=TO_S, seconds=3.0):
    """The first ``seconds`` of a sweep, with ``move`` (m) added to every tracker position from ``since`` ``until`` (s)."""
    messages = []
    for m in bag_messages("clean_sweep", seconds):
        if m.kind == "pose" and since <= m.stamp * 1e-9 < until:
            position, *rest = m.content
            m = replace(m, content=(tuple(np.add(position, move())), *rest))
        messages.append(m)
    return messages


@pytest.mark.parametrize("distance", [0.03, 0.12])
def test_outputs_are_invalid_while_tracker_and_model_are_far_apart(distance):
    run = play(displaced(lambda: (distance, 0.0, 0.0)))
    valid, t = run.column("valid"), run.t
    assert valid[t < FROM_S].all()
    assert not valid[(t > FROM_S + 0.35) & (t < TO_S)].any()
    assert valid[t > TO_S + 0.5].all()
    reason = next(out.reason for out in run.outputs if not out.valid)
    assert "tracker and model lie" in reason
    assert "limit 19.9 mm" in reason


def test_outliers_below_half_leave_the_outputs_valid():
    rng = np.random.default_rng(3)
    run = play(displaced(lambda: (0.05 * (rng.random() < 0.3), 0.0, 0.0)))
    assert run.column("valid").all()


def test_a_shift_since_the_start_may_be_one_of_the_registration():
    """Nobody can tell that from a fault of the tracker, so the covariance holds both; a shift that begins later is one of the tracker."""
    start, later = (play(displaced(lambda: (0.0, 0.005, 0.0), since, 2.0, 1.5)) for since in (0.0, FROM_S))
    for run, deviates in ((start, True), (later, False)):
        covariance = run.column("tip_covariance")[run.t > 1.2, :3, :3]
        deviation = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        assert run.column("valid").all()
        assert np.all((deviation > 4e-3) == deviates)


@pytest.mark.parametrize("zeros", [(0.8, 0.8), (0.0, -1.2)])
def test_joints_with_wrong_zeros_are_not_taken_for_a_late_tracker_when_they_begin_to_move(zeros):
    """No delay brings tracker and model together, so an unknown one is no excuse for their distance."""
    messages = []
    for m in bag_messages("clean_sweep", 3.0):
        if m.kind == "joints":
            names, values = m.content
            shift = dict(zip(("tube1_rotation", "tube2_rotation"), zeros, strict=True))
            m = replace(
                m, content=(names, [x + shift.get(n, 0.0) for n, x in zip(names, values, strict=True)])
            )
        messages.append(m)
    run = play(messages)
    assert not run.column("valid")[run.t > 0.1].any()
    reasons = {out.reason for out in run.outputs if not out.valid}
    assert all("tracker and model lie" in reason or "known to no better" in reason for reason in reasons), (
        reasons
    )
