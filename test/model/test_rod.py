"""A steel rod released from a tip load against a public Cosserat-rod program (test/data/rod).

That program has shear and stretch, which this model leaves out; both change the deflection of a rod of 2 mm
in 500 mm by parts of 1e-5, far below the time errors compared here.
"""

from pathlib import Path

import numpy as np
import pytest
from model_cases import make_robot, make_tube, run, still

from ctr_dynamics.model.model import Model
from ctr_dynamics.model.statics import Statics

DATA = Path(__file__).parents[1] / "data" / "rod" / "steel_dt3ms.csv"
LOAD = (-0.02 * 9.81, 0.0, 0.0)


@pytest.fixture(scope="module")
def rod():
    tube = make_tube(0.0, 1e-3, E=200e9, density=8000.0, segments=((0.5, (0, 0, 0)),))
    tube["shear_modulus"] = {"value": 80e9, "unit": "Pa"}
    return Model(make_robot([tube], [0.0], gravity=(-9.81, 0.0, 0.0)), nodes=100)


def test_static_tip_before_the_release(rod):
    found = Statics(rod).solve([0.0], [0.0], LOAD)
    np.testing.assert_allclose(found.tip_position, (-0.063302140, 0.0, 0.495215169), atol=2e-6)


def test_motion_after_the_release(rod):
    """The same scheme and step, BDF-alpha -0.2 at 3 ms: 1.5 s within 0.05 mm of a swing of over 20 mm.

    And the motion is plane.
    """
    expected = np.loadtxt(DATA, delimiter=",", skiprows=1)
    steps = 500
    free = still([0.0], [0.0])
    _, tips, _ = run(
        rod, "bdf_alpha", 0.003, steps, lambda t: free, start=still([0.0], [0.0], LOAD), alpha=-0.2
    )
    times = 0.003 * np.arange(steps + 1)
    np.testing.assert_allclose(expected[: steps + 1, 0], times, atol=1e-9)
    apart = np.linalg.norm(tips - expected[: steps + 1, 1:], axis=1)
    print(f"rod: largest {apart.max() * 1e3:.4f} mm, rms {np.sqrt((apart**2).mean()) * 1e3:.4f} mm")
    assert np.ptp(expected[:, 1]) > 0.02
    assert apart.max() < 0.05e-3
    assert np.abs(tips[:, 1]).max() < 1e-9
