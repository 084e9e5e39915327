"""What a measurement beyond chance adds to the covariance, and when that ends."""

import numpy as np
import pytest
from estimation_cases import BAGS, Run, estimator

from ctr_dynamics.estimation.monitoring.unexpected_innovation import AGREEING, UnexpectedInnovation
from ctr_dynamics.estimation.step_output import Innovation
from ctr_dynamics.io.bag_reader import open_bag
from ctr_dynamics.runtime.replay import Player

MS = 1_000_000


def innovation(at_ms, distance, nis, accepted=True):
    residual = np.array([0.0, distance, 0.0, 0.0, 0.0, 0.0])
    return Innovation(at_ms * MS, residual, np.ones(6), nis, 6, accepted, 0.0)


def deviation(watch, at_ms):
    covariance = np.zeros((12, 12))
    watch.inflate(covariance, at_ms * MS)
    return float(np.sqrt(np.trace(covariance[:3, :3])))


def test_the_distance_counts_until_measurements_in_a_row_agree():
    watch = UnexpectedInnovation(0.02, 1e-4)
    watch.take([innovation(0, 1e-4, 5.0), innovation(25, 1e-4, 22.0)])
    assert deviation(watch, 30) == 0.0  # chance
    watch.take([innovation(50, 2e-3, 60.0)])
    assert deviation(watch, 50) == pytest.approx(2e-3)
    assert deviation(watch, 75) == pytest.approx(4e-3)  # it goes on growing
    assert deviation(watch, 1000) == pytest.approx(6e-3)  # and turns back
    for i in range(AGREEING):
        assert deviation(watch, 50) > 0.0
        watch.take([innovation(75 + 25 * i, 1e-4, 3.0)])
    assert deviation(watch, 200) == 0.0


def test_one_outside_the_gate_counts_after_a_jump_of_the_load_alone():
    watch = UnexpectedInnovation(0.02, 1e-4)
    watch.take([innovation(0, 1e-4, 5.0), innovation(25, 3e-3, 200.0, accepted=False)])
    assert deviation(watch, 30) == 0.0
    watch.load_jumped(40 * MS)
    watch.take([innovation(50, 3e-3, 200.0, accepted=False)])
    assert deviation(watch, 50) == pytest.approx(3e-3)
    watch.take([innovation(60, 5e-2, 1e4, accepted=False)])
    assert deviation(watch, 50) == pytest.approx(3e-3), "an outlier"
    watch.take([innovation(75 + 25 * i, 1e-4, 3.0) for i in range(AGREEING)])
    watch.take([innovation(5000, 3e-3, 200.0, accepted=False)])
    assert deviation(watch, 5000) == 0.0


def test_before_anything_has_agreed_any_distance_counts():
    """A registration that is 19 mm off is as likely as an outlier of the tracker; half a metre is not."""
    watch = UnexpectedInnovation(0.02, 1e-4)
    watch.take([innovation(0, 0.5, 1e9, accepted=False)], confirmed=False)
    assert deviation(watch, 0) == 0.0
    watch.take([innovation(0, 1.9e-2, 1e5, accepted=False)], confirmed=False)
    assert deviation(watch, 0) == pytest.approx(1.9e-2)
    watch.take([innovation(25, np.nan, 1e5, accepted=False)], confirmed=False)  # no position is measured
    assert deviation(watch, 0) == pytest.approx(1.9e-2)
    watch.take([innovation(50 + 25 * i, 1e-4, 3.0) for i in range(AGREEING)])
    watch.take([innovation(500, 1.9e-2, 1e5, accepted=False)])
    assert deviation(watch, 500) == 0.0


def test_with_a_refuted_robot_file_the_covariance_holds_what_measurements_lie_apart():
    watch = UnexpectedInnovation(0.02, 1e-4)
    probable = [innovation(25 * i, 2e-3, 5.0, accepted=i % 2 == 0) for i in range(100)]
    watch.take(probable)
    assert deviation(watch, 2500) == 0.0
    watch.take(probable, refuted=True)
    assert deviation(watch, 2500) == pytest.approx(2e-3, rel=0.01)
    watch.take([], refuted=False)
    assert deviation(watch, 2500) == 0.0


def test_after_the_release_of_a_robot_with_a_heavier_payload_the_covariance_holds():
    """Until the force's variance is found, 0.1 s after the cut, errors were ten published deviations."""
    made = estimator({"output.policy": "predict"})
    run = Run([], made)
    for out in Player(made).play(open_bag(BAGS / "payload_protocol.mcap")):
        run.outputs.append(out)
        if out.k > 500:
            break
    truth = np.load(BAGS / "truth" / "payload_protocol.npz")
    inside = (run.t > 1.08) & (run.t < 1.2)
    expected = np.array([np.interp(run.t, truth["t"], truth["p_trk"][:, i]) for i in range(3)]).T
    error = np.linalg.norm(run.column("tip_position") - expected, axis=1)[inside]
    covariance = run.column("tip_covariance")[inside, :3, :3]
    assert error.max() > 3e-3, "nothing is shown"
    assert np.all(error < 3.0 * np.sqrt(np.trace(covariance, axis1=1, axis2=2)))
