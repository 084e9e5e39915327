"""A contact plane that the tip runs into, hidden by the truth's own simulator, and found from the moment of the first impact."""

import json
from dataclasses import replace

import numpy as np
import pytest
from truth.cases import make_case

from ctr_dynamics.diagnosis.inference.candidates import Candidate, causes_of
from ctr_dynamics.diagnosis.inference.contact_plane import find_contact_plane
from ctr_dynamics.diagnosis.inference.fit_problem import choose_steps, make_problem
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis, check_time_error
from ctr_dynamics.diagnosis.inference.map_fit import fit
from ctr_dynamics.diagnosis.recording import read_recording
from ctr_dynamics.diagnosis.run_context import RunContext

STIFFNESS = ("contact", "stiffness_N_per_m")
NORMAL = [("contact", "n" + axis) for axis in "xyz"]


def _problem(folder, robot, known, effect, seed):
    case = make_case(seed, "single", folder, effects=(effect,), duration_s=2.2)
    recording = read_recording(case.protocol, robot)
    nuisances = [q for q in known.values() if q.effect == "registration_translation"]
    answer = json.loads((folder / "answer.json").read_text())["hidden"][0]["parameters"]
    truth = {name: item["total"] for name, item in answer.items()}
    return make_problem(robot, [recording], nuisances, np.ones(6, bool)), truth


@pytest.fixture(scope="module")
def hit(tmp_path_factory, robot, known):
    """The problem of a recording with impacts, and the true plane."""
    return _problem(tmp_path_factory.mktemp("hit"), robot, known, "contact", 91020)


def _angle(a, b) -> float:
    return float(np.degrees(np.arccos(np.clip(np.dot(a, b) / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))))


def test_the_first_impacts_tell_plane_and_stiffness(hit, known):
    problem, truth = hit
    found = find_contact_plane(problem, list(known.values()), RunContext())
    assert isinstance(found, Candidate)
    start = dict(found.start)
    assert _angle([start[key] for key in NORMAL], [truth[name] for _, name in NORMAL]) < 15.0
    assert 0.4 < found.sizes[0] / truth["stiffness_N_per_m"] < 2.5
    assert found.keys == {q.key for q in known.values() if q.effect == "contact"}
    before = problem.residual({})
    result = fit(problem, causes_of([found]), {**start, STIFFNESS: found.sizes[0]})
    assert result is not None
    assert result.chi2 < 0.05 * float(before @ before)
    assert 0.5 < result.point[STIFFNESS] / truth["stiffness_N_per_m"] < 2.0


def test_a_delay_is_no_contact_plane(tmp_path, robot, known):
    """A late tracker and the model diverge as suddenly, when the weight is cut."""
    problem, _ = _problem(tmp_path, robot, known, "tracker_latency", 91021)
    assert find_contact_plane(problem, list(known.values()), RunContext()) is None


def test_what_impacts_leave_is_measured_against_the_error_in_time(hit, known):
    """That of the short steps of the fit, where the model without impacts needs few."""
    problem, truth = replace(hit[0]), hit[1]
    choose_steps(problem, {}, RunContext(workers=1))
    assert problem.forward_models[0].longest_step > problem.forward_models[0].scheme.dt
    point = {("contact", name): value for name, value in truth.items()}
    contact = tuple(q for q in known.values() if q.effect == "contact")
    candidate = Candidate("contact", contact)
    residual = problem.even.residual(point)
    finer = problem.even.finer.residual(point)
    error = float((finer - residual) @ (finer - residual))
    some = fit(problem, (), {}, iterations=1)
    assert some is not None
    for left, resolved in ((20.0 * error, True), (0.5 * error, False)):
        at_truth = replace(
            some,
            active=contact,
            values=np.array([point[q.key] for q in contact]),
            residual=residual,
            chi2=problem.size + left,
        )
        hypothesis = Hypothesis((candidate,), at_truth)
        check_time_error(problem, hypothesis)
        assert hypothesis.resolved == resolved
        elsewhere = Hypothesis((), at_truth)
        check_time_error(problem, elsewhere)
        assert elsewhere.resolved
