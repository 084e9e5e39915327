"""Choice of terms by evidence, features on a known path, and guidance: answers that are known without a diagnosis."""

import copy
from dataclasses import replace
from math import comb

import numpy as np
import pytest

from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.learned.dictionary import Features, dictionary, shaped_robot
from ctr_dynamics.diagnosis.learned.guided_model import GuidedModel, measured_tip, smoothed
from ctr_dynamics.diagnosis.learned.sparse_terms import Data, Noise, choose_terms, log_choice
from ctr_dynamics.kernels.rotations import matrix
from ctr_dynamics.model.model import Model
from ctr_dynamics.model.time_scheme import make_scheme
from ctr_dynamics.model.trajectory import run
from ctr_dynamics.robot_files import robot_from_dict, robot_to_dict

SIZES, WIDTHS = np.array([0.0, 0.2, 0.5, 1.0, 1.5, 2.0, 3.0]), np.array([0.01, 0.1, 1.0])


def linear(seed, truth=None, correlated=0.0, count=400):
    """A linear problem of 40 smooth columns, two uncertain ones beside them, and noise; with the correlated noise's model."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 10.0, count)
    process = np.exp(-np.abs(t[:, None] - t) / 0.3)
    waves = [np.sin(rng.uniform(0.3, 12.0) * t + rng.uniform(0, 6.3)) for _ in range(42)]
    columns = 30.0 * np.stack(waves, axis=1)
    residual = columns[:, 40:] @ np.array([0.5, -1.0]) + rng.standard_normal(count)
    residual += correlated * np.linalg.cholesky(process) @ rng.standard_normal(count)
    for k, value in (truth or {}).items():
        residual += value * columns[:, k]
    variance, vectors = np.linalg.eigh(process)
    noise = Noise(lambda x: vectors.T @ x, np.maximum(variance, 0.0))
    return Data(residual, columns[:, 40:], np.zeros(2), np.ones(2), columns[:, :40], np.zeros(40, bool)), [
        noise
    ]


@pytest.mark.parametrize("correlated", [0.0, 1.5])
def test_terms_are_found_with_their_sizes(correlated):
    truth = {3: 0.4, 17: -0.8, 30: 0.25}
    data, noises = linear(1, truth, correlated)
    found = choose_terms(data, noises, SIZES, WIDTHS)
    assert set(found.chosen) == set(truth)
    expected = np.array([truth[k] for k in found.chosen])
    assert np.abs(found.values - expected).max() < (0.05 if correlated else 0.01)
    assert np.abs(found.common - [0.5, -1.0]).max() < 0.1


@pytest.mark.parametrize("correlated", [0.0, 1.5])
def test_noise_has_no_terms(correlated):
    """White noise or correlated: of twenty dictionaries of forty columns hardly one finds anything."""
    false = sum(
        bool(choose_terms(*linear(seed, correlated=correlated), SIZES, WIDTHS).chosen) for seed in range(20)
    )
    assert false <= 2


def test_terms_that_must_not_be_negative_are_not():
    data, noises = linear(1, {3: 0.4, 17: -0.8})
    found = choose_terms(replace(data, positive=np.ones(40, bool)), noises, SIZES, WIDTHS)
    assert 17 not in found.chosen
    assert np.all(found.values >= 0.0)


@pytest.mark.parametrize("columns", [1, 2, 6])
def test_prior_of_a_choice_sums_to_one(columns):
    every = sum(comb(columns, k) * np.exp(log_choice(k, columns)) for k in range(columns + 1))
    assert every == pytest.approx(1.0)


def test_smoothing_leaves_the_noise():
    t = np.linspace(0.0, 5.0, 201)
    exact = 0.05 * np.sin(7.0 * t)
    noise = 3e-4 * np.random.default_rng(2).standard_normal(len(t))
    path = smoothed(t, exact + noise, 3e-4)
    assert np.std(path(t) - exact - noise) == pytest.approx(3e-4, rel=0.05)
    assert np.std(path(t) - exact) < 2e-4
    assert np.std(path.derivative()(t) - 0.35 * np.cos(7.0 * t)) < 0.03


def learned(robot, **values):
    """``robot`` with a learned force."""
    data = copy.deepcopy(robot_to_dict(robot))
    data["extensions"]["learned_force"].update(values)
    return robot_from_dict(data, "learned")


def test_features_are_those_of_the_effect(robot):
    """The force of the features on a path, given from outside, moves the robot as the effect does that made the path."""
    shaped = shaped_robot(robot, np.array([[0.05, 0.0, 0.1], [0.1, 0.05, 0.12]]), np.array([0.2, 0.3]))
    values = {
        "potential_xyy_N": 0.03,
        "potential_zz_N": -0.02,
        "damping_xy_N": 0.02,
        "drag_y_N": 0.02,
        "dry_x_N": 0.01,
        "memory_y_N": 0.05,
        "tube1.sine_x_N": 0.02,
        "tube2.cosine_z_N": 0.02,
    }
    model, plain = Model(learned(shaped, memory_s=0.1, **values), nodes=10), Model(robot, nodes=10)
    alpha, beta = np.array(robot.rest.alpha.value), np.array(robot.rest.beta.value)

    def rows(t, width):
        out = np.zeros((len(t), width))
        out[:, 0:2] = alpha + np.stack([0.4 - 0.4 * np.cos(7.0 * t), 0.2 - 0.2 * np.cos(5.0 * t)], axis=1)
        out[:, 2:4] = np.stack([2.8 * np.sin(7.0 * t), np.sin(5.0 * t)], axis=1)
        out[:, 4:6] = beta
        return out

    scheme, dt, span = make_scheme("sdirk3", 0.002), 0.002, 0.4
    found = run(model, scheme, model.parameters, lambda t: rows(t, model.input_count), span, tolerance=1e-10)
    p = found.tip[:, :3]
    v = np.array(
        [
            matrix(h / np.linalg.norm(h)) @ q
            for h, q in zip(found.tip[:, 3:7], found.tip[:, 7:10], strict=True)
        ]
    )
    z = [p[0]]
    for mean in 0.5 * (p[:-1] + p[1:]):
        z.append(z[-1] + (1.0 - np.exp(-dt / 0.1)) * (mean - z[-1]))
    actuators = rows(found.t, 14)
    given = Features.of_robot(shaped, list(values))(
        p, v, [np.array(z)], actuators[:, :2], actuators[:, 4:6]
    ) @ np.array(list(values.values()))

    def outside(t):
        out = rows(t, plain.input_count)
        for axis in range(3):
            out[:, 6 + axis] += np.interp(t, found.t, given[:, axis])
        return out

    again = run(plain, scheme, plain.parameters, outside, span, tolerance=1e-10)
    without = run(
        plain, scheme, plain.parameters, lambda t: rows(t, plain.input_count), span, tolerance=1e-10
    )
    change = np.linalg.norm(without.tip[:, :3] - p, axis=1).max()
    assert change > 5e-4
    assert np.linalg.norm(again.tip[:, :3] - p, axis=1).max() < 0.01 * change


def test_translations_that_stand_still_are_no_features(robot):
    names = [q.name for q in dictionary(robot, [False, True])]
    assert not any(name.startswith("tube1.slide") for name in names)
    assert any(name.startswith("tube2.slide") for name in names)


def test_guided_model_stays_on_the_measured_path(robot, recording):
    """Also with a payload that the robot file does not know; and its derivatives by a force are those of finite forces."""
    free = ForwardModel(recording, robot)
    times, positions = measured_tip(free, {})
    assert np.abs(positions - recording.position[: len(positions)]).max() < 0.01  # same frame, small lever
    features = Features.of_robot(
        shaped_robot(robot, positions, np.ones(2)), ["constant_x_N", "potential_yy_N"]
    )
    guided, off = GuidedModel(free, {}, features, (0.2,)), np.zeros(2)

    def left(strength):
        guided.set_guidance(strength, off)
        return float(np.linalg.norm(guided.residual_at({})[:, :3]))

    without = float(np.linalg.norm(free.residual_at({})[:, :3]))
    strong, weak = left(3.0), left(0.01)
    assert strong < 0.6 * without
    assert strong < weak < 1.1 * without
    guided.set_guidance(3.0, off)
    columns = guided.force_jacobian({}, slice(None))
    part = guided.force_jacobian({}, slice(1, 2))
    np.testing.assert_allclose(part, columns[:, :, 1:], atol=1e-3 * np.abs(columns).max())
    before = guided.predict({}).position
    for k in range(2):
        guided.set_guidance(3.0, 1e-3 * (np.arange(2) == k))
        change = (guided.predict({}).position - before) / 1e-3
        np.testing.assert_allclose(columns[:, :3, k], change, atol=0.02 * np.abs(change).max())
    assert len(times) == len(positions)
