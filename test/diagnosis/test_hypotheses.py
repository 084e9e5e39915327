"""Fits of hypotheses: sizes that a derivative does not reach, and alternatives in the place of a cause."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_cases import Vibration, quantity

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference import hypotheses
from ctr_dynamics.diagnosis.inference.candidates import candidates, causes_of
from ctr_dynamics.diagnosis.inference.fit_problem import make_problem
from ctr_dynamics.diagnosis.inference.fit_quality import is_acceptable, is_far_from_noise
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis, best_size_nearby
from ctr_dynamics.diagnosis.inference.map_fit import fit
from ctr_dynamics.diagnosis.inference.screening import Screened
from ctr_dynamics.diagnosis.inference.search_moves import (
    SearchState,
    add_further_cause,
    alternatives,
    begin_again_without_causes,
    fit_alternatives,
    keep_promises,
)
from ctr_dynamics.diagnosis.inference.sensitivities import sensitivities_at
from ctr_dynamics.diagnosis.run_context import RunContext

OPTIONS = DiagnosisOptions()
SILENT = RunContext(workers=1)


def test_a_size_is_looked_for_beyond_the_reach_of_its_column():
    """Half a turn of phase has run away before the vibration has decayed."""
    frequency = quantity("frequency")
    problem = Vibration({frequency.key: 0.4})
    found = best_size_nearby(problem, {frequency.key: 0.3}, frequency)
    assert found[frequency.key] == pytest.approx(0.4, abs=0.003)
    assert problem.steps == [OPTIONS.screening.finite_size_dt_s]


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


def test_alternatives_begin_at_nominal_nuisances_too(recording, robot, known, monkeypatch):
    """Nuisances that have followed other causes so far may be stuck where these took them."""
    offset = known["encoder_offset", "tube1.offset_rad"]
    mass = known["payload_mass", "added_kg"]
    problem = make_problem(robot, [recording], [offset], np.ones(6, bool))
    pool = [
        c
        for c in candidates(list(known.values()), recording.position)
        if c.effect in ("payload_mass", "density")
    ]
    (right,) = [c for c in pool if c.effect == "payload_mass"]
    other = next(c for c in pool if c.effect == "density")
    wrong = fit(problem, causes_of([other]), {})
    here = sensitivities_at(problem, wrong.point, pool, SILENT, again=wrong)
    starts = []

    def stuck_first(own, members, start, **given):
        """A fit that stays where it is when it begins far from nominal."""
        starts.append(dict(start))
        begun = {**start, offset.key: 5.0 * offset.tolerance} if len(starts) == 1 else start
        return Hypothesis(
            members, fit(own, causes_of(members), begun, iterations=0 if len(starts) == 1 else None)
        )

    monkeypatch.setattr(hypotheses, "fit_hypothesis", stuck_first)
    found = hypotheses.fit_alternative(problem, Hypothesis((other,), wrong), (right,), here, 0.0)
    assert len(starts) == 2
    assert starts[1][offset.key] == offset.off
    assert found.fit.point[mass.key] == pytest.approx(3e-4, rel=0.1)
    assert abs(found.fit.point[offset.key]) < offset.tolerance


def test_a_fit_that_does_not_keep_what_screening_promised_is_done_again(recording, robot, known):
    """From nominal nuisances; one that has kept it, and one of which less was promised, are not."""
    offset, mass = known["encoder_offset", "tube1.offset_rad"], known["payload_mass", "added_kg"]
    problem = make_problem(robot, [recording], [offset], np.ones(6, bool))
    every = candidates(list(known.values()), recording.position)
    right = next(c for c in every if c.effect == "payload_mass")
    other = next(c for c in every if c.effect == "density")
    without = fit(problem, (), {})
    stuck = fit(problem, causes_of([right]), {offset.key: 5.0 * offset.tolerance}, iterations=0)
    assert stuck.cost > without.cost
    found = [Hypothesis((), without), Hypothesis((right,), stuck), Hypothesis((other,), stuck)]
    state = SearchState(problem, [right, other], without, SILENT, list(found))
    state.add()
    keep_promises(state, [Screened(50.0, right, None), Screened(1.0, other, None)])
    (new,) = [e for e in state.found if not any(e is old for old in found)]
    assert new.effects == ("payload_mass",)
    assert new.fit.point[mass.key] == pytest.approx(3e-4, rel=0.1)
    assert state.best is new
    keep_promises(state, [Screened(50.0, right, None), Screened(1.0, other, None)])
    assert state.best is new


def test_nuisances_that_a_cause_has_led_to_replace_those_without(recording, robot, known):
    """A fit that has stopped early is no fit to count causes against."""
    mass = known["payload_mass", "added_kg"]
    problem = make_problem(robot, [recording], [replace(mass, tolerance=mass.scale)], np.ones(6, bool))
    stopped, whole = fit(problem, (), {}, iterations=0), fit(problem, (), {})
    assert stopped is not None
    assert whole is not None
    other = candidates([known["density", "all.scale"]], recording.position)[0]
    led = fit(problem, causes_of([other]), whole.point)
    assert led is not None
    state = SearchState(
        problem, [other], stopped, SILENT, [Hypothesis((other,), led), Hypothesis((), stopped)]
    )
    assert begin_again_without_causes(state)
    assert state.recalibrated.cost == pytest.approx(whole.cost, abs=1.0)
    assert not begin_again_without_causes(state)


@pytest.mark.parametrize(
    ("noises", "left", "causes", "far"),
    [(8.0, 0.9, 1, False), (15.0, 0.9, 1, True), (15.0, 0.1, 1, False), (15.0, 0.1, 3, True)],
)
def test_a_search_far_from_the_noise_ends(recording, robot, known, noises, left, causes, far):
    """Far above the noise, and little explained or as many causes as there may be: the error is the model's."""
    problem = make_problem(robot, [recording], [], np.ones(6, bool))
    some = fit(problem, (), {}, iterations=0)
    assert some is not None
    chi2 = noises * problem.size
    before = problem.size + (chi2 - problem.size) / left
    members = candidates(list(known.values()), recording.position)[:causes]
    hypothesis = Hypothesis(tuple(members), replace(some, chi2=chi2, cost=chi2))
    assert is_far_from_noise(problem, hypothesis, replace(some, chi2=before, cost=before)) is far


