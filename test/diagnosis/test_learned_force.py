"""A force outside the catalogue, hidden by the simulator of the tests: the learned one removes the error of another bag, or none is kept.

Learning is asked for directly, as after a verdict `unknown`. A whole diagnosis after which nothing is learned is in test_nothing_hidden.py.
"""

from dataclasses import replace

import numpy as np
import pytest
from truth import nuisances, sensors
from truth.motion import sweep
from truth.world import Law, World, carry_out

from ctr_dynamics.diagnosis.diagnosis_options import DiagnosisOptions
from ctr_dynamics.diagnosis.inference.fit_problem import make_problem
from ctr_dynamics.diagnosis.inference.map_fit import fit
from ctr_dynamics.diagnosis.inference.recalibration import nuisances_of
from ctr_dynamics.diagnosis.inference.residual_tests import rms
from ctr_dynamics.diagnosis.learned.learn import learn_force, rejection
from ctr_dynamics.diagnosis.output.robot_export import robot_with_fit
from ctr_dynamics.diagnosis.recording import read_recording
from ctr_dynamics.diagnosis.run_context import RunContext
from ctr_dynamics.diagnosis.verdict.validation import BagErrors, Validation
from ctr_dynamics.diagnosis.whitening import noise_floor

STEP_S = 2.5e-3


def quadratic_drag(p, v, z, alpha):
    return -0.15 * np.linalg.norm(v, axis=1)[:, None] * v


def bags(folder, robot, law, seed):
    """Two multisines of 6 and 3 s with the tolerances drawn."""
    rng = np.random.default_rng(seed)
    world = World.of(robot)
    nuisances.apply(nuisances.draw(rng, robot), world)
    world.disturbance.law = law
    for name, duration in (("fitted", 6.0), ("other", 3.0)):
        motion = replace(sweep(rng, np.array(robot.rest.alpha.value)), name=name, duration_s=duration)
        path = folder / f"{name}.mcap"
        sensors.write(path, carry_out(world, motion, STEP_S), world.sensing, robot, rng)
        yield read_recording(path, robot)


def test_hidden_force_is_learned(tmp_path, robot):
    """From a part of one bag, and the rest of it judges; the robot file that is written predicts another bag."""
    fitted, other = bags(tmp_path, robot, Law(quadratic_drag), 7201)
    problem = make_problem(robot, [fitted], nuisances_of(robot), np.ones(6, bool), DiagnosisOptions())
    base = fit(problem, (), {}, polish=False)
    found = learn_force(problem, base, [], RunContext(workers=1))
    force = found.force
    assert force is not None, found.reason
    assert "%" in force.held_out
    assert 0.0 < force.validation.interval[0] < force.validation.gain < force.validation.interval[1]
    assert len(force.fit.residual) == problem.size

    saved = robot_with_fit(force.robot, force.fit, "extended", "learned")
    assert set(saved.extensions["learned_force"]) >= {q.name for q in force.terms}
    before = rms(problem.on([other]).residuals(base.point)[0][:, :3])
    again = make_problem(saved, [other], (), np.ones(6, bool), DiagnosisOptions())
    after = rms(again.residuals({})[0][:, :3])
    assert before**2 - after**2 > 0.7 * (before**2 - noise_floor(robot) ** 2)
    # it is not learned on top of itself
    twice = learn_force(make_problem(saved, [fitted], (), np.ones(6, bool)), base, [other], RunContext())
    assert twice.force is None
    assert "already" in twice.reason


@pytest.mark.parametrize(
    ("interval", "bags", "said"),
    [
        ((0.2, 0.6), [("a", 2e-3, 1e-3), ("b", 1e-3, 1e-3)], ""),
        ((-0.1, 0.6), [("a", 2e-3, 1e-3)], "does not predict other bags: gain 0.40 [-0.10, 0.60]"),
        ((0.2, 0.6), [("a", 2e-3, 1e-3), ("b", 1e-3, 1.1e-3)], "prediction of b worse"),
    ],
)
def test_a_force_that_does_not_predict_is_not_kept(interval, bags, said):
    found = rejection(
        Validation(1e-3, 1e-3, 0.4, interval, 1.0, 1.0, [BagErrors(*bag) for bag in bags]), "other bags"
    )
    assert said in found if said else not found
    assert "cannot be simulated" in rejection(None, "other bags")
