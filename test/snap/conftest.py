"""Makes the helpers beside the tests, and the robots and the NumPy twin of the model's tests, importable."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "model"))

import pytest
from snap_cases import EXAMPLE, START

from ctr_dynamics.robot_files import load_robot
from ctr_dynamics.snap.experiment import Plan, run
from ctr_dynamics.snap.scurve import s_curve


@pytest.fixture(scope="session")
def example():
    """The published example as published: 10 us, 12 ms, its grid."""
    return run(load_robot(EXAMPLE), Plan(START))


@pytest.fixture(scope="session")
def example_curve():
    """The example's S-curve at 1000 end angles, with weight."""
    robot = load_robot(EXAMPLE)
    return s_curve(robot, robot.rest.beta.value)
