"""Steps that are long where the data can tell no difference."""

from dataclasses import replace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference.fit_problem import choose_steps, make_problem
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.step_choice import with_chosen_steps
from ctr_dynamics.diagnosis.time_steps import TimeSteps
from ctr_dynamics.diagnosis.whitening import Whitener

OPTIONS = DiagnosisOptions()
SILENT = RunContext(workers=1)
WINDOW = 128 * 0.003


def test_steps_fill_their_windows_and_end_with_the_recording():
    steps = TimeSteps(WINDOW, (0.006, 0.003, 0.012))
    whole = steps.lengths(3 * WINDOW)
    assert whole.tolist() == 64 * [0.006] + 128 * [0.003] + 32 * [0.012]
    longer = steps.lengths(3.5 * WINDOW + 0.001)  # the last window serves for what comes after
    assert longer.sum() == pytest.approx(3.5 * WINDOW + 0.001, abs=1e-12)
    assert longer[: len(whole)].tolist() == whole.tolist()
    assert 0.9 * 0.012 < longer[-1] < 0.012
    assert steps.lengths(0.004).tolist() == [0.004]
    assert steps.scaled(0.5).lengths(WINDOW).tolist() == 128 * [0.003]
    assert steps.at_least(0.005).in_window == (0.006, 0.005, 0.012)
    assert (steps.shortest, steps.longest) == (0.003, 0.012)


def whitened(model, whiten, point):
    return whiten(model.residual_at(point))


@pytest.fixture
def long(recording, robot):
    """The recording, and four seconds more in which the joints stand, with a tracker twenty times as exact as its file says."""
    t = np.arange(0.0, 5.0, 0.01)
    joints = np.column_stack([t, np.tile(recording.joints[-1, 1:], (len(t), 1))])
    joints[: len(recording.joints)] = recording.joints
    stamps = np.arange(0.0, 4.9, 0.025)
    blind = replace(
        recording,
        joints=joints,
        stamps=stamps,
        position=np.zeros((len(stamps), 3)),
        quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (len(stamps), 1)),
    )
    return ForwardModel(blind, robot), Whitener(
        robot, stamps, np.array([True] * 3 + [False] * 3), np.ones(len(stamps), bool)
    )


def test_steps_are_as_long_as_the_data_can_tell_no_difference(long):
    even, whiten = long
    fine = whitened(even, whiten, {})
    counts = []
    for limit in (1e-6, 0.3, 3.0):
        chosen = with_chosen_steps(even, whiten, {}, replace(OPTIONS.steps, limit=limit))
        assert np.linalg.norm(whitened(chosen, whiten, {}) - fine) <= limit
        counts.append(len(chosen.predict({}).trajectory.t))
    assert counts[0] > counts[1] > counts[2]
    assert counts[2] < 0.3 * counts[0]


def test_a_recording_has_its_steps_in_its_parts_and_in_finer_ones(recording, robot):
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    choose_steps(problem, {}, SILENT)
    (model,) = problem.forward_models
    assert model.steps is not None
    assert model.longest_step > model.scheme.dt
    (part,) = problem.until([0.5]).forward_models
    assert part.steps == model.steps
    assert part.recording.stamps[-1] <= 0.5
    (finer,) = problem.finer.forward_models
    assert finer.longest_step == 0.5 * model.longest_step
    (even,) = problem.even.forward_models
    assert even.longest_step == even.shortest_step == model.scheme.dt
    least = problem.with_least_step(0.5 * model.longest_step).forward_models[0]
    assert least.shortest_step >= 0.5 * model.longest_step
