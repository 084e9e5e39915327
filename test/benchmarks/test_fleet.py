"""The fleet: draws follow the tolerances, and a few bags are consistent."""

import numpy as np
import pytest

from ctr_dynamics.benchmarks.fleet import fleet, interval, table
from ctr_dynamics.benchmarks.fleet_robots import FLEET, LAB_STIFFNESS, drawn, fleet_robot, seed_of


@pytest.mark.parametrize("name", FLEET)
def test_draws_scatter_as_the_file_says(name):
    robot = fleet_robot(name, lab=True)
    rng = np.random.default_rng(1)
    draws = [drawn(robot, rng) for _ in range(300)]
    stiffness = (
        np.array([d.robot.tubes[0].youngs_modulus.value for d in draws]) / robot.tubes[0].youngs_modulus.value
    )
    assert stiffness.std() == pytest.approx(LAB_STIFFNESS, rel=0.15)
    assert np.abs(stiffness - 1.0).max() > 2.2 * LAB_STIFFNESS  # not cut off
    translation = np.array([d.robot.tracker.registration_translation.value for d in draws])
    assert translation.std() == pytest.approx(robot.tracker.registration_translation.tolerance[0], rel=0.15)
    assert np.array([d.offsets for d in draws]).std() == pytest.approx(
        robot.encoders.offset.tolerance, rel=0.15
    )
    densities = np.array([[tube.density.value for tube in d.robot.tubes] for d in draws])
    assert np.ptp(densities / densities[:, :1], axis=0).max() < 1e-9  # of one alloy
    assert all(np.linalg.norm(d.robot.gravity.value) == pytest.approx(9.81, rel=1e-6) for d in draws)


def test_random_robots_differ_and_are_the_same_each_time():
    robots = [fleet_robot(f"random{number}") for number in range(1, 9)]
    lengths = [robot.exposed_length for robot in robots]
    assert len(set(lengths)) == len(lengths)
    assert all(0.05 < length < 0.3 for length in lengths)
    assert fleet_robot("random3") == robots[2]
    assert len({*map(seed_of, FLEET), *(seed_of(robot.name) for robot in robots)}) == len(FLEET) + 8
    for name in ("random", "random0", "nobody"):
        with pytest.raises(KeyError):
            seed_of(name)
        with pytest.raises(KeyError):
            fleet_robot(name)


def test_two_robots_are_consistent():
    """Four bags: the NEES of a bag is between 0.2 and 4 with more than 99 %, the NIS of 200 poses within 0.2."""
    rows = fleet(2, ["tissue", "light"], lab=[True], seed=3)
    for row in rows:
        assert not row["failures"]
        assert 0.2 < row["nees"]["mean"] < 3.0
        assert 0.8 < row["nis"]["mean"] < 1.2
        assert row["error_m"]["rms"] < 4e-4
    assert table(rows).count("\n") == 3


def test_intervals_hold_the_mean_of_independent_values():
    rng = np.random.default_rng(4)
    held = 0
    for _ in range(200):
        mean, half = interval(rng.normal(1.0, 0.5, 30))
        held += abs(mean - 1.0) < half
    assert held >= 180
    assert np.isnan(interval(np.array([1.0]))[1])
