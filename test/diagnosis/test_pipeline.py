"""The stages of a diagnosis in their order, and how it ends."""

import pytest

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
