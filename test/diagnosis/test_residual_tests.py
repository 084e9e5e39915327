"""Residual tests: noise that a fit has followed is noise."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.inference.gaussian_posterior import posterior
from ctr_dynamics.diagnosis.inference.map_fit import Fit
from ctr_dynamics.diagnosis.inference.residual_tests import whiteness

POSES, AXES, FREE = 300, 6, 24


def a_fit(rng, columns):
    """The fit of parameters of unit prior deviation to unit noise and to what parameters from that prior do."""
    data = rng.normal(size=POSES * AXES) + columns @ rng.normal(size=FREE)
    nothing = np.zeros((len(data), 0))
    values, covariance, _ = posterior(data, columns, np.zeros(FREE), np.ones(FREE), nothing)
    left = data - columns @ values
    return Fit((), (None,) * FREE, values, covariance, float(left @ left), 0.0, left, left, columns, 0.0, 1.0)


@pytest.mark.parametrize("seen", [0, FREE])
def test_noise_is_called_suspicious_as_often_as_it_should(seen):
    """Whether the data show many of the parameters or none, as where their tolerances are tight."""
    rng = np.random.default_rng(4)
    whitener = SimpleNamespace(used=np.ones(POSES, bool), mask=np.ones(AXES, bool))
    problem = SimpleNamespace(whiteners=[whitener], options=DiagnosisOptions())
    t = np.arange(POSES) / POSES
    columns = np.stack(
        [
            (1e-6 if i >= seen else 0.5)
            * np.cos(0.3 * i + np.pi * i * np.tile(t, AXES))
            * rng.normal(size=AXES).repeat(POSES)
            for i in range(FREE)
        ],
        axis=1,
    )
    found = [whiteness(problem, a_fit(rng, columns)) for _ in range(600)]
    assert a_fit(rng, columns).effective_parameters == pytest.approx(seen, abs=0.3 * FREE)
    for name in ("p_power", "p_correlation"):
        often = np.mean([getattr(w, name) < 0.1 for w in found])
        assert often == pytest.approx(0.1, abs=0.05), name
