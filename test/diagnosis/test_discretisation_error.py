"""The solver's own error: measured, corrected, and measured again where causes are found."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions, DiscretisationOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference import discretisation_error, hypothesis_search
from ctr_dynamics.diagnosis.inference.candidates import candidates
from ctr_dynamics.diagnosis.inference.discretisation_error import (
    change_solution,
    choose_nodes,
    correct_discretisation,
    differences,
    renew_correction,
)
from ctr_dynamics.diagnosis.inference.fit_problem import make_problem
from ctr_dynamics.diagnosis.inference.map_fit import corrected, fit
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.time_steps import TimeSteps
from ctr_dynamics.robot_files import load_robot

OPTIONS = DiagnosisOptions()
SILENT = RunContext(workers=1)


def test_more_nodes_where_the_data_can_see_them(recording, robot):
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    errors = correct_discretisation(problem, {}, SILENT)
    assert problem.forward_models[0].nodes == OPTIONS.forward_model.nodes
    keen = DiscretisationOptions(space_limit=0.0)
    problem.options = replace(OPTIONS, discretisation=keen)
    finer = correct_discretisation(problem, {}, SILENT)
    assert problem.forward_models[0].nodes == keen.most_nodes
    assert finer["space_error_m"] < 0.3 * errors["space_error_m"]
    assert finer["time_error_m"] == pytest.approx(errors["time_error_m"], rel=0.2)


def test_a_pose_that_was_not_measured_hides_no_error(recording, robot):
    """A whole row that is not a number, or its rotation only."""
    position, quaternion = recording.position.copy(), recording.quaternion.copy()
    position[3], quaternion[[3, 7]] = np.nan, np.nan
    gappy = replace(recording, position=position, quaternion=quaternion)
    whole, found = (
        differences(make_problem(robot, [r], [], np.ones(6, bool)), {}, SILENT) for r in (recording, gappy)
    )
    assert found.directions.shape[0] == whole.directions.shape[0] - 12
    assert found.rms == pytest.approx(whole.rms, rel=0.1)
    assert np.isfinite([found.first, found.second, found.misfit]).all()


def test_errors_far_below_the_misfit_need_no_finer_solution(recording, robot):
    """Beside a misfit of many times the noise nothing sees them; where causes explain the data, they are looked at again."""
    wrong = {("payload_mass", "added_kg"): 1.5e-3}
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    found = differences(problem, wrong, SILENT)
    assert found.misfit > 2.0
    seen = DiscretisationOptions(
        space_limit=0.6 * float(np.linalg.norm(found.directions[:, 1])),
        time_limit=math.inf,
        time_left=math.inf,
    )
    problem.options = replace(OPTIONS, discretisation=seen)
    correct_discretisation(problem, wrong, SILENT)
    assert problem.forward_models[0].nodes == OPTIONS.forward_model.nodes
    problem.options = replace(OPTIONS, discretisation=replace(seen, space_limit=0.0))
    renew_correction(problem, {}, SILENT)
    assert problem.forward_models[0].nodes == seen.most_nodes


def test_nodes_are_chosen_before_anything_is_fitted(recording, robot, monkeypatch):
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    choose_nodes(problem, {}, SILENT)
    begun = OPTIONS.forward_model.nodes
    assert problem.forward_models[0].nodes == begun
    plain = ForwardModel.residual_at
    monkeypatch.setattr(
        ForwardModel,
        "residual_at",
        lambda model, point: None if model.nodes == begun else plain(model, point),
    )
    choose_nodes(problem, {}, SILENT)
    assert problem.forward_models[0].nodes == 2 * begun, "fewer cannot be simulated"


def test_many_nodes_for_a_heavy_payload_on_three_tubes():
    """Ten nodes miss the vibration after a release by ten times the noise: nuisances would be fitted to that."""
    robot = load_robot("three_tube")
    times, still = np.linspace(0.0, 4.0, 161), np.concatenate([robot.rest.alpha.value, robot.rest.beta.value])
    joints = np.column_stack([times, np.tile(still, (len(times), 1))])
    weight = np.zeros((2, 7))
    weight[:, 0], weight[0, 3] = (0.0, 0.2), -0.6
    places, turns = np.zeros((len(times), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
    recording = Recording("release", "", {}, joints, weight, times, places, turns, ())
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    coarse, fine = (problem.forward_models[0].resolved(n, 0.003).residual_at({}) for n in (10, 40))
    assert coarse is not None
    assert fine is not None
    choose_nodes(problem, {}, SILENT)
    chosen = problem.residual({})
    assert problem.forward_models[0].nodes > OPTIONS.forward_model.nodes
    (whiten,) = problem.whiteners
    limit = OPTIONS.discretisation.space_limit
    assert np.linalg.norm(whiten(coarse - fine)) > limit
    assert np.linalg.norm(chosen - whiten(fine)) < limit


def test_the_error_of_the_solver_is_that_of_the_point(recording, robot, known, monkeypatch):
    """Where it is larger there, residuals and evidence are those with it, without a simulation."""
    problem = make_problem(
        robot, [recording], [known["encoder_offset", "tube1.offset_rad"]], np.ones(6, bool)
    )
    correct_discretisation(problem, {}, SILENT)
    friction = known["tube_coulomb", "mu"]
    there = fit(problem, [friction], {friction.key: friction.off + 0.1}, iterations=0)
    assert there is not None
    assert renew_correction(problem, there.point, SILENT) is None  # about the same: all stays
    np.testing.assert_array_equal(problem.residual(there.point), there.residual)
    measured = discretisation_error.differences

    def larger(found):
        return replace(found, directions=2000.0 * found.directions)

    monkeypatch.setattr(discretisation_error, "differences", lambda *given: larger(measured(*given)))
    change = renew_correction(problem, there.point, SILENT)
    assert change is not None
    assert np.linalg.norm(change) >= OPTIONS.discretisation.renewed
    moved = corrected(problem, there, change)
    np.testing.assert_allclose(moved.residual, problem.residual(there.point), atol=1e-9)
    again = fit(problem, [friction], there.point, iterations=0)
    assert again is not None
    assert moved.log_evidence == pytest.approx(again.log_evidence, abs=1e-6)
    assert moved.log_evidence != pytest.approx(there.log_evidence, abs=1.0)


def test_steps_that_were_long_for_another_motion_are_chosen_again(recording, robot):
    """A robot that rested where the nominal model does would leave the time error of this motion in what every cause has to explain."""
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    (even,) = problem.forward_models
    fine = problem.residual({})
    problem.forward_models = [even.with_steps(TimeSteps(0.384, (0.192,)))]
    wrong = problem.residual({})
    assert np.linalg.norm(wrong - fine) > 2.0 * OPTIONS.steps.limit
    change = renew_correction(problem, {}, SILENT)
    assert problem.forward_models[0].longest_step < 0.192
    now = problem.residual({})
    np.testing.assert_allclose(wrong - change, now, atol=1e-9)
    assert np.linalg.norm(now + problem.offset - fine) <= OPTIONS.steps.limit
    assert renew_correction(problem, {}, SILENT) is None  # they suit it now


def test_steps_at_which_the_robot_cannot_be_simulated_are_not_taken(recording, robot, monkeypatch):
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    models, offset = problem.forward_models, problem.offset
    longer = [models[0].with_steps(TimeSteps(0.384, (0.192,)))]
    plain = ForwardModel.residual_at
    monkeypatch.setattr(
        ForwardModel, "residual_at", lambda model, point: None if model is longer[0] else plain(model, point)
    )
    assert change_solution(problem, longer, offset + 1.0, problem.numerics, {}) is None
    assert problem.forward_models is models
    assert problem.offset is offset


def test_the_search_with_free_nuisances_hands_on_its_steps_and_its_correction(
    recording, robot, known, monkeypatch
):
    """All hypotheses are weighed by one solution, whichever search has found them."""
    problem = make_problem(
        robot, [recording], [known["encoder_offset", "tube1.offset_rad"]], np.ones(6, bool)
    )
    pool = [
        c
        for c in candidates(list(known.values()), recording.position)
        if c.effect in ("payload_mass", "density")
    ]
    recalibrated = fit(problem, (), {})
    shorter = [e.resolved(e.nodes, 0.5 * e.scheme.dt) for e in problem.forward_models]
    once = hypothesis_search.search_once

    def search_once(own, *given, **named):
        if own is not problem:  # the one with free nuisances
            own.forward_models, own.offset = shorter, np.full(own.size, 0.1)
        return once(own, *given, **named)

    monkeypatch.setattr(hypothesis_search, "search_once", search_once)
    for name in ("explains", "is_far_from_noise"):
        monkeypatch.setattr(hypothesis_search, name, lambda *given: False)
    found = hypothesis_search.search_hypotheses(problem, pool, recalibrated, SILENT)
    assert found.best.effects == ("payload_mass",)
    assert problem.forward_models[0].scheme.dt == shorter[0].scheme.dt
    for e in (found.best, found.no_cause):
        assert np.linalg.norm(problem.residual(e.fit.point) - e.fit.residual) < 1.0


def test_a_shorter_step_that_fails_is_followed_by_a_longer_one(recording, robot, monkeypatch):
    """Its difference is brought to that of half a step; where none succeeds there is no correction."""
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    plain, dt = ForwardModel.residual_at, problem.forward_models[0].scheme.dt

    def errors():
        return correct_discretisation(problem, {}, SILENT)["time_error_m"], problem.offset

    half, offset = errors()
    monkeypatch.setattr(
        ForwardModel,
        "residual_at",
        lambda model, point: None if model.scheme.dt < 0.6 * dt else plain(model, point),
    )
    longer, other = errors()
    assert not np.array_equal(offset, other)
    assert longer == pytest.approx(half, rel=0.5)
    monkeypatch.setattr(
        ForwardModel,
        "residual_at",
        lambda model, point: None if model.scheme.dt < dt else plain(model, point),
    )
    assert math.isnan(errors()[0])


def test_a_step_too_long_for_the_vibration_is_halved(recording, robot):
    """Until the difference to half of it is small, and the error named is that of the last refinement."""
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    plain = correct_discretisation(problem, {}, SILENT)
    dt = problem.forward_models[0].scheme.dt
    assert dt == OPTIONS.forward_model.dt_s
    keen = DiscretisationOptions(time_limit=0.0)
    problem.options = replace(OPTIONS, discretisation=keen)
    finer = correct_discretisation(problem, {}, SILENT)
    assert problem.forward_models[0].scheme.dt == keen.shortest_s
    assert finer["time_error_m"] < 0.3 * plain["time_error_m"]


def test_an_error_that_the_correction_leaves_halves_the_step(recording, robot, monkeypatch):
    measured = discretisation_error.differences
    monkeypatch.setattr(
        discretisation_error,
        "differences",
        lambda problem, *given: replace(
            measured(problem, *given),
            second=10.0 if problem.forward_models[0].scheme.dt > 0.002 else 0.0,
        ),
    )
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    correct_discretisation(problem, {}, SILENT)
    assert problem.forward_models[0].scheme.dt == 0.5 * OPTIONS.forward_model.dt_s
