"""Crossing, extrema and frequencies of known signals."""

import numpy as np
import pytest

from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.snap.experiment import robot_for_snap
from ctr_dynamics.snap.features import LEVEL, after_snap, crossing, extrema, frequencies
from ctr_dynamics.snap.scurve import s_curve


def decaying(t):
    """A step at 2 ms that rings at 2 kHz about 5 rad."""
    ring = 5.0 + 1.2 * np.exp(-(t - 2e-3) / 1e-3) * np.sin(2 * np.pi * 2e3 * (t - 2e-3) - 0.5 * np.pi)
    return np.where(t < 2e-3, 3.8, ring)


def test_crossing_lies_between_samples():
    t = np.linspace(0, 1, 101)
    assert crossing(t, 5.0 * t**2, 1.3) == pytest.approx(np.sqrt(1.3 / 5.0), abs=1e-9)
    assert crossing(t, 0.1 * t, 4.0) is None


def test_extrema_lie_between_samples():
    t = np.linspace(0, 1, 200)
    found = extrema(t, np.sin(2 * np.pi * 2.0 * t + 0.3))
    assert [e.kind for e in found] == ["peak", "trough", "peak", "trough"]
    exact = (np.pi / 2 - 0.3 + np.pi * np.arange(4)) / (4 * np.pi)
    np.testing.assert_allclose([e.t_s for e in found], exact, atol=1e-6)
    np.testing.assert_allclose([e.theta_f for e in found], [1, -1, 1, -1], atol=1e-6)
    assert [e.kind for e in after_snap(found, 0.3)] == ["trough", "peak", "trough"][0:0] + [
        e.kind for e in found if e.t_s >= 0.3
    ]
    assert after_snap(found, None) == []
    assert extrema(t[:3], t[:3]) == []


def test_frequency_of_a_decaying_vibration():
    t = 1e-5 * np.arange(1, 1201)
    (hz, height), *_ = frequencies(t, decaying(t), 2e-3)
    assert hz == pytest.approx(2e3, rel=0.03)
    assert height == 1.0
    assert frequencies(t, decaying(t), 12e-3) == []


@pytest.mark.parametrize("beta1", [-0.112, -0.1374, -0.1628])
def test_the_level_at_which_a_snap_is_timed_lies_between_the_folds(beta1):
    robot = robot_for_snap(load_robot("till2020_snap"), {"beta1": beta1})
    curve = s_curve(robot, np.array(robot.rest.beta.value), points=40, nodes=24)
    (_, opens, _), (_, back, _) = curve.folds()
    assert opens < LEVEL < back
