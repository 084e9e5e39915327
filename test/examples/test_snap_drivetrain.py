"""The worked example on snaps with a hidden drivetrain: its data are what the truth generator makes, and the diagnosis finds what is hidden."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from joblib import Parallel, delayed

from ctr_dynamics.robot_files import load_robot

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "06_snap_drivetrain"
for folder in (EXAMPLE, ROOT / "test" / "diagnosis", ROOT / "test" / "snap"):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

snap_fit = importlib.import_module("snap_fit")
truth = importlib.import_module("snap_truth")
ANSWER = json.loads((EXAMPLE / "data" / "answer.json").read_text())


def small_drives():
    """Fewer starts than the example's, none of them at the truth."""
    cause = snap_fit.drive()
    return snap_fit.Cause(cause.effect, cause.starts[2:9:2], cause.mix, cause.steps)


@pytest.fixture(scope="module")
def example():
    """(fitter, snaps) of the shipped data: 3.4 ms of the first snap, and a fine grid that is less fine than the example's."""
    name, snaps = snap_fit.load(EXAMPLE / "data")
    first = replace(snaps[0], t=snaps[0].t[:170], theta_f=snaps[0].theta_f[:170])
    fine = snap_fit.Grid((10, 6, 3, 24, 8, 3), 5e-6)
    return snap_fit.Fitter(load_robot(name), first, fine=fine), snaps


def test_a_straight_crossing_is_found_between_frames():
    t = 2e-5 * np.arange(40)
    snap = snap_fit.Snap(t, 4.0 + 2e4 * (t - 3.13e-4), 0.01, -0.1, 10.0, 0.0)
    assert snap.passed == pytest.approx(3.13e-4, abs=1e-9)


def test_noise_is_white_and_a_line_is_not():
    rng = np.random.default_rng(3)
    noise = rng.standard_normal(270)
    assert snap_fit.whiteness(noise) > 0.01
    assert snap_fit.whiteness(noise + np.sin(0.3 * np.arange(270))) < 1e-6


def test_intervals_are_of_logarithms_through_the_mix():
    """J = k / (2 pi f)^2: ten per cent of k and none of f are ten per cent of J."""
    cause = snap_fit.drive()
    start = cause.starts[0]
    covariance = np.diag([1.0, 1.0, 0.01, 0.0])
    fit = snap_fit.Fit(cause, start, np.zeros(4), {}, np.zeros(9), 0.0, 9, covariance, 0)
    for name in cause.names:
        value, low, high = fit.interval(name, 1.0)
        assert value == start[name]
        assert np.log(high / value) == pytest.approx(0.01)
        assert np.log(value / low) == pytest.approx(0.01)
    assert cause.values(start, np.array([0.0, 1.0]))["tube1.inertia_kgm2"] == pytest.approx(
        start["tube1.inertia_kgm2"] * np.exp(-0.2)
    )


@pytest.mark.slow
def test_shipped_snap_is_the_generators():
    """The first half millisecond after 4 rad, from the seed in the answer, noise and all."""
    robot = truth.robot_for_snap(load_robot(truth.ROBOT), {"beta1": truth.LENGTHS["fit"]})
    hidden = truth.draw(ANSWER["seed"], load_robot(truth.ROBOT))
    assert hidden.stiffness_Nm_per_rad == ANSWER["stiffness_Nm_per_rad"]
    start = truth.fold(robot, hidden) - truth.MARGIN
    t, theta = truth.snap(truth.hidden_machine(robot, hidden), start, 4.4e-3, truth.SLOW_S)
    crossed = truth.crossing(t, theta)
    kept = theta[t > crossed - truth.BEFORE]
    rng = np.random.default_rng([ANSWER["seed"], 0])
    measured = kept + hidden.zero_rad + truth.NOISE * rng.standard_normal(len(kept))
    shipped = np.loadtxt(EXAMPLE / "data" / "fit.csv", delimiter=",", skiprows=1)[: len(kept), 1]
    np.testing.assert_allclose(measured, shipped, atol=1e-4)


@pytest.mark.slow
def test_drivetrain_is_named_and_its_size_found(example):
    fitter, snaps = example
    rivals = (small_drives(), snap_fit.NOTHING, snap_fit.one("shear_modulus", "tube1.scale", 0.94))
    soft, rigid, rival = Parallel(n_jobs=2)(delayed(fitter.fit)(cause) for cause in rivals)
    soft = fitter.fit(soft.cause, soft)
    print([(f.cause.title, f.bic, f.rms, f.simulations) for f in (rigid, soft, rival)])
    best = min((rigid, soft, rival), key=lambda f: f.bic)
    assert best is soft
    assert min(rigid.bic, rival.bic) - soft.bic > snap_fit.DECISIVE
    for name, hidden in (
        ("tube1.stiffness_Nm_per_rad", ANSWER["stiffness_Nm_per_rad"]),
        ("tube1.inertia_kgm2", ANSWER["inertia_kgm2"]),
    ):
        value, low, high = soft.interval(name)
        print(name, value, low, high, hidden)
        assert low < hidden < high
        assert high < 1.3 * low
    assert soft.rms < 1.2 * snaps[0].noise
    assert soft.rms**2 < 0.15 * rigid.rms**2
    # another transmission length, which was not fitted
    checked = [snap_fit.check(fitter.robot, fit, snaps[1], fitter.fine) for fit in (rigid, soft)]
    print([(c.rms, c.theta_b) for c in checked], snaps[1].theta_b)
    assert checked[1].rms ** 2 < 0.3 * checked[0].rms ** 2
    assert abs(checked[1].theta_b - snaps[1].theta_b) < 0.2 * abs(checked[0].theta_b - snaps[1].theta_b)
