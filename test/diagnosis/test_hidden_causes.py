"""Effects hidden by a simulator of its own are named with their size. The large study is studies/diagnosis_study.py; these seeds are others."""

import math

import numpy as np
import pytest
from hidden_cases import check_files, diagnosed

# name: stratum, seed, what is hidden, s of the bags
CASES = {
    "payload": ("single", 91003, ("payload_mass",), 9.0),
    "latency": ("single", 91004, ("tracker_latency",), 8.0),
    "pair": ("pair", 91006, ("payload_mass", "encoder_offset"), 9.0),
}


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """Findings and answers of all cases, one after another: other tests use the other core."""
    return {name: diagnosed(tmp_path_factory.mktemp(name), *given) for name, given in CASES.items()}


@pytest.mark.parametrize("name", CASES)
def test_hidden_causes_are_named_with_their_size(outcomes, name):
    findings, answer, folder = outcomes[name]
    check_files(findings, folder)
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
