"""The authors' published example: trajectory, tip path, S-curve, refinement in time."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from snap_cases import EXAMPLE, START, table

from ctr_dynamics.robot_files import load_robot, robot_with
from ctr_dynamics.snap.experiment import Plan, refined_cells, robot_for_snap, run
from ctr_dynamics.snap.features import after_snap, crossing, extrema
from ctr_dynamics.snap.scurve import s_curve


def first_peak(t, theta):
    """theta_f, rad, of the first peak behind the snap."""
    return after_snap(extrema(t, theta), crossing(t, theta))[0].theta_f


@pytest.mark.slow
def test_trajectory_of_the_published_example(example):
    """Same grid, step and start; compared after aligning on the crossing of 4 rad."""
    theirs = table("tip_dt10us.csv")
    assert not example.failure
    assert example.unknowns == 1441
    np.testing.assert_allclose(example.t, theirs["t_s"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(example.theta_b, theirs["theta_b"], rtol=0, atol=1e-9)
    mine, published = crossing(example.t, example.theta_f), crossing(theirs["t_s"], theirs["theta_f"])
    assert published == pytest.approx(6.7449e-3, abs=1e-7)
    assert abs(mine - published) < 12e-6
    grid = np.linspace(-6.5e-3, 5.2e-3, 20_001)

    def aligned(t, values, at):
        return CubicSpline(t - at, values)(grid)

    off = aligned(example.t, example.theta_f, mine) - aligned(theirs["t_s"], theirs["theta_f"], published)
    print(f"crossing {1e6 * (mine - published):+.2f} us, theta_f {np.abs(off).max():.4f} rad")
    assert np.abs(off).max() < 0.005
    for which, found in (("inner", example.inner_tip), ("outer", example.outer_tip)):
        path = np.column_stack([theirs[f"{which}_tip_{axis}"] for axis in "xyz"])
        apart = np.linalg.norm(
            aligned(example.t, found, mine) - aligned(theirs["t_s"], path, published), axis=1
        ).max()
        print(f"{which} tip {apart:.2e} m")
        assert apart < 3e-5
    peaks = after_snap(extrema(example.t, example.theta_f), mine)
    theirs_peaks = after_snap(extrema(theirs["t_s"], theirs["theta_f"]), published)
    for a, b in zip(peaks[:7], theirs_peaks[:7], strict=True):
        assert a.kind == b.kind
        assert abs((a.t_s - mine) - (b.t_s - published)) < 2e-6
        assert abs(a.theta_f - b.theta_f) < 0.005
    assert theirs_peaks[0].theta_f == pytest.approx(6.2006, abs=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "alpha"), [("bdf2", -0.45), ("bdf_alpha", -0.2)])
@pytest.mark.parametrize("factor", [1, 2])
def test_first_peak_converges_in_second_order(example, scheme, alpha, factor):
    """To one limit on the published grid and on doubled cells, by either scheme.

    The published program's peaks at 10 and 5 us lie 0.8e-3 rad above these at both steps, and so does what the pair extrapolates to, its
    6.2085 rad: the terms of (12) and (20) in gamma (docs/snap.md).
    """
    robot = load_robot(EXAMPLE)

    def found(dt):
        if (dt, factor, scheme) == (1e-5, 1, "bdf2"):
            return first_peak(example.t, example.theta_f)
        cells = refined_cells(robot, factor)
        motion = run(robot, Plan(START, dt=dt, duration=7.2e-3, cells=cells, scheme=scheme, alpha=alpha))
        return first_peak(motion.t, motion.theta_f)

    at_10, at_5, at_2 = (found(dt) for dt in (1e-5, 5e-6, 2.5e-6))
    print(f"{scheme} {alpha}, cells x {factor}: {at_10:.5f} {at_5:.5f} {at_2:.5f}")
    assert 1.8 < np.log2((at_5 - at_10) / (at_2 - at_5)) < 2.4
    assert at_2 + (at_2 - at_5) / 3 == pytest.approx(6.2072, abs=3e-4)
    pair = at_5 + (at_5 - at_10) / 3
    assert pair == pytest.approx(6.2085, abs=1.3e-3)
    if scheme == "bdf2":
        published = [
            first_peak(t["t_s"], t["theta_f"]) for t in map(table, ("tip_dt10us.csv", "theta_dt5us.csv"))
        ]
        assert published[1] + (published[1] - published[0]) / 3 == pytest.approx(6.2085, abs=2e-4)
        for mine, theirs in zip((at_10, at_5), published, strict=True):
            assert theirs - mine == pytest.approx(8.5e-4, abs=2e-4)


@pytest.mark.slow
def test_printed_equations_are_those_of_the_published_program():
    """Without the term in gamma that (12) and (20) as printed lack: the same motion, and first peaks that go to 6.2085 rad."""
    robot, peaks = load_robot(EXAMPLE), []
    for dt, file in ((1e-5, "tip_dt10us.csv"), (5e-6, "theta_dt5us.csv")):
        theirs = table(file)
        mine = run(robot, Plan(START, dt=dt, duration=7.6e-3, equations="printed"))
        crossings = crossing(mine.t, mine.theta_f), crossing(theirs["t_s"], theirs["theta_f"])
        grid = np.linspace(-6e-3, 0.8e-3, 10_001)
        off = CubicSpline(mine.t - crossings[0], mine.theta_f)(grid) - CubicSpline(
            theirs["t_s"] - crossings[1], theirs["theta_f"]
        )(grid)
        print(f"{1e6 * dt:g} us: theta_f {np.abs(off).max():.5f} rad")
        assert np.abs(off).max() < 5e-4
        peaks.append(first_peak(mine.t, mine.theta_f))
    assert peaks == pytest.approx([6.2007, 6.2065], abs=2e-4)
    assert peaks[1] + (peaks[1] - peaks[0]) / 3 == pytest.approx(6.2085, abs=2e-4)


def test_no_friction_snaps_sooner_and_keeps_its_energy():
    """Held by nothing, the tubes snap some 4 ms earlier and ring on."""
    robot = robot_for_snap(load_robot(EXAMPLE), {"tube_coulomb": 0.0})
    free = run(robot, Plan(START, duration=6e-3))
    crossed = crossing(free.t, free.theta_f)
    assert crossed < 3e-3
    peaks = [e for e in after_snap(extrema(free.t, free.theta_f), crossed) if e.kind == "peak"]
    assert max(e.theta_f for e in peaks[3:]) > 6.1


def test_doubled_cells_move_the_snap_and_keep_its_shape(example):
    robot = load_robot(EXAMPLE)
    fine = run(robot, Plan(START, duration=8e-3, cells=refined_cells(robot, 2)))
    later = crossing(fine.t, fine.theta_f) - crossing(example.t, example.theta_f)
    assert later == pytest.approx(11e-6, abs=2e-6)
    a = CubicSpline(fine.t - crossing(fine.t, fine.theta_f), fine.theta_f)
    b = CubicSpline(example.t - crossing(example.t, example.theta_f), example.theta_f)
    grid = np.linspace(-6e-3, 1.2e-3, 5000)
    assert np.abs(a(grid) - b(grid)).max() < 0.005


@pytest.mark.parametrize("weight", [True, False])
def test_s_curve_of_the_published_example(example_curve, weight):
    """Its own refinement, the exact snap, and the published curve within what that one is off."""
    robot = load_robot(EXAMPLE)
    beta = robot.rest.beta.value
    curve = example_curve
    if not weight:
        robot = robot_with(robot, {"gravity": (0.0, 0.0, 0.0)})
        curve = s_curve(robot, beta)
    refined = s_curve(robot, beta, points=200, nodes=400)
    fine = CubicSpline(curve.theta_f, curve.theta_b)(refined.theta_f)
    assert np.abs(fine - refined.theta_b).max() < 1e-6
    theirs = table("scurve_beta112mm.csv")
    off = np.abs(CubicSpline(curve.theta_f, curve.theta_b)(theirs["theta_f"]) - theirs["theta_b"]).max()
    print(f"weight {weight}: snap {curve.snap}, published curve off by {off:.2e} rad")
    assert off < 2e-3
    assert curve.snap[0] == pytest.approx(3.5728, abs=3e-4)


def test_s_curve_is_the_exact_one_without_weight():
    """Torsion of the unloaded pair is a pendulum's equation from the tip to the plate, and straight behind it."""
    from scipy.integrate import solve_ivp

    robot = robot_with(load_robot(EXAMPLE), {"gravity": (0.0, 0.0, 0.0)})
    curve = s_curve(robot, robot.rest.beta.value, points=40)
    inner, outer = robot.tubes
    softness = 1 / inner.torsion_stiffness + 1 / outer.torsion_stiffness
    bend = (
        inner.bending_stiffness
        * outer.bending_stiffness
        / (inner.bending_stiffness + outer.bending_stiffness)
    )
    pull = softness * bend * 37.12 * 8.72
    for theta_b, theta_f in zip(curve.theta_b[1::6], curve.theta_f[1::6], strict=True):
        both = solve_ivp(
            lambda s, y: [y[1], pull * np.sin(y[0])], (0.0436, 0.0132), [theta_f, 0.0], rtol=1e-11, atol=1e-12
        )
        theta, rate = both.y[:, -1]
        torque = rate / softness
        exact = theta - 0.0132 * rate - 0.112 * torque / inner.torsion_stiffness
        assert theta_b == pytest.approx(exact, abs=1e-8)


