"""Predictions, derivatives and fits on one second of a motion whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions, DiscretisationOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference import discretisation_error
from ctr_dynamics.diagnosis.inference.candidates import candidates, causes_of
from ctr_dynamics.diagnosis.inference.discretisation_error import correct_discretisation, renew_correction
from ctr_dynamics.diagnosis.inference.fit_problem import make_problem
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis
from ctr_dynamics.diagnosis.inference.map_fit import corrected, fit
from ctr_dynamics.diagnosis.inference.screening import screen
from ctr_dynamics.diagnosis.inference.search_moves import SearchState, alternatives, fit_alternatives
from ctr_dynamics.diagnosis.inference.sensitivities import sensitivities_at, with_large_sizes
from ctr_dynamics.diagnosis.pipeline import diagnose
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.effects import quantities
from ctr_dynamics.model import trajectory
from ctr_dynamics.robot_files import load_robot

SILENT = RunContext(workers=1)
OPTIONS = DiagnosisOptions()
PAYLOAD = ("payload_mass", "added_kg")
AIR = ("air_drag", "linear_Ns_per_m2")
STIFFNESS = ("youngs_modulus", "tube1.scale")


@pytest.fixture(scope="module")
def robot():
    return load_robot("till2020_tissue")


@pytest.fixture(scope="module")
def known(robot):
    return {q.key: q for q in quantities(robot)}


@pytest.fixture(scope="module")
def recording(robot):
    """Both tubes turned by 0.6 rad within 0.3 s, seen by a tracker without noise; 0.3 g more payload than the robot file says."""
    t = np.arange(101) / 100.0
    turn = 0.6 * np.clip(t / 0.3, 0.0, 1.0)[:, None]
    joints = np.column_stack([t, robot.rest.alpha.value + turn, np.tile(robot.rest.beta.value, (len(t), 1))])
    stamps = np.arange(40) / 40.0
    empty = np.tile([1.0, 0.0, 0.0, 0.0], (40, 1))
    blind = Recording("truth", "", {}, joints, np.zeros((0, 7)), stamps, np.zeros((40, 3)), empty, ())
    seen = ForwardModel(blind, robot).predict({PAYLOAD: 3e-4})
    assert not seen.failure
    return Recording("seen", "", {}, joints, np.zeros((0, 7)), stamps, seen.position, seen.quaternion, ())


def test_columns_together_are_those_apart(recording, robot, known, monkeypatch):
    """With a cause that needs the extended model, plain columns go through that one too."""
    forward_model = ForwardModel(recording, robot)

    def apart():
        """Largest difference of the stiffness' columns, of their size on each axis; and all columns."""
        alone = forward_model.jacobian({}, [known[STIFFNESS]])[1][:, :, 0]
        together = forward_model.jacobian({}, [known[STIFFNESS], known[AIR]])[1]
        return np.abs((together[:, :, 0] - alone) / np.abs(alone).max(axis=0)).max(), together

    difference, together = apart()
    assert difference < 1e-3  # rounding: changes are as small as strong friction needs
    with monkeypatch.context() as patch:
        patch.setattr(trajectory, "EPSILON", 1e-6)
        for model in forward_model._models.values():
            patch.setattr(model, "tangent_step", 0.1 * model.step)
        assert apart()[0] < 1e-5
    step = 0.01
    shifted = [
        forward_model.predict({AIR: known[AIR].off + side * step * known[AIR].scale}).position
        for side in (0, 1)
    ]
    slope = (shifted[1] - shifted[0]) / step
    assert np.abs(together[:, :3, 1] - slope).max() < 0.03 * np.abs(slope).max()


def test_a_fit_finds_the_payload_and_one_without_a_chance_does_not_move(recording, robot, known):
    nuisances = [known[key] for key in known if key[0] in ("registration_translation", "encoder_offset")]
    problem = make_problem(robot, [recording], nuisances, np.ones(6, bool))
    found = fit(problem, [known[PAYLOAD]], {})
    assert found is not None
    sigma = found.sigma[[q.key for q in found.active].index(PAYLOAD)]
    assert abs(found.point[PAYLOAD] - 3e-4) < 0.3 * sigma
    assert found.chi2 < 1.0
    # without the payload no tolerance reaches that
    given_up = fit(problem, (), {}, limit=found.cost + 1.0)
    best = fit(problem, (), {})
    assert given_up is not None
    assert best is not None
    assert given_up.cost > best.cost > found.cost + 1.0
    assert np.all(given_up.values == [q.off for q in problem.nuisances])


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
    monkeypatch.setattr(
        discretisation_error, "differences", lambda *given: tuple(20.0 * part for part in measured(*given))
    )
    change = renew_correction(problem, there.point, SILENT)
    assert change is not None
    assert np.linalg.norm(change) >= OPTIONS.discretisation.renewed
    moved = corrected(problem, there, change)
    np.testing.assert_allclose(moved.residual, problem.residual(there.point), atol=1e-9)
    again = fit(problem, [friction], there.point, iterations=0)
    assert again is not None
    assert moved.log_evidence == pytest.approx(again.log_evidence, abs=1e-6)
    assert moved.log_evidence != pytest.approx(there.log_evidence, abs=1.0)


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
    assert errors()[0] == 0.0


