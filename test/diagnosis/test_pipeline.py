"""The stages of a diagnosis in their order, and how it ends."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ctr_dynamics.diagnosis import pipeline
from ctr_dynamics.diagnosis.configuration_mistakes import FoundMistake
from ctr_dynamics.diagnosis.output.findings import findings
from ctr_dynamics.diagnosis.pipeline import diagnose_recordings
from ctr_dynamics.diagnosis.run_context import RunContext


def test_a_used_up_time_budget_ends_the_search_and_is_said(recording, robot):
    stages = []
    found = diagnose_recordings(
        robot, [recording], context=RunContext(stages.append, workers=1, time_budget_s=0.0)
    )
    assert "the time budget of 0 s is used up: the search was not completed" in found.notes
    assert stages[:3] == ["nominal model", "re-calibration inside tolerance", "discretisation error"]
    assert not [stage for stage in stages if "alternatives" in stage or "leaves" in stage]
    assert found.search is not None
    assert found.search.probabilities.sum() == pytest.approx(1.0)


def test_what_no_cause_explains_competes_by_its_evidence(recording, robot):
    """A wandering error of 5 mm: the probabilities of all explanations sum to one, and findings state what remains."""
    rng = np.random.default_rng(3)
    error = np.cumsum(rng.normal(size=recording.position.shape), axis=0)
    error *= 5e-3 / np.sqrt(np.mean(np.sum(error**2, axis=1)))
    wandering = replace(recording, position=recording.position + error)
    found = diagnose_recordings(
        robot, [wandering], context=RunContext(lambda stage: None, workers=1, time_budget_s=0.0)
    )
    assert found.verdict == "unknown"
    assert found.search is not None
    assert found.search.best.members  # the likeliest hypothesis has a cause, which is not named
    assert found.extended.causes == ()
    assert found.discrepancy is not None
    told = findings(found, "", None)
    assert 1e-3 < told["discrepancy"]["rms_m"] < 2e-2
    assert 0.9 < told["causes"][0]["probability"] <= 1.0
    assert sum(e["probability"] for e in told["probabilities"]) <= 1.0 + 1e-9


def test_an_error_in_time_that_cannot_be_measured_forbids_clean(recording, robot, monkeypatch):
    real = pipeline.recalibrate

    def unmeasured(problem, context):
        fit, numerics = real(problem, context)
        return fit, {**numerics, "time_error_m": math.nan}

    monkeypatch.setattr(pipeline, "recalibrate", unmeasured)
    found = diagnose_recordings(
        robot, [recording], context=RunContext(lambda stage: None, workers=1, time_budget_s=0.0)
    )
    assert found.verdict not in ("clean", "named", "named_with_remainder")
    told = findings(found, "", None)
    assert told["numerics"]["time_error_m"] is None
    assert told["numerics"]["within_noise"] is None
    if found.verdict == "unknown":
        assert told["causes"][0]["probability"] is None


@pytest.mark.parametrize(("undone_m", "word"), [(0.02, "config_mistake"), (0.1, None)])
def test_a_mistake_that_the_tolerances_explain_better_is_none(recording, robot, monkeypatch, undone_m, word):
    """The recalibrated model leaves about 57 mm of a recording that is moved by that much."""
    moved = replace(recording, position=recording.position + np.array([0.0, 0.0, 0.057]))
    monkeypatch.setattr(
        pipeline, "find_mistake", lambda *_: FoundMistake("gravity_along_plus_y", 0.2, undone_m)
    )
    found = diagnose_recordings(robot, [moved], context=RunContext(workers=1, time_budget_s=0.0))
    assert (found.causes[0].effect if found.mistake else None) == word
    assert found.problem is None or word is None
