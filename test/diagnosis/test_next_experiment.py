"""What a proposed experiment is worth: the same separation as that of the bags at hand, with rows that it adds."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctr_dynamics.diagnosis import next_experiment
from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.inference.candidates import Candidate, candidates
from ctr_dynamics.diagnosis.inference.separation import separation, separation_in
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.simulation.scenario import load_scenario

TISSUE = load_robot("till2020_tissue")
ROWS = 60


@pytest.fixture
def case(monkeypatch):
    """A payload and a stiffness inside its tolerance, fitted to random columns; density is the rival. ``added`` are the rows of the experiment."""
    rng = np.random.default_rng(1)
    pool = candidates(effect_quantities(TISSUE), np.zeros((1, 3)))
    own, rival = (next(c for c in pool if c.effect == name) for name in ("payload_mass", "density"))
    stiffness = next(q for q in effect_quantities(TISSUE) if q.effect == "youngs_modulus" and q.tolerance > 0)
    active = (*own.quantities, stiffness)
    fit = SimpleNamespace(
        active=active, causes=own.quantities, values=np.array([2.0 * own.quantities[0].scale, 1.0]), tolerance_factor=1.0,
        columns=3e3 * rng.normal(size=(ROWS, 2)), point={},
    )  # fmt: skip
    sensitivities = SimpleNamespace(by_candidate={rival: 30.0 * rng.normal(size=(ROWS, 1))})
    problem = SimpleNamespace(
        robot=TISSUE, options=DiagnosisOptions(), numerics=rng.normal(size=(ROWS, 1)), whiteners=[SimpleNamespace(mask=None)],
        forward_models=[SimpleNamespace(options=None)],
    )  # fmt: skip
    against = sensitivities.by_candidate[rival] * rival.quantities[0].scale
    made = SimpleNamespace(added=np.zeros((ROWS, 3)), fit=fit, problem=problem, own=own, against=against)
    scales = np.array([*(q.scale for q in active), 1.0])
    model = SimpleNamespace(
        jacobian=lambda point, of: (SimpleNamespace(failure=""), made.added * scales)  # by scales
    )
    monkeypatch.setattr(next_experiment, "ForwardModel", lambda *given: model)
    monkeypatch.setattr(next_experiment, "with_chosen_steps", lambda model, *given: model)
    monkeypatch.setattr(next_experiment, "Whitener", lambda *given: lambda rows: rows)
    made.before = separation(problem, fit, (own,), rival, sensitivities)
    made.contrast = next_experiment.Contrast(problem, fit, sensitivities, own, [rival])
    made.after = lambda: made.contrast.smallest(made.contrast.told(load_scenario("turns")))
    return made


def test_nothing_told_is_the_separation_of_the_bags_at_hand(case):
    assert case.before > 1.0
    assert case.contrast.smallest(case.contrast.nothing) == pytest.approx(case.before, rel=1e-9)


def test_an_experiment_that_shows_nothing_changes_nothing(case):
    assert case.after() == pytest.approx(case.before, rel=1e-9)


def test_more_data_never_tell_less(case):
    """However much of the cause its own tolerance would explain."""
    rng = np.random.default_rng(2)
    for size in (0.1, 1.0, 10.0):
        case.added = size * rng.normal(size=(ROWS, 3))
        assert case.after() > case.before


def test_what_is_told_is_that_of_more_rows(case):
    """Products of columns add up to what the separation with all rows is."""
    rng = np.random.default_rng(3)
    case.added = 3.0 * rng.normal(size=(ROWS, 3))
    fit, problem, own = case.fit, case.problem, case.own
    columns = np.vstack([fit.columns, case.added[:, :2]])
    against = np.vstack([case.against, case.added[:, 2:]])
    numerics = np.vstack([problem.numerics, np.zeros((ROWS, 1))])
    whole = separation_in(fit, columns, (own,), against, numerics)
    assert case.after() == pytest.approx(whole, rel=1e-9)


def test_a_rival_that_has_a_tolerance_may_leave_it_as_any_other(case):
    """Its column is among those of the fit, with the tolerance for its prior; as a cause it is as wide as causes are."""
    fit, problem, own = case.fit, case.problem, case.own
    stiffness = fit.active[1]
    rival = Candidate("youngs_modulus", (stiffness,))
    sensitivities = SimpleNamespace(by_candidate={rival: fit.columns[:, 1:]})
    # what a stiffness that is off by many tolerances does as well
    fit.columns[:, 0] += 30.0 * stiffness.tolerance / fit.values[0] * fit.columns[:, 1]
    contrast = next_experiment.Contrast(problem, fit, sensitivities, own, [rival])
    before = separation(problem, fit, (own,), rival, sensitivities)
    assert stiffness.scale > stiffness.tolerance > 0.0
    assert before < 0.9 * separation(problem, fit, (own,))
    assert contrast.smallest(contrast.nothing) == pytest.approx(before, rel=1e-9)
