"""Fits on problems with known answers: the posterior, steps inside bounds, how far nuisances go."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_cases import LongVibration, Vibration, quantity

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.inference import recalibration
from ctr_dynamics.diagnosis.inference.fit_problem import make_problem
from ctr_dynamics.diagnosis.inference.gaussian_posterior import posterior
from ctr_dynamics.diagnosis.inference.growing_fit import fit_growing
from ctr_dynamics.diagnosis.inference.map_fit import GaussNewton, fit
from ctr_dynamics.diagnosis.inference.recalibration import _from_growing_parts
from ctr_dynamics.diagnosis.run_context import RunContext

OPTIONS = DiagnosisOptions()
PAYLOAD = ("payload_mass", "added_kg")


def test_posterior_is_bayes_rule():
    """Against the dense formulas of a linear Gaussian model."""
    rng = np.random.default_rng(1)
    J, N = rng.normal(size=(40, 3)), rng.normal(size=(40, 2))
    variance = np.array([0.5, 2.0, 0.01])
    departure = np.array([0.3, -0.2, 0.1])
    y = rng.normal(size=40)  # residual at the departure
    mean, covariance, evidence = posterior(y, J, departure, variance, N)
    data = y + J @ departure
    noise = np.eye(40) + N @ N.T
    precision = np.diag(1 / variance) + J.T @ np.linalg.solve(noise, J)
    np.testing.assert_allclose(covariance, np.linalg.inv(precision), rtol=1e-9)
    np.testing.assert_allclose(
        mean, np.linalg.solve(precision, J.T @ np.linalg.solve(noise, data)), rtol=1e-9
    )
    total = noise + J @ np.diag(variance) @ J.T
    expected = -0.5 * data @ np.linalg.solve(total, data) - 0.5 * np.linalg.slogdet(total)[1]
    assert evidence == pytest.approx(expected, rel=1e-9)


def test_steps_are_the_best_inside_the_bounds():
    rng = np.random.default_rng(3)
    names = ("a", "b", "c", "d")
    nuisances = tuple(quantity(n, tolerance=0.5) for n in names)
    cause = quantity("size", low=0.0, scale=2.0)
    descent = GaussNewton(Vibration({}, nuisances), (cause,), {})
    descent.columns, descent.residual = rng.normal(size=(500, 5)), 3.0 * rng.normal(size=500)
    descent.residual += descent.columns @ np.array([4.0, -3.0, 0.2, 0.1, -1.0])  # beyond the bounds of three
    descent.cost = descent.cost_at(descent.residual, descent.values)
    step = descent.step()
    assert np.all(step >= descent.low - descent.values)
    assert np.all(step <= descent.high - descent.values)
    assert sum(np.isclose(step, (1.0, -1.0, 9.0, 9.0, 0.0))) == 3
    best = descent.promise(step)
    for _ in range(200):
        other = np.clip(step + rng.normal(scale=0.1, size=5), descent.low, descent.high)
        assert descent.promise(other) <= best + 1e-9
    sizes = [np.linalg.norm(descent.step(damping)) for damping in (0.0, 1e3, 1e5)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 0.1 * sizes[0]
    assert descent.promise(descent.step(1e5)) > 0.0


def test_a_fit_finds_the_payload_and_one_without_a_chance_does_not_move(recording, robot, known):
    nuisances = [known[key] for key in known if key[0] in ("registration_translation", "encoder_offset")]
    problem = make_problem(robot, [recording], nuisances, np.ones(6, bool))
    found = fit(problem, [known[PAYLOAD]], {})
    assert found is not None
    sigma = found.sigma[[q.key for q in found.active].index(PAYLOAD)]
    assert abs(found.point[PAYLOAD] - 3e-4) < 0.3 * sigma
    assert found.chi2 < 1.0
    # without the payload no tolerance reaches that
    given_up = fit(problem, (), {}, limit=found.cost + 1.0)
    best = fit(problem, (), {})
    assert given_up is not None
    assert best is not None
    assert given_up.cost > best.cost > found.cost + 1.0
    assert np.all(given_up.values == [q.off for q in problem.nuisances])


def test_nuisances_stay_near_their_tolerances_unless_they_may_go_far(recording, robot, known):
    nuisance = known["registration_translation", "tx_m"]
    there = replace(recording, position=recording.position + [0.002, 0.0, 0.0])  # ten tolerances
    problem = make_problem(robot, [there], [nuisance], np.ones(6, bool))
    near, far = fit(problem, (), {}), fit(replace(problem, reach=np.inf), (), {})
    cause = fit(problem, [nuisance], {})
    assert near is not None
    assert far is not None
    assert cause is not None
    assert near.values[0] == pytest.approx(OPTIONS.calibration.reach * nuisance.tolerance)
    assert 7 < far.values[0] / nuisance.tolerance < 11
    assert 7 < cause.values[0] / nuisance.tolerance < 11


def test_a_frequency_is_found_by_growing_parts(recording, robot, known, monkeypatch):
    """A first fit that has stopped at a wrong minimum is replaced, and one to noise is left. What grows no further goes on from the first."""
    mass = known["payload_mass", "added_kg"]
    problem = make_problem(robot, [recording], [replace(mass, tolerance=mass.scale)], np.ones(6, bool))
    stopped, right = fit(problem, (), {}, iterations=0), fit(problem, (), {})
    found = _from_growing_parts(problem, stopped, RunContext(workers=1))
    assert found.cost < stopped.cost - 1.0
    assert found.cost == pytest.approx(right.cost, abs=0.5)
    assert _from_growing_parts(problem, right, RunContext(workers=1)) is right
    monkeypatch.setattr(recalibration, "is_acceptable", lambda *_: False)
    monkeypatch.setattr(problem.__class__, "until", lambda *_: problem.on([recording]))
    on = _from_growing_parts(problem, stopped, RunContext(workers=1))
    straight = fit(problem, (), stopped.point, polish=False)
    np.testing.assert_array_equal(on.values, straight.values)


@pytest.mark.parametrize("off", [-2.7, -1.3, 0.4, 1.9, 2.8])
@pytest.mark.parametrize("begin_s", [0.0, 3.0])
def test_growing_parts_follow_a_phase_over_many_turns(off, begin_s):
    """A frequency of 50 Hz that is up to 3 % off, sampled at 40 Hz for 8 s: a fit to all of it stops where it begins."""
    nuisances = (quantity("frequency", tolerance=0.01), quantity("size", tolerance=0.05))
    truth = {("made_up", "frequency"): 0.01 * off, ("made_up", "size"): -0.03}
    problem = LongVibration(truth, nuisances, begin_s=begin_s)
    at_once = fit(problem, (), {}, polish=False)
    grown = fit_growing(problem)
    assert grown.point[("made_up", "frequency")] == pytest.approx(0.01 * off, abs=1e-4)
    assert grown.cost < 1.2 * problem.size
    assert abs(off) < 1.0 or at_once.cost > 3.0 * grown.cost


def test_what_no_part_explains_grows_no_further():
    problem = LongVibration({}, (quantity("frequency", tolerance=0.01),), noise=3.0)
    assert fit_growing(problem) is None
    assert len(problem.spans) < 10
