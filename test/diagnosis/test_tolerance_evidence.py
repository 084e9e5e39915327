"""Evidence for wider tolerances, on linear models whose values are drawn from a known scatter."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_cases import quantity
from scipy.stats import multivariate_normal

from ctr_dynamics.diagnosis.diagnosis_options import ToleranceOptions
from ctr_dynamics.diagnosis.inference.gaussian_posterior import posterior_of_information
from ctr_dynamics.diagnosis.inference.tolerance_evidence import tolerance_evidence
from ctr_dynamics.diagnosis.output.summary_text import summary

SIZE, COUNT, TOLERANCE, NONE = 300, 12, 0.02, np.zeros((300, 0))


def fitted(rng, factor, *, at=None, numerics=NONE):
    """A fit of 12 values that scatter ``factor`` times their tolerances, at their true values or at ``at``."""
    columns = rng.normal(size=(SIZE, COUNT)) * 10.0
    values = TOLERANCE * factor * rng.normal(size=COUNT)
    data = columns @ values + rng.normal(size=SIZE) + numerics @ rng.normal(size=numerics.shape[1])
    here = values if at is None else at
    residual = data - columns @ here
    active = [quantity(f"p{i}", tolerance=TOLERANCE, off=1.0) for i in range(COUNT)]
    return SimpleNamespace(
        active=active, values=here + 1.0, columns=columns, residual=residual, whitened=residual,
        chi2=float(SIZE), inflation=1.0,
    )  # fmt: skip


def test_evidence_is_the_marginal_likelihood_of_the_linear_model():
    rng = np.random.default_rng(1)
    J, y, deviation = rng.normal(size=(8, 3)), rng.normal(size=8), np.array([0.5, 1.0, 2.0])
    _, _, ours = posterior_of_information(J.T @ J, J.T @ y, deviation)
    with_prior = multivariate_normal(np.zeros(8), np.eye(8) + (J * deviation**2) @ J.T).logpdf(y)
    assert ours == pytest.approx(with_prior - multivariate_normal(np.zeros(8), np.eye(8)).logpdf(y))


def test_a_right_robot_file_is_seldom_contradicted():
    rng = np.random.default_rng(2)
    found = [tolerance_evidence(fitted(rng, 1.0), NONE, ToleranceOptions()).evidence for _ in range(300)]
    # about 1 %; 10 of 300 have a chance below 0.001 at that rate
    assert sum(e > ToleranceOptions().substantial for e in found) < 10


def test_values_that_scatter_three_tolerances_are_found():
    rng = np.random.default_rng(3)
    found = [tolerance_evidence(fitted(rng, 3.0), NONE, ToleranceOptions()) for _ in range(50)]
    assert np.mean([e.evidence > 4.0 for e in found]) > 0.9
    assert all(w.suggested > w.stated and w.evidence > 0.0 for e in found for w in e.wider)


def test_one_departure_names_its_own_tolerance_first():
    fit = fitted(np.random.default_rng(4), np.eye(COUNT)[5] * 20.0)
    wider = tolerance_evidence(fit, NONE, ToleranceOptions()).wider
    assert wider[0].quantity.name == "p5"
    assert 2.0 < wider[0].suggested / TOLERANCE <= ToleranceOptions().widest


def test_the_point_of_the_fit_does_not_matter():
    first = tolerance_evidence(fitted(np.random.default_rng(5), 3.0), NONE, ToleranceOptions())
    moved = fitted(np.random.default_rng(5), 3.0, at=np.linspace(-0.1, 0.1, COUNT))
    assert tolerance_evidence(moved, NONE, ToleranceOptions()).evidence == pytest.approx(first.evidence)


def test_what_the_discretisation_error_explains_is_no_scatter():
    rng = np.random.default_rng(6)
    fit = fitted(rng, 0.0)
    numerics = fit.columns[:, :1]
    fit.residual = fit.residual + numerics[:, 0] * 1.0
    without = tolerance_evidence(fit, NONE, ToleranceOptions())
    beside = tolerance_evidence(fit, numerics, ToleranceOptions())
    assert without.evidence > 4.0
    assert beside.evidence < 0.0


def test_without_tolerances_there_is_nothing_to_say():
    fit = fitted(np.random.default_rng(7), 1.0)
    fit.active = [quantity(f"p{i}", off=1.0) for i in range(COUNT)]
    found = tolerance_evidence(fit, NONE, ToleranceOptions())
    assert found.evidence == -math.inf
    assert found.wider == ()


def test_summary_says_which_tolerance_and_by_how_much():
    residual = {"recalibrated_rms_m": None}
    entry = {
        "parameter": "tracker_lever_arm.y_m",
        "unit": "m",
        "stated": 3e-4,
        "suggested": 9e-4,
        "evidence": 3.0,
    }
    content = {
        "verdict": "tolerances", "causes": [], "residual": residual, "validation": None,
        "next_experiment": None, "tolerances": [entry], "discrepancy": None, "learned": None,
    }  # fmt: skip
    lines = summary(content)
    assert lines[0].startswith("verdict: tolerances.")
    assert lines[1] == "Tolerance of tracker_lever_arm.y_m: 0.9 mm instead of 0.3 mm."