def test_stability_vanishes_at_the_folds_and_is_negative_between(example_curve):
    curve = example_curve
    (b1, f1, opens1), (b2, f2, opens2) = curve.folds()
    assert (opens1, opens2) == (True, False)
    assert b1 > b2
    between = (curve.theta_f > f1 + 0.01) & (curve.theta_f < f2 - 0.01)
    outside = (curve.theta_f < f1 - 0.01) | (curve.theta_f > f2 + 0.01)
    assert (curve.stability[between] < 0).all()
    assert (curve.stability[outside] > 0).all()
    assert abs(np.interp(f1, curve.theta_f, curve.stability)) < 1e-3


def test_start_of_the_published_example_with_weight(example):
    assert example.theta_f_rest == pytest.approx(2.0110, abs=5e-4)


def test_adaptive_steps_resolve_the_snap_and_save_the_rest(example):
    robot = load_robot(EXAMPLE)
    motion = run(robot, Plan(START, adaptive=1.6e-4))
    assert not motion.failure
    assert len(motion.t) < 0.6 * len(example.t)
    assert motion.t[-1] == pytest.approx(12e-3, abs=1e-5)
    steps = np.diff(motion.t)
    fast = np.interp(motion.t[1:], example.t, np.abs(np.gradient(example.theta_f, example.t))) > 3e3
    assert steps[fast].max() < 1.05e-5
    assert steps.max() > 1e-4
    mine, dense = crossing(motion.t, motion.theta_f), crossing(example.t, example.theta_f)
    assert abs(mine - dense) < 30e-6
    a, b = (
        after_snap(extrema(m.t, m.theta_f), at)[0].theta_f for m, at in ((motion, mine), (example, dense))
    )
    assert a == pytest.approx(b, abs=0.01)
