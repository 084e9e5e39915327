"""What a validation confirms, and the interval of the gain."""

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.verdict.validation import Validation, block_bootstrap

OPTIONS = DiagnosisOptions()


def test_bootstrap_interval_holds_the_gain():
    rng = np.random.default_rng(3)
    t = np.arange(400) / 40.0
    before, after = rng.chisquare(3, 400), 0.25 * rng.chisquare(3, 400)
    low, high = block_bootstrap(before, after, t, OPTIONS.validation)
    assert low < 1 - after.sum() / before.sum() < high
    assert 0.6 < low < high < 0.85


@pytest.mark.parametrize(
    ("before", "after", "confirmed"),
    [
        (30.0, 1.02, True),
        (30.0, 1.2, False),
        (1.26, 1.13, False),
        (1.26, 1.03, True),
        (1.0, 0.99, True),
        (0.99, 1.05, False),
    ],
)
def test_a_validation_confirms_what_removes_most_of_a_visible_misfit(before, after, confirmed):
    assert Validation(1e-3, 1e-3, 0.0, (0.0, 0.0), before, after).confirms(OPTIONS.validation) is confirmed
