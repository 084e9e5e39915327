"""Rules of the verdict on hypotheses that are given."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.evidence import WeighedHypotheses
from ctr_dynamics.diagnosis.inference.hypotheses import Hypothesis
from ctr_dynamics.diagnosis.inference.residual_tests import Whiteness
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.verdict import decision
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.robot_files import load_robot

OPTIONS = DiagnosisOptions()
KNOWN = {q.key: q for q in effect_quantities(load_robot("till2020_tissue"))}
GAIN, OTHER_GAIN = (Candidate("encoder_gain", (KNOWN["encoder_gain", f"tube{i}.gain"],)) for i in (1, 2))
SCALE = Candidate("tracker_scale", (KNOWN["tracker_scale", "scale"],))
MASS = Candidate("payload_mass", (KNOWN["payload_mass", "added_kg"],))


def test_sets_that_are_not_listed_count_for_the_causes_that_they_hold(monkeypatch):
    """The likeliest sets hold enough for the list before one that names the cause beside another."""
    named, enough = OPTIONS.verdict.named, OPTIONS.evidence.set_probability
    rest = 1.0 - enough
    of_cause, of_rival, of_both = named - 0.5 * rest, enough + 0.2 * rest - (named - 0.5 * rest), 0.8 * rest
    members = [(GAIN,), (SCALE,), (OTHER_GAIN, MASS), ()]
    found = [
        Hypothesis(m, SimpleNamespace(chi2=100.0), score=s, fitted_score=s)
        for m, s in zip(members, (30.0, 28.0, 29.0, 0.0), strict=True)
    ]
    weighed = WeighedHypotheses(
        found, np.array([of_cause, of_rival, of_both, 0.0]), found[-1], None, [], [], None
    )
    problem = SimpleNamespace(size=100, options=OPTIONS, robot=None)
    monkeypatch.setattr(
        decision,
        "_separate",
        lambda result, *_: result.causes.append(decision.Cause(GAIN, "encoder_gain", 1.0)),
    )
    evidence = decision.Evidence(Whiteness(1.0, 1.0, 1.0, 1.0), None, True)
    assert of_cause < named < of_cause + of_both
    verdict = decision.decide(problem, weighed, found[0], evidence, RunContext(workers=1))
    assert verdict.word == "named"
    assert [effects for effects, _ in verdict.cause_sets] == [("encoder_gain",), ("tracker_scale",)]
    assert sum(p for _, p in verdict.cause_sets) == pytest.approx(enough + 0.2 * rest)
