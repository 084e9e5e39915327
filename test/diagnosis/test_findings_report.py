"""What the report draws is what the verdict says."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions, VerdictOptions
from ctr_dynamics.diagnosis.inference.candidates import Candidate
from ctr_dynamics.diagnosis.output.findings_report import _rivals, noise_band, separations
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.reporting.page import Page
from ctr_dynamics.robot_files import load_robot

KNOWN = {q.key: q for q in effect_quantities(load_robot("till2020_tissue"))}
MASS, SCALE, SKEW = (
    Candidate(key[0], (KNOWN[key],))
    for key in (("payload_mass", "added_kg"), ("tracker_scale", "scale"), ("clock_skew", "rate"))
)


@pytest.fixture
def diagnosis():
    """The verdict names a payload, the likeliest hypothesis of the search another cause."""
    rng = np.random.default_rng(1)
    (mass,) = MASS.quantities
    fit = SimpleNamespace(
        active=(mass,), causes=(mass,), values=np.array([2.0 * mass.scale]), tolerance_factor=1.0,
        columns=rng.normal(size=(40, 1)) / mass.scale,
    )  # fmt: skip
    sensitivities = {c: rng.normal(size=(40, 1)) for c in (MASS, SCALE, SKEW)}
    return SimpleNamespace(
        causes=[SimpleNamespace(candidate=MASS), SimpleNamespace(candidate=None)],
        extended=fit,
        problem=SimpleNamespace(numerics=np.zeros((40, 0))),
        sensitivities=SimpleNamespace(by_candidate=sensitivities),
        search=SimpleNamespace(hypotheses=[SimpleNamespace(members=(SKEW,), fit=None)]),
        options=DiagnosisOptions(verdict=VerdictOptions(separation=10.0)),
    )


def test_separations_are_those_of_the_causes_of_the_verdict(diagnosis):
    members, names, table = separations(diagnosis)
    assert members == [MASS]
    assert names == ["clock_skew", "payload_mass", "tracker_scale"]
    assert np.isnan(table[0, 1])
    assert (table[0, [0, 2]] > 1.0).all()


def test_the_limit_that_is_told_is_that_of_the_options(diagnosis):
    page = Page("report")
    _rivals(page, diagnosis)
    assert "below 10 (1.0 on this scale)" in page.text()


def test_a_verdict_without_causes_draws_none(diagnosis):
    diagnosis.causes = []
    assert separations(diagnosis)[0] == []


@pytest.mark.parametrize("lengths", [[400] * 3, [400] * 12, [400, 100, 100]])
def test_the_band_holds_the_mean_autocorrelation_of_noise(lengths):
    rng = np.random.default_rng(2)
    found = []
    for _ in range(300):
        sequences = [rng.normal(size=n) for n in lengths]
        found.append(np.mean([float(x[1:] @ x[:-1]) / float(x @ x) for x in sequences]))
    assert noise_band(sequences) == pytest.approx(2.0 * math.sqrt(np.mean(np.square(found))), rel=0.15)
