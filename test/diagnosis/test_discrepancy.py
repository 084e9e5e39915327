"""A discrepancy: found where there is one, with its size and correlation time, and not where there is noise only."""

from dataclasses import replace

import numpy as np
import pytest

from ctr_dynamics.diagnosis.inference.discrepancy import CorrelatedNoise, discrepancy_of
from ctr_dynamics.diagnosis.inference.fit_problem import make_problem
from ctr_dynamics.diagnosis.inference.map_fit import fit

SEEDS = range(12)


@pytest.fixture(scope="module")
def problem(recording, robot, known):
    return make_problem(robot, [recording], [known["encoder_offset", "tube1.offset_rad"]], np.ones(6, bool))


@pytest.fixture(scope="module")
def processes(problem):
    return [CorrelatedNoise(problem, time) for time in problem.options.discrepancy.times_s]


@pytest.fixture(scope="module")
def plain(problem):
    """A fit whose residual is replaced by noise of known kind."""
    found = fit(problem, (), {}, iterations=0)
    assert found is not None
    return found


def _noise(problem, rng, size, time):
    """Whitened unit noise, and a process of ``size`` (m) with ``time`` (s) on every axis, made without the module under test."""
    whiten, t = problem.whiteners[0], problem.forward_models[0].recording.stamps
    root = np.linalg.cholesky(np.exp(-np.abs(t[:, None] - t) / time) + 1e-10 * np.eye(len(t)))
    values = size * root @ rng.normal(size=(len(t), 6))
    values[:, 3:] *= 1.5 / problem.robot.exposed_length
    return rng.normal(size=problem.size) + whiten(values)


def test_noise_alone_is_no_discrepancy(problem, processes, plain):
    for seed in SEEDS:
        residual = np.random.default_rng(seed).normal(size=problem.size)
        assert discrepancy_of(problem, replace(plain, residual=residual), processes).log_bayes < 1.0


@pytest.mark.parametrize("time", [0.03, 0.3])
def test_size_and_correlation_time_come_back(problem, processes, plain, time):
    size = 5.0 * problem.robot.tracker.noise.position.value
    found = []
    for seed in SEEDS:
        residual = _noise(problem, np.random.default_rng(seed), size, time)
        found.append(discrepancy_of(problem, replace(plain, residual=residual), processes))
    assert min(d.log_bayes for d in found) > 10.0
    assert np.median([d.rms_m for d in found]) == pytest.approx(np.sqrt(3.0) * size, rel=0.25)
    assert 0.5 * time < np.median([d.correlation_time_s for d in found]) < 2.0 * time


def test_a_discrepancy_widens_what_it_can_imitate(problem, processes, plain):
    """The posterior of a constant angle is wider beside a slow process, and never narrower."""
    size = 5.0 * problem.robot.tracker.noise.position.value
    residual = _noise(problem, np.random.default_rng(0), size, 1.0)
    with_it = discrepancy_of(problem, replace(plain, residual=residual), processes).covariance
    assert with_it[0, 0] > 1.5 * plain.covariance[0, 0]
