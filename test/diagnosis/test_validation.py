"""What a validation confirms, and the interval of the gain."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.verdict.validation import Validation, block_bootstrap, validate

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


def errors_of(sizes):
    """A model whose tip errs by ``sizes[point]`` m along x at every pose; None where it cannot be simulated with finer steps, NaN at all.

    The tracker has measured no pose at one stamp.
    """

    def at(point):
        size = sizes[point["which"] if point else "nominal"]
        if size is None:
            return None
        rows = np.tile([size, 0.0, 0.0, 0.0, 0.0, 0.0], (80, 1))
        rows[7] = np.nan
        return rows

    return at


@pytest.mark.parametrize(
    ("coarse", "finer", "expected"),
    [
        ({}, {"nominal": 4e-3, "recalibrated": 2e-3, "extended": 1e-3}, (4e-3, 2e-3, 1e-3)),
        # only the robot file as it is needs the coarser steps, or cannot be simulated at all
        ({"nominal": 5e-3}, {"nominal": None, "recalibrated": 2e-3, "extended": 1e-3}, (5e-3, 2e-3, 1e-3)),
        (
            {"nominal": np.nan},
            {"nominal": None, "recalibrated": 2e-3, "extended": 1e-3},
            (np.nan, 2e-3, 1e-3),
        ),
        (
            {"recalibrated": 3e-3, "extended": 2e-3},
            {"nominal": 4e-3, "recalibrated": None, "extended": 1e-3},
            (4e-3, 3e-3, 2e-3),
        ),
    ],
)
def test_errors_of_nominal_recalibrated_and_extended_model(coarse, finer, expected):
    recording = SimpleNamespace(name="held", stamps=np.arange(80) / 40.0, duration=2.0)
    model = SimpleNamespace(recording=recording, predict=lambda point: point, residual=errors_of(coarse))
    used = np.arange(80) != 7
    whiten = type(
        "Whiten", (), {"size": 237, "used": used, "__call__": lambda self, r: r[used, :3].ravel() / 1e-3}
    )()
    held_out = SimpleNamespace(
        forward_models=[model],
        finer=SimpleNamespace(forward_models=[SimpleNamespace(residual_at=errors_of(finer))]),
        whiteners=[whiten],
        options=OPTIONS,
    )
    found = validate(held_out, *(SimpleNamespace(point={"which": w}) for w in ("recalibrated", "extended")))
    nominal, recalibrated, extended = expected
    assert (found.rms_nominal, found.rms_recalibrated, found.rms_extended) == pytest.approx(
        expected, nan_ok=True
    )
    assert found.gain == pytest.approx(1.0 - (extended / recalibrated) ** 2)
    assert found.gain_over_nominal == pytest.approx(1.0 - (extended / nominal) ** 2, nan_ok=True)
    assert found.bags[0] == pytest.approx(("held", recalibrated, extended, nominal), nan_ok=True)
    assert found.nis_before == pytest.approx((recalibrated / 1e-3) ** 2 / 3)
    assert found.nis_after == pytest.approx((extended / 1e-3) ** 2 / 3)
