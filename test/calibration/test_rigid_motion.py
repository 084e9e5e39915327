"""Closed forms of the first steps."""

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_dynamics.calibration.rigid_motion import mean_rotation, rigid_motion, shortest_turn

RNG = np.random.default_rng(5)


def turn_of(h):
    return Rotation.from_quat(np.roll(h, -1))


def test_rigid_motion_is_that_of_an_independent_solver():
    source = RNG.normal(size=(30, 3))
    true, shift = Rotation.from_rotvec([0.4, -2.1, 0.9]), np.array([3.0, -1.0, 0.2])
    target = true.apply(source) + shift + 0.01 * RNG.normal(size=(30, 3))
    h, found = rigid_motion(source, target)
    best, _ = Rotation.align_vectors(target - target.mean(axis=0), source - source.mean(axis=0))
    assert (turn_of(h) * best.inv()).magnitude() < 1e-6
    assert np.allclose(found, target.mean(axis=0) - best.apply(source.mean(axis=0)), atol=1e-6)


def test_mean_rotation_takes_both_signs_for_one_rotation():
    true = Rotation.from_rotvec([1.0, 0.3, -0.7])
    rows = np.roll((true * Rotation.from_rotvec(0.02 * RNG.normal(size=(50, 3)))).as_quat(), 1, axis=1)
    rows[::2] *= -1.0
    assert (turn_of(mean_rotation(rows)) * true.inv()).magnitude() < 0.01


def test_shortest_turn_also_of_opposite_axes():
    for a, b in ((RNG.normal(size=3), RNG.normal(size=3)), (np.array([0, 0, 1.0]), np.array([0, 0, -1.0]))):
        a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
        turn = turn_of(shortest_turn(a, b))
        assert np.allclose(turn.apply(a), b, atol=1e-9)
        assert np.isclose(turn.magnitude(), np.arccos(np.clip(a @ b, -1.0, 1.0)))