def test_a_further_cause_is_tried_at_finite_sizes_where_much_is_left(recording, robot, known):
    """Derivatives at zero rank damping of torsion, drag and friction at the plate before damping of bending, which was hidden."""
    damping = known["bending_damping", "tube2.B_Nm2s"]
    truth = {("registration_rotation", "rx_rad"): 0.04, damping.key: 3.0 * damping.scale}
    seen = ForwardModel(recording, robot).predict(truth)
    there = replace(recording, position=seen.position, quaternion=seen.quaternion)
    problem = make_problem(robot, [there], [known["encoder_offset", "tube1.offset_rad"]], np.ones(6, bool))
    problem.options = replace(OPTIONS, search=replace(OPTIONS.search, further=1))
    every = candidates(list(known.values()), there.position)
    dissipation = ("bending_damping", "torsion_damping", "air_drag", "base_viscous", "tube_viscous")
    pool = [c for c in every if c.effect in ("registration_rotation", *dissipation)]
    (rotation,) = [c for c in pool if c.effect == "registration_rotation"]
    alone = fit(problem, (), {})
    led = fit(problem, causes_of([rotation]), {})
    assert alone is not None
    assert led is not None
    leader = Hypothesis((rotation,), led)
    assert not is_acceptable(problem, led)
    state = SearchState(problem, pool, alone, SILENT, [leader, Hypothesis((), alone)])
    here = sensitivities_at(problem, alone.point, pool, SILENT)
    assert here is not None
    add_further_cause(state, [leader], here)
    assert state.best.effects == ("bending_damping", "registration_rotation")
    assert state.best.fit.point[damping.key] == pytest.approx(truth[damping.key], rel=0.02)
