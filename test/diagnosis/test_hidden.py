"""Effects hidden by a simulator of its own, sealed until the verdict is in. The large study is studies/diagnosis_study.py; these seeds are others."""

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from truth.cases import make_case

# (name, stratum, seed, what is hidden, s of the bags): one of each kind; None leaves the choice to the seed
CASES = (
    ("clean", "none", 91001, None, 8.0),
    ("payload", "single", 91003, ("payload_mass",), 9.0),
    ("latency", "single", 91004, ("tracker_latency",), 8.0),
    ("pair", "pair", 91006, ("payload_mass", "encoder_offset"), 9.0),
    ("outside", "outside", 91007, ("pulse",), 8.0),
    ("at_rest", "not_excited", 91008, None, 8.0),
)


def _run(folder: Path, stratum: str, seed: int, effects, duration: float):
    """Make a case, run the command on it in a process of its own, then open the answer."""
    case = make_case(seed, stratum, folder, effects=effects, duration_s=duration)
    arguments = [
        str(case.protocol),
        "--validate",
        str(case.sweep),
        "--robot",
        case.robot,
        "--output",
        str(folder / "out"),
        "--workers",
        "1",
    ]
    done = subprocess.run(
        [sys.executable, "-m", "ctr_dynamics.cli.main", "diagnose", *arguments, "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), case.unseal(), folder / "out"


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """Findings and answers of all cases, one after another: other tests use the other core."""
    return {name: _run(tmp_path_factory.mktemp(name), *given) for name, *given in CASES}


@pytest.mark.parametrize("name", ["payload", "latency", "pair"])
def test_hidden_causes_are_named_with_their_size(outcomes, name):
    findings, answer, _ = outcomes[name]
    truth = {h["effect"]: h["parameters"] for h in answer["hidden"]}
    assert {c["effect"] for c in findings["causes"]} == set(truth)
    assert findings["verdict"] in (("named", "ambiguous") if len(truth) > 1 else ("named",))
    assert sorted(truth) in [sorted(s) for s in findings["cause_set95"]]
    for cause in findings["causes"]:
        for parameter, value in truth[cause["effect"]].items():
            low, high = cause["parameters"][parameter]["ci99"]
            width = high - low
            assert low - 0.2 * width <= value["total"] <= high + 0.2 * width
    # the re-calibrated model, whose tolerances are priors and no bounds, follows a strong cause part of the way
    assert findings["validation"]["gain"] > -0.02
    assert findings["validation"]["rms_extended_m"] < 1.2 * findings["residual"]["noise_floor_m"]


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


def test_findings_are_plain_json_without_nan_and_files_are_there(outcomes):
    for findings, _, folder in outcomes.values():
        stored = json.loads(
            (folder / "findings.json").read_text(), parse_constant=lambda text: pytest.fail(text)
        )
        assert stored["schema"] == "ctr_dynamics/findings/1"
        assert stored["verdict"] == findings["verdict"]
        for key in ("extended_robot", "recalibrated_robot"):
            assert (folder / stored[key]).is_file()
        report = (folder / "report.html").read_text()
        assert "<script src" not in report
        assert "mathdefault" not in report  # ticks of an axis as TeX that nobody typesets
        assert ">nominal<" in report


def test_extended_robot_predicts_better_through_the_same_door(outcomes):
    """The robot file that diagnosis writes, used by replay without fusion."""
    from ctr_dynamics.parameters import Settings
    from ctr_dynamics.runtime.replay import replay

    findings, _, folder = outcomes["payload"]
    bag = folder.parent / "sweep.mcap"
    residual = []
    for robot in ("till2020_tissue", folder / findings["extended_robot"]):
        settings = Settings({"output.policy": "wait", "filter.enabled": False})
        residual.append(replay(bag, robot, settings).summary["residual_rms_m"]["predicted"])
    assert np.isfinite(residual).all()
    assert residual[1] < 0.8 * residual[0]
    assert math.isclose(residual[1], findings["validation"]["rms_extended_m"], rel_tol=0.15)
