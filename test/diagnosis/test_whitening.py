"""The whitened residual has unit noise."""

import math

import numpy as np
import pytest

from ctr_dynamics.diagnosis.whitening import Whitener
from ctr_dynamics.robot_files import load_robot


def test_whitener_gives_unit_noise():
    robot = load_robot("till2020_tissue")
    noise = robot.tracker.noise
    t = np.arange(400) / 40.0
    rng = np.random.default_rng(2)
    drift = np.zeros((400, 3))
    drift[0] = noise.drift.value * rng.normal(size=3)
    keep = math.exp(-1 / (40.0 * noise.drift_time.value))
    for k in range(1, 400):
        drift[k] = keep * drift[k - 1] + noise.drift.value * math.sqrt(1 - keep**2) * rng.normal(size=3)
    values = np.hstack(
        [
            drift + noise.position.value * rng.normal(size=(400, 3)),
            noise.rotation.value * rng.normal(size=(400, 3)),
        ]
    )
    whiten = Whitener(robot, t, np.ones(6, bool), np.ones(400, bool))
    white = whiten(values)
    assert white.size == whiten.size == 2400
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.1)
    assert abs(float(white[1:400] @ white[:399])) / 400 < 0.15
    # derivatives go the same way as values
    np.testing.assert_allclose(whiten(values[:, :, None])[:, 0], white)
