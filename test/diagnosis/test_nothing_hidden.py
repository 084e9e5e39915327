"""Bags without a cause of the catalogue, by a simulator of its own. The large study is studies/diagnosis_study.py; these seeds are others."""

import pytest
from hidden_cases import check_files, diagnosed

# name: stratum, seed, what is hidden (None leaves the choice to the seed), s of the bags
CASES = {
    "clean": ("none", 91001, None, 8.0),
    "outside": ("outside", 91007, ("pulse",), 8.0),
    "at_rest": ("not_excited", 91008, None, 8.0),
}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """Findings and answers of all cases, one after another: other tests use the other core."""
    return {name: diagnosed(tmp_path_factory.mktemp(name), *given) for name, given in CASES.items()}


def test_a_clean_bag_is_clean(outcomes):
    findings, _, _ = outcomes["clean"]
    assert findings["verdict"] == "clean"
    assert findings["causes"] == []
    assert findings["cause_set95"] == [[]]
    assert findings["probabilities"][0]["effects"] == []


def test_what_is_outside_the_catalogue_is_unknown(outcomes):
    findings, _, _ = outcomes["outside"]
    assert findings["verdict"] == "unknown"
    assert findings["causes"][0]["effect"] == "unknown"
    assert findings["causes"][0]["separation"] is None
    assert any("like a force at the tip" in note for note in findings["notes"])
    # it comes once, at a time of its own: nothing that predicts
    assert findings["learned"] is None
    assert any("nothing was learned" in note for note in findings["notes"])


def test_a_robot_at_rest_cannot_be_diagnosed(outcomes):
    findings, _, folder = outcomes["at_rest"]
    assert findings["verdict"] == "not_excited"
    assert findings["causes"] == []
    assert (folder / findings["next_experiment"]["scenario_file"]).is_file()


@pytest.mark.parametrize("name", CASES)
def test_files_of_the_findings_are_there(outcomes, name):
    findings, _, folder = outcomes[name]
    check_files(findings, folder)
