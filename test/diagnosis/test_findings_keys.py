"""Every key of findings.json is in the table of docs/findings.md, and every key of the table in findings.json."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_result import Diagnosis
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.inference.tolerance_evidence import ToleranceEvidence, WiderTolerance
from ctr_dynamics.diagnosis.output.findings import findings
from ctr_dynamics.diagnosis.output.findings_keys import KEYS, undocumented
from ctr_dynamics.diagnosis.verdict.separability import Cause
from ctr_dynamics.diagnosis.verdict.validation import Validation

EXPERIMENT = {
    "description": "", "scenario_file": "a.yaml", "separation_before": 1.0, "separation_after": 2.0
}  # fmt: skip


@pytest.fixture
def diagnosis(robot, known):
    """One with everything that a diagnosis may have."""
    mass = known["payload_mass", "added_kg"]
    fit = SimpleNamespace(
        active=(mass,), values=np.array([2e-4]), sigma=np.array([1e-5]), point={mass.key: 2e-4}
    )
    validation = Validation(1e-3, 1e-4, 0.9, (0.8, 0.95), 5.0, 1.0, rms_nominal=2e-3)
    force = SimpleNamespace(fit=fit, terms=(mass,), validation=validation, held_out="other bags")
    step = SimpleNamespace(nodes=10, shortest_step=0.003, longest_step=0.024)
    found = Diagnosis(robot, [SimpleNamespace(sha256={"a.mcap": "0"})])
    found.verdict = "tolerances"
    found.causes = [Cause(Candidate("payload_mass", (mass,)), "payload_mass", 0.99, 9.0)]
    found.problem = SimpleNamespace(forward_models=[step])
    found.recalibrated = found.extended = fit
    found.residual_recalibrated = found.residual_extended = [np.full((3, 6), 2e-3)]
    found.discrepancy = SimpleNamespace(rms_m=1e-4, correlation_time_s=0.3)
    found.validation, found.learning = validation, SimpleNamespace(force=force)
    found.tolerances = ToleranceEvidence(2.0, (WiderTolerance(mass, 1e-5, 3e-5, 1.5),))
    return found


def present(content, path):
    """Whether the first entries of all lists on the way have the ``path``."""
    at = content
    for part in path.split("."):
        name = part.removesuffix("[]")
        if name == "*":
            name = next(iter(at))
        if name not in at:
            return False
        at = at[name][0] if part.endswith("[]") else at[name]
    return True


def test_the_table_has_every_key_and_no_other(diagnosis):
    content = findings(diagnosis, "ctr-dynamics diagnose", EXPERIMENT)
    assert undocumented(content) == set()
    assert [key.path for key in KEYS if not present(content, key.path)] == []
    assert len({key.path for key in KEYS}) == len(KEYS)


def test_a_new_key_is_found(diagnosis):
    content = findings(diagnosis, "ctr-dynamics diagnose", EXPERIMENT)
    content["causes"][0]["parameters"]["added_kg"]["ci50"] = [0.0, 1.0]
    content["numerics"]["nodes"] = 10
    assert undocumented(content) == {"causes[].parameters.*.ci50", "numerics.nodes"}
