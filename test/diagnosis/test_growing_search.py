"""Causes are found where the part of a recording that is explained ends, while the whole is out of phase."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_cases import LongVibration, quantity

from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.inference.candidates import candidates
from ctr_dynamics.diagnosis.inference.fit_problem import make_problem
from ctr_dynamics.diagnosis.inference.fit_quality import is_acceptable
from ctr_dynamics.diagnosis.inference.growing_fit import explain_growing_parts
from ctr_dynamics.diagnosis.inference.growing_search import search_growing_parts
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis
from ctr_dynamics.diagnosis.inference.map_fit import fit
from ctr_dynamics.diagnosis.inference.search_moves import SearchState
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.robot_files import robot_from_dict, robot_to_dict

SILENT = RunContext(workers=1)


def test_how_much_is_explained_ends_where_another_frequency_runs_out_of_phase():
    """Half a tolerance more than fits may go: in phase for seconds, and then no more."""
    frequency = quantity("frequency", tolerance=0.001)
    problem = LongVibration({frequency.key: 0.0045}, (frequency,))
    done = explain_growing_parts(problem)
    assert done.fit is None
    assert 0.02 < done.part < 0.7
    # as a cause it has no limit
    cause = quantity("frequency", tolerance=0.001, scale=0.01)
    whole = explain_growing_parts(problem, (cause,), done.point, first_part=done.part)
    assert whole.fit is not None
    assert whole.part == 1.0
    assert whole.fit.point[frequency.key] == pytest.approx(0.0045, abs=1e-5)


def test_a_cause_is_found_in_the_first_part_that_is_not_explained(recording, robot, known):
    data = robot_to_dict(robot)
    for name, value in (("position", 2e-5), ("rotation", 2e-4), ("drift", 2e-6)):
        data["tracker"]["noise"][name]["value"] = value
    nuisances = [known["registration_translation", "ty_m"], known["encoder_offset", "tube1.offset_rad"]]
    problem = make_problem(robot_from_dict(data), [recording], nuisances, np.ones(6, bool))
    pool = [
        c
        for c in candidates(list(known.values()), recording.position)
        if c.effect in ("payload_mass", "air_drag", "tracker_latency")
    ]
    without = fit(problem, (), {})
    assert without is not None
    assert not is_acceptable(problem, without)
    state = SearchState(problem, pool, without, SILENT, [Hypothesis((), without)])
    search_growing_parts(state)
    best = min(state.found, key=lambda e: e.fit.cost)
    assert best.effects == ("payload_mass",)
    assert best.fit.point["payload_mass", "added_kg"] == pytest.approx(3e-4, rel=0.02)
    assert is_acceptable(problem, best.fit)


def test_a_second_cause_is_added_where_the_part_that_the_first_explains_ends(recording, robot, known):
    """Neither explains the whole by itself, and each misleads the derivatives by the other."""
    true = {("payload_mass", "added_kg"): 2e-3, ("tube_viscous", "nu"): 2e-4}
    seen = ForwardModel(recording, robot).predict(true)
    assert not seen.failure
    hidden = replace(recording, position=seen.position, quaternion=seen.quaternion)
    problem = make_problem(robot, [hidden], [known["registration_translation", "ty_m"]], np.ones(6, bool))
    among = ("payload_mass", "air_drag", "tracker_latency", "tube_viscous")
    pool = [c for c in candidates(list(known.values()), hidden.position) if c.effect in among]
    without = fit(problem, (), {})
    state = SearchState(problem, pool, without, SILENT, [Hypothesis((), without)])
    search_growing_parts(state)
    assert state.best.effects == ("payload_mass", "tube_viscous")
    for key, value in true.items():
        assert state.best.fit.point[key] == pytest.approx(value, rel=0.05)
    found = list(state.found)
    search_growing_parts(state)  # a second time brings nothing
    assert state.found == found


def test_what_tolerances_explain_is_not_searched(recording, robot, known):
    nuisances = [known["registration_translation", "ty_m"]]
    problem = make_problem(robot, [recording], nuisances, np.ones(6, bool))
    none = fit(problem, (), {})
    assert none is not None
    state = SearchState(problem, [], none, SILENT, [Hypothesis((), none)])
    search_growing_parts(state)
    assert [e.effects for e in state.found] == [()]
