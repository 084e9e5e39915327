"""Makes the package `truth` and helpers importable; a short recording whose truth is known."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parent.parent / "model"))

from ctr_dynamics.diagnosis.forward_model import ForwardModel
from ctr_dynamics.diagnosis.recording import Recording
from ctr_dynamics.effects import effect_quantities
from ctr_dynamics.robot_files import load_robot


@pytest.fixture(scope="session")
def robot():
    return load_robot("till2020_tissue")


@pytest.fixture(scope="session")
def known(robot):
    """Quantities of the catalogue by key."""
    return {q.key: q for q in effect_quantities(robot)}


@pytest.fixture(scope="session")
def recording(robot):
    """Both tubes turned by 0.6 rad within 0.3 s, seen by a tracker without noise; 0.3 g more payload than the robot file says."""
    t = np.arange(101) / 100.0
    turn = 0.6 * np.clip(t / 0.3, 0.0, 1.0)[:, None]
    joints = np.column_stack([t, robot.rest.alpha.value + turn, np.tile(robot.rest.beta.value, (len(t), 1))])
    stamps = np.arange(40) / 40.0
    empty = np.tile([1.0, 0.0, 0.0, 0.0], (40, 1))
    blind = Recording("truth", "", {}, joints, np.zeros((0, 7)), stamps, np.zeros((40, 3)), empty, ())
    seen = ForwardModel(blind, robot).predict({("payload_mass", "added_kg"): 3e-4})
    assert not seen.failure
    return Recording("seen", "", {}, joints, np.zeros((0, 7)), stamps, seen.position, seen.quaternion, ())