def test_the_misfit_is_a_smooth_function_of_delays(robot, known):
    """Drives and load later by as much as the tracker is earlier is the same experiment, wherever in the steps their samples fall."""
    rng = np.random.default_rng(2)
    t = np.arange(101) / 100.0
    turn = 0.3 * (1.0 - np.cos(np.pi * np.clip(t / 0.3, 0.0, 1.0)))[:, None] + 5e-4 * rng.standard_normal(
        (101, 2)
    )
    joints = np.column_stack([t, robot.rest.alpha.value + turn, np.tile(robot.rest.beta.value, (len(t), 1))])
    load = np.zeros((4, 7))
    load[:, 0], load[:, 2] = (0.0, 0.5, 0.51, 1.0), (-0.3, -0.3, 0.0, 0.0)
    stamps = np.arange(2, 39) / 40.0
    nothing = np.zeros((len(stamps), 3))
    recording = Recording(
        "", "", {}, joints, load, stamps, nothing, np.tile([1.0, 0, 0, 0], (len(stamps), 1)), ()
    )
    forward_model = ForwardModel(recording, robot)

    def seen(drives, tracker):
        later = {("actuator_latency", "delay_s"): drives, ("load_time", "delay_s"): drives}
        return forward_model.predict({**later, ("tracker_latency", "delay_s"): tracker}).position

    base, moved = seen(0.0, 0.004), seen(0.0, 0.0)
    shifts = [seen(d, 0.004 - d) for d in (0.0003, 0.0007, 0.0013, 0.0019, 0.0026, 0.004)]
    assert max(np.abs(shift - base).max() for shift in shifts) < 0.02 * np.abs(moved - base).max()


def test_nuisances_stay_near_their_tolerances_unless_they_may_go_far(recording, robot, known):
    nuisance = known["registration_translation", "tx_m"]
    there = replace(recording, position=recording.position + [0.002, 0.0, 0.0])  # ten tolerances
    problem = make_problem(robot, [there], [nuisance], np.ones(6, bool))
    near, far = fit(problem, (), {}), fit(replace(problem, reach=np.inf), (), {})
    cause = fit(problem, [nuisance], {})
    assert near is not None
    assert far is not None
    assert cause is not None
    assert near.values[0] == pytest.approx(OPTIONS.calibration.reach * nuisance.tolerance)
    assert 7 < far.values[0] / nuisance.tolerance < 11
    assert 7 < cause.values[0] / nuisance.tolerance < 11


def test_large_sizes_are_looked_at_where_the_misfit_is_large(recording, robot, known):
    heavy = ("payload_inertia", "scale")
    seen = ForwardModel(recording, robot).predict({heavy: 0.5})
    there = replace(recording, position=seen.position, quaternion=seen.quaternion)
    problem = make_problem(robot, [there], [known["encoder_offset", "tube1.offset_rad"]], np.ones(6, bool))
    pool = [
        c
        for c in candidates(list(known.values()), there.position)
        if c.effect in ("payload_inertia", "density")
    ]
    clean = fit(problem, (), {})
    near = sensitivities_at(problem, {}, pool, SILENT)
    assert clean is not None
    assert near is not None
    far = with_large_sizes(problem, near, pool, SILENT)
    assert not near.trials
    (inertia,) = [c for c in pool if c.effect == "payload_inertia"]
    assert [p.shift[heavy] for p in far.trials[inertia]] == pytest.approx([0.55, 0.75, 1.25, 1.45, 1.7])
    np.testing.assert_array_equal(near.by_candidate[inertia], far.by_candidate[inertia])
    best = screen(problem, far, clean, (), pool)[0]
    assert best.candidate is inertia


def test_what_looks_like_a_cause_is_fitted_in_its_place(recording, robot, known):
    nuisances = [known["encoder_offset", "tube1.offset_rad"], known["registration_translation", "ty_m"]]
    problem = make_problem(robot, [recording], nuisances, np.ones(6, bool))
    pool = [
        c
        for c in candidates(list(known.values()), recording.position)
        if c.effect in ("payload_mass", "density")
    ]
    other = next(c for c in pool if c.effect == "density")
    wrong = fit(problem, causes_of([other]), {})
    assert wrong is not None
    state = SearchState(problem, pool, wrong, SILENT, [Hypothesis((other,), wrong)])
    here = sensitivities_at(problem, wrong.point, pool, SILENT, again=wrong)
    assert here is not None
    new = fit_alternatives(state, alternatives(problem, state.found, here), here)
    (right,) = [e for e in new if e.effects == ("payload_mass",)]
    assert right.fit.cost < wrong.cost - 1.0
    known_ones = [*state.found, *new]
    assert not [s for s in alternatives(problem, known_ones, here) if s[0].effect == "payload_mass"]


def test_a_used_up_time_budget_ends_the_search_and_is_said(recording, robot):
    stages = []
    found = diagnose(robot, [recording], context=RunContext(stages.append, workers=1, time_budget_s=0.0))
    assert "the time budget of 0 s is used up: the search was not completed" in found.notes
    assert stages[:3] == ["nominal model", "re-calibration inside tolerance", "discretisation error"]
    assert not [stage for stage in stages if "alternatives" in stage or "leaves" in stage]
    assert found.search is not None
    assert found.search.probabilities.sum() == pytest.approx(1.0)
